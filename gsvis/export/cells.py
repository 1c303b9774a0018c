"""Rows of the cells of a static scene: for each cell the blocks that it sees, and how much each counts there.

A row is a bitmap of blocks, lowest bit first; a byte for the gain of each block in it; and, where the scene has active
terms, a byte for the share of the block's terms that are active in the cell; each row is compressed by itself. A scene
without visible sets has one cell that sees everything.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsvis.abr import AbrConfig
from gsvis.abr.index import extents
from gsvis.export.blocks import GAIN_STEPS, Blocks, quantize_gains
from gsvis.export.columns import column, compress, differences
from gsvis.package.package import Package
from gsvis.progress import Progress
from gsvis.pvs.cells import CellGrid
from gsvis.scene.gaussians import Gaussians
from gsvis.stream.scene import class_weights

__all__ = ["CellRows", "rows_of_package", "rows_of_scene"]

F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]

REPLACED = AbrConfig().replaced
"""Share of the area of its replacements after which a Gaussian is no longer drawn, as on a server."""


@dataclass(frozen=True, eq=False)
class CellRows:
    """The cells of a scene, as written.

    Attributes:
        grid: The cells; None for one cell that sees everything.
        top: Quarters of an octave of the gain that byte 255 stands for.
        active: Whether rows have shares of active terms.
        rows: The row of each cell.
    """

    grid: CellGrid | None
    top: int
    active: bool
    rows: tuple[bytes, ...]

    def index(self) -> bytes:
        """Return the content of `grid`: the box of each cell, and the bytes of its row."""
        boxes = np.zeros((len(self.rows), 3), np.int64) if self.grid is None else self.grid.coords
        sizes = [len(row) for row in self.rows]
        return compress(*(column(differences(boxes[:, axis]), 4) for axis in range(3)), column(sizes, 4))


def rows_of_scene(g: Gaussians, blocks: Blocks) -> CellRows:
    """Return one row with all blocks; a Gaussian counts by its opacity times its mean cross-section."""
    gains = blocks.sums(np.arange(len(g)), _areas(g) * g.opacities)
    top = _top(gains)
    return CellRows(None, top, False, (compress(_row(gains, top, np.ones(len(blocks), np.bool_))),))


def gains_of_package(package: Package, g: Gaussians) -> F64 | None:
    """Return for each of N Gaussians the sum over cells of its weight there times its mean cross-section.

    None if the package has no visible sets.
    """
    if package.manifest.visibility is None:
        return None
    sets, weights, found = package.visibility, class_weights(package.visibility), np.zeros(len(g))
    for cell in range(len(sets)):
        ids, classes = sets.classes(cell)
        found[ids] += weights[classes]
    return found * _areas(g)


def rows_of_package(package: Package, g: Gaussians, blocks: Blocks, progress: Progress) -> CellRows:
    """Return a row for each cell; a Gaussian counts by its weight in the cell times its mean cross-section.

    Args:
        package: A package.
        g: Its decoded Gaussians.
        blocks: Its blocks.
        progress: Called with stage "sets", in cells.
    """
    if package.manifest.visibility is None:
        return rows_of_scene(g, blocks)
    sets, areas, weights = package.visibility, _areas(g), class_weights(package.visibility)
    top = _top(blocks.sums(np.arange(len(g)), areas))
    shares = None if package.epsilon is None else _shares(package, blocks)
    rows = []
    progress("sets", 0, len(sets))
    for cell in range(len(sets)):
        ids, classes = sets.classes(cell)
        gains = blocks.sums(ids, areas[ids] * weights[classes])
        seen = np.bincount(blocks.of_ids[ids], minlength=len(blocks)) > 0
        of_terms = b"" if shares is None else shares(cell)[seen].tobytes()
        rows.append(compress(_row(gains, top, seen), of_terms))
        progress("sets", cell + 1, len(sets))
    return CellRows(sets.grid, top, shares is not None, tuple(rows))


def _shares(package: Package, blocks: Blocks) -> Callable[[int], U8]:
    """Return a function of a cell: (B,) share of the terms of each block that are active there, in 255ths."""
    contents, active = package.contents, package.active_terms
    owners = np.repeat(blocks.of_ids, contents.term_counts)
    totals = np.maximum(np.bincount(owners, minlength=len(blocks)), 1)

    def shares(cell: int) -> U8:
        found = np.bincount(owners[active.active_ids(cell)], minlength=len(blocks))
        return np.ceil(found * 255 / totals).astype(np.uint8)

    return shares


def _row(gains: F64, top: int, seen: NDArray[np.bool_]) -> bytes:
    return np.packbits(seen, bitorder="little").tobytes() + quantize_gains(gains[seen], top).tobytes()


def _areas(g: Gaussians) -> F64:
    """Return (N,) mean cross-sections, none so large that sums overflow."""
    return np.minimum(extents(g)[1].astype(np.float64), 1e30)


def _top(gains: F64) -> int:
    return int(np.ceil(GAIN_STEPS * np.log2(max(gains.max(initial=0.0), 1e-300))))


def replaced_rows(
    offsets: NDArray[np.int64], ids: NDArray[np.int32], blocks: Blocks, ending: NDArray[np.int64], g: Gaussians
) -> bytes:
    """Return the content of `replaced`: what replaces each Gaussian that ends below the highest level, block by block.

    Named are the fewest blocks that hold `REPLACED` of the area of its replacements: a page reads this beside the
    records, and all blocks would take more bytes than the records themselves.

    Args:
        offsets: (N + 1,) of `gsvis.abr.index.nearest_replacements`.
        ids: Their replacements.
        blocks: The blocks.
        ending: (E,) blocks whose Gaussians end below the highest level, ascending.
        g: The N Gaussians.
    """
    rows = list(_replaced(offsets, ids, blocks, ending, _areas(g)))
    ends = 4 * (len(rows) + 1) + np.concatenate([[0], np.cumsum([len(row) for row in rows])])
    return ends.astype("<u4").tobytes() + b"".join(rows)


def _replaced(
    offsets: NDArray[np.int64], ids: NDArray[np.int32], blocks: Blocks, ending: NDArray[np.int64], areas: F64
) -> Iterator[bytes]:
    for block in ending.tolist():
        members = blocks.order[blocks.starts[block] : blocks.starts[block + 1]].tolist()
        lists = [_main_blocks(ids[offsets[g] : offsets[g + 1]], blocks, areas) for g in members]
        yield bytes(len(each) for each in lists) + np.concatenate(lists).astype("<u4").tobytes()


def _main_blocks(ids: NDArray[np.int32], blocks: Blocks, areas: F64) -> NDArray[np.int32]:
    """Return the fewest blocks, ascending, that hold `REPLACED` of the area of some Gaussians; at most 255."""
    found, of = np.unique(blocks.of_ids[ids], return_inverse=True)
    held = np.bincount(of, areas[ids], minlength=len(found))
    order = np.argsort(-held, kind="stable")
    before = np.cumsum(held[order]) - held[order]
    return np.sort(found[order[before < REPLACED * held.sum()]][:255])
