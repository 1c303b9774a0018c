"""What a server does beside its viewers: close scenes without viewers, bound the memory of tables, open tiles ahead.

Tables are memory-mapped, so their memory can be given back at any time; a page that is touched again comes from the
file, which the system mostly still has in its cache. Tiles of worlds without viewers near them go first, then scenes
without viewers, the least recently used first.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

from gsvis.files.mapped import resident_bytes
from gsvis.serve._log import EventLog
from gsvis.serve.limits import Limits
from gsvis.serve.metrics import Metrics
from gsvis.serve.scenes import ServedScene

__all__ = ["AHEAD_S", "LOOK_S", "Upkeep"]

LOOK_S = 0.25
"""Seconds between two looks: pages of tables come at a gigabyte a second when many viewers arrive."""

AHEAD_S = 3.0
"""Seconds ahead of a walk for which tiles are opened."""


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
        self._scenes = scenes
        self._limits = limits
        self._metrics = metrics
        self._log = log
        self._now = now
        self._resident = resident
        self._touched: dict[str, dict[int, tuple[float, float]]] = {}  # tiles that somebody has been near, by scene
        for served in scenes.values():
            served.used_at = now()
            if served.tables is not None:
                served.tables.release()
        self._base = resident()  # libraries

    def look(self) -> None:
        """Close scenes and give memory back where it is time."""
        now = self._now()
        served = list(self._scenes.values())
        for scene in served:
            if scene.close_unused(now, self._limits.close_s):
                self._touched.pop(scene.name, None)
                self._metrics.scenes.closed.add(of=scene.name)
                self._log("unused", scene=scene.name, seconds=self._limits.close_s)
        mapped = [scene for scene in served if scene.tables is not None]
        for scene in mapped:
            self._release_tiles(scene)
        for scene in sorted(mapped, key=lambda each: (each.users > 0, each.used_at)):
            if self._excess() <= self._limits.tables_bytes:
                break
            if (tables := scene.tables) is not None:
                tables.release()
                self._metrics.scenes.tables_released.add(of=scene.name)
        self._metrics.scenes.tables_bytes.set(self._excess() if mapped else 0)
        self._metrics.scenes.open.set(sum(scene.opened is not None for scene in served))

    def ahead(self) -> list[Callable[[], None]]:
        """Return what opens the tiles that viewers are about to enter; threads may run it."""
        found = dict[tuple[str, int], Callable[[], None]]()
        for scene in self._scenes.values():
            if scene.opened is None:
                continue
            index = scene.opened.index
            for session in scene.sessions:
                position = session.planner.position_in(AHEAD_S)
                near = [] if position is None else index.sets.tiles_near(index.grid.nearest(position))
                for tile in sorted(near):
                    if not index.sets.is_open(tile):
                        found[scene.name, tile] = partial(index.sets.load, tile)
        return list(found.values())

    def _release_tiles(self, scene: ServedScene) -> None:
        """Give back the memory of tiles of a world that viewers have left, if there is too much."""
        if scene.opened is None:
            return
        sets = scene.opened.index.sets
        cells = {cell for each in scene.sessions if (cell := each.planner.cell) >= 0}
        near = {tile: share for cell in cells for tile, share in sets.tiles_near(cell).items()}
        touched = self._touched.setdefault(scene.name, {})
        left = [share for tile, share in touched.items() if tile not in near]
        if left and scene.tables is not None and self._excess() > self._limits.tables_bytes:
            scene.tables.release(left)
            touched.clear()
        touched.update(near)

    def _excess(self) -> int:
        """Return the bytes of tables in memory."""
        return max(0, self._resident() - self._base)
