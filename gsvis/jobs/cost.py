"""What work costs: the memory of a task before it runs, the gain by workers, and the error of work that does not fit.

A module that has tasks declares the bytes that each needs in `MEMORY`, beside the code that allocates them.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from importlib import import_module
from typing import Any

from gsvis.errors import ArgumentError
from gsvis.jobs.workers import Workers

__all__ = ["COARSER", "IDLE", "machine_load", "memory_error", "needed_memory", "speed_up"]

COARSER = "raise it, or take a coarser level of the scene"
"""What to do about a scene that does not fit the memory."""

IDLE = 280 << 20
"""Bytes of a process that has loaded every library and runs no task."""

_EFFICIENCY = 0.9  # of processes with one thread each, which share the memory


def needed_memory(run: str, params: dict[str, Any], inputs: Sequence[dict[str, Any]]) -> int:
    """Return the bytes that a task needs beyond an idle process; 0 if its module declares none in `MEMORY`.

    Args:
        run: Its function, as `module:name`.
        params: Its values.
        inputs: Facts of the results that it reads.
    """
    module, name = run.split(":")
    need = getattr(import_module(module), "MEMORY", {}).get(name)
    return 0 if need is None else int(need(params, inputs))


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
    """Return the mean number of processes that used or waited for a core in the last minute; None if unknown."""
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
