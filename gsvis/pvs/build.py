"""Build the visible sets of a scene: look from shared viewpoints, find and certify the set of each cell, write a store.

Every finished viewpoint and cell is kept, so a stopped build resumes. The bytes of the file do not depend on the number
of workers, on interruptions, or on a cluster: what a viewpoint sees depends on the scene and the configuration, and a
set on what its viewpoints see, on its cell, and on rays that are drawn by the number of the cell.
"""

from __future__ import annotations

import errno
import hashlib
import os
import shutil
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.errors import OutputError, SceneError
from gsvis.files.output import output_errors
from gsvis.jobs.crew import Crew
from gsvis.jobs.resume import KeptWork
from gsvis.jobs.workers import Workers
from gsvis.progress import Progress, silent
from gsvis.pvs._journal import find_kept, name_cell, name_viewpoint, read_packed, read_view
from gsvis.pvs._tasks import (
    CellTask,
    SceneArrays,
    Task,
    ViewpointTask,
    forget_scene,
    perform,
    run_tasks,
)
from gsvis.pvs.cell_view import CellView
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.config import PvsConfig
from gsvis.pvs.memory import fitting_workers
from gsvis.pvs.store import CellSet, StoreInfo, StoreWriter, VisibilityStore
from gsvis.pvs.viewpoints import CellViewpoints, SharedViewpoints
from gsvis.raycast.directions import NUM_FACES
from gsvis.raycast.proxies import MIN_ALPHA
from gsvis.scene.content import scene_hash, space_hash
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels, as_levels, levels_record, union_of
from gsvis.scene.navigable import NavigableSpace

__all__ = ["Work", "build_pvs", "journal_of", "plan_work"]

Results = Generator[tuple[int, bytes], None, None]
Run = Callable[[Sequence[int], Callable[[int], Task]], Results]

_PLAN = 11  # increase it when the same plan gives other bytes


@dataclass(frozen=True, eq=False)
class Work:
    """The plan of a build, and its finished work.

    Attributes:
        levels: The levels.
        grid: The cells.
        viewpoints: Their free voxels.
        config: How sets are found.
        target: The file to write.
        plan: Everything that decides its bytes.
    """

    levels: Levels
    grid: CellGrid
    viewpoints: CellViewpoints
    config: PvsConfig
    target: Path
    plan: dict[str, Any]

    @cached_property
    def shared(self) -> SharedViewpoints:
        """The viewpoints to look from first."""
        return SharedViewpoints(self.viewpoints)

    @cached_property
    def kept(self) -> KeptWork:
        """Finished viewpoints and cells, beside the target."""
        return KeptWork.beside(self.target, self.plan)

    @cached_property
    def scene(self) -> SceneArrays:
        """The scene in the form for workers."""
        plan = self.plan
        key = f"{plan['scene']} {plan.get('levels')} {plan['config']}"
        return SceneArrays.from_levels(key, self.levels, self.config)

    def find_kept(self) -> tuple[list[int], list[int]]:
        """Return the viewpoints and the cells that are finished."""
        return find_kept(self.kept, len(self.shared), len(self.grid), len(self.levels.union))

    def viewpoint_task(self, number: int) -> ViewpointTask:
        """Return the task of a viewpoint."""
        return ViewpointTask(number, self.shared.points[number], bool(self.shared.fine[number]))

    def cell_task(self, cell: int) -> CellTask:
        """Return the task of a cell, with the sightings that are kept."""
        found = [read_packed(self.kept, k, len(self.levels.union)) for k in self.shared.of_cell(cell).tolist()]
        whole = [each for each in found if each is not None]
        if len(whole) < len(found):
            raise OSError(errno.EIO, f"the journal of a viewpoint of cell {cell} was damaged")
        return CellTask(cell, self.viewpoints.voxels(cell), whole)


