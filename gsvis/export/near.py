"""Round a bare scene for pages on the same machine: blocks of space one by one, by several threads.

Nobody downloads such a scene, so nothing here looks for fewer bytes: each Gaussian has a set of harmonics of its own,
in the order of the Gaussians. The rounding is that of `gsvis.export.bare`. Scene frame and units.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gsvis.color.records import Grids
from gsvis.export.bare import BareScene, base_grids, base_places
from gsvis.export.harmonics import Harmonics, Palette, mean_squares
from gsvis.export.lights import areas_of
from gsvis.jobs.in_order import in_order
from gsvis.package.codec import ChunkTable, build_chunks, encode_records
from gsvis.package.contents import Contents
from gsvis.package.layout import RecordLayout, TermLayout
from gsvis.package.order import PackageOrder
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels
from gsvis.scene.morton import morton_codes

__all__ = ["NearScene", "encode_near"]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]

_ALONE = 1 << 20  # Gaussians up to which a scene is one block
_BLOCKS = 4  # of a larger one, at least
_MOST = 1 << 21  # Gaussians of a block, about
_RUNS = 64  # of neighbors in a block in which lattices are looked for, at most
_SAMPLE = 1 << 16  # Gaussians from which the frame of the curve is found
_MIDDLE = (0.01, 0.99)  # quantiles between which it lies


@dataclass(frozen=True, eq=False)
class NearScene:
    """N Gaussians as records, and what was known of them before.

    Attributes:
        scene: The records and the sets of harmonics.
        means: (N, 3) centers, in the order of the records.
        lights: (N,) area times opacity.
    """

    scene: BareScene
    means: F32
    lights: F64


class _Block(NamedTuple):
    """M Gaussians of a block: records and chunks, first Gaussians of parts and M, harmonics, and what they were."""

    records: U8
    table: ChunkTable
    starts: I64
    sets: U8
    squares: F64
    means: F32
    lights: F64


def encode_near(g: Gaussians) -> NearScene:
    """Return the records of Gaussians.

    Raises:
        ValueError: If there are none.
    """
    if len(g) == 0:
        raise ValueError("scene: expected at least one Gaussian, got none; name another scene")
    grids = base_grids(g.sh0[:, 0])
    ranges = Harmonics.from_coefficients(g.shN, g.sh_degree) if g.sh_degree else None

    def encode(ids: I64) -> _Block:
        """Return a block."""
        return _encode_block(g, ids, grids, ranges)

    blocks = list(in_order(encode, _blocks_of(g.means)))
    joined = [np.concatenate([getattr(block, name) for block in blocks]) for name in ("records", "means", "lights")]
    records, means, lights = joined
    firsts = np.cumsum([0, *(len(block.records) for block in blocks)])
    starts = [block.starts[:-1] + first for block, first in zip(blocks, firsts[:-1], strict=True)]
    table = ChunkTable.concatenate([block.table for block in blocks])
    contents = Contents(
        Levels.single(g[:1]).names,
        table,
        np.zeros((len(table), 2), np.uint8),
        records,
        np.zeros(len(g), np.uint8),
        np.zeros((0, TermLayout.from_grids(grids).nbytes), np.uint8),
        grids,
        np.concatenate([*starts, firsts[-1:]]),
        g.facts,
    )
    if ranges is None:
        return NearScene(BareScene(contents, None, None), means, lights)
    sets = np.concatenate([block.sets for block in blocks])
    squares = np.concatenate([block.squares for block in blocks])
    return NearScene(BareScene(contents, ranges, Palette.of_each(sets, lights, squares)), means, lights)


def _encode_block(g: Gaussians, ids: I64, grids: Grids, ranges: Harmonics | None) -> _Block:
    """Return the block of some Gaussians of a scene.

    Args:
        g: The scene.
        ids: (M,) Gaussians in the block.
        grids: Tables of base colors.
        ranges: Ranges of harmonics; None in degree 0.
    """
    own = g.without_harmonics()[ids]
    order = PackageOrder.from_levels(Levels.single(own), runs=_RUNS)
    own = own[order.permutation]
    layout = RecordLayout.from_variant(grids.variant)
    table = build_chunks(own, layout, starts=order.chunks, lattices=order.lattices)
    records = encode_records(own, base_places(own.sh0[:, 0], grids), table, layout)
    lights = areas_of(own) * own.opacities
    if ranges is None:
        return _Block(records, table, order.starts, np.zeros((0, 0), np.uint8), np.zeros(0), own.means, lights)
    coefficients = g.shN[ids]
    sets = ranges.encode(coefficients)[order.permutation]
    squares = mean_squares(coefficients)[order.permutation]
    return _Block(records, table, order.starts, sets, squares, own.means, lights)


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
