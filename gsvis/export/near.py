"""Write a bare scene for pages on the same machine: the arrays that a page gives to the GPU, block by block of space.

Nobody downloads such a scene, so nothing here looks for fewer bytes: records and rows of chunks are not coded, and each
Gaussian has a set of harmonics of its own beside its record. The rounding is that of `gsvis.export.bare`.
docs/static.md describes a part to the byte. Several threads work. Scene frame and units.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gsvis.color.records import Grids
from gsvis.export._kernels.sets import pack_sets
from gsvis.export.bare import base_grids, base_places
from gsvis.export.harmonics import ZERO, Harmonics
from gsvis.export.index import Spheres
from gsvis.export.lights import areas_of
from gsvis.jobs.in_order import in_order
from gsvis.package.codec import ChunkTable, build_chunks, encode_records, packed_bits
from gsvis.package.layout import RecordLayout
from gsvis.package.order import PackageOrder
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels
from gsvis.scene.morton import morton_codes

__all__ = ["NearScene", "encode_near"]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]

HEAD = struct.Struct("<4I")
"""Id of the first Gaussian, Gaussians, chunks, bytes of a set."""

_TEXEL = 16  # bytes, of which a set has a whole number
_ALONE = 1 << 20  # Gaussians up to which a scene is one block
_BLOCKS = 4  # of a larger one, at least
_MOST = 1 << 21  # Gaussians of a block, about
_RUNS = 64  # of neighbors in a block in which lattices are looked for, at most
_SAMPLE = 1 << 16  # Gaussians from which the frame of the curve is found
_MIDDLE = (0.01, 0.99)  # quantiles between which it lies
_IN_SPHERE = 1 << 10  # Gaussians from which the sphere of a part is found, about


@dataclass(frozen=True, eq=False)
class NearScene:
    """N Gaussians as P parts.

    Attributes:
        parts: The content of the file of each part.
        counts: (P,) Gaussians of each.
        lights: (P,) area times opacity, summed over the Gaussians of each.
        spheres: Where the light of each part is.
        chunks: Number of chunks.
        grids: Tables of base colors.
        ranges: Ranges of harmonics; None in degree 0.
    """

    parts: list[memoryview]
    counts: I64
    lights: F64
    spheres: Spheres
    chunks: int
    grids: Grids
    ranges: Harmonics | None


class _Block(NamedTuple):
    """Some parts: content, Gaussians, light and chunks of each, and means and lights of some Gaussians of each."""

    parts: list[memoryview]
    counts: list[int]
    lights: list[float]
    chunks: int
    means: list[F32]
    weights: list[F64]


def encode_near(g: Gaussians) -> NearScene:
    """Return the parts of a scene.

    Raises:
        ValueError: If there are no Gaussians.
    """
    if len(g) == 0:
        raise ValueError("scene: expected at least one Gaussian, got none; name another scene")
    grids = base_grids(g.sh0[:, 0])
    ranges = Harmonics.from_coefficients(g.shN, g.sh_degree) if g.sh_degree else None
    members = _blocks_of(g.means)
    firsts = np.cumsum([0, *map(len, members[:-1])]).tolist()

    def encode(block: tuple[int, I64]) -> _Block:
        """Return the parts of a block."""
        first, ids = block
        return _encode_block(g, ids, first, grids, ranges)

    blocks = list(in_order(encode, zip(firsts, members, strict=True)))
    means = [some for block in blocks for some in block.means]
    ends = np.cumsum([0, *map(len, means)]).tolist()
    weights = np.concatenate([some for block in blocks for some in block.weights])
    spheres = Spheres.from_parts([np.arange(low, high) for low, high in pairwise(ends)], np.concatenate(means), weights)
    return NearScene(
        parts=[part for block in blocks for part in block.parts],
        counts=np.array([count for block in blocks for count in block.counts]),
        lights=np.array([light for block in blocks for light in block.lights]),
        spheres=spheres,
        chunks=sum(block.chunks for block in blocks),
        grids=grids,
        ranges=ranges,
    )


def _encode_block(g: Gaussians, ids: I64, first: int, grids: Grids, ranges: Harmonics | None) -> _Block:
    """Return the parts of a block.

    Args:
        g: The scene.
        ids: (M,) Gaussians in the block.
        first: Id of the first of them in the static form.
        grids: Tables of base colors.
        ranges: Ranges of harmonics; None in degree 0.
    """
    own = g.without_harmonics()[ids]
    order = PackageOrder.from_levels(Levels.single(own), runs=_RUNS)
    own = own[order.permutation]
    ids = ids[order.permutation]
    layout = RecordLayout.from_variant(grids.variant)
    table = build_chunks(own, layout, starts=order.chunks, lattices=order.lattices)
    records = encode_records(own, base_places(own.sh0[:, 0], grids), table, layout)
    lights = areas_of(own) * own.opacities
    found = _Block([], [], [], len(table), [], [])
    cuts = np.searchsorted(order.chunks, order.starts).tolist()
    for (low, high), (start, end) in zip(pairwise(order.starts.tolist()), pairwise(cuts), strict=True):
        some = slice(low, high, max(1, (high - low) // _IN_SPHERE))
        part = _Part(first + low, table[start:end], records[low:high], ids[low:high])
        found.parts.append(part.to_bytes(g.shN, ranges).data)
        found.counts.append(high - low)
        found.lights.append(float(lights[low:high].sum()))
        found.means.append(own.means[some])
        found.weights.append(lights[some])
    return found


class _Part(NamedTuple):
    """G Gaussians of a part: id of the first, C rows of chunks, records (G, 16), and places (G,) in the scene."""

    first: int
    table: ChunkTable
    records: U8
    ids: I64

    def to_bytes(self, coefficients: F32, ranges: Harmonics | None) -> U8:
        """Return the content of the file (B,); `coefficients` (N, K, 3) are those of the scene."""
        count = len(self.ids)
        chunks = len(self.table)
        width = 0 if ranges is None else -(-3 * len(ranges.high) // _TEXEL) * _TEXEL
        at = HEAD.size + 36 * chunks
        out = np.zeros(at + (len(self.records[0]) + width) * count, np.uint8)
        HEAD.pack_into(out.data, 0, self.first, count, chunks, width)
        rows = out[HEAD.size : at - 4 * chunks].view("<f4").reshape(chunks, 8)
        rows[:, :3] = self.table.origins
        rows[:, 3] = self.table.lows
        rows[:, 4:7] = self.table.steps
        rows[:, 7] = self.table.strides
        sizes = self.table.counts + (packed_bits(self.table.bits).astype(np.uint32) << 16)
        out[at - 4 * chunks : at] = sizes.astype("<u4").view(np.uint8)
        end = at + self.records.size
        out[at:end] = self.records.reshape(-1)
        if ranges is not None:
            factors = np.repeat(np.float32(255 - ZERO) / ranges.high, 3)
            pack_sets(coefficients.reshape(len(coefficients), -1), self.ids, factors, out[end:].reshape(count, width))
        return out


def _blocks_of(means: F32) -> list[I64]:
    """Return the ids of the Gaussians of each block: equally many, along a Morton curve."""
    n = len(means)
    if n <= _ALONE:
        return [np.arange(n)]
    count = max(_BLOCKS, -(-n // _MOST))
    low, high = np.quantile(means[:: max(1, n // _SAMPLE)].astype(np.float64), _MIDDLE, axis=0)
    codes = morton_codes(means, (low + high) / 2.0, max(float((high - low).max()) / 2.0, 1e-9))
    cuts = np.arange(1, count) * n // count
    block = np.searchsorted(np.partition(codes, cuts)[cuts], codes, side="right")
    return [ids for k in range(count) if len(ids := np.flatnonzero(block == k))]
