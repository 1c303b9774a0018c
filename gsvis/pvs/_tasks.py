"""Workers that look from viewpoints and find sets: this process, processes of this machine, or any executor (Dask).

A task is a viewpoint, or a cell with what its viewpoints see; its result is packed bytes. The scene is sent once to
each worker. If a worker dies, its tasks are submitted again. A result does not depend on the worker or on the time.
"""

from __future__ import annotations

import shutil
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.errors import GsvisError
from gsvis.files.output import output_errors
from gsvis.files.shelf import Shelved
from gsvis.jobs.crew import Crew
from gsvis.jobs.freed_memory import release_freed_memory
from gsvis.jobs.processes import limit_threads, one_at_a_time, ready
from gsvis.progress import Progress, silent
from gsvis.pvs._journal import pack_sighting, pack_view, unpack_sighting
from gsvis.pvs.cell_view import Finder
from gsvis.pvs.config import PvsConfig
from gsvis.pvs.prepared import PreparedLevel, PreparedLevels
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
    "run_tasks",
]

# shN does not change what is visible.
_SHAPES = {"means": (-1, 3), "quats": (-1, 4), "scales": (-1, 3), "opacities": (-1,), "sh0": (-1, 1, 3)}
_MEMBERSHIP = ("first", "last")  # first and last level of each Gaussian


@dataclass(frozen=True, eq=False)
class SceneArrays:
    """A scene, or levels, in a form that can be sent to a worker.

    Attributes:
        key: Names the scene and the configuration.
        source: The arrays of the union and the levels of each Gaussian; or a folder with one file for each array.
        config: How visible sets are found.
        shelf: Folder of this process for what is prepared of levels; None keeps that in memory.
        made: The levels, prepared already.
    """

    key: str
    source: dict[str, Any] | Path
    config: PvsConfig
    shelf: Path | None = None
    made: tuple[Shelved[PreparedLevel], ...] = ()

    @classmethod
    def from_levels(cls, key: str, levels: Levels, config: PvsConfig) -> SceneArrays:
        """Return the scene with its arrays in memory."""
        arrays = {name: getattr(levels.union, name) for name in _SHAPES}
        return cls(key, arrays | {name: getattr(levels, name) for name in _MEMBERSHIP}, config)

    @contextmanager
    def stored(self, folder: Path, progress: Progress = silent) -> Iterator[SceneArrays]:
        """Yield the scene with its arrays, and its prepared levels, in files of `folder`.

        All processes of a machine map and share the files. The folder is removed at the end of the block. `progress` is
        called with stage "structure".
        """
        assert isinstance(self.source, dict)
        try:
            with output_errors(folder):
                folder.mkdir(parents=True, exist_ok=True)
                for name, array in self.source.items():
                    (folder / f"{name}.bin").write_bytes(np.ascontiguousarray(array).data)
                made = PreparedLevels(_levels_of(self.source), self.config).shelve(folder, progress)
            yield SceneArrays(self.key, folder, self.config, made=made)
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    def finder(self) -> Finder:
        """Return the prepared levels; cached until another scene or configuration is asked for."""
        finder = ready.find(self.key)
        if finder is None:
            ready.clear()
            levels = _levels_of(_map(self.source) if isinstance(self.source, Path) else self.source)
            finder = Finder(levels, self.config, PreparedLevels(levels, self.config, self.shelf, self.made))
            ready.keep(self.key, finder)
        return finder

    def tracer(self) -> Tracer | None:
        """Return the tracer of the highest level; None unless it is prepared."""
        if self.made:
            return self.made[-1].open().certifier.tracer
        finder = ready.find(self.key)
        return None if finder is None else finder.tracer


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
    """A cell whose set is to be found: its number, its free voxels, and the packed sightings of its viewpoints."""

    number: int
    voxels: FreeVoxels
    sightings: list[bytes]

    def perform(self, finder: Finder) -> bytes:
        """Return the packed view of the cell."""
        found = [unpack_sighting(data, len(finder.levels.union)) for data in self.sightings]
        whole = [each for each in found if each is not None]
        if len(whole) < len(found):
            raise GsvisError(f"cell {self.number}: a sighting of a viewpoint arrived damaged; run the same again")
        return pack_view(finder.find_cell(self.voxels, whole))


Task = ViewpointTask | CellTask


def _levels_of(source: dict[str, Any]) -> Levels:
    """Return levels from their arrays, without harmonics."""
    first, last = (source[name] for name in _MEMBERSHIP)
    union = Gaussians(*(source[name] for name in _SHAPES))
    return Levels(union, first, last, [str(k) for k in range(int(last.max()) + 1)])


def _map(folder: Path) -> dict[str, NDArray[Any]]:
    """Return the memory-mapped arrays of a scene in a folder, by name."""
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
    release_freed_memory()


def run_tasks(
    crew: Crew[bytes], numbers: Iterable[int], task_of: Callable[[int], Task]
) -> Generator[tuple[int, bytes], None, None]:
    """Yield the number and the packed result of each task as it is finished.

    Args:
        crew: Workers that call `perform`.
        numbers: The tasks, begun in this order.
        task_of: Returns a task when it is given out.

    Raises:
        GsvisError: If workers are lost again and again.
    """
    left = deque(numbers)

    def next_job() -> tuple[int, Task] | None:
        """Return the next task."""
        if not left:
            return None
        number = left.popleft()
        return number, task_of(number)

    with closing(crew.run(next_job, left.appendleft)) as finished:
        for number, future in finished:
            yield number, future.result()
