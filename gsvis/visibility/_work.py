"""Cells given out to workers: in this process, in processes of this machine, or on any executor (a Dask cluster).

A task is a few numbers and its result some packed bytes; the scene travels once to each worker. A task that is lost
with its worker is given out again. What comes back does not depend on who did it, nor on when.
"""

from __future__ import annotations

import os
import threading
from collections import OrderedDict
from collections.abc import Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from gsvis.errors import GsvisError
from gsvis.scene.gaussians import Gaussians
from gsvis.visibility._journal import pack_view
from gsvis.visibility.look import Look
from gsvis.visibility.pvs import PvsConfig, see_cell

__all__ = ["SceneArrays", "Task", "done_by", "done_by_processes", "done_here"]

_ARRAYS = ("means", "quats", "scales", "opacities", "sh0", "shN")
_RESTARTS = 3  # times that a broken pool of processes is started again

_ready: OrderedDict[str, Look] = OrderedDict()  # of this process, the last scene and configuration
_one_at_a_time = threading.Lock()  # the kernels of numba's default threading layer may not run from two threads


@dataclass(frozen=True, eq=False)
class SceneArrays:
    """A scene on its way to a worker.

    Attributes:
        key: Names the scene and the configuration.
        source: Its arrays, or the folder that holds them as .npy files.
        config: How visible sets are found.
    """

    key: str
    source: dict[str, Any] | Path
    config: PvsConfig

    @classmethod
    def of(cls, key: str, g: Gaussians, config: PvsConfig) -> SceneArrays:
        """The arrays themselves."""
        return cls(key, {name: getattr(g, name) for name in _ARRAYS}, config)

    def stored(self, folder: Path) -> SceneArrays:
        """The same with the arrays in files, which all processes of a machine map and share."""
        assert isinstance(self.source, dict)
        folder.mkdir(parents=True, exist_ok=True)
        for name, array in self.source.items():
            partial = folder / f".{name}.npy"
            np.save(partial, array)
            os.replace(partial, folder / f"{name}.npy")
        return SceneArrays(self.key, folder, self.config)

    def look(self) -> Look:
        """The scene, ready; kept until another one is asked for."""
        look = _ready.get(self.key)
        if look is None:
            _ready.clear()
            source = self.source
            if isinstance(source, Path):
                source = {name: np.load(source / f"{name}.npy", mmap_mode="r") for name in _ARRAYS}
            look = Look(Gaussians(**source), self.config.method, self.config.size, self.config.tau)
            _ready[self.key] = look
        return look


@dataclass(frozen=True, eq=False)
class Task:
    """One cell to be looked from: its number and its viewpoints (V, 3)."""

    cell: int
    viewpoints: Any


def see(scene: SceneArrays, task: Task) -> bytes:
    """Do one task; runs in the worker."""
    with _one_at_a_time:
        return pack_view(see_cell(scene.look(), task.viewpoints, scene.config))


def done_here(scene: SceneArrays, tasks: Iterable[Task]) -> Iterator[tuple[int, bytes]]:
    """The tasks one after the other, in this process."""
    for task in tasks:
        yield task.cell, see(scene, task)


def done_by(executor: Executor, scene: Any, tasks: Iterable[Task], *, in_flight: int) -> Iterator[tuple[int, bytes]]:
    """The tasks as an executor finishes them.

    Args:
        executor: Anything with `submit`.
        scene: A `SceneArrays`, or what the executor turns into one (a Dask future).
        tasks: Taken as they are needed.
        in_flight: Tasks given out at a time.
    """
    waiting: dict[Future[bytes], Task] = {}
    left = iter(tasks)
    try:
        while True:
            for task in left:
                waiting[executor.submit(see, scene, task)] = task
                if len(waiting) >= in_flight:
                    break
            if not waiting:
                return
            for future in wait(waiting, return_when=FIRST_COMPLETED).done:
                task = waiting[future]
                result = future.result()
                del waiting[future]
                yield task.cell, result
    finally:
        for future in waiting:
            future.cancel()


def done_by_processes(scene: SceneArrays, tasks: list[Task], workers: int) -> Iterator[tuple[int, bytes]]:
    """The tasks on `workers` processes of this machine; processes that die are replaced."""
    missing = {task.cell: task for task in tasks}
    for _ in range(1 + _RESTARTS):
        try:
            with _local_processes(workers) as executor:
                for cell, data in done_by(executor, scene, list(missing.values()), in_flight=2 * workers):
                    del missing[cell]
                    yield cell, data
            return
        except BrokenExecutor:
            continue
    raise GsvisError(
        f"worker processes died {1 + _RESTARTS} times, most likely for want of memory; use fewer --workers or a smaller"
        " --max-memory"
    )


@contextmanager
def _local_processes(workers: int) -> Iterator[Executor]:
    """A pool of processes with one thread each, which goes at once when the block is left early."""
    # Started afresh: a forked process would inherit the threads of numba's kernels in an unusable state.
    pool = ProcessPoolExecutor(workers, mp_context=get_context("spawn"), initializer=_begin, initargs=(os.getpid(),))
    done = False
    try:
        yield pool
        done = True
    finally:
        if not done:
            for process in list((pool._processes or {}).values()):
                process.terminate()
        pool.shutdown(wait=True, cancel_futures=True)


def _begin(parent: int) -> None:
    """Begin a worker process: one thread, deaf to Ctrl-C, which is for the parent, and gone when the parent is."""
    import signal
    import time

    from numba import set_num_threads

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1.0)
        os._exit(1)

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    set_num_threads(1)
    threading.Thread(target=watch, daemon=True).start()
