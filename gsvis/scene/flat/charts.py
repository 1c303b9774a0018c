"""Describe surfaces as charts: a patch of the plane, in meters, that is laid into the room and painted.

Meters, z up. A chart has a place and a color, but no light. Shapes return lists of charts;
`move` turns and shifts them, so that furniture is built at the origin, facing +y.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["Chart", "Look", "Paint", "box", "cross", "disc", "ellipsoid", "move", "plain", "rectangle", "tube"]

F64 = NDArray[np.float64]
Pair = tuple[float, float]
Triple = tuple[float, float, float]
Hole = tuple[float, float, float, float]
Paint = Callable[[F64, F64], F64]
Place = Callable[[F64, F64], F64]


@dataclass(frozen=True)
class Look:
    """The appearance of a surface.

    Args:
        paint: Function from (...,) meters along u and v to (..., 3) sRGB colors in [0, 1].
        gloss: Share of light that it mirrors when seen from the front, 0 to 1.
        glow: Light that it emits, in units of the color.
        texel: Size of the finest detail, meters.
        detail: Weight of its detail in the distribution of Gaussians.
        rim: Weight of a sharp border.
    """

    paint: Paint
    gloss: float = 0.0
    glow: float = 0.0
    texel: float = 0.012
    detail: float = 1.0
    rim: float = 1.0


@dataclass(frozen=True)
class Chart:
    """A painted surface.

    Args:
        place: Function from u and v (n,), in [0, 1], to (n, 3) points.
        size: Extent along u and v, meters.
        look: Color and gloss.
        holes: Rectangles (u0, v0, u1, v1), meters, that are left out.
        bend: Curvature: 0 for a plane, about 1 for a cushion.
        side: 1 if du x dv points to the visible side, else -1.
    """

    place: Place
    size: Pair
    look: Look
    holes: tuple[Hole, ...] = ()
    bend: float = 0.0
    side: float = 1.0

    def frame(self, u: F64, v: F64) -> tuple[F64, F64, F64]:
        """Return derivatives along u and v, meters for all of the chart, and unit normals, (n, 3) each."""
        step = 1e-3
        low_u = np.maximum(u - step, 0.0)
        high_u = np.minimum(u + step, 1.0)
        low_v = np.maximum(v - step, 0.0)
        high_v = np.minimum(v + step, 1.0)
        du = (self.place(high_u, v) - self.place(low_u, v)) / (high_u - low_u)[:, None]
        dv = (self.place(u, high_v) - self.place(u, low_v)) / (high_v - low_v)[:, None]
        normal = self.side * cross(du, dv)
        return du, dv, normal / np.maximum(np.sqrt((normal**2).sum(axis=1)), 1e-12)[:, None]


def cross(a: F64, b: F64) -> F64:
    """Return (n, 3) cross products; `np.cross` takes several times as long for a few."""
    found = np.empty_like(a)
    found[:, 0] = a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1]
    found[:, 1] = a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2]
    found[:, 2] = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    return found


def plain(color: Triple, **options: float) -> Look:
    """Return a look of one color."""

    def paint(u: F64, v: F64) -> F64:
        """Return the color at u and v."""
        return np.broadcast_to(np.array(color), (*np.shape(u), 3))

    return Look(paint, **options)


def rectangle(
    corner: ArrayLike,
    u_edge: ArrayLike,
    v_edge: ArrayLike,
    look: Look,
    *,
    holes: Iterable[Hole] = (),
    side: float = 1.0,
) -> Chart:
    """Return a flat chart with one corner and two edges given, meters."""
    origin, along, up = (np.asarray(each, np.float64) for each in (corner, u_edge, v_edge))

    def place(u: F64, v: F64) -> F64:
        """Return (n, 3) points of the chart at u and v."""
        return np.asarray(origin + u[:, None] * along + v[:, None] * up)

    size = (float(np.linalg.norm(along)), float(np.linalg.norm(up)))
    return Chart(place, size, look, tuple(holes), side=side)


def box(low: Triple, high: Triple, look: Look, *, rounded: float = 0.0, faces: str = "xXyYZ") -> list[Chart]:
    """Return the faces of a box, without its bottom unless asked for.

    Args:
        low: Lowest corner.
        high: Highest corner.
        look: Look of all faces; u is horizontal on the sides.
        rounded: Radius of the edges, meters.
        faces: A letter for each face: lower case at the low end of an axis, upper case at the high end.
    """
    found = []
    for letter in faces:
        axis = "xyz".index(letter.lower())
        found.append(_face(np.array(low), np.array(high), axis, letter.isupper(), look, rounded))
    return found


def _face(low: F64, high: F64, axis: int, upper: bool, look: Look, rounded: float) -> Chart:
    """Return one face of a box."""
    across, up = ((1, 2), (0, 2), (0, 1))[axis]
    corner = low.copy()
    corner[axis] = high[axis] if upper else low[axis]
    u_edge = np.zeros(3)
    v_edge = np.zeros(3)
    u_edge[across] = high[across] - low[across]
    v_edge[up] = high[up] - low[up]
    outward = np.cross(u_edge, v_edge)[axis] > 0.0
    flat = rectangle(corner, u_edge, v_edge, look, side=1.0 if outward == upper else -1.0)
    if rounded <= 0.0:
        return flat
    radius = min(rounded, 0.49 * float((high - low).min()))
    inner_low = low + radius
    inner_high = high - radius

    def place(u: F64, v: F64) -> F64:
        """Return (n, 3) points of the chart at u and v."""
        points = flat.place(u, v)
        core = np.clip(points, inner_low, inner_high)
        away = points - core
        return np.asarray(core + radius * away / np.linalg.norm(away, axis=1, keepdims=True))

    return replace(flat, place=place, bend=0.5)


def tube(base: Triple, height: float, radii: Pair, look: Look, *, profile: Callable[[F64], F64] | None = None) -> Chart:
    """Return the side of an upright cylinder, cone or other round shape.

    Args:
        base: Center of the lower end.
        height: Meters.
        radii: Radii at the lower and the upper end.
        look: Look; u runs around.
        profile: Function from heights in [0, 1] to factors of the radius.
    """
    origin = np.array(base)

    def place(u: F64, v: F64) -> F64:
        """Return (n, 3) points of the chart at u and v."""
        radius = radii[0] + (radii[1] - radii[0]) * v
        if profile is not None:
            radius = radius * profile(v)
        angle = 2.0 * np.pi * u
        return np.asarray(origin + np.stack([radius * np.cos(angle), radius * np.sin(angle), height * v], axis=1))

    around = 2.0 * np.pi * max(radii)
    return Chart(place, (around, height), look, bend=1.0)


def disc(center: Triple, radius: float, look: Look, *, facing: float = 1.0) -> Chart:
    """Return a horizontal disc that is seen from above, or from below if `facing` is -1."""
    origin = np.array(center)

    def place(u: F64, v: F64) -> F64:
        """Return (n, 3) points of the chart at u and v."""
        x = 2.0 * u - 1.0
        y = 2.0 * v - 1.0
        flat_x = x * np.sqrt(1.0 - 0.5 * y * y)
        flat_y = y * np.sqrt(1.0 - 0.5 * x * x)
        return np.asarray(origin + radius * np.stack([flat_x, flat_y, np.zeros_like(x)], axis=1))

    return Chart(place, (1.8 * radius, 1.8 * radius), look, bend=0.3, side=facing)


def ellipsoid(center: Triple, radii: Triple, look: Look) -> Chart:
    """Return an ellipsoid; u runs around, v from the bottom to the top."""
    origin = np.array(center)
    half = np.array(radii)

    def place(u: F64, v: F64) -> F64:
        """Return (n, 3) points of the chart at u and v."""
        angle = 2.0 * np.pi * u
        height = np.pi * (0.02 + 0.96 * v)
        ring = np.sin(height)
        return np.asarray(
            origin + half * np.stack([ring * np.cos(angle), ring * np.sin(angle), -np.cos(height)], axis=1)
        )

    return Chart(place, (2.0 * np.pi * max(radii[:2]), np.pi * max(radii)), look, bend=1.0)


def move(charts: Iterable[Chart], to: Triple, yaw: float = 0.0) -> list[Chart]:
    """Return the charts turned about the z axis by `yaw` degrees, counterclockwise from above, then shifted."""
    angle = np.radians(yaw)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
    shift = np.array(to)
    return [replace(chart, place=_moved(chart.place, turn, shift)) for chart in charts]


def _moved(place: Place, turn: F64, shift: F64) -> Place:
    """Return a parametrization, rotated and shifted."""

    def transformed(u: F64, v: F64) -> F64:
        """Return the points, rotated and shifted."""
        return np.asarray(place(u, v) @ turn.T + shift)

    return transformed
