"""Building the potentially visible sets of a whole scene: planned, shared out, kept as they come, written as one store.

The file is the same, byte by byte, whatever the number of workers, for a build that was killed and went on, and on a
cluster: what a cell sees depends on the scene, the cell and the configuration alone.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Iterator
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.errors import SceneError
from gsvis.progress import Progress, silent
from gsvis.raycast.directions import NUM_FACES
from gsvis.scene.content import scene_hash
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.visibility._journal import Journal, pack_view
from gsvis.visibility._work import SceneArrays, Task, done_by, done_by_processes, done_here
from gsvis.visibility.cells import CellGrid
from gsvis.visibility.pvs import PvsConfig, see_cell
from gsvis.visibility.store import CellSet, StoreInfo, StoreWriter, VisibilityStore
from gsvis.visibility.viewpoints import CellViewpoints

__all__ = ["Estimate", "Workers", "build_pvs", "estimate_pvs", "journal_of"]

_PLAN = 1  # raised whenever the same plan would give other bytes

# Measured peaks (docs/design/007): bytes of an interpreter with its libraries, and bytes for each Gaussian.
_BASE = {"hybrid": 330 << 20, "raster": 700 << 20, "raycast": 600 << 20}
_PER_GAUSSIAN = {"hybrid": 320, "raster": 700, "raycast": 900}
_PER_PIXEL = 6 * 24  # of the six faces


@dataclass(frozen=True)
class Workers:
    """Who does the work.

    Attributes:
        count: Processes of this machine; 1 works in this process, with all its threads.
        max_memory: Bytes that this process and its workers may take together; fewer workers are started if need be.
            None sets no bound.
        executor: Anything with the interface of `concurrent.futures.Executor`, instead of processes; as many tasks
            are given to it at a time as `count` says, times two. Dask: `client.get_executor()`.
        scatter: Takes the scene and gives what the executor's tasks get in its place, such as a Dask future, so that
            it travels once to each worker. None sends it with each task.
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
    """What a build will cost.

    Attributes:
        cells: Cells to look from.
        finished: How many of them an earlier, interrupted build has kept.
        workers: Processes that fit the memory.
        seconds: Expected time.
        memory: Bytes taken at most, all processes together.
        disk: Bytes of the finished store.
        working_disk: Bytes of the journal while it is built.
    """

    cells: int
    finished: int
    workers: int
    seconds: float
    memory: int
    disk: int
    working_disk: int


def build_pvs(
    g: Gaussians,
    grid: CellGrid,
    space: NavigableSpace,
    path: str | os.PathLike[str],
    config: PvsConfig | None = None,
    *,
    workers: Workers | None = None,
    progress: Progress = silent,
) -> VisibilityStore:
    """Find what each cell sees, and write it as a store.

    With more than one worker, a script that calls this needs `if __name__ == "__main__":` around its doings, as all
    Python programs that start processes do.

    Args:
        g: The scene, N Gaussians.
        grid: The cells.
        space: The navigable space that the grid was cut from.
        path: The file to write. Finished cells are kept beside it until it is whole: an interrupted build of the same
            scene, grid and configuration goes on where it stood.
        config: How; None means `PvsConfig()`.
        workers: Who does the work; None means this process.
        progress: Called with stages "cells" and "store".

    Returns:
        The open store.

    Raises:
        SceneError: If the scene is empty, or every viewpoint is buried in something solid.
        ValueError: If the memory cannot suffice, or the grid was cut from another space.
        OSError: If the disk is full or cannot be written; finished cells are kept.
    """
    config, workers = config or PvsConfig(), workers or Workers()
    count = _fitting(len(g), config, workers)
    viewpoints = CellViewpoints(grid, space)
    journal, plan, scene = _open_journal(g, grid, space, Path(path), config)
    try:
        finished = journal.finished(len(grid))
        progress("cells", len(finished), len(grid))
        left = sorted(set(range(len(grid))) - set(finished))
        tasks = [Task(cell, viewpoints.spread(cell, config.max_viewpoints)) for cell in left]
        for done, (cell, data) in enumerate(_results(scene, tasks, workers, count, journal), len(finished) + 1):
            journal.keep(cell, data)
            progress("cells", done, len(grid))
        _write(journal, grid, Path(path), g, plan, config, progress)
    except OSError as error:
        kept = len(journal.finished(len(grid)))
        raise OSError(
            error.errno,
            f"{error.strerror or error}; {kept} of {len(grid)} cells are kept in {journal.folder.name}: make room and"
            " run the same again",
            str(path),
        ) from error
    journal.remove()
    return VisibilityStore.open(path)


