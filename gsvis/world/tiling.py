"""Split scenes of any size into tiles, batch by batch. Scene frame and units.

There are two passes. The first takes a sample of constant size, from which it finds robust bounds, the up axis, and the
tiles: rectangles of small squares with nearly equal numbers of Gaussians. The second writes each batch as one file for
each tile in it. Memory holds one batch or one tile. The order of scenes and rows does not matter: a hash of its center
decides whether a row is in the sample.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.errors import SceneError
from gsvis.io.batches import Batch, read_batch
from gsvis.jobs.graph import Facts, Given
from gsvis.raycast.proxies import MIN_ALPHA
from gsvis.scene.axes import axis_vector, describe_direction, nearest_axis, snap_to_axis, tilt_of
from gsvis.scene.cameras import Cameras, intrinsics
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.sh import SH_C0
from gsvis.scene.upright import Upright, doubt_up, find_up
from gsvis.world.manifest import Grid
from gsvis.world.rows import content_order, flatten, load_gaussians, save_gaussians

__all__ = [
    "MEMORY",
    "OUTSIDE",
    "VERSIONS",
    "Rect",
    "TilingConfig",
    "cut_squares",
    "find_grid",
    "grid_of",
    "sample_rows",
    "sampling_interval",
    "split_batch",
    "thin_out",
    "tile_name",
    "tiles_of",
]

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

VERSIONS = {"sample_rows": 2, "find_grid": 5, "split_batch": 3}

_GUESSED = 1 << 18  # assumed Gaussians of a batch whose number is unknown until it is read

OUTSIDE = "outside"
"""Name of the tile of the Gaussians outside all squares."""

_SAMPLE = 1 << 19  # approximate rows of the sample
_MARGIN = 0.25  # share of the robust box that is added to each side
_SQUARES = 64  # squares along a side for each tile along it
_MOST_SIDE = 1 << 11  # most squares along the longer side of the grid
_FILL = 0.95  # share of `most` that a tile of a part with more can have: cuts lie between squares
_SURE = 2.0  # standard deviations of the sampled number of Gaussians of a full tile that are left free

Rect = tuple[int, int, int, int]
"""A rectangle of squares: the first square along each axis, then the number of squares along each axis."""


@dataclass(frozen=True)
class TilingConfig:
    """How a world is cut.

    Attributes:
        most: Approximate largest number of Gaussians of a tile; a rectangle with more is cut across its longer side.
        coverage: Share of the centers inside the robust box on each axis.
        up: The up axis: a name such as "+z", or a direction (3,). None takes it from the files, else from the cameras,
            else estimates it. Squares are along the two axes that are nearest to horizontal.

    Raises:
        ValueError: If a value is out of range.
    """

    most: int = 250_000
    coverage: float = 0.98
    up: str | tuple[float, float, float] | None = None

    def __post_init__(self) -> None:
        _check.positive_int("most", self.most)
        if not 0.5 <= self.coverage < 1.0:
            raise ValueError(f"coverage: expected a share in [0.5, 1), got {self.coverage!r}")
        if self.up is not None:
            _direction(self.up)


def sample_rows(params: Facts, given: Given, out: Path, work: Path) -> Facts:
    """Task: write the rows of a batch that are in the sample: about one of `every` rows.

    Facts: the number of Gaussians in the batch and in the sample, and the SH degree.
    """
    g = read_batch(Batch(**params["batch"]))
    flat = flatten(thin_out(g, params["every"]))
    save_gaussians(out / "sample", flat)
    return {"gaussians": len(g), "sampled": len(flat), "sh_degree": g.sh_degree}


def thin_out(g: Gaussians, every: int) -> Gaussians:
    """Return about one in `every` visible Gaussians, the same ones whatever the order of the input."""
    return g[(_hashes(g.means) % np.uint32(every) == 0) & (g.opacities >= MIN_ALPHA)]


def find_grid(params: Facts, given: Given, out: Path, work: Path) -> Facts:
    """Task: find the grid from all samples.

    Params: `config`, `every`, and `cameras`, world-to-camera matrices (C, 4, 4) that help to find the up axis.

    Facts: `grid`; `up` (3,) and `remarks` on it; `bottom` and `top` on the axis that is not cut; `tiles`, their
    rectangles of squares, by first square; `expected`, the Gaussians of each by the sample; and `tree`, how they were
    cut (see `cut_squares`).
    """
    parts = [load_gaussians(given.path(k, "sample")) for k in range(len(given)) if given.inputs[k].facts["sampled"]]
    if not parts:
        raise SceneError("the scene has no Gaussian with an opacity of at least 1/255: there is nothing to see")
    sample = Gaussians.concatenate(parts)
    config = TilingConfig(**params["config"])
    sample = sample[content_order(sample)]
    upright = _find_up(sample, config, params.get("cameras"))
    low, high = sample.bounds(config.coverage)
    spread = np.maximum(_MARGIN * (high - low), 3.0 * float(np.median(sample.scales)))
    low = low - spread
    high = high + spread
    cut = int(np.abs(axis_vector(nearest_axis(upright.up))).argmax())  # the squares lie along axes
    axes = [axis for axis in range(3) if axis != cut]
    inside = sample.means[((sample.means >= low) & (sample.means <= high)).all(axis=1)].astype(np.float64)
    every = params["every"]
    most = _most_by_sample(config.most, every)
    number = _SQUARES * math.sqrt(max(1.0, len(inside) * every / config.most))
    while True:
        number = min(number, _MOST_SIDE)
        side = float((high - low)[axes].max()) / math.ceil(number)
        shape = np.maximum(np.ceil((high - low)[axes] / side - 1e-9), 1).astype(int)
        squares = np.floor((inside[:, axes] - low[axes]) / side).astype(int).clip(0, shape - 1)
        counts = every * np.bincount(squares[:, 0] * shape[1] + squares[:, 1], minlength=int(shape.prod()))
        tiles, expected, tree = cut_squares(counts.reshape(shape), most)
        if max(expected, default=0) <= most or number >= _MOST_SIDE:
            break
        number *= 2
    grid = Grid(_triple(low), side, (axes[0], axes[1]), (int(shape[0]), int(shape[1])))
    return {
        "grid": asdict(grid),
        "up": [float(value) for value in upright.up],
        "remarks": _describe_up(upright, axes),
        "bottom": float(low[cut]),
        "top": float(high[cut]),
        "tiles": tiles,
        "expected": expected,
        "tree": tree,
    }


def _find_up(sample: Gaussians, config: TilingConfig, viewmats: Any) -> Upright:
    """Return the up axis: as given, else from the files, else estimated from cameras and Gaussians."""
    cameras = None
    if viewmats:
        cameras = Cameras(viewmats, np.tile(intrinsics(64, 48, 60.0), (len(viewmats), 1, 1)), 64, 48)
    if config.up is not None:
        known = _direction(config.up)
        return Upright(known, 1.0, "given by --up", doubt_up(sample, known, cameras=cameras))
    found = find_up(sample, cameras=cameras)
    return found if sample.facts.up is not None else replace(found, up=snap_to_axis(found.up))


def _describe_up(upright: Upright, axes: Sequence[int]) -> list[str]:
    """Return lines for the user about the up axis: doubts, contradictions, and a tilt to the squares."""
    found = []
    where = describe_direction(upright.up)
    if not upright.sure:
        found.append(
            f"Not sure: up was estimated as {where} with a confidence of {upright.confidence:.0%}; give --up or"
            " --cameras."
        )
    if upright.doubt:
        found.append(f"Check the up axis: {upright.doubt}")
    if tilt_of(upright.up, axis_vector(nearest_axis(upright.up))) > 1.0:
        level = " and ".join("xyz"[axis] for axis in axes)
        found.append(f"Up is {where}: tiles are cut along {level}, eyes and views follow the true up.")
    return found


def _direction(up: str | Sequence[float]) -> F64:
    """Return the unit vector (3,) of an axis name or a direction."""
    if isinstance(up, str):
        return axis_vector(up)
    rows = _check.unit_vectors("up", np.reshape(np.asarray(up, np.float64), (1, -1)))
    return np.asarray(rows[0], np.float64)


def cut_squares(counts: I64, most: int) -> tuple[list[Rect], list[int], Any]:
    """Cut a grid into few rectangles with at most `most` Gaussians each.

    A rectangle with more is cut across its longer side, where both parts need fewest tiles, and of such places at the
    one that halves it best, but not in the outer quarters of the side.

    Args:
        counts: (X, Y) Gaussians of each square.
        most: Most Gaussians of a rectangle; a single square may have more.

    Returns:
        tiles: The rectangles with Gaussians, by first square.
        counts: Number of Gaussians of each.
        tree: How they were cut: the number of a rectangle, a pair of such trees, or None for an empty rectangle.
    """
    found: dict[Rect, int] = {}

    def cut(x: int, y: int, width: int, height: int) -> Any:
        """Cut a rectangle; return its tree of rectangles."""
        block = counts[x : x + width, y : y + height]
        total = int(block.sum())
        if total <= most or width * height == 1:
            if total:
                found[x, y, width, height] = total
            return (x, y, width, height) if total else None
        across = width >= height
        before = np.cumsum(block.sum(axis=1 if across else 0))
        least = max(1, len(before) // 4)
        at = least + _best_cut(before[least - 1 : len(before) - least], total, most)
        if across:
            return [cut(x, y, at, height), cut(x + at, y, width - at, height)]
        return [cut(x, y, width, at), cut(x, y + at, width, height - at)]

    tree = cut(0, 0, *counts.shape)
    tiles = sorted(found)
    numbers = {rect: k for k, rect in enumerate(tiles)}

    def numbered(node: Any) -> Any:
        """Return a tree with numbers in place of rectangles."""
        return [numbered(each) for each in node] if isinstance(node, list) else numbers.get(node)

    return tiles, [found[rect] for rect in tiles], numbered(tree)


def _best_cut(before: I64, total: int, most: int) -> int:
    """Return the number of the cut after which both parts need fewest tiles, and which halves best of these.

    Args:
        before: (C,) Gaussians before each cut.
        total: Gaussians of both parts.
        most: Most Gaussians of a tile.
    """
    tiles = _fewest_tiles(before, most) + _fewest_tiles(total - before, most)
    return int(np.lexsort((np.abs(2 * before - total), tiles))[0])


def _fewest_tiles(counts: I64, most: int) -> F64:
    """Return about how many tiles parts with some numbers (C,) of Gaussians need, at least."""
    return np.where(counts <= most, np.sign(counts), np.ceil(counts / (_FILL * most)))


def _most_by_sample(most: int, every: int) -> int:
    """Return the most sampled Gaussians of a tile, times `every`, so that it hardly has more than `most` in truth."""
    return most if every == 1 else max(1, int(most - _SURE * math.sqrt(most * every)))


def split_batch(params: Facts, given: Given, out: Path, work: Path) -> Facts:
    """Task: write the rows of a batch as one file for each tile. The input is the grid.

    Facts: `counts`, the number of rows of each tile; `reach`, least and largest value of each color component.
    """
    g = read_batch(Batch(**params["batch"]))
    found = given.inputs[0].facts
    keys = tiles_of(g.means, found)
    order = np.argsort(keys, kind="stable")
    tiles, first = np.unique(keys[order], return_index=True)
    counts = {}
    for key, rows in zip(tiles.tolist(), np.split(order, first[1:]), strict=True):
        name = tile_name(None if key < 0 else found["tiles"][key])
        save_gaussians(out / name, g[rows])
        counts[name] = len(rows)
    colors = np.maximum(0.5 + SH_C0 * g.sh0[:, 0].astype(np.float64), 0.0) if len(g) else np.full((1, 3), 0.5)
    return {"counts": counts, "reach": np.stack([colors.min(axis=0), colors.max(axis=0)], axis=1).tolist()}


def tiles_of(points: NDArray[np.floating[Any]], found: Facts) -> I64:
    """Return the tile (M,) of each point (M, 3), an index of `tiles` in the facts of `find_grid`; -1 outside."""
    grid = grid_of(found["grid"])
    upright = 3 - sum(found["grid"]["axes"])
    squares = grid.squares_of(points)
    heights = points[:, upright]
    squares[(heights < found["bottom"]) | (heights > found["top"])] = -1
    owners = np.full(grid.shape, -1)
    for k, (x, y, width, height) in enumerate(found["tiles"]):
        owners[x : x + width, y : y + height] = k
    return np.where(squares[:, 0] < 0, -1, owners[squares[:, 0], squares[:, 1]])


def tile_name(rect: Rect | None) -> str:
    """Return the name of a tile in files and messages: its first square."""
    return OUTSIDE if rect is None else f"{rect[0]}-{rect[1]}"


def grid_of(value: Facts) -> Grid:
    """Return the grid from the facts of `find_grid`."""
    origin = value["origin"]
    axes = value["axes"]
    shape = value["shape"]
    return Grid(_triple(origin), value["side"], (axes[0], axes[1]), (shape[0], shape[1]))


def sampling_interval(gaussians: int) -> int:
    """Return the sampling interval for a number of Gaussians: one row of so many is in the sample."""
    return max(1, gaussians // _SAMPLE)


def _hashes(means: NDArray[np.float32]) -> NDArray[np.uint32]:
    """Return hashes (N,) of centers (N, 3), evenly spread.

    References:
        The finalizer of MurmurHash3.
    """
    bits = np.ascontiguousarray(means, "<f4").view("<u4")
    mixed = bits[:, 0] * np.uint32(0x9E3779B1) ^ bits[:, 1] * np.uint32(0x85EBCA77) ^ bits[:, 2] * np.uint32(0xC2B2AE3D)
    for shift, factor in ((16, 0x85EBCA6B), (13, 0xC2B2AE35)):
        mixed = (mixed ^ (mixed >> np.uint32(shift))) * np.uint32(factor)
    return np.asarray(mixed ^ (mixed >> np.uint32(16)))


def _triple(values: F64 | list[float]) -> tuple[float, float, float]:
    """Return three numbers as a tuple of floats."""
    x, y, z = (float(v) for v in values)
    return x, y, z


def _memory_of_batch(params: Facts, inputs: Sequence[Facts]) -> int:
    """Return the bytes that `sample_rows` and `split_batch` need."""
    count = params["batch"]["count"]
    return int((10 << 20) + 200 * (count if count >= 0 else max(_GUESSED, params["batch"]["nbytes"] // 16)))


def _memory_of_grid(params: Facts, inputs: Sequence[Facts]) -> int:
    """Return the bytes that `find_grid` needs."""
    return int((20 << 20) + 450 * sum(each["sampled"] for each in inputs))


MEMORY = {"sample_rows": _memory_of_batch, "find_grid": _memory_of_grid, "split_batch": _memory_of_batch}
"""The bytes that tasks need beyond an idle process."""
