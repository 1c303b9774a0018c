"""Workers that look from viewpoints and find sets: this process, processes of this machine, or any executor (Dask).

A task is a viewpoint, or a cell with what its viewpoints see; its result is packed bytes. The scene is sent once to
each worker. If a worker dies, its tasks are submitted again. A result does not depend on the worker or on the time.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    wait,
)
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.errors import GsvisError
from gsvis.files.output import output_errors
from gsvis.jobs.processes import Processes, limit_threads, one_at_a_time, ready
from gsvis.pvs._journal import pack_sighting, pack_view, unpack_sighting
from gsvis.pvs.cell_view import Finder
from gsvis.pvs.config import PvsConfig
from gsvis.pvs.viewpoints import FreeVoxels
from gsvis.raycast import Tracer
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels

__all__ = [
    "CellTask",
    "SceneArrays",
    "Task",
    "ViewpointTask",
    "forget_scene",
    "perform",
    "ready_tracer",
    "run_here",
    "run_in_processes",
    "run_on",
]

Result = tuple[int, bytes]
"""The number of a task and its packed result."""

# shN does not change what is visible.
_SHAPES = {"means": (-1, 3), "quats": (-1, 4), "scales": (-1, 3), "opacities": (-1,), "sh0": (-1, 1, 3)}
_MEMBERSHIP = ("first", "last")  # first and last level of each Gaussian
_RESTARTS = 3  # consecutive restarts without a finished task


@dataclass(frozen=True, eq=False)
class SceneArrays:
    """A scene, or levels, in a form that can be sent to a worker.

    Attributes:
        key: Names the scene and the configuration.
        source: The arrays of the union and the levels of each Gaussian; or a folder with one file for each array.
        config: How visible sets are found.
        shelf: Folder of this process for what a `Finder` makes of levels; None keeps that in memory.
    """

    key: str
    source: dict[str, Any] | Path
    config: PvsConfig
    shelf: Path | None = None

    @classmethod
    def from_levels(cls, key: str, levels: Levels, config: PvsConfig) -> SceneArrays:
        """Return the scene with its arrays in memory."""
        arrays = {name: getattr(levels.union, name) for name in _SHAPES}
        return cls(key, arrays | {name: getattr(levels, name) for name in _MEMBERSHIP}, config)

    @contextmanager
    def stored(self, folder: Path) -> Iterator[SceneArrays]:
        """Yield the scene with its arrays in files of `folder`.

        All processes of a machine map and share the files. The folder is removed at the end of the block.
        """
        assert isinstance(self.source, dict)
        try:
            with output_errors(folder):
                folder.mkdir(parents=True, exist_ok=True)
                for name, array in self.source.items():
                    (folder / f"{name}.bin").write_bytes(np.ascontiguousarray(array).data)
            yield SceneArrays(self.key, folder, self.config)
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    def finder(self) -> Finder:
        """Return the prepared levels; cached until another scene or configuration is asked for."""
        finder = ready.find(self.key)
        if finder is None:
            ready.clear()
            source = self.source
            if isinstance(source, Path):
                source = _map(source)
            first, last = (source[name] for name in _MEMBERSHIP)
            union = Gaussians(*(source[name] for name in _SHAPES))
            levels = Levels(union, first, last, [str(k) for k in range(int(last.max()) + 1)])
            finder = Finder(levels, self.config, self.shelf)
            ready.keep(self.key, finder)
        return finder


@dataclass(frozen=True, eq=False)
class ViewpointTask:
    """A viewpoint (3,) to look from, its number, and whether it looks finely and at lower levels too."""

    number: int
    viewpoint: Any
    fine: bool

    def perform(self, finder: Finder) -> bytes:
        """Return the packed sighting."""
        return pack_sighting(finder.look(np.asarray(self.viewpoint), fine=self.fine))


@dataclass(frozen=True, eq=False)
class CellTask:
    """A cell whose set is to be found.

    Attributes:
        number: Number of the cell.
        voxels: Its free voxels.
        sightings: Packed sightings of its viewpoints; or a function that reads them when the task is given out.
    """

    number: int
    voxels: FreeVoxels
    sightings: list[bytes] | Callable[[], list[bytes]]

    def filled(self) -> CellTask:
        """Return the task with its sightings, so that it can be sent."""
        if isinstance(self.sightings, list):
            return self
        return CellTask(self.number, self.voxels, self.sightings())

    def perform(self, finder: Finder) -> bytes:
        """Return the packed view of the cell."""
        sightings = self.sightings if isinstance(self.sightings, list) else self.sightings()
        found = [unpack_sighting(data, len(finder.levels.union)) for data in sightings]
        whole = [each for each in found if each is not None]
        if len(whole) < len(found):
            raise GsvisError(f"cell {self.number}: a sighting of a viewpoint arrived damaged; run the same again")
        return pack_view(finder.find_cell(self.voxels, whole))


Task = ViewpointTask | CellTask


def _map(folder: Path) -> dict[str, NDArray[Any]]:
    kinds: dict[str, Any] = dict.fromkeys(_SHAPES, np.float32) | dict.fromkeys(_MEMBERSHIP, np.uint8)
    arrays = {name: np.asarray(np.memmap(folder / f"{name}.bin", kind, mode="r")) for name, kind in kinds.items()}
    return {name: array.reshape(_SHAPES.get(name, (-1,))) for name, array in arrays.items()}


def perform(scene: SceneArrays, task: Task) -> bytes:
    """Run one task and return its packed result; called in the worker."""
    with one_at_a_time:
        limit_threads()
        return task.perform(scene.finder())


def forget_scene() -> None:
    """Release the memory of the last scene."""
    ready.clear()


def ready_tracer(key: str) -> Tracer | None:
    """Return the tracer of the highest level of the last scene, if that has this key; None if it has not."""
    finder = ready.find(key)
    return None if finder is None else finder.tracer


def run_here(scene: SceneArrays, tasks: Iterable[Task]) -> Iterator[Result]:
    """Yield the results of the tasks, computed one by one in this process; `forget_scene` afterward."""
    for task in tasks:
        yield task.number, perform(scene, task)


def run_on(executor: Executor, share: Callable[[], Any], tasks: list[Task], in_flight: int) -> Iterator[Result]:
    """Yield the results of the tasks as an executor finishes them; lost tasks are submitted again.

    Args:
        executor: Anything with `submit`.
        share: Returns a `SceneArrays`, or an object that the executor turns into one (a Dask future).
        tasks: The tasks, submitted in this order.
        in_flight: Tasks submitted at a time.

    Raises:
        GsvisError: If tasks are lost more than three times in a row without progress.
    """
    message = "the cluster lost its tasks again and again: are its scheduler and its workers alive?"
    return _until_done(tasks, lambda left: _submit(executor, share(), left, in_flight), CancelledError, message)


def run_in_processes(scene: SceneArrays, tasks: list[Task], processes: Processes) -> Iterator[Result]:
    """Yield the results of the tasks from processes of this machine; dead processes are replaced.

    Raises:
        GsvisError: If processes die more than three times in a row without progress.
    """

    def attempt(left: list[Task]) -> Iterator[Result]:
        try:
            yield from _submit(processes.executor(), scene, left, 2 * processes.count)
        except BrokenExecutor:
            processes.end(kill=True)
            raise

    message = (
        "worker processes died again and again, probably out of memory: use fewer --workers or a smaller --max-memory"
    )
    return _until_done(tasks, attempt, BrokenExecutor, message)


def _until_done(
    tasks: list[Task], attempt: Callable[[list[Task]], Iterator[Result]], lost: type[Exception], message: str
) -> Iterator[Result]:
    missing = {task.number: task for task in tasks}
    failures = 0
    while missing:
        before = len(missing)
        try:
            for number, data in attempt(list(missing.values())):
                del missing[number]
                yield number, data
        except lost as error:
            failures = 0 if len(missing) < before else failures + 1
            if failures > _RESTARTS:
                raise GsvisError(message) from error


def _submit(executor: Executor, scene: Any, tasks: Iterable[Task], in_flight: int) -> Iterator[Result]:
    waiting: dict[Future[bytes], Task] = {}
    left = iter(tasks)
    try:
        while True:
            for task in left:
                sent = task.filled() if isinstance(task, CellTask) else task
                waiting[executor.submit(perform, scene, sent)] = task
                if len(waiting) >= in_flight:
                    break
            if not waiting:
                return
            # Yield finished tasks before lost ones: the set has no order, and a lost task ends this attempt.
            for future in sorted(wait(waiting, return_when=FIRST_COMPLETED).done, key=_is_lost):
                task = waiting.pop(future)
                yield task.number, future.result()
    finally:
        for future in waiting:
            future.cancel()


def _is_lost(future: Future[bytes]) -> bool:
    return future.cancelled() or future.exception() is not None
