"""Make the store that a package gets: cells joined on request, sets completed, classes and directions shared.

Small cells have small sets, so a walk needs fewer Gaussians; but there are more of them, and what neighbors see is
nearly the same. On request cells are joined to cubes of F x F x F cells, with the least F for which the sets are at
most a fifth of the package. A joined cell sees what any of its cells sees, so nothing is lost.

Direction sets are half of a store, and the sender does not read them. Runs of neighbors in the order of the package
share the union of theirs. `shipped.py` makes sets and weight classes small.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from os import PathLike

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis._kernels.bits import count
from gsvis.files.temporary import temporary_folder
from gsvis.progress import Progress, silent
from gsvis.pvs._writer import share_directions
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.shipped import CLASSES_RUN, CLASSES_SIDE, split_classes, write_shipped
from gsvis.pvs.store import CellSet, StoreInfo, StoreWriter, VisibilityStore

__all__ = [
    "DIRECTIONS_RUN",
    "MOST_SHARE",
    "RECORD_BYTES",
    "WALK_CELLS",
    "JoinedCells",
    "join_cells",
    "join_until_small",
    "measure_sets",
    "walks_through",
]

RECORD_BYTES = 12
"""Bytes of a Gaussian with its terms in a package and on the wire, about; decides how large cells are, no more."""

MOST_SHARE = 0.25
"""Bytes of sets over those of Gaussians, at most: a fifth of the package."""

DIRECTIONS_RUN = 16
"""Neighbors that share a direction set in a package."""

WALK_CELLS = 10
"""Cells of the finest grid that a walk passes."""

_WALKS = 64
_STEPS = 40  # most steps of a walk, which may be shut in by few cells
_SEED = 0

I64 = NDArray[np.int64]
Words = NDArray[np.uint64]


@dataclass(frozen=True)
class JoinedCells:
    """Sets of cells of one size, and what they cost and save.

    Attributes:
        factor: Cells along each side of a cube that was joined; 1 for the cells as they were built.
        cells: Number of cells after that.
        nbytes: Bytes of the store without its direction sets.
        walk: Gaussians that a walk needs, mean of several walks through `WALK_CELLS` cells of the finest grid.
        ever: Gaussians that any cell sees.
    """

    factor: int
    cells: int
    nbytes: int
    walk: float
    ever: int

    @property
    def saved(self) -> float:
        """Bytes that a walk saves over sending what any cell sees."""
        return RECORD_BYTES * (self.ever - self.walk)

    @property
    def pays(self) -> bool:
        """Whether the sets save at least the bytes on a walk that they take."""
        return self.saved >= self.nbytes


def join_until_small(
    store: VisibilityStore,
    target: str | PathLike[str],
    *,
    may_join: bool = True,
    in_runs: bool = False,
    progress: Progress = silent,
) -> tuple[JoinedCells, ...]:
    """Write the store of a package: cells joined if that is asked for, sets completed, classes and directions shared.

    Args:
        store: Sets as they were built.
        target: The file to write.
        may_join: Whether cells may be joined until the sets are small.
        in_runs: Whether runs of neighbors share how their classes change from cell to cell, as around an object; else
            cubes of cells share classes.
        progress: Called with stage "join".

    Returns:
        What was tried, smallest cells first. The last was written.

    Raises:
        OSError: If a file cannot be written; an older file at the path stays.
    """
    path = _check.path("target", target)
    walks = walks_through(store.grid)
    of = tuple(range(len(store)))
    tried = [measure_sets(store)]
    ever = tried[0].ever
    most = MOST_SHARE * RECORD_BYTES * store.gaussians
    progress("join", 0, 1)
    with temporary_folder() as folder:
        written = store.path
        for factor in _factors(store.grid) if may_join else ():
            if tried[-1].nbytes <= most:
                break
            written = folder / "joined.pvs"
            of = join_cells(store, written, factor)
            with VisibilityStore.open(written) as joined:
                tried.append(JoinedCells(factor, len(joined), _bytes_of(joined), _walk(joined, walks, of), ever))
        small = folder / "small.pvs"
        with VisibilityStore.open(written) as joined:
            write_shipped(joined, small, max(1, CLASSES_SIDE // tried[-1].factor))
            classes = split_classes(joined, CLASSES_RUN) if in_runs else None
        share_directions(small, path, DIRECTIONS_RUN, classes=classes)
    with VisibilityStore.open(path) as found:
        tried[-1] = replace(tried[-1], nbytes=_bytes_of(found), walk=_walk(found, walks, of))
    progress("join", 1, 1)
    return tuple(tried)


def measure_sets(store: VisibilityStore) -> JoinedCells:
    """Return what the sets of a store cost and save as they are."""
    walk = _walk(store, walks_through(store.grid), tuple(range(len(store))))
    return JoinedCells(1, len(store), _bytes_of(store), walk, len(store.ever_visible()))


def join_cells(store: VisibilityStore, target: str | PathLike[str], factor: int) -> tuple[int, ...]:
    """Write a store whose cells are cubes of F x F x F cells; return the new cell of each old one.

    A joined cell sees what any of its cells sees, with the largest weight class. Its viewpoints and rays are those of
    all of them. What it misses is at most what the worst of them misses.

    Args:
        store: C cells.
        target: The file to write.
        factor: F, at least 1.
    """
    _check.positive_int("factor", factor)
    old = store.grid
    coords, of = np.unique(old.coords // factor, axis=0, return_inverse=True)
    of = of.reshape(-1)
    x, y, z = (-(-side // factor) for side in old.shape)
    grid = CellGrid(old.origin, factor * old.cell_size, (x, y, z), coords.astype(np.int32), old.up)
    info = store.info
    config = {**info.config, "joined": {"factor": factor, "cells": len(old)}}
    with StoreWriter(target, grid, StoreInfo(info.gaussians, info.scene, info.tau, info.class_edges, config)) as writer:
        for cell in range(len(grid)):
            writer.add_cell(_join(store, np.flatnonzero(of == cell)))
        writer.finish(store.direction_sets)
    return tuple(of.tolist())


def walks_through(grid: CellGrid) -> tuple[tuple[int, ...], ...]:
    """Return walks from cell to neighboring cell, each as the cells that it passes.

    A walk begins in any cell and takes random steps until it has passed `WALK_CELLS` cells. The same grid gives the
    same walks.
    """
    rng = np.random.default_rng(_SEED)
    return tuple(_walk_from(grid, int(rng.integers(len(grid))), rng) for _ in range(_WALKS))


def _walk_from(grid: CellGrid, cell: int, rng: np.random.Generator) -> tuple[int, ...]:
    """Return the cells that a random walk from a cell passes, ascending."""
    passed = {cell}
    for _ in range(_STEPS):
        around = grid.neighbors(cell)
        if len(passed) == WALK_CELLS or len(around) == 0:
            break
        cell = int(rng.choice(around))
        passed.add(cell)
    return tuple(sorted(passed))


def _factors(grid: CellGrid) -> Iterator[int]:
    """Yield the sides of cubes to try: 2, 3, 4, 6, 8, 12 and so on, the last of which joins all cells."""
    longest = max(grid.shape)
    factor = 2
    while factor < longest:
        yield factor
        factor = 3 * factor // 2 if factor & (factor - 1) == 0 else 4 * factor // 3
    if longest > 1:
        yield longest


def _join(store: VisibilityStore, cells: I64) -> CellSet:
    """Return the set of some cells together."""
    levels = np.zeros(store.gaussians, np.uint8)
    for cell in cells.tolist():
        ids, classes = store.classes(cell)
        levels[ids] = np.maximum(levels[ids], classes + np.uint8(1))
    ids = np.flatnonzero(levels)
    made = store.certificates
    return CellSet(
        ids,
        levels[ids] - np.uint8(1),
        int(store.viewpoints[cells].sum()),
        int(made.inner[cells].sum()),
        int(made.rays[cells].sum()),
        float(made.missed[cells].max()),
        float(made.bound[cells].max()),
        float(made.tile[cells].max()),
    )


def _walk(store: VisibilityStore, walks: tuple[tuple[int, ...], ...], of: tuple[int, ...]) -> float:
    """Return the number of Gaussians that a walk needs, mean of all walks; `of` has the cell of each finest cell."""
    needs = []
    for walk in walks:
        seen = store.visible_words(of[walk[0]])
        for cell in {of[each] for each in walk[1:]}:
            seen |= store.visible_words(cell)
        needs.append(count(seen))
    return float(np.mean(needs))


def _bytes_of(store: VisibilityStore) -> int:
    """Return the bytes of a store without its direction sets."""
    sizes = store.sizes()
    return int(sizes["file"] - sizes["directions"])
