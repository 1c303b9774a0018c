"""What a server does once a second beside its viewers: close scenes without viewers, and bound the memory of tables.

Tables are memory-mapped, so their memory can be given back at any time; a page that is touched again comes from the
file, which the system mostly still has in its cache. Scenes without viewers go first, those used longest ago before
others.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from gsvis.files.mapped import resident_bytes
from gsvis.serve._log import EventLog
from gsvis.serve.limits import Limits
from gsvis.serve.metrics import Metrics
from gsvis.serve.scenes import ServedScene

__all__ = ["LOOK_S", "Upkeep"]

LOOK_S = 1.0
"""Seconds between two looks."""


class Upkeep:
    """Looks after the scenes of one server.

    Args:
        scenes: The scenes.
        limits: Bounds.
        metrics: Counters of the server.
        log: Log of events.
        now: The server's clock, seconds.
        resident: Returns the bytes of files in the memory of the process, libraries included.
    """

    def __init__(
        self,
        scenes: Mapping[str, ServedScene],
        limits: Limits,
        metrics: Metrics,
        log: EventLog,
        now: Callable[[], float],
        *,
        resident: Callable[[], int] = resident_bytes,
    ) -> None:
        self._scenes, self._limits, self._metrics, self._log = scenes, limits, metrics, log
        self._now, self._resident = now, resident
        for served in scenes.values():
            served.used_at = now()
            if served.tables is not None:
                served.tables.release()
        self._base = resident()  # libraries

    def look(self) -> None:
        """Close scenes and give memory back where it is time."""
        now, served = self._now(), list(self._scenes.values())
        for scene in served:
            if scene.close_unused(now, self._limits.close_s):
                self._metrics.scenes_closed.add(of=scene.name)
                self._log("unused", scene=scene.name, seconds=self._limits.close_s)
        mapped = [scene for scene in served if scene.tables is not None]
        for scene in sorted(mapped, key=lambda each: (each.users > 0, each.used_at)):
            if self._excess() <= self._limits.tables_bytes:
                break
            if (tables := scene.tables) is not None:
                tables.release()
                self._metrics.tables_released.add(of=scene.name)
        self._metrics.tables_bytes.set(self._excess() if mapped else 0)
        self._metrics.open_scenes.set(sum(scene.opened is not None for scene in served))

    def _excess(self) -> int:
        return max(0, self._resident() - self._base)
