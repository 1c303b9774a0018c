"""Read and write solid voxels as a sparse octree: `.voxel.json` and `.voxel.bin`, version 1.1.

SuperSplat and PlayCanvas read this format to stop visitors at walls (PlayCanvas, "Voxel Format", 2026). A
block is 4 x 4 x 4 voxels: 64 bits, bit x + 4 y + 16 z. Blocks are the leaves of an octree in the layout of Laine and
Karras (2010), nodes breadth first: an inner node holds the mask of its children, 8 bits, and the index of the first of
them, 24 bits; a leaf holds the index of its block, or `SOLID` where all is solid. Children follow each other by
x + 2 y + 4 z.

The frame is that of the engine: the frame of the file of Gaussians, rotated by 180 degrees about z. Everything outside
the grid counts as solid.
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.errors import FormatError
from gsvis.files.atomic import atomic_path
from gsvis.files.limits import read_whole

__all__ = ["VOXELS", "Voxels", "load_voxels", "save_voxels"]

Mask = NDArray[np.bool_]
F64 = NDArray[np.float64]
U32 = NDArray[np.uint32]

VOXELS = ".voxel.json"
"""Suffix of the file that users name; `.voxel.bin` lies beside it."""

SOLID = 0xFF000000
_SIDE = 4  # voxels of a block
_MOST = 1 << 24  # nodes, and blocks
_MOST_DEPTH = 12
_MOST_VOXELS = 1 << 28
_MOST_JSON = 1 << 20
_MOST_BIN = 1 << 28


@dataclass(frozen=True, eq=False)
class Voxels:
    """Solid voxels of a box. Scene frame.

    Attributes:
        origin: (3,) lowest corner of voxel (0, 0, 0).
        size: Side of a voxel, scene units.
        solid: (X, Y, Z) mask of solid voxels.
    """

    origin: F64
    size: float
    solid: Mask

    def is_solid(self, points: ArrayLike) -> Mask:
        """Return whether points (P, 3) lie in solid voxels; points outside the box do."""
        at = np.floor((_check.floats("points", points, ("P", 3), np.float64) - self.origin) / self.size)
        inside = np.all((at >= 0) & (at < self.solid.shape), axis=1)
        x, y, z = np.where(inside[:, None], at, 0).astype(int).T
        return np.asarray(~inside | self.solid[x, y, z])


def save_voxels(voxels: Voxels, path: str | os.PathLike[str], *, generator: str = "gsvis") -> None:
    """Write voxels as `NAME.voxel.json` and `NAME.voxel.bin`; each appears whole.

    Args:
        voxels: The voxels.
        path: The file `NAME.voxel.json`.
        generator: Name of the program for the file.

    Raises:
        ValueError: If the path has not that suffix, or there are more than 2^24 nodes.
        OSError: If it cannot be written.
    """
    target = _named(path)
    turned = np.pad(voxels.solid[::-1, ::-1], [(0, -n % _SIDE) for n in voxels.solid.shape], constant_values=True)
    far = voxels.origin + np.array(voxels.solid.shape) * voxels.size
    low = np.array([-far[0], -far[1], voxels.origin[2]])
    high = low + np.array(turned.shape) * voxels.size
    depth = max(1, int(np.ceil(np.log2(max(turned.shape) // _SIDE))))
    nodes, blocks, inner = _encode(turned, depth)
    box = {"min": low.tolist(), "max": high.tolist()}
    said: dict[str, Any] = {
        "version": "1.1",
        "asset": {"generator": generator},
        "gridBounds": box,
        "sceneBounds": {"min": low.tolist(), "max": (low + np.array(voxels.solid.shape) * voxels.size).tolist()},
        "voxelResolution": voxels.size,
        "leafSize": _SIDE,
        "treeDepth": depth,
        "numInteriorNodes": inner,
        "numMixedLeaves": len(blocks),
        "nodeCount": len(nodes),
        "leafDataCount": 2 * len(blocks),
    }
    with atomic_path(_binary(target)) as partial:
        partial.write_bytes(nodes.astype("<u4").tobytes() + blocks.astype("<u8").tobytes())
    with atomic_path(target) as partial:
        partial.write_text(json.dumps(said, indent=2) + "\n", encoding="utf-8")


def load_voxels(path: str | os.PathLike[str]) -> Voxels:
    """Read `NAME.voxel.json` and the `NAME.voxel.bin` beside it.

    Raises:
        ValueError: If the path has not that suffix.
        FormatError: If a file is damaged.
        OSError: If it cannot be read.
    """
    target = _named(path)
    low, size, shape, depth, count, leaves = _header(target)
    binary = _binary(target)
    data = read_whole(binary, _MOST_BIN)
    if len(data) != 4 * count + 8 * leaves:
        raise FormatError(binary, "", f"{4 * count + 8 * leaves:,} bytes", f"{len(data):,}", "write it again")
    nodes = np.frombuffer(data, "<u4", count).astype(np.uint32)
    blocks = np.frombuffer(data, "<u8", leaves, 4 * count).astype(np.uint64)
    turned = _decode(binary, nodes, blocks, depth, shape)
    origin = np.array([-(low[0] + shape[0] * size), -(low[1] + shape[1] * size), low[2]])
    return Voxels(origin, size, np.ascontiguousarray(turned[::-1, ::-1]))


def _named(path: str | os.PathLike[str]) -> Path:
    """Return the path; raise unless it has the suffix."""
    target = _check.path("path", path)
    if not target.name.endswith(VOXELS):
        raise ValueError(f"path: expected a name that ends with {VOXELS}, got {target.name}")
    return target


def _binary(target: Path) -> Path:
    """Return the path of the binary file."""
    return target.with_name(target.name.removesuffix(VOXELS) + ".voxel.bin")


def _encode(solid: Mask, depth: int) -> tuple[U32, NDArray[np.uint64], int]:
    """Return the nodes, the blocks of mixed leaves, and the number of inner nodes."""
    levels = _pyramid(_blocks_of(solid), depth)
    states = [level[0] for level in levels]
    masks = levels[0][1]
    nodes: list[NDArray[np.int64]] = []
    kept: list[NDArray[np.uint64]] = []
    inner = 0
    leaves = 0
    wave = np.zeros((1 if states[-1][0, 0, 0] else 0, 3), np.int64)  # places of the nodes of the current level
    start = len(wave)  # index of the first node of the next level
    for level in range(depth, -1, -1):
        place = tuple(wave.T)
        full = states[level][place] == 2
        values = np.zeros(len(wave), np.int64)
        values[full] = SOLID
        if level == 0:
            mixed = masks[place][~full]
            values[~full] = np.arange(leaves, leaves + len(mixed))
            kept.append(mixed)
            leaves += len(mixed)
            nodes.append(values)
            break
        parents = wave[~full]
        children = 2 * parents[:, None] + _OCTANTS[None]
        held = states[level - 1][tuple(np.moveaxis(children, 2, 0))] > 0
        counts = held.sum(axis=1)
        firsts = start + np.cumsum(counts) - counts
        values[~full] = (held @ (1 << np.arange(8))) << 24 | firsts
        nodes.append(values)
        inner += len(parents)
        wave = children[held]
        start += len(wave)
        if start > _MOST:
            raise ValueError(f"voxels: expected at most {_MOST:,} nodes, got more; use a lower resolution")
    return np.concatenate(nodes).astype(np.uint32), np.concatenate(kept or [np.zeros(0, np.uint64)]), inner


_OCTANTS = np.array([[k & 1, k >> 1 & 1, k >> 2] for k in range(8)])


def _blocks_of(solid: Mask) -> NDArray[np.uint64]:
    """Return the 64 bits of each block of voxels, (X / 4, Y / 4, Z / 4)."""
    x, y, z = (n // _SIDE for n in solid.shape)
    cells = solid.reshape(x, _SIDE, y, _SIDE, z, _SIDE).transpose(0, 2, 4, 5, 3, 1).reshape(x, y, z, 64)
    return np.packbits(cells, axis=3, bitorder="little").view("<u8")[..., 0].astype(np.uint64)


def _pyramid(blocks: NDArray[np.uint64], depth: int) -> list[tuple[NDArray[np.uint8], NDArray[np.uint64]]]:
    """Return for each level of the octree, leaves first, its states (0 empty, 1 mixed, 2 solid) and blocks."""
    side = 1 << depth
    whole = np.zeros((side, side, side), np.uint64)
    x, y, z = blocks.shape
    whole[:x, :y, :z] = blocks
    state = np.where(whole == 0, 0, np.where(whole == np.uint64(0xFFFFFFFFFFFFFFFF), 2, 1)).astype(np.uint8)
    levels = [(state, whole)]
    for _ in range(depth):
        side //= 2
        eight = state.reshape(side, 2, side, 2, side, 2)
        low = eight.min(axis=(1, 3, 5))
        high = eight.max(axis=(1, 3, 5))
        state = np.where(high == 0, 0, np.where(low == 2, 2, 1)).astype(np.uint8)
        levels.append((state, whole[:0]))
    return levels


def _header(path: Path) -> tuple[F64, float, tuple[int, int, int], int, int, int]:
    """Return lowest corner, side, shape, depth, and the numbers of nodes and of blocks, in the frame of the file."""

    def fail(what: str, got: object) -> FormatError:
        """Return the error about a value of the header."""
        return FormatError(path, "", what, repr(got), "write it again")

    try:
        said = json.loads(read_whole(path, _MOST_JSON))
        bounds = np.array([said["gridBounds"]["min"], said["gridBounds"]["max"]], np.float64)
        size = float(said["voxelResolution"])
        sides = said["leafSize"]
        depth, count, words = (said[key] for key in ("treeDepth", "nodeCount", "leafDataCount"))
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise FormatError(path, "", "the header of voxels", str(error)[:80], "write it again") from None
    if bounds.shape != (2, 3) or not np.isfinite(bounds).all() or not (np.isfinite(size) and size > 0.0):
        raise fail("a box and a positive side of voxels", said.get("gridBounds"))
    numbers = (depth, count, words)
    if sides != _SIDE or not all(type(n) is int for n in numbers) or not (1 <= depth <= _MOST_DEPTH):
        raise fail("blocks of 4 voxels and a depth of 1 to 12", (sides, depth))
    if not (0 <= count <= _MOST and 0 <= words <= 2 * _MOST and words % 2 == 0):
        raise fail("at most 2^24 nodes and blocks", (count, words))
    with np.errstate(over="ignore"):  # infinity fails the test below
        cells = np.rint((bounds[1] - bounds[0]) / size)
    if (cells < 1).any() or (cells > _SIDE << depth).any() or (cells % _SIDE).any() or cells.prod() > _MOST_VOXELS:
        raise fail(f"a box of whole blocks within {_SIDE << depth} voxels a side", cells.tolist())
    x, y, z = cells.astype(int).tolist()
    return bounds[0], size, (x, y, z), depth, count, words // 2


def _decode(path: Path, nodes: U32, blocks: NDArray[np.uint64], depth: int, shape: tuple[int, int, int]) -> Mask:
    """Return the (X, Y, Z) solid voxels of an octree."""
    found = np.zeros([n // _SIDE for n in shape], np.uint64)
    wave = np.zeros(min(len(nodes), 1), np.int64)
    places = np.zeros((min(len(nodes), 1), 3), np.int64)
    for level in range(depth, -1, -1):
        values = nodes[wave]
        full = values == SOLID
        for place in places[full].tolist():
            part = tuple(slice(n << level, (n + 1) << level) for n in place)
            found[part] = 0xFFFFFFFFFFFFFFFF
        values = values[~full].astype(np.int64)
        places = places[~full]
        parents = wave[~full]
        if level == 0:
            within = (places < found.shape).all(axis=1)
            if (values >= len(blocks)).any():
                raise FormatError(path, "", f"blocks below {len(blocks):,}", f"{values.max():,}", "write it again")
            found[tuple(places[within].T)] = blocks[values[within]]
            break
        held = (values[:, None] >> 24 >> np.arange(8)) & 1 == 1
        rank = np.cumsum(held, axis=1) - held
        wave = ((values & (_MOST - 1))[:, None] + rank)[held]
        places = (2 * places[:, None] + _OCTANTS[None])[held]
        behind = wave > np.repeat(parents, held.sum(axis=1))
        if not behind.all() or (wave >= len(nodes)).any() or len(wave) > len(nodes):
            got = f"one before it, {wave[~behind][0]:,}" if not behind.all() else f"{len(wave):,} up to {wave.max():,}"
            raise FormatError(path, "", f"children behind their parent, below {len(nodes):,}", got, "write it again")
    bits = np.unpackbits(found.astype("<u8")[..., None].view(np.uint8), axis=3, bitorder="little")
    x, y, z = found.shape
    voxels = bits.reshape(x, y, z, _SIDE, _SIDE, _SIDE).transpose(0, 5, 1, 4, 2, 3)
    return np.asarray(voxels.reshape(shape), bool)