def estimate_pvs(
    g: Gaussians,
    grid: CellGrid,
    space: NavigableSpace,
    path: str | os.PathLike[str],
    config: PvsConfig | None = None,
    *,
    workers: Workers | None = None,
    sample: int = 2,
) -> Estimate:
    """What `build_pvs` would cost; looks from `sample` cells to find out and writes nothing.

    Args:
        g: The scene.
        grid: The cells.
        space: The navigable space of the grid.
        path: The file that would be written.
        config: How; None means `PvsConfig()`.
        workers: Who would do the work.
        sample: Cells to try.

    Raises:
        SceneError: If the scene is empty.
        ValueError: If the memory cannot suffice, or the grid was cut from another space.
    """
    config, workers = config or PvsConfig(), workers or Workers()
    count = _fitting(len(g), config, workers)
    viewpoints = CellViewpoints(grid, space)
    some = np.unique(np.linspace(0, len(grid) - 1, min(sample, len(grid)) + 2).astype(int)[1:-1]).tolist() or [0]
    scene = SceneArrays.of(_key(g, config), g, config)
    look = scene.look()
    see_cell(look, viewpoints.spread(some[0], 1), config)  # kernels are loaded before the clock runs
    began, taken, bits = time.perf_counter(), 0, 0.0
    for cell in some:
        view = see_cell(look, viewpoints.spread(cell, config.max_viewpoints), config)
        taken += len(pack_view(view))
        bits += 2.0 * len(view.ids) + 2.0 * len(view.ids)  # sets and classes
    seconds = (time.perf_counter() - began) / len(some) * len(grid)
    folder = journal_of(g, grid, space, path, config)
    finished = len(Journal(folder, {}).finished(len(grid))) if folder.is_dir() else 0
    share = 1.0 - finished / len(grid)
    parallel = 1 if count == 1 else min(count, os.cpu_count() or 1) * 0.6  # one process has all threads already
    return Estimate(
        len(grid),
        finished,
        count,
        seconds * share / max(parallel, 1.0),
        _parent(len(g), config) + (_worker(len(g), config) * count if count > 1 else 0),
        int(bits / 8.0 / len(some) * len(grid)) + 2 * len(g),
        int(taken / len(some) * len(grid)),
    )


def journal_of(
    g: Gaussians, grid: CellGrid, space: NavigableSpace, path: str | os.PathLike[str], config: PvsConfig
) -> Path:
    """The folder in which a build of this plan keeps finished cells."""
    target, plan = Path(path), _plan(g, grid, space, config)
    digest = hashlib.sha256(json.dumps(plan, sort_keys=True).encode()).hexdigest()
    return target.with_name(f"{target.name}.partial-{digest[:12]}")


def _open_journal(
    g: Gaussians, grid: CellGrid, space: NavigableSpace, path: Path, config: PvsConfig
) -> tuple[Journal, dict[str, Any], SceneArrays]:
    plan = _plan(g, grid, space, config)
    journal = Journal(journal_of(g, grid, space, path, config), plan)
    return journal, plan, SceneArrays.of(_key(g, config), g, config)


def _plan(g: Gaussians, grid: CellGrid, space: NavigableSpace, config: PvsConfig) -> dict[str, Any]:
    """All that decides the bytes of the store."""
    free = hashlib.sha256(np.packbits(space.free).tobytes())
    free.update(np.concatenate([space.origin, [space.voxel_size], space.free.shape]).astype("<f8").tobytes())
    return {
        "format": "gsvis pvs plan",
        "version": _PLAN,
        "scene": scene_hash(g),
        "gaussians": len(g),
        "grid": grid.as_dict(),
        "cells": hashlib.sha256(grid.coords.astype("<i4").tobytes()).hexdigest(),
        "space": free.hexdigest(),
        "config": config.as_dict(),
    }


def _key(g: Gaussians, config: PvsConfig) -> str:
    return f"{scene_hash(g)} {config}"


def _results(
    scene: SceneArrays, tasks: list[Task], workers: Workers, count: int, journal: Journal
) -> Iterator[tuple[int, bytes]]:
    if workers.executor is not None:
        shared = scene if workers.scatter is None else workers.scatter(scene)
        return done_by(workers.executor, shared, tasks, in_flight=2 * workers.count)
    if count == 1 or len(tasks) < 2:
        return done_here(scene, tasks)
    return done_by_processes(scene.stored(journal.folder / "scene"), tasks, min(count, len(tasks)))


def _write(
    journal: Journal,
    grid: CellGrid,
    path: Path,
    g: Gaussians,
    plan: dict[str, Any],
    config: PvsConfig,
    progress: Progress,
) -> None:
    info = StoreInfo(
        len(g), plan["scene"], config.tau, config.class_edges, {**config.as_dict(), "space": plan["space"]}
    )
    directions: NDArray[np.uint8] = np.zeros((len(g), NUM_FACES // 8), np.uint8)
    looked = 0
    with StoreWriter(path, grid, info) as writer:
        for cell in range(len(grid)):
            view = journal.view(cell)
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


def _parent(gaussians: int, config: PvsConfig) -> int:
    return _BASE["hybrid"] + 260 * gaussians if config else 0


def _worker(gaussians: int, config: PvsConfig) -> int:
    pixels = _PER_PIXEL * config.size**2
    return _BASE[config.method] + _PER_GAUSSIAN[config.method] * gaussians + pixels


def _fitting(gaussians: int, config: PvsConfig, workers: Workers) -> int:
    """How many processes fit the memory; 1 means that this process works itself."""
    if workers.max_memory is None or workers.executor is not None:
        return workers.count
    alone = max(_parent(gaussians, config), _worker(gaussians, config))
    if workers.max_memory < alone:
        raise ValueError(
            f"max_memory: expected at least {alone / 2**30:.2g} GiB for {gaussians:,} Gaussians,"
            f" got {workers.max_memory / 2**30:.2g} GiB; raise it, or take a coarser level of the scene"
        )
    room = (workers.max_memory - _parent(gaussians, config)) // _worker(gaussians, config)
    return int(min(workers.count, room)) if room >= 2 else 1
