"""Make the sets that a package ships from those that were built: less to say, and nothing that is seen is left out.

Sets are completed by label. Weight classes only say what is sent first, and a Gaussian has nearly the same one in
neighboring cells, so cubes of cells share their mean (docs/design/129, 161). Around an object each Gaussian has one
class, and each run of neighbors a shift of it in each cell (docs/design/162).
"""

from __future__ import annotations

from os import PathLike

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.pvs import _order, codec
from gsvis.pvs.completed import Completion
from gsvis.pvs.run_classes import RunClasses
from gsvis.pvs.store import CellSet, StoreWriter, VisibilityStore

__all__ = ["CLASSES_RUN", "CLASSES_SIDE", "split_classes", "write_shipped"]

CLASSES_SIDE = 2
"""Cells along the side of the cubes that share weight classes in a package; cells of the grid as it was built."""

CLASSES_RUN = 64
"""Neighbors whose weight classes differ in the same way from cell to cell in a package of an object."""

_ROUNDS = 2  # of finding classes and shifts

I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]


def write_shipped(store: VisibilityStore, target: str | PathLike[str], side: int = CLASSES_SIDE) -> None:
    """Write a store with completed sets, in which the cells of a cube give a Gaussian the same weight class.

    Args:
        store: C cells.
        target: The file to write.
        side: Cells along the side of a cube, at least 1.
    """
    coords = store.grid.coords // _check.positive_int("side", side)
    cubes = np.unique(coords, axis=0, return_inverse=True)[1].reshape(-1)
    labels = _order.choose_labels(store.gaussians, len(store), store.visible_words, completed=True)
    ever = np.array(store.ever_visible().to_array(), np.int64)
    complete = Completion(labels, codec.pack(ever, store.gaussians))
    known: dict[int, U8] = {}
    last = {int(cube): cell for cell, cube in enumerate(cubes)}  # the last cell of each cube
    with StoreWriter(target, store.grid, store.info) as writer:
        for cell in range(len(store)):
            cube = int(cubes[cell])
            if cube not in known:
                known[cube] = _mean_classes(store, np.flatnonzero(cubes == cube))
            ids = codec.ids_of(complete(store.visible_words(cell)))
            writer.add_cell(_copy_cell(store, cell, ids, known[cube][ids]))
            if last[cube] == cell:
                del known[cube]
        writer.finish(store.direction_sets, groups=cubes, labels=labels)


def split_classes(store: VisibilityStore, run: int) -> RunClasses:
    """Return the classes of a store as one for each Gaussian plus a shift for each run of neighbors in each cell.

    First a Gaussian has the mean class over the cells that see it, and a run the mean of what its Gaussians have from a
    cell beyond that. Both are then found once more, each with the other taken off. Means are rounded. Classes are
    logarithms of weights, so these are geometric means.

    Args:
        store: N Gaussians, C cells.
        run: Gaussians in a run, at least 1; the last run may be shorter.
    """
    _check.positive_int("run", run)
    of = np.arange(store.gaussians) // run
    shifts = np.zeros((len(store), -(-store.gaussians // run)), np.int64)
    for _ in range(_ROUNDS):
        common = _common_classes(store, shifts, of)
        for cell in range(len(store)):
            ids, classes = store.classes(cell)
            beyond = np.bincount(of[ids], classes - common[ids], shifts.shape[1]).astype(np.int64)
            shifts[cell] = _rounded_means(beyond, np.bincount(of[ids], minlength=shifts.shape[1]))
    return RunClasses(run, len(store.info.class_edges), common.astype(np.uint8), shifts.astype(np.int8))


def _common_classes(store: VisibilityStore, shifts: I64, of: I64) -> I64:
    """Return (N,) the mean class of each Gaussian over the cells that see it, less shifts (C, R) of its run `of` (N,).

    It is rounded, and kept within the classes; 0 for a Gaussian that no cell sees.
    """
    sums = np.zeros(store.gaussians, np.int64)
    seen = np.zeros(store.gaussians, np.int64)
    for cell in range(len(store)):
        ids, classes = store.classes(cell)
        sums[ids] += classes - shifts[cell, of[ids]]
        seen[ids] += 1
    return np.clip(_rounded_means(sums, seen), 0, len(store.info.class_edges) - 1)


def _rounded_means(sums: I64, counts: I64) -> I64:
    """Return sums over counts, rounded, halves up; 0 where the count is 0."""
    return (2 * sums + counts) // np.maximum(2 * counts, 1)


def _mean_classes(store: VisibilityStore, cells: I64) -> U8:
    """Return (N,) the mean weight class of each Gaussian over those of some cells that see it, rounded; 0 for none.

    Classes are logarithms of weights, so this is the geometric mean of the weights in the cells that see it.
    """
    sums = np.zeros(store.gaussians, np.uint32)
    seen = np.zeros(store.gaussians, np.uint32)
    for cell in cells.tolist():
        ids, classes = store.classes(cell)
        sums[ids] += classes
        seen[ids] += 1
    seen = np.maximum(seen, 1)
    return ((2 * sums + seen) // (2 * seen)).astype(np.uint8)


def _copy_cell(store: VisibilityStore, cell: int, ids: I64, classes: U8) -> CellSet:
    """Return a cell with another set. What it misses is at most what it missed."""
    made = store.certificates
    return CellSet(
        ids,
        classes,
        int(store.viewpoints[cell]),
        int(made.inner[cell]),
        int(made.rays[cell]),
        float(made.missed[cell]),
        float(made.bound[cell]),
        float(made.tile[cell]),
    )
