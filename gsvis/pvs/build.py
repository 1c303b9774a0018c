"""Build the visible sets of a scene: plan the work, run it on workers, keep each finished cell, write one store.

The bytes of the file do not depend on the number of workers, on interruptions, or on a cluster. A set depends only
on the scene, the cell and the configuration.
"""

from __future__ import annotations

import errno
import hashlib
import os
import time
from collections.abc import Generator
from concurrent.futures import Executor
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.errors import OutputError, SceneError
from gsvis.files.output import output_errors
from gsvis.files.resume import KeptWork
from gsvis.progress import Progress, silent
from gsvis.pvs._journal import find_kept_cells, name_entry, pack_view, read_view
from gsvis.pvs._workers import (
    Result,
    SceneArrays,
    Task,
    forget_scene,
    run_here,
    run_in_processes,
    run_on,
)
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.config import PvsConfig
from gsvis.pvs.store import CellSet, StoreInfo, StoreWriter, VisibilityStore
from gsvis.pvs.viewpoints import CellViewpoints
from gsvis.raycast.directions import NUM_FACES
from gsvis.raycast.proxies import MIN_ALPHA
from gsvis.scene.content import scene_hash, space_hash
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels, as_levels, levels_record, union_of
from gsvis.scene.navigable import NavigableSpace

__all__ = ["Estimate", "Workers", "build_pvs", "estimate_pvs", "journal_of"]

_clock = time.perf_counter  # tests set another
_PLAN = 2  # increase it when the same plan gives other bytes

# Measured peaks with a margin (docs/design/007): bytes of a process with its libraries, and for each Gaussian.
_BASE = {"hybrid": 150 << 20, "raster": 380 << 20, "raycast": 260 << 20}
_PER_GAUSSIAN = {"hybrid": 190, "raster": 420, "raycast": 680}
_PER_PIXEL = {"hybrid": 6 * 24, "raster": 6 * 64, "raycast": 6 * 64}  # all six faces
_PARENT_BASE = 220 << 20
_PARENT_PER_GAUSSIAN = 320  # navigable space, order of the store, and leftovers of reading
_SCENE_FILE = 58  # bytes of the scene that workers map

_BITS = 5.0  # bits for each visible Gaussian of a cell: its set and its classes
_DISK_PER_GAUSSIAN = 6  # order and direction sets
_PROCESSES_OVER_THREADS = 1.3  # how much better processes use the cores than threads of one process


@dataclass(frozen=True)
class Workers:
    """The workers of a build.

    Attributes:
        count: Processes of this machine; 1 works in this process, with all its threads.
        max_memory: Bytes that this process and its workers may use together. Fewer workers start if they do not fit.
            None sets no limit.
        executor: An object with the interface of `concurrent.futures.Executor`, used instead of processes. It gets
            2 x `count` tasks at a time. Dask: `client.get_executor()`.
        scatter: Takes the scene and returns the argument that tasks get in its place, such as a Dask future. So the
            scene is sent once to each worker. None sends it with each task.
    """

    count: int = 1
    max_memory: int | None = None
    executor: Executor | None = None
    scatter: Any = None

    def __post_init__(self) -> None:
        _check.positive_int("count", self.count)
        if self.max_memory is not None:
            _check.positive_int("max_memory", self.max_memory)


@dataclass(frozen=True)
class Estimate:
    """The expected cost of a build.

    Attributes:
        cells: Cells to look from.
        finished: Cells that an earlier, interrupted build has kept.
        workers: Processes that fit the memory.
        seconds: Expected time.
        memory: Peak bytes of memory, all processes together.
        disk: Bytes of the finished store.
        working_disk: Bytes of temporary files during the build.
    """

    cells: int
    finished: int
    workers: int
    seconds: float
    memory: int
    disk: int
    working_disk: int


