"""The workers of a build: how many there are, the memory that each needs, and how much faster they are than one."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any, NamedTuple

from gsvis import _check
from gsvis.errors import ArgumentError
from gsvis.pvs.config import PvsConfig
from gsvis.scene.levels import Levels

__all__ = [
    "COARSER",
    "SCENE_BYTES",
    "Workers",
    "expected_memory",
    "fitting_workers",
    "machine_load",
    "memory_error",
    "sets_memory",
    "speed_up",
]

# Measured peaks with a margin (docs/design/070): bytes of a process with its libraries, and for each Gaussian: of its
# looks, and of the tracer that certifies.
_BASE = {"hybrid": 280 << 20, "raster": 380 << 20, "raycast": 260 << 20}
_PER_GAUSSIAN = {"hybrid": 190 + 420, "raster": 420 + 420, "raycast": 680 + 420}
_PER_PIXEL = {"hybrid": 6 * 24, "raster": 6 * 64, "raycast": 6 * 64}  # all six faces
_PARENT_BASE = 220 << 20
_PARENT_PER_GAUSSIAN = 320  # navigable space, order of the store, and leftovers of reading
_CHECK_BASE = 300 << 20  # parts of the second tracer
_CHECK_PER_GAUSSIAN = 420  # hierarchy of the first

SCENE_BYTES = 58
"""Bytes of each Gaussian in the file of the scene that workers map."""

_EFFICIENCY = 0.9  # of processes with one thread each, which share the memory


COARSER = "raise it, or take a coarser level of the scene"
"""What to do about a scene that does not fit the memory."""


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


class _Sizes(NamedTuple):
    """What the memory of a build depends on.

    Attributes:
        union: Gaussians of all levels together.
        counts: Gaussians of each level, lowest first.
        nbytes: Bytes of the Gaussians in memory.
    """

    union: int
    counts: Sequence[int]
    nbytes: int

    @property
    def drawn(self) -> int:
        """Gaussians that are looked at, each as often as it stands in a level."""
        return sum(self.counts)


def _sizes_of(levels: Levels) -> _Sizes:
    return _Sizes(len(levels.union), levels.counts, levels.union.nbytes)


def _parent(sizes: _Sizes) -> int:
    """Return the bytes of memory of the process that submits the tasks and writes the store."""
    copies = sizes.nbytes * sizes.counts[-1] // sizes.union if len(sizes.counts) > 1 else 0  # the highest level
    return _PARENT_BASE + _PARENT_PER_GAUSSIAN * sizes.union + sizes.nbytes + copies


def _check_twice(sizes: _Sizes) -> int:
    """Return the bytes that the second tracer needs when all cells are found."""
    return _CHECK_BASE + _CHECK_PER_GAUSSIAN * sizes.counts[-1]


def _worker(sizes: _Sizes, config: PvsConfig) -> int:
    """Return the bytes of memory of a worker process."""
    pixels = _PER_PIXEL[config.method] * config.size**2
    copies = SCENE_BYTES * sizes.drawn if len(sizes.counts) > 1 else 0  # a single level is the mapped arrays themselves
    return _BASE[config.method] + _PER_GAUSSIAN[config.method] * sizes.drawn + copies + pixels


def _alone(sizes: _Sizes, config: PvsConfig) -> int:
    """Return the bytes of memory of one process that does all the work."""
    held = sizes.nbytes + _PARENT_PER_GAUSSIAN // 4 * sizes.union
    return max(_parent(sizes) + _check_twice(sizes), _worker(sizes, config) + held)


def sets_memory(counts: Sequence[int], gaussians: int, sh_degree: int, config: PvsConfig) -> int:
    """Return the bytes that one process needs at its peak to find visible sets, before a scene is read.

    Args:
        counts: Gaussians of each level, lowest first.
        gaussians: Gaussians of all levels together.
        sh_degree: Of the scene.
        config: How sets are found.
    """
    return _alone(_Sizes(gaussians, counts, 4 * (11 + 3 * (sh_degree + 1) ** 2) * gaussians), config)


def expected_memory(levels: Levels, config: PvsConfig, count: int) -> int:
    """Return the peak bytes of memory of all processes, with `count` workers on this machine; 1 is this process."""
    sizes = _sizes_of(levels)
    if count == 1:
        return _alone(sizes, config)
    return _parent(sizes) + max(_check_twice(sizes), count * _worker(sizes, config))


def speed_up(count: int, workers: Workers, threads: float = 1.0) -> float:
    """Return the speed-up by `count` workers over one process that uses all threads of this machine.

    Args:
        count: Workers.
        workers: Which workers.
        threads: Speed-up of the one process by its threads.
    """
    if workers.executor is not None:
        return max(1.0, _EFFICIENCY * count)
    return _EFFICIENCY * min(count, os.cpu_count() or 1) / threads if count > 1 else 1.0


def machine_load() -> float | None:
    """Return how many processes have used or waited for a core in the last minute, mean; None where nobody knows."""
    try:
        return round(os.getloadavg()[0], 2)
    except (AttributeError, OSError):
        return None


def memory_error(need: int, limit: int, what: str, remedy: str) -> ArgumentError:
    """Return the error of work that does not fit the memory. The need is rounded up: a limit of that suffices.

    Args:
        need: Bytes.
        limit: Bytes, `Workers.max_memory`.
        what: What needs them.
        remedy: What to do.
    """
    least = math.ceil(need / 1e6) / 1e3
    got = math.floor(limit / 1e6) / 1e3
    return ArgumentError("max_memory", f"expected at least {least:.10g} GB for {what}, got {got:.10g} GB", remedy)


def fitting_workers(levels: Levels, config: PvsConfig, workers: Workers) -> int:
    """Return how many processes fit the memory; 1 means that this process does the work."""
    if workers.max_memory is None or workers.executor is not None:
        return workers.count
    sizes = _sizes_of(levels)
    alone = _alone(sizes, config)
    if workers.max_memory < alone:
        raise memory_error(alone, workers.max_memory, f"{len(levels.union):,} Gaussians", COARSER)
    room = (workers.max_memory - _parent(sizes)) // _worker(sizes, config)
    return int(min(workers.count, room)) if room >= 2 else 1
