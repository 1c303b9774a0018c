"""State the plan of the flat: rooms, doors and windows, in meters; x east, y north, z up, the floor at z = 0."""

from __future__ import annotations

from dataclasses import dataclass

from gsvis.scene.flat.light import Window

__all__ = ["DOORS", "HEIGHT", "OUTER", "ROOMS", "WINDOWS", "Opening", "Room", "opening_windows"]

HEIGHT = 2.7
OUTER = 0.28  # thickness of outer walls
INNER = 0.12


@dataclass(frozen=True)
class Room:
    """A room: its name and its inner extent."""

    name: str
    x: tuple[float, float]
    y: tuple[float, float]


@dataclass(frozen=True)
class Opening:
    """A hole in walls that lie across one axis.

    Args:
        axis: 0 if the wall lies across x, 1 if across y.
        low: Start of the hole on that axis, at one face of the wall.
        high: End of the hole, at the other face.
        span: Extent along the wall.
        z: Vertical extent.
    """

    axis: int
    low: float
    high: float
    span: tuple[float, float]
    z: tuple[float, float]


ROOMS = (
    Room("living", (0.0, 5.9), (0.0, 4.3)),
    Room("kitchen", (6.02, 10.0), (0.0, 4.3)),
    Room("bedroom", (0.0, 4.1), (4.42, 8.6)),
    Room("hall", (4.22, 10.0), (4.42, 5.7)),
    Room("study", (4.22, 7.3), (5.82, 8.6)),
    Room("bath", (7.42, 10.0), (5.82, 8.6)),
)

DOORS = (
    Opening(0, 5.9, 6.02, (1.2, 3.0), (0.0, 2.3)),
    Opening(1, 4.3, 4.42, (4.65, 5.55), (0.0, 2.06)),
    Opening(0, 4.1, 4.22, (4.6, 5.5), (0.0, 2.06)),
    Opening(1, 5.7, 5.82, (5.4, 6.3), (0.0, 2.06)),
    Opening(1, 5.7, 5.82, (8.0, 8.85), (0.0, 2.06)),
)

WINDOWS = (
    Opening(1, -OUTER, 0.0, (0.7, 2.5), (0.4, 2.35)),
    Opening(1, -OUTER, 0.0, (3.3, 5.1), (0.4, 2.35)),
    Opening(0, -OUTER, 0.0, (1.3, 3.1), (0.06, 2.35)),
    Opening(1, -OUTER, 0.0, (7.1, 8.9), (1.12, 2.35)),
    Opening(0, -OUTER, 0.0, (5.6, 7.5), (0.8, 2.3)),
    Opening(1, 8.6, 8.6 + OUTER, (4.9, 6.6), (0.85, 2.3)),
    Opening(1, 8.6, 8.6 + OUTER, (8.5, 9.3), (1.4, 2.25)),
)


def opening_windows() -> tuple[Window, ...]:
    """Return the windows as openings to the sky, at the outer face of the wall."""
    found = []
    for each in WINDOWS:
        outer = each.low if each.low < 0.0 else each.high
        inward = 1.0 if each.low < 0.0 else -1.0
        wide = each.span[1] - each.span[0]
        tall = each.z[1] - each.z[0]
        if each.axis == 0:
            found.append(
                Window((outer, each.span[0], each.z[0]), (0.0, wide, 0.0), (0.0, 0.0, tall), (inward, 0.0, 0.0))
            )
        else:
            found.append(
                Window((each.span[0], outer, each.z[0]), (wide, 0.0, 0.0), (0.0, 0.0, tall), (0.0, inward, 0.0))
            )
    return tuple(found)