def build_pvs(
    g: Gaussians | Levels,
    grid: CellGrid,
    space: NavigableSpace,
    path: str | os.PathLike[str],
    config: PvsConfig | None = None,
    *,
    workers: Workers | None = None,
    progress: Progress = silent,
) -> VisibilityStore:
    """Find the visible set of each cell, and write all sets as a store.

    With more than one worker, a script that calls this needs an `if __name__ == "__main__":` guard, like every
    Python program that starts processes.

    Args:
        g: The scene, N Gaussians; or its levels. With levels, a cell sees a Gaussian of the union if it sees it in at
            least one level drawn alone.
        grid: The cells.
        space: The navigable space that the grid was made from.
        path: The file to write. Finished cells are kept beside it until it is complete. An interrupted build of the
            same scene, grid, space and configuration resumes.
        config: Options; None means `PvsConfig()`.
        workers: The workers; None means this process.
        progress: Called with stages "cells" and "store".

    Returns:
        The open store.

    Raises:
        SceneError: If the scene or a level has nothing to see, or every viewpoint lies inside something solid.
        ValueError: If `max_memory` is too small, or the grid was made from another space.
        OSError: If the disk is full or cannot be written; finished cells are kept.
    """
    config, workers = config or PvsConfig(), workers or Workers()
    levels = _check_levels(g)
    count = _fitting(levels, config, workers)
    viewpoints = CellViewpoints(grid, space)
    target, plan = _check.path("path", path), _plan(levels, grid, space, config)
    work = KeptWork.beside(target, plan)
    try:
        with work.opened():
            finished = find_kept_cells(work, len(grid), len(levels.union))
            progress("cells", len(finished), len(grid))
            left = sorted(set(range(len(grid))) - set(finished))
            tasks = [Task(cell, viewpoints.spread(cell, config.max_viewpoints)) for cell in left]
            scene = SceneArrays.from_levels(_key(plan), levels, config)
            with closing(_results(scene, tasks, workers, count, work)) as results:
                for done, (cell, data) in enumerate(results, len(finished) + 1):
                    work.keep(name_entry(cell), data)
                    progress("cells", done, len(grid))
            _write(work, grid, target, plan, config, progress)
            store = VisibilityStore.open(target)  # before the journal is removed: an unreadable store loses no work
            work.remove()
    except SceneError:
        work.remove()
        raise
    except OSError as error:
        raise _explain(error, work, plan, len(grid), target) from error
    return store


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
    """Estimate the cost of `build_pvs` from `sample` cells. Writes nothing.

    Args:
        g: The scene, or its levels.
        grid: The cells.
        space: The navigable space that the grid was made from.
        path: The file that `build_pvs` would write.
        config: Options; None means `PvsConfig()`.
        workers: The workers; None means this process.
        sample: Number of cells to try.
        progress: Called with stage "trying".

    Raises:
        SceneError: If the scene or a level has nothing to see.
        ValueError: If `max_memory` is too small, or the grid was made from another space.
    """
    config, workers = config or PvsConfig(), workers or Workers()
    levels = _check_levels(g)
    count = _fitting(levels, config, workers)
    viewpoints = CellViewpoints(grid, space)
    _check.positive_int("sample", sample)
    plan = _plan(levels, grid, space, config)
    finished = len(find_kept_cells(KeptWork.beside(path, plan), len(grid), len(levels.union)))
    some = np.unique(np.linspace(0, len(grid) - 1, min(sample, len(grid)) + 2).astype(int)[1:-1]).tolist() or [0]
    scene = SceneArrays.from_levels(_key(plan), levels, config)
    scene.view(viewpoints.spread(some[0], 1))  # loads the kernels before the timing starts
    began, taken, bits = _clock(), 0, 0.0
    progress("trying", 0, len(some))
    for done, cell in enumerate(some, 1):
        view = scene.view(viewpoints.spread(cell, config.max_viewpoints))
        taken += len(pack_view(view))
        bits += _BITS * len(view.ids)
        progress("trying", done, len(some))
    seconds = (_clock() - began) / len(some) * (len(grid) - finished)
    forget_scene()
    shared = count > 1 and workers.executor is None
    return Estimate(
        cells=len(grid),
        finished=finished,
        workers=count,
        seconds=seconds / _speed_up(count, workers),
        memory=_parent(levels) + count * _worker(levels, config) if shared else _alone(levels, config),
        disk=int(bits / 8.0 / len(some) * len(grid)) + _DISK_PER_GAUSSIAN * len(levels.union),
        working_disk=int(taken / len(some) * len(grid)) + (_SCENE_FILE * len(levels.union) if shared else 0),
    )


def journal_of(
    g: Gaussians | Levels, grid: CellGrid, space: NavigableSpace, path: str | os.PathLike[str], config: PvsConfig
) -> Path:
    """Return the folder in which a build of this plan keeps finished cells."""
    return KeptWork.beside(path, _plan(as_levels(g), grid, space, config)).folder


def _check_levels(g: Gaussians | Levels) -> Levels:
    """Return the levels; raise `SceneError` if a level has nothing to see."""
    bright = union_of(g).opacities >= MIN_ALPHA
    problem = "has no Gaussian with an opacity of at least 1/255: there is nothing to see; is it the right one?"
    if not bright.any():
        raise SceneError(f"the scene {problem}")
    levels = as_levels(g)
    for k, name in enumerate(levels.names):
        if not bright[levels.member(k)].any():
            raise SceneError(f"level {name!r} {problem}")
    return levels


def _explain(error: OSError, work: KeptWork, plan: dict[str, Any], count: int, target: Path) -> OSError:
    """Return the error with the number of kept cells and a remedy."""
    kept = len(find_kept_cells(work, count, plan["gaussians"]))
    held = f"{kept} of {count} cells are kept in {work.folder.name}" if kept else "no cell was finished"
    try:
        with output_errors(target, work.folder):
            raise error
    except OutputError as found:
        return OutputError(found.path, found.errno or errno.EIO, held, found.remedy)
    except OSError:
        again = "run the same again to resume"
        return OSError(error.errno or errno.EIO, f"{error.strerror or error}; {held}: {again}", str(target))


