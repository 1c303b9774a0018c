"""Run work that can be stopped and resumed: here, on processes, on any executor, or on a Dask cluster.

    with connect("tcp://10.0.0.5:8786") as workers:
        results = run_graph(tasks, open_store("shared/work"), workers)

This room knows no scene. Names are imported on first use.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gsvis.jobs.cluster import connect
    from gsvis.jobs.graph import Given, Result, Task, run_graph
    from gsvis.jobs.objects import ObjectStore, open_store
    from gsvis.jobs.workers import Workers

__all__ = ["Given", "ObjectStore", "Result", "Task", "Workers", "connect", "open_store", "run_graph"]

_HOMES = {
    "cluster": ("connect",),
    "graph": ("Given", "Result", "Task", "run_graph"),
    "objects": ("ObjectStore", "open_store"),
    "workers": ("Workers",),
}


def __getattr__(name: str) -> Any:
    for home, names in _HOMES.items():
        if name in names:
            value = globals()[name] = getattr(import_module(f"{__name__}.{home}"), name)
            return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
