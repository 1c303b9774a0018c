"""Estimate the cost of a build of visible sets from a few viewpoints and cells. Writes nothing."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass, field

import numpy as np
from numba import get_num_threads, set_num_threads
from numpy.typing import NDArray

from gsvis import _check
from gsvis.jobs.cost import machine_load, speed_up
from gsvis.jobs.workers import Workers
from gsvis.progress import Progress, silent
from gsvis.pvs._journal import pack_sighting, pack_view
from gsvis.pvs._tasks import forget_scene
from gsvis.pvs.build import Work, plan_work
from gsvis.pvs.cell_view import Finder
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.coded_size import BESIDE, DIRECTIONS_BYTES, bytes_of_cell
from gsvis.pvs.config import PvsConfig
from gsvis.pvs.memory import expected_memory, fitting_workers, shared_files
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels
from gsvis.scene.navigable import NavigableSpace

__all__ = ["Estimate", "estimate_pvs"]

F64 = NDArray[np.float64]

_clock = time.perf_counter  # tests set another

_BUDGET = 3.5  # seconds after which no further cell is tried
_CEILING = 10.0  # seconds that the tried cells may take together, as far as one tells what the next takes

# Mean time of a cell over that of the few that are tried: one in ten asks for six looks or more, which a few rarely
# show. Around an object cells are alike (docs/design/053).
_RARE = 1.7

_MOST_TRIED = 12
_GOLDEN = 0.5 * (5.0**0.5 - 1.0)  # steps of this share of the cells spread the tried ones evenly, however many they are

_START = 1.5  # seconds until worker processes are ready, for viewpoints and for cells
_REST = 0.3  # seconds of the tracing structure, the second tracer and the writing of the store, and for each Gaussian
_REST_PER_GAUSSIAN = 1.5e-5  # 1.3e-5 in 2 million, 1.7e-5 in 6


@dataclass(frozen=True)
class Estimate:
    """The expected cost of a build.

    Attributes:
        viewpoints: Shared viewpoints to look from.
        cells: Cells to find the sets of.
        looked: Viewpoints that an earlier, interrupted build has kept.
        finished: Cells that it has kept.
        workers: Processes that fit the memory.
        seconds: Expected time.
        of_cells: Part of it in which the sets of cells are found, after all viewpoints.
        memory: Peak bytes of memory, all processes together.
        visible: Gaussians that a cell sees, mean.
        ever: Gaussians that the tried cells see together.
        disk: Bytes of the finished store.
        working_disk: Bytes of temporary files during the build.
        load: Processes that used or waited for a core when the estimate began; None if unknown. Times on a busy machine
            are longer than on a quiet one.
    """

    viewpoints: int
    cells: int
    looked: int
    finished: int
    workers: int
    seconds: float
    of_cells: float
    memory: int
    visible: float
    ever: int
    disk: int
    working_disk: int
    load: float | None


def estimate_pvs(
    g: Gaussians | Levels,
    grid: CellGrid,
    space: NavigableSpace,
    path: str | os.PathLike[str],
    config: PvsConfig | None = None,
    *,
    workers: Workers | None = None,
    sample: int = 2,
    progress: Progress = silent,
) -> Estimate:
    """Estimate the cost of `build_pvs` from a few cells and their viewpoints. Writes nothing.

    Args:
        g: The scene, or its levels.
        grid: The cells.
        space: The navigable space that the grid was made from.
        path: The file that `build_pvs` would write.
        config: Options; None means `PvsConfig()`.
        workers: The workers; None means this process.
        sample: Least number of cells to try; more are tried while that takes a few seconds, and fewer, at least one,
            where these would take more than ten.
        progress: Called with stage "trying".

    Raises:
        SceneError: If the scene or a level has nothing to see.
        ValueError: If `max_memory` is too small, or the grid was made from another space.
    """
    config = config or PvsConfig()
    workers = workers or Workers()
    load = machine_load()
    _check.positive_int("sample", sample)
    work = plan_work(g, grid, space, path, config)
    levels = work.levels
    cells = len(grid)
    count = fitting_workers(levels, config, workers)
    seen, finished = work.find_kept()
    tried = _try_cells(work, min(sample, cells), progress)
    viewpoints = len(work.shared)
    left = np.ones(viewpoints, bool)
    left[seen] = False
    fine = int(np.count_nonzero(left & work.shared.fine))
    seconds = fine * tried.of_look(fine=True) + (int(left.sum()) - fine) * tried.of_look(fine=False)
    faster = speed_up(count, workers, tried.threads)
    rare = 1.0 if space.kind.kind == "object" else _RARE
    of_cells = rare * tried.finding / tried.cells * (cells - len(finished)) / faster
    processes = count > 1 and workers.executor is None
    rest = (2.0 * _START if processes else 0.0) + _REST + _REST_PER_GAUSSIAN * levels.counts[-1]
    return Estimate(
        viewpoints=viewpoints,
        cells=cells,
        looked=len(seen),
        finished=len(finished),
        workers=count,
        seconds=seconds / faster + of_cells + rest,
        of_cells=of_cells,
        memory=expected_memory(levels, config, count if processes else 1),
        visible=tried.visible / tried.cells,
        ever=int(np.count_nonzero(tried.seen)),
        disk=int(BESIDE * tried.coded / tried.cells * cells + DIRECTIONS_BYTES * len(levels.union)),
        working_disk=int(tried.held / tried.looks * viewpoints + tried.kept / tried.cells * cells)
        + (shared_files(levels, config) if processes else 0),
        load=load,
    )


@dataclass
class _Tried:
    """What it cost to look from the viewpoints of some cells, and to find these cells' sets, in seconds and bytes."""

    cells: int = 0
    looking: tuple[list[float], list[float]] = field(default_factory=lambda: ([], []))  # coarse looks, fine ones
    finding: float = 0.0
    held: int = 0
    kept: int = 0
    visible: int = 0
    coded: int = 0
    seen: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, bool))  # (N,), by any of them
    threads: float = 1.0  # speed-up of a look by all threads

    @property
    def looks(self) -> int:
        """Looks taken."""
        return sum(map(len, self.looking))

    def of_look(self, *, fine: bool) -> float:
        """Return the seconds of a look, fine or not; of all looks if there was none of this kind."""
        return float(np.mean(self.looking[fine] or [*self.looking[0], *self.looking[1]]))


