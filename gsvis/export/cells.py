"""Write the rows of the cells of a static scene: the blocks that each cell sees, and their gains there.

A row is a bitmap of blocks, lowest bit first; a byte for the gain of each block in it; and, where the scene has active
terms, for each layer a byte for what the block's terms there are worth in the cell; each row is compressed by itself. A
scene without visible sets has one cell that sees everything.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsvis.abr import AbrConfig
from gsvis.abr.index import extents, nearest_replacements
from gsvis.color.activation import Activation
from gsvis.export.blocks import BLOCK, GAIN_STEPS, Blocks, quantize_gains
from gsvis.export.columns import column, compress, differences
from gsvis.export.layers import LAYERS
from gsvis.package.package import Package
from gsvis.progress import Progress
from gsvis.pvs.cells import CellGrid
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels
from gsvis.stream.source import class_weights

__all__ = ["CellRows", "rows_of_package", "rows_of_scene"]

F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]

REPLACED = AbrConfig().replaced
"""Share of the area of a Gaussian's replacements from which the Gaussian is hidden, as on a server."""

_SPHERE = 4.0 * np.pi  # largest solid angle


@dataclass(frozen=True, eq=False)
class CellRows:
    """The cells of a scene, as written.

    Attributes:
        grid: The cells; None for one cell that sees everything.
        top: Quarters of an octave of the gain that byte 255 stands for.
        active: Whether rows hold the worth of terms.
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
    sets = package.visibility
    weights = class_weights(package.visibility)
    found = np.zeros(len(g))
    for cell in range(len(sets)):
        ids, classes = sets.classes(cell)
        found[ids] += weights[classes]
    return found * _areas(g)


def rows_of_package(
    package: Package, g: Gaussians, blocks: Blocks, items: NDArray[np.int64], progress: Progress
) -> CellRows:
    """Return a row for each cell; a Gaussian counts by its weight times its solid angle from the middle of the cell.

    Args:
        package: A package of T terms.
        g: Its decoded Gaussians.
        blocks: Its B blocks.
        items: (T,) item of each term, from `items_of`.
        progress: Called with stage "sets", in cells.
    """
    if package.manifest.visibility is None:
        return rows_of_scene(g, blocks)
    sets = package.visibility
    areas = _areas(g)
    weights = class_weights(package.visibility)
    grid = sets.grid
    near = sets.grid.cell_size / 2.0
    worth = None if package.epsilon is None else _TermWorth(package, g, items, len(blocks))
    top = _top(np.array([BLOCK * _SPHERE]))
    rows = []
    progress("sets", 0, len(sets))
    for cell in range(len(sets)):
        ids, classes = sets.classes(cell)
        squared = np.square(g.means[ids] - grid.centers[cell]).sum(axis=1)
        lights = np.zeros(len(g))
        lights[ids] = weights[classes] * np.minimum(areas[ids] / np.maximum(squared, near * near), _SPHERE)
        gains = blocks.sums(ids, lights[ids])
        seen = np.bincount(blocks.of_ids[ids], minlength=len(blocks)) > 0
        of_terms = b"" if worth is None else worth.of_cell(cell, grid.centers[cell], lights)[:, seen].tobytes()
        rows.append(compress(_row(gains, top, seen), of_terms))
        progress("sets", cell + 1, len(sets))
    return CellRows(grid, top, worth is not None, tuple(rows))


class _TermWorth:
    """The worth of the items of a package in its cells."""

    def __init__(self, package: Package, g: Gaussians, items: NDArray[np.int64], count: int) -> None:
        contents = package.contents
        self._active = package.active_terms
        self._changes = Activation(contents.colors().dequantize(), g.means, self._active.epsilon)
        self._owners = np.repeat(np.arange(len(g)), contents.term_counts)
        self._items = items
        self._count = count

    def of_cell(self, cell: int, middle: F64, lights: F64) -> U8:
        """Return (LAYERS, B) octaves above 2^-128 of the sums over active terms of squared change times light (N,)."""
        active = self._active.active_ids(cell)
        changes = np.maximum(self._changes.contributions(middle)[active], self._active.epsilon).astype(np.float64)
        values = np.square(changes) * lights[self._owners[active]]
        found = np.bincount(self._items[active], values, minlength=LAYERS * self._count)
        octaves = np.rint(np.log2(np.maximum(found, np.finfo(np.float64).tiny))) + 128
        return np.where(found > 0, np.clip(octaves, 1, 255), 0).astype(np.uint8).reshape(LAYERS, self._count)


def _row(gains: F64, top: int, seen: NDArray[np.bool_]) -> bytes:
    """Return the row of a cell, not yet compressed."""
    return np.packbits(seen, bitorder="little").tobytes() + quantize_gains(gains[seen], top).tobytes()


def _areas(g: Gaussians) -> F64:
    """Return (N,) mean cross-sections, none so large that sums overflow."""
    return np.minimum(extents(g)[1].astype(np.float64), 1e30)


def _top(gains: F64) -> int:
    """Return the largest gain in quarters of an octave, rounded up."""
    return int(np.ceil(GAIN_STEPS * np.log2(max(gains.max(initial=0.0), 1e-300))))


def replaced_rows(levels: Levels, blocks: Blocks) -> list[bytes]:
    """Return for each of B blocks the blocks that replace its Gaussians; nothing for the highest level.

    A row lists the fewest blocks that hold `REPLACED` of the area of the replacements of a Gaussian, because all blocks
    would take more bytes than the records themselves.

    Args:
        levels: The N Gaussians and their levels.
        blocks: The blocks.
    """
    offsets, ids = nearest_replacements(levels)
    areas = _areas(levels.union)
    ends = levels.last < len(levels) - 1
    rows = [b""] * len(blocks)
    for block in np.flatnonzero(ends[blocks.order[blocks.starts[:-1]]]).tolist():
        members = blocks.order[blocks.starts[block] : blocks.starts[block + 1]].tolist()
        rows[block] = _spell([_main_blocks(ids[offsets[i] : offsets[i + 1]], blocks, areas) for i in members])
    return rows


def _spell(lists: list[NDArray[np.int32]]) -> bytes:
    """Return the length of each list, and its numbers as zigzag-encoded differences, 7 bits per byte."""
    out = bytearray()
    last = 0
    for found in lists:
        out.append(len(found))
        for block in found.tolist():
            folded = 2 * (block - last) if block >= last else 2 * (last - block) - 1
            last = block
            while folded > 127:
                out.append(folded & 127 | 128)
                folded >>= 7
            out.append(folded)
    return bytes(out)


def _main_blocks(ids: NDArray[np.int32], blocks: Blocks, areas: F64) -> NDArray[np.int32]:
    """Return the fewest blocks, ascending, that hold `REPLACED` of the area of some Gaussians; at most 255."""
    found, of = np.unique(blocks.of_ids[ids], return_inverse=True)
    held = np.bincount(of, areas[ids], minlength=len(found))
    order = np.argsort(-held, kind="stable")
    before = np.cumsum(held[order]) - held[order]
    return np.sort(found[order[before < REPLACED * held.sum()]][:255])
