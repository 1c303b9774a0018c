"""The memory that finding visible sets needs, and how many processes fit a limit."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from gsvis.jobs.cost import COARSER, memory_error
from gsvis.jobs.workers import Workers
from gsvis.pvs.config import PvsConfig
from gsvis.scene.levels import Levels

__all__ = ["expected_memory", "fitting_workers", "sets_memory", "shared_files"]

# Measured peaks with a margin (docs/design/070): bytes of a process with its libraries; for each Gaussian those of its
# prepared look and of the tracer that certifies, which processes share, and those that a process needs beside them.
_BASE = {"hybrid": 200 << 20, "raster": 380 << 20, "raycast": 260 << 20}
_PREPARED = {"hybrid": 110 + 300, "raster": 70 + 300, "raycast": 70 + 300}
_PER_GAUSSIAN = {"hybrid": 60, "raster": 350, "raycast": 610}
_PER_PIXEL = {"hybrid": 6 * 24, "raster": 6 * 64, "raycast": 6 * 64}  # all six faces
_PARENT_BASE = 220 << 20
_PARENT_PER_GAUSSIAN = 320  # navigable space, order of the store, and leftovers of reading
_CHECK_BASE = 300 << 20  # parts of the second tracer
_CHECK_PER_GAUSSIAN = 300  # hierarchy of the first

_SCENE_BYTES = 58  # of each Gaussian in the arrays of the scene


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


def _prepared(gaussians: int, config: PvsConfig) -> int:
    """Return the bytes of the looks and tracers of that many Gaussians."""
    return (_PREPARED[config.method] + _SCENE_BYTES) * gaussians


def _worker(sizes: _Sizes, config: PvsConfig) -> int:
    """Return the bytes of memory of a worker process beside what all of them share."""
    return (
        _BASE[config.method] + _PER_GAUSSIAN[config.method] * sizes.drawn + _PER_PIXEL[config.method] * config.size**2
    )


def _alone(sizes: _Sizes, config: PvsConfig) -> int:
    """Return the bytes of memory of one process that does all the work."""
    held = sizes.nbytes + _PARENT_PER_GAUSSIAN // 4 * sizes.union
    return max(_parent(sizes) + _check_twice(sizes), _prepared(sizes.drawn, config) + _worker(sizes, config) + held)


def _together(sizes: _Sizes, config: PvsConfig) -> int:
    """Return the bytes of memory of all processes before any worker starts."""
    return _parent(sizes) + _prepared(sizes.drawn, config)


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
    return max(_parent(sizes) + _check_twice(sizes), _together(sizes, config) + count * _worker(sizes, config))


def shared_files(levels: Levels, config: PvsConfig) -> int:
    """Return the bytes of the files that processes of a machine share while they work."""
    return _SCENE_BYTES * len(levels.union) + _prepared(_sizes_of(levels).drawn, config)


def fitting_workers(levels: Levels, config: PvsConfig, workers: Workers) -> int:
    """Return how many processes fit the memory; 1 means that this process does the work."""
    if workers.max_memory is None or workers.executor is not None:
        return workers.count
    sizes = _sizes_of(levels)
    alone = _alone(sizes, config)
    if workers.max_memory < alone:
        raise memory_error(alone, workers.max_memory, f"{len(levels.union):,} Gaussians", COARSER)
    room = (workers.max_memory - _together(sizes, config)) // _worker(sizes, config)
    return int(min(workers.count, room)) if room >= 2 else 1
