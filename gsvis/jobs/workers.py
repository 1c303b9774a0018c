"""The workers of a run: this process, processes of this machine, or any executor such as that of Dask."""

from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any

from gsvis import _check

__all__ = ["Workers"]


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