def _plan(levels: Levels, grid: CellGrid, space: NavigableSpace, config: PvsConfig) -> dict[str, Any]:
    """Return the record of everything that decides the bytes of the store."""
    record = levels_record(levels)
    return {
        "format": "gsvis pvs plan",
        "version": _PLAN,
        "scene": scene_hash(levels.union),
        "gaussians": len(levels.union),
        **({} if record is None else {"levels": record}),
        "grid": grid.as_dict(),
        "cells": hashlib.sha256(grid.coords.astype("<i4").tobytes()).hexdigest(),
        "space": space_hash(space),
        "config": config.as_dict(),
    }


def _key(plan: dict[str, Any]) -> str:
    return f"{plan['scene']} {plan.get('levels')} {plan['config']}"


def _results(
    scene: SceneArrays, tasks: list[Task], workers: Workers, count: int, work: KeptWork
) -> Generator[Result, None, None]:
    if workers.executor is not None:
        share = workers.scatter or (lambda given: given)
        yield from run_on(workers.executor, lambda: share(scene), tasks, 2 * workers.count)
    elif count == 1 or len(tasks) < 2:
        yield from run_here(scene, tasks)
    else:
        with scene.stored(work.folder / "scene") as stored:
            yield from run_in_processes(stored, tasks, min(count, len(tasks)))


def _write(
    work: KeptWork,
    grid: CellGrid,
    path: Path,
    plan: dict[str, Any],
    config: PvsConfig,
    progress: Progress,
) -> None:
    count = plan["gaussians"]
    how = {**config.as_dict(), "space": plan["space"], **{name: plan[name] for name in ("levels",) if name in plan}}
    info = StoreInfo(count, plan["scene"], config.tau, config.class_edges, how)
    directions: NDArray[np.uint8] = np.zeros((count, NUM_FACES // 8), np.uint8)
    looked = 0
    with StoreWriter(path, grid, info) as writer:
        for cell in range(len(grid)):
            view = read_view(work, cell, count)
            if view is None:
                raise OSError(5, f"the journal of cell {cell} was damaged while the store was written")
            directions[view.ids] |= view.directions
            looked += view.viewpoints
            writer.add_cell(CellSet(view.ids, view.classes, view.viewpoints, view.growth))
        if not looked:
            raise SceneError(
                "every viewpoint lies inside something solid; give a navigable space or a box that is free of it"
            )
        writer.finish(directions, progress=progress)


def _parent(levels: Levels) -> int:
    """Return the bytes of memory of the process that submits the tasks and writes the store."""
    n, held = len(levels.union), levels.union.nbytes
    copies = held * levels.counts[-1] // n if len(levels) > 1 else 0  # the highest level
    return _PARENT_BASE + _PARENT_PER_GAUSSIAN * n + held + copies


def _worker(levels: Levels, config: PvsConfig) -> int:
    """Return the bytes of memory of a worker process."""
    pixels, drawn = _PER_PIXEL[config.method] * config.size**2, sum(levels.counts)
    copies = _SCENE_FILE * drawn if len(levels) > 1 else 0  # a single level is the mapped arrays themselves
    return _BASE[config.method] + _PER_GAUSSIAN[config.method] * drawn + copies + pixels


def _alone(levels: Levels, config: PvsConfig) -> int:
    """Return the bytes of memory of one process that does all the work."""
    held = levels.union.nbytes + _PARENT_PER_GAUSSIAN // 4 * len(levels.union)
    return max(_parent(levels), _worker(levels, config) + held)


def _speed_up(count: int, workers: Workers) -> float:
    """Return the speed-up over one process that uses all threads of this machine."""
    if workers.executor is not None:
        return max(1.0, 0.9 * count)
    cores = os.cpu_count() or 1
    return max(1.0, min(count, cores) * _PROCESSES_OVER_THREADS / cores) if count > 1 else 1.0


def _fitting(levels: Levels, config: PvsConfig, workers: Workers) -> int:
    """Return how many processes fit the memory; 1 means that this process does the work."""
    if workers.max_memory is None or workers.executor is not None:
        return workers.count
    alone = _alone(levels, config)
    if workers.max_memory < alone:
        raise ValueError(
            f"max_memory: expected at least {alone / 1e9:.2g} GB for {len(levels.union):,} Gaussians,"
            f" got {workers.max_memory / 1e9:.2g} GB; raise it, or take a coarser level of the scene"
        )
    room = (workers.max_memory - _parent(levels)) // _worker(levels, config)
    return int(min(workers.count, room)) if room >= 2 else 1