def plan_work(
    g: Gaussians | Levels,
    grid: CellGrid,
    space: NavigableSpace,
    path: str | os.PathLike[str],
    config: PvsConfig,
) -> Work:
    """Return the plan of `build_pvs` with these arguments. Writes nothing.

    Raises:
        SceneError: If the scene or a level has nothing to see.
        ValueError: If the grid was made from another space.
    """
    levels = _check_levels(g)
    target = _check.path("path", path)
    return Work(levels, grid, CellViewpoints(grid, space), config, target, _plan(levels, grid, space, config))


def build_pvs(
    g: Gaussians | Levels,
    grid: CellGrid,
    space: NavigableSpace,
    path: str | os.PathLike[str],
    config: PvsConfig | None = None,
    *,
    workers: Workers | None = None,
    one_level: bool = False,
    progress: Progress = silent,
) -> VisibilityStore:
    """Find the visible set of each cell, certify it by rays, and write all sets as a store.

    With more than one worker, a script that calls this needs an `if __name__ == "__main__":` guard, like every
    Python program that starts processes.

    Args:
        g: The scene, N Gaussians; or its levels. With levels, a cell sees a Gaussian of the union if it sees it in at
            least one level drawn alone.
        grid: The cells.
        space: The navigable space that the grid was made from.
        path: The file to write. Finished work is kept beside it until it is complete. An interrupted build of the
            same scene, grid, space and configuration resumes.
        config: Options; None means `PvsConfig()`.
        workers: The workers; None means this process.
        one_level: Whether this process, if it does the work, keeps looks and tracers of one level in memory, and those
            of the others in files beside the target. Changes no byte of the store.
        progress: Called with stages "structure" (with several processes), "viewpoints", "cells", "check" and "store".

    Returns:
        The open store.

    Raises:
        SceneError: If the scene or a level has nothing to see, or every viewpoint lies inside something solid.
        ValueError: If `max_memory` is too small, or the grid was made from another space.
        OSError: If the disk is full or cannot be written; finished work is kept.
    """
    config = config or PvsConfig()
    workers = workers or Workers()
    count = fitting_workers(_check_levels(g), config, workers)
    work = plan_work(g, grid, space, path, config)
    try:
        with work.kept.opened():
            seen, found = work.find_kept()
            cells = sorted(set(range(len(grid))) - set(found))
            needed = {int(k) for cell in cells for k in work.shared.of_cell(cell)}
            looks = sorted(needed - set(seen))
            total = len(work.shared)
            count = min(count, max(len(looks), len(cells), 1))
            with _prepare_scene(work, workers, count, one_level, progress) as scene:
                with _begin_work(scene, workers, count) as run:
                    sightings = run(looks, work.viewpoint_task)
                    _keep(work, sightings, name_viewpoint, ("viewpoints", total - len(looks), total), progress)
                    views = run(cells, work.cell_task)
                    _keep(work, views, name_cell, ("cells", len(found), len(grid)), progress)
                if not one_level:
                    forget_scene()  # lower levels and the second tracer would be in memory together
                twice = _check_twice(work, scene, progress)
            _write(work, twice, progress)
            store = VisibilityStore.open(work.target)  # an unreadable store must lose no work
            work.kept.remove()
    except SceneError:
        work.kept.remove()
        raise
    except OSError as error:
        raise _explain(error, work) from error
    finally:
        forget_scene()
    return store


def journal_of(
    g: Gaussians | Levels, grid: CellGrid, space: NavigableSpace, path: str | os.PathLike[str], config: PvsConfig
) -> Path:
    """Return the folder in which a build of this plan keeps finished viewpoints and cells."""
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


def _explain(error: OSError, work: Work) -> OSError:
    """Return the error with the numbers of finished viewpoints and cells, and a remedy."""
    seen, found = work.find_kept()
    held = f"{len(seen)} of {len(work.shared)} viewpoints and {len(found)} of {len(work.grid)} cells are kept in"
    held = f"{held} {work.kept.folder.name}" if seen or found else "nothing was finished"
    try:
        with output_errors(work.target, work.kept.folder):
            raise error
    except OutputError as output:
        return OutputError(output.path, output.errno or errno.EIO, held, output.remedy)
    except OSError:
        again = "run the same again to resume"
        return OSError(error.errno or errno.EIO, f"{error.strerror or error}; {held}: {again}", str(work.target))


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


