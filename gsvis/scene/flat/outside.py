"""Paint the view through the windows: houses across the street, trees, a lawn and the sky.

It is not lit; its colors are those of a bright afternoon. Its charts are scaled down by their distance, so that a house
across the street gets as many Gaussians as a picture of it on the wall.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gsvis.scene.flat.charts import Chart, Look, Paint, ellipsoid, rectangle, tube
from gsvis.scene.flat.materials import mixed
from gsvis.scene.flat.noise import chance, grain

__all__ = ["outside"]

F64 = NDArray[np.float64]
Triple = tuple[float, float, float]

GROUND = -7.0
FAR = 60.0
MIDDLE = np.array([5.0, 4.3])


def outside() -> list[Chart]:
    """Return all charts of the view outside."""
    found = [_sky(), _lawn()]
    facades: tuple[Triple, ...] = ((0.80, 0.62, 0.50), (0.88, 0.84, 0.74), (0.66, 0.50, 0.44), (0.78, 0.78, 0.76))
    number = 0
    for distance, bearings in (
        (24.0, (-150.0, -118.0, -92.0, -66.0, -40.0, 150.0, 178.0, 95.0, 62.0)),
        (38.0, (-134, -104, -78, -50, 165, 78)),
    ):
        for bearing in bearings:
            color = facades[number % len(facades)]
            found += _house(distance, float(bearing), color, number)
            number += 1
    for i in range(26):
        bearing = (-170.0 + 150.0 * i / 15.0) if i < 16 else (60.0 + 120.0 * (i - 16) / 9.0)
        found += _tree(12.0 + 7.0 * float(chance(i, 1)), bearing + 8.0 * float(chance(i, 2)), i)
    return found


def _shrunk(chart: Chart, paint: Paint, distance: float) -> Chart:
    """Return a chart that counts as small as it looks; `paint` takes true meters."""
    by = 1.5 / distance

    def smaller(u: F64, v: F64) -> F64:
        """Return the color at u and v of the scaled chart."""
        return paint(u / by, v / by)

    look = Look(smaller, texel=0.016, detail=0.7, rim=0.15)
    return replace(chart, size=(chart.size[0] * by, chart.size[1] * by), look=look, bend=0.15 * min(chart.bend, 1.0))


def _at(distance: float, bearing: float) -> F64:
    """Return the point at a distance and a bearing from the flat."""
    angle = np.radians(bearing)
    return np.asarray(MIDDLE + distance * np.array([np.cos(angle), np.sin(angle)]))


def _sky() -> Chart:
    """Return the chart of the sky."""

    def paint(u: F64, v: F64) -> F64:
        """Return the color at u and v."""
        height = np.clip((v + GROUND - 1.5) / 34.0, 0.0, 1.0)
        blue = mixed((0.90, 0.94, 0.97), (0.45, 0.66, 0.90), height**0.8)
        cloud = grain(u / 260.0, v / 110.0 + 0.2) + 0.5 * grain(u / 90.0, v / 45.0)
        share = np.clip(0.75 * (cloud - 0.1), 0.0, 0.85) * np.clip(4.0 * height, 0.0, 1.0)
        return mixed(blue, (0.98, 0.98, 0.98), share)

    base = tube((float(MIDDLE[0]), float(MIDDLE[1]), GROUND), 44.0, (FAR, FAR), Look(paint))
    return _shrunk(replace(base, side=-1.0, bend=0.1), paint, 4.0 * FAR)


def _lawn() -> Chart:
    """Return the chart of the ground outside."""

    def paint(u: F64, v: F64) -> F64:
        """Return the color at u and v."""
        x = u - 50.0
        y = v - 50.0
        green = mixed((0.52, 0.62, 0.34), (0.36, 0.50, 0.26), np.clip(0.5 + 0.4 * grain(u / 60.0, v / 60.0), 0.0, 1.0))
        radius = np.hypot(x, y)
        street = (radius > 17.0) & (radius < 22.0)
        path = (radius > 15.6) & (radius < 17.0)
        gray = np.array([0.55, 0.55, 0.56]) * (1.0 + 0.05 * grain(u / 9.0, v / 9.0))[..., None]
        return np.where(street[..., None], gray, np.where(path[..., None], np.array([0.78, 0.76, 0.72]), green))

    corner = (float(MIDDLE[0]) - 50.0, float(MIDDLE[1]) - 50.0, GROUND)
    base = rectangle(corner, (100.0, 0.0, 0.0), (0.0, 100.0, 0.0), Look(paint))
    return _shrunk(base, paint, 90.0)


def _house(distance: float, bearing: float, color: Triple, seed: int) -> list[Chart]:
    """Return the front of a house and its roof, turned toward the flat."""
    wide = 8.5 + 3.0 * float(chance(seed, 1))
    tall = 9.0 + 5.0 * float(chance(seed, 2))
    center = _at(distance, bearing)
    angle = np.radians(bearing)
    along = np.array([-np.sin(angle), np.cos(angle), 0.0])
    back = np.array([np.cos(angle), np.sin(angle), 0.0])
    corner = np.array([*center, GROUND]) - 0.5 * wide * along

    def paint(u: F64, v: F64) -> F64:
        """Return the color at u and v."""
        column = np.floor(u / 1.9)
        row = np.floor(v / 2.9)
        inner_u = u - 1.9 * column
        inner_v = v - 2.9 * row
        pane = (inner_u > 0.5) & (inner_u < 1.45) & (inner_v > 0.9) & (inner_v < 2.3)
        rim = (inner_u > 0.4) & (inner_u < 1.55) & (inner_v > 0.78) & (inner_v < 2.4)
        glass = mixed((0.30, 0.38, 0.46), (0.80, 0.84, 0.86), chance(column, row, seed))
        shade = 1.0 + 0.04 * grain(u / 11.0, v / 11.0)
        wall = np.clip(np.array(color) * shade[..., None], 0.0, 1.0)
        return np.where(pane[..., None], glass, np.where(rim[..., None], np.array([0.95, 0.94, 0.92]), wall))

    def slate(u: F64, v: F64) -> F64:
        """Return the color of the roof at u and v."""
        rows = 1.0 + 0.10 * (chance(np.floor(v / 0.35), np.floor(u / 0.5), seed) - 0.5)
        return np.clip(np.array([0.50, 0.33, 0.27]) * rows[..., None], 0.0, 1.0)

    front = rectangle(corner, wide * along, (0.0, 0.0, tall), Look(paint))
    top = corner + np.array([0.0, 0.0, tall])
    roof = rectangle(top - 0.3 * along, (wide + 0.6) * along, 3.0 * back + np.array([0.0, 0.0, 2.6]), Look(slate))
    walls = []
    for end in (corner, corner + wide * along):
        walls.append(_shrunk(rectangle(end, 6.0 * back, (0.0, 0.0, tall), Look(paint)), paint, 1.3 * distance))
    return [_shrunk(front, paint, distance), _shrunk(roof, slate, distance), *walls]


def _tree(distance: float, bearing: float, seed: int) -> list[Chart]:
    """Return a tree: a trunk and some round masses of leaves."""
    x, y = _at(distance, bearing)
    tall = 4.2 + 2.3 * float(chance(seed, 3))

    def bark(u: F64, v: F64) -> F64:
        """Return the color of the trunk at u and v."""
        return np.clip(np.array([0.36, 0.29, 0.22]) * (1.0 + 0.1 * grain(u / 3.0, v / 9.0))[..., None], 0.0, 1.0)

    found = [_shrunk(tube((x, y, GROUND), 0.7 * tall, (0.22, 0.14), Look(bark)), bark, 1.5 * distance)]
    for i in range(7):
        angle = 2.4 * i
        part = 0.55 + 0.45 * float(chance(seed, i, 4))
        center = (x + 1.1 * np.cos(angle), y + 1.1 * np.sin(angle), GROUND + tall * part)
        radius = 1.0 + 0.6 * float(chance(seed, i, 5))
        leaf = _foliage(radius, seed + i)
        found.append(_shrunk(ellipsoid(center, (radius, radius, 0.8 * radius), Look(leaf)), leaf, distance))
    return found


def _foliage(radius: float, seed: int) -> Paint:
    """Return the paint of leaves."""
    tall = np.pi * radius

    def paint(u: F64, v: F64) -> F64:
        """Return the color at u and v."""
        lit = np.clip(v / tall, 0.0, 1.0)
        spots = np.clip(0.55 * lit + 0.22 * grain(u / 9.0 + 0.1 * seed, v / 9.0) + 0.15, 0.0, 1.0)
        return mixed((0.16, 0.26, 0.12), (0.55, 0.66, 0.30), spots)

    return paint