def _try_cells(work: Work, least: int, progress: Progress) -> _Tried:
    """Find the sets of `least` cells, of more while that takes a few seconds, of fewer where it takes too long."""
    some = _spread(len(work.grid), max(least, min(_MOST_TRIED, len(work.grid))))
    progress("trying", 0, len(some))
    finder = work.scene.finder()
    finder.warm()  # loads the kernels and makes the tracers before the timing starts
    shared = work.shared
    tried = _Tried(threads=_gain_of_threads(finder, work.shared.points[0]), seen=np.zeros(len(work.levels.union), bool))
    start = _clock()
    while tried.cells < len(some):
        began = _clock()
        taken = began - start
        if taken >= _BUDGET and (tried.cells >= least or taken * (tried.cells + 1) > _CEILING * tried.cells > 0.0):
            break
        cell = some[tried.cells]
        sightings = []
        for k in shared.of_cell(cell).tolist():
            sightings.append(finder.look(shared.points[k], fine=bool(shared.fine[k])))
            began, before = _clock(), began
            tried.looking[bool(shared.fine[k])].append(began - before)
        view = finder.find_cell(work.viewpoints.voxels(cell), sightings)
        tried.finding += _clock() - began
        tried.cells += 1
        tried.held += sum(len(pack_sighting(each)) for each in sightings)
        tried.kept += len(pack_view(view))
        tried.visible += len(view.ids)
        tried.seen[view.ids] = True
        tried.coded += bytes_of_cell(view.ids, view.classes, len(work.levels.union), len(work.config.class_edges))
        progress("trying", tried.cells, len(some))
    progress("trying", len(some), len(some))
    forget_scene()
    return tried


def _gain_of_threads(finder: Finder, viewpoint: F64) -> float:
    """Return how much faster a look is with all threads of this process than with one; at least 1."""
    taken = []
    before = get_num_threads()
    try:
        for threads in (before, 1):
            set_num_threads(threads)
            began = _clock()
            finder.look(viewpoint)
            taken.append(_clock() - began)
    finally:
        set_num_threads(before)
    return max(1.0, taken[1] / taken[0]) if taken[0] > 0.0 else 1.0


def _spread(cells: int, count: int) -> list[int]:
    """Return `count` different cells, at most all; the first of them are spread evenly, however many are taken."""
    places = np.arange(1, 4 * max(count, _MOST_TRIED)) * _GOLDEN % 1.0
    return list(dict.fromkeys((cells * places).astype(int).tolist()))[:count]