def _keep(
    work: Work, results: Results, name: Callable[[int], str], shown: tuple[str, int, int], progress: Progress
) -> None:
    """Keep each result under its name; `shown` is the progress stage, the number done, and the total."""
    stage, done, total = shown
    progress(stage, done, total)
    with closing(results):
        for number, data in results:
            work.kept.keep(name(number), data)
            done += 1
            progress(stage, done, total)


@contextmanager
def _prepare_scene(
    work: Work, workers: Workers, count: int, one_level: bool, progress: Progress
) -> Iterator[SceneArrays]:
    """Yield the scene for `count` processes or other workers; what is prepared is released at the end of the block."""
    shelf = work.kept.folder / "levels"
    here = workers.executor is None
    try:
        if here and count > 1:
            with work.scene.stored(work.kept.folder / "scene", progress) as stored:
                yield stored
        else:
            yield replace(work.scene, shelf=shelf) if here and one_level else work.scene
    finally:
        forget_scene()
        shutil.rmtree(shelf, ignore_errors=True)


@contextmanager
def _begin_work(scene: SceneArrays, workers: Workers, count: int) -> Iterator[Run]:
    """Yield a function that runs tasks on the workers; the same processes run all stages. One task needs no process."""
    alone = crew = Crew(Workers(), perform, lambda: (scene,))
    with ExitStack() as stack:
        if workers.executor is not None:
            scatter = workers.scatter or (lambda scene: scene)
            alone = crew = Crew(workers, perform, lambda: (scatter(scene),))
        elif count > 1:
            crew = stack.enter_context(Crew(Workers(count), perform, lambda: (scene,), ahead=2))
        yield lambda numbers, task_of: run_tasks(crew if len(numbers) > 1 else alone, numbers, task_of)


def _write(work: Work, twice: dict[str, Any] | None, progress: Progress) -> None:
    """Write the store from the kept views of all cells; `twice` is the comparison by a second tracer."""
    plan = work.plan
    grid = work.grid
    config = work.config
    count = plan["gaussians"]
    how = {**config.as_dict(), "space": plan["space"], **{name: plan[name] for name in ("levels",) if name in plan}}
    directions: NDArray[np.uint8] = np.zeros((count, NUM_FACES // 8), np.uint8)
    how["traced_twice"] = twice
    looked = 0
    with StoreWriter(work.target, grid, StoreInfo(count, plan["scene"], config.tau, config.class_edges, how)) as writer:
        for cell in range(len(grid)):
            view = _read(work, cell)
            directions[view.ids] |= view.directions
            looked += view.figures.viewpoints + view.figures.rays
            writer.add_cell(CellSet(view.ids, view.classes, **asdict(view.figures)))
        if not looked:
            raise SceneError(
                "every viewpoint lies inside something solid; give a navigable space or a box that is free of it"
            )
        writer.finish(directions, progress=progress)


def _read(work: Work, cell: int) -> CellView:
    """Return the kept view of a cell."""
    view = read_view(work.kept, cell, len(work.levels.union))
    if view is None:
        raise OSError(errno.EIO, f"the journal of cell {cell} was damaged while the store was written")
    return view


def _check_twice(work: Work, scene: SceneArrays, progress: Progress) -> dict[str, Any] | None:
    """Trace the kept rays of all cells with a second tracer; None if there are no rays or no such tracer."""
    from gsvis.raycast import EllipsoidProxies, Tracer, cross_check

    rays = np.concatenate([_read(work, cell).checked for cell in range(len(work.grid))])
    if not len(rays):
        return None
    progress("check", 0, 1)
    tracer = scene.tracer()
    if tracer is None:
        top = work.levels.bare_level(len(work.levels) - 1)
        tracer = Tracer.named(work.config.tracer, EllipsoidProxies.from_scene(top))
    found = cross_check(tracer, rays[:, :3], rays[:, 3:])
    progress("check", 1, 1)
    return None if found is None else asdict(found)
