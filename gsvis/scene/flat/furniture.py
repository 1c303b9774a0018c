"""Build furniture from boxes, tubes and ellipsoids, at the origin, facing +y, the floor at z = 0, meters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gsvis.scene.flat.charts import Chart, Look, box, disc, ellipsoid, move, plain, rectangle, tube
from gsvis.scene.flat.materials import cloth, wood
from gsvis.scene.flat.noise import chance

__all__ = [
    "armchair",
    "bed",
    "bookcase",
    "chair",
    "curtain",
    "cushion",
    "floor_lamp",
    "pendant",
    "pot",
    "round_table",
    "sofa",
    "table",
    "table_lamp",
]

F64 = NDArray[np.float64]
Triple = tuple[float, float, float]

SPINES: tuple[Triple, ...] = (
    (0.62, 0.20, 0.17),
    (0.18, 0.30, 0.46),
    (0.83, 0.70, 0.40),
    (0.25, 0.40, 0.30),
    (0.88, 0.86, 0.80),
    (0.20, 0.19, 0.21),
    (0.76, 0.46, 0.25),
    (0.46, 0.28, 0.42),
    (0.35, 0.52, 0.56),
    (0.70, 0.64, 0.56),
)
BRASS = plain((0.72, 0.58, 0.34), gloss=0.25, texel=0.012)
SHADE = plain((0.98, 0.90, 0.74), glow=2.4, texel=0.02)


def cushion(center: Triple, radii: Triple, look: Look, *, power: float = 2.6) -> Chart:
    """Return a soft cushion: an ellipsoid with square corners, flatter toward its rim."""
    chart = ellipsoid((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), look)
    half = np.array(radii)
    middle = np.array(center)

    def place(u: F64, v: F64) -> F64:
        """Return (n, 3) points of the chart at u and v."""
        ball = chart.place(u, v)
        squared = np.sign(ball) * np.abs(ball) ** (2.0 / power)
        return np.asarray(middle + half * squared)

    return replace(chart, place=place, size=(4.0 * max(radii), 2.6 * max(radii)))


def sofa(width: float, fabric: Look, pillows: tuple[Look, ...] = ()) -> list[Chart]:
    """Return a sofa, its back at y = -0.42."""
    half = width / 2
    found = box((-half, -0.42, 0.12), (half, 0.40, 0.30), fabric, rounded=0.04)
    found += box((-half, -0.45, 0.14), (half, -0.22, 0.82), fabric, rounded=0.09)
    for side in (-1.0, 1.0):
        low, high = sorted((side * half, side * (half - 0.2)))
        found += box((low, -0.42, 0.14), (high, 0.42, 0.60), fabric, rounded=0.08)
    seats = 3 if width > 1.8 else 1
    wide = (width - 0.44) / seats
    for i in range(seats):
        left = -half + 0.22 + i * wide
        found += box((left, -0.24, 0.27), (left + wide, 0.42, 0.46), fabric, rounded=0.07)
        found += box((left + 0.01, -0.28, 0.42), (left + wide - 0.01, -0.06, 0.86), fabric, rounded=0.09)
    for i, look in enumerate(pillows):
        across = -half + 0.44 + i * (width - 0.88) / max(len(pillows) - 1, 1)
        pillow = cushion((0.0, 0.0, 0.0), (0.23, 0.09, 0.21), look)
        found += move([pillow], (across, 0.05, 0.66), 14.0 * (-1.0) ** i)
    for x in (-half + 0.1, half - 0.1):
        for y in (-0.34, 0.32):
            found.append(tube((x, y, 0.0), 0.13, (0.018, 0.024), wood((0.30, 0.20, 0.13))))
    return found


def armchair(fabric: Look, pillow: Look | None = None) -> list[Chart]:
    """Return an armchair, its back at y = -0.42."""
    return sofa(0.92, fabric, () if pillow is None else (pillow,))


def table(width: float, depth: float, height: float, top: Look, legs: Look) -> list[Chart]:
    """Return a table with four round legs."""
    found = box((-width / 2, -depth / 2, height - 0.035), (width / 2, depth / 2, height), top, faces="xXyYzZ")
    for x in (-width / 2 + 0.07, width / 2 - 0.07):
        for y in (-depth / 2 + 0.07, depth / 2 - 0.07):
            found.append(tube((x, y, 0.0), height - 0.035, (0.018, 0.028), legs))
    return found


def round_table(radius: float, height: float, top: Look, leg: Look) -> list[Chart]:
    """Return a table on one foot."""
    rim = tube((0.0, 0.0, height - 0.03), 0.03, (radius, radius), top)
    under = disc((0.0, 0.0, height - 0.03), radius, top, facing=-1.0)
    foot = tube((0.0, 0.0, 0.0), 0.03, (0.45 * radius, 0.08 * radius), leg)
    return [
        disc((0.0, 0.0, height), radius, top),
        rim,
        under,
        foot,
        tube((0.0, 0.0, 0.0), height - 0.03, (0.03, 0.03), leg),
    ]


def chair(frame: Look, seat: Look) -> list[Chart]:
    """Return a chair; a person on it looks along +y."""
    found = box((-0.21, -0.2, 0.42), (0.21, 0.22, 0.47), seat, rounded=0.02, faces="xXyYzZ")
    found += box((-0.2, -0.23, 0.62), (0.2, -0.20, 0.88), frame, rounded=0.012, faces="xXyYzZ")
    for x in (-0.18, 0.18):
        found.append(tube((x, -0.2, 0.0), 0.86, (0.014, 0.017), frame))
        found.append(tube((x, 0.19, 0.0), 0.43, (0.014, 0.017), frame))
    return found


def bookcase(width: float, height: float, depth: float, look: Look, boards: int, seed: int) -> list[Chart]:
    """Return a shelf full of books, its back at y = 0."""
    thick = 0.022
    found = box((-width / 2, 0.0, 0.0), (-width / 2 + thick, depth, height), look)
    found += box((width / 2 - thick, 0.0, 0.0), (width / 2, depth, height), look)
    back = (-width / 2, 0.004, 0.0)
    found.append(rectangle(back, (width, 0.0, 0.0), (0.0, 0.0, height), look, side=-1.0))
    pitch = (height - thick) / boards
    for board in range(boards + 1):
        low = board * pitch
        found += box((-width / 2, 0.0, low), (width / 2, depth, low + thick), look, faces="YzZ")
        if board < boards:
            found += _books(
                -width / 2 + thick, width / 2 - thick, low + thick, pitch - thick, depth, seed * 100 + board
            )
    return found


def _books(left: float, right: float, floor: float, room: float, depth: float, seed: int) -> list[Chart]:
    """Return a row of books that ends before the board does, and a thing beside them."""
    found: list[Chart] = []
    at = left + 0.005
    i = 0
    full = right - (0.04 + 0.30 * float(chance(seed, 77)))
    while at < full:
        wide = 0.018 + 0.034 * float(chance(seed, i, 1))
        tall = room * (0.62 + 0.30 * float(chance(seed, i // 4, 2)) - 0.10 * float(chance(seed, i, 3)))
        front = depth - 0.015 - 0.05 * float(chance(seed, i, 4))
        color = np.array(SPINES[int(len(SPINES) * chance(seed, i // 2 if chance(seed, i) < 0.4 else i, 5))])
        color = np.clip(color * (0.85 + 0.3 * float(chance(seed, i, 6))), 0.0, 1.0)
        cover = _spine(color, tall, float(chance(seed, i, 7)))
        page = plain((0.90, 0.86, 0.76), texel=0.015)
        found.append(rectangle((at + wide, front, floor), (-wide, 0.0, 0.0), (0.0, 0.0, tall), cover))
        found.append(rectangle((at, 0.02, floor + tall), (wide, 0.0, 0.0), (0.0, front - 0.02, 0.0), page))
        at += wide + 0.002
        i += 1
    if right - at > 0.16:
        kind = float(chance(seed, 9))
        middle = 0.5 * (at + right)
        color_of = SPINES[int(len(SPINES) * chance(seed, 8))]
        glazed = plain(color_of, gloss=0.1, texel=0.012)
        if kind < 0.6:
            found += move(pot(0.05, 0.5 * room, glazed), (middle, 0.6 * depth, floor))
        else:
            found.append(ellipsoid((middle, 0.6 * depth, floor + 0.06), (0.06, 0.06, 0.06), glazed))
    return found


def _spine(color: F64, tall: float, kind: float) -> Look:
    """Return the back of a book, with a label or lines."""
    mark = np.array((0.92, 0.84, 0.62) if color.sum() < 1.6 else (0.25, 0.2, 0.2))

    def paint(u: F64, v: F64) -> F64:
        """Return the color at u and v."""
        high = v / tall
        label = (
            (high > 0.6) & (high < 0.82) if kind < 0.35 else (np.abs(high - 0.15) < 0.02) | (np.abs(high - 0.85) < 0.02)
        )
        text = (np.abs(high - 0.5) < 0.2) & (np.sin(300.0 * v) > 0.3) if kind > 0.6 else np.zeros(u.shape, bool)
        return np.where((label | text)[..., None], mark, color)

    return Look(paint, gloss=0.02, texel=0.007, detail=1.4)


def bed(width: float, length: float, sheet: Look, duvet: Look, frame: Look) -> list[Chart]:
    """Return a bed, its head at y = 0, reaching to +y."""
    half = width / 2
    found = box((-half - 0.03, 0.0, 0.10), (half + 0.03, length, 0.30), frame)
    found += box((-half - 0.05, -0.02, 0.0), (half + 0.05, 0.06, 1.05), cloth((0.46, 0.42, 0.40)), rounded=0.03)
    found += box((-half, 0.05, 0.26), (half, length - 0.02, 0.50), sheet, rounded=0.06)
    cover = box((-half - 0.03, 0.62, 0.28), (half + 0.03, length + 0.01, 0.58), duvet, rounded=0.08)
    found += [_rippled(chart) for chart in cover]
    for x in (-0.25 * width, 0.25 * width):
        found.append(cushion((x, 0.34, 0.62), (0.34, 0.22, 0.10), sheet))
    found.append(cushion((0.0, 0.50, 0.70), (0.24, 0.10, 0.17), cloth((0.75, 0.45, 0.35), seed=5)))
    return found


def _rippled(chart: Chart) -> Chart:
    """Return a chart with the soft folds of a blanket."""

    def place(u: F64, v: F64) -> F64:
        """Return (n, 3) points of the chart at u and v."""
        points = chart.place(u, v)
        x, y, z = points.T
        fold = 0.012 * np.sin(9.0 * x + 3.0 * np.sin(3.1 * y)) + 0.010 * np.sin(7.0 * y - 4.0 * x + 5.0 * z)
        return np.asarray(points + np.stack([0.3 * fold, 0.3 * fold, fold], axis=1))

    return replace(chart, place=place, bend=0.7)


def curtain(width: float, height: float, look: Look, folds: float = 7.0) -> list[Chart]:
    """Return a hanging curtain in the plane y = 0, starting at x = 0; both sides are visible."""

    def place(u: F64, v: F64) -> F64:
        """Return (n, 3) points of the chart at u and v."""
        wave = (0.045 + 0.012 * np.sin(17.0 * u)) * np.sin(2.0 * np.pi * folds * u + 0.6 * np.sin(3.0 * v))
        drawn = u + 0.02 * np.sin(2.0 * np.pi * folds * u)
        return np.stack([width * drawn, wave * (0.75 + 0.25 * (1.0 - v)), height * v], axis=1)

    chart = Chart(place, (1.5 * width, height), look, bend=1.5)
    return [chart, replace(chart, side=-1.0)]


def pot(radius: float, height: float, look: Look) -> list[Chart]:
    """Return a vase or a flower pot."""

    def profile(v: F64) -> F64:
        """Return the factor of the radius at a height."""
        return 0.72 + 0.42 * np.sin(np.pi * (0.15 + 0.72 * v))

    soil = plain((0.20, 0.15, 0.11), texel=0.02)
    return [
        tube((0.0, 0.0, 0.0), height, (radius, radius), look, profile=profile),
        disc((0.0, 0.0, 0.95 * height), radius * 0.9, soil),
    ]


def floor_lamp(height: float) -> list[Chart]:
    """Return a lamp on a stand."""
    stand = [tube((0.0, 0.0, 0.0), 0.025, (0.15, 0.15), BRASS), disc((0.0, 0.0, 0.025), 0.15, BRASS)]
    stand.append(tube((0.0, 0.0, 0.02), height - 0.25, (0.012, 0.012), BRASS))
    return [*stand, *_shade((0.0, 0.0, height - 0.3), 0.28, 0.21, 0.15)]


def table_lamp(height: float, foot: Look) -> list[Chart]:
    """Return a small lamp on a round foot."""
    body = ellipsoid((0.0, 0.0, 0.28 * height), (0.08, 0.08, 0.28 * height), foot)
    return [body, *_shade((0.0, 0.0, 0.58 * height), 0.42 * height, 0.14, 0.10)]


def pendant(drop: float, radius: float, outside: Look) -> list[Chart]:
    """Return a lamp that hangs from the ceiling at the origin."""

    def profile(v: F64) -> F64:
        """Return the factor of the radius at a height."""
        return np.sqrt(np.clip(1.0 - (0.96 * v) ** 2, 0.0, 1.0))

    cord = tube((0.0, 0.0, -drop), drop, (0.006, 0.006), plain((0.12, 0.12, 0.12), texel=0.02))
    bell = tube((0.0, 0.0, -drop - 0.6 * radius), 0.75 * radius, (radius, radius), outside, profile=profile)
    inner = replace(bell, look=plain((0.98, 0.92, 0.78), glow=1.6, texel=0.02), side=-1.0)
    bulb = ellipsoid(
        (0.0, 0.0, -drop - 0.45 * radius), (0.06, 0.06, 0.06), plain((1.0, 0.95, 0.84), glow=7.0, texel=0.02)
    )
    return [cord, bell, inner, bulb]


def _shade(base: Triple, height: float, low: float, high: float) -> list[Chart]:
    """Return a lamp shade, visible from both sides."""
    side = tube(base, height, (low, high), SHADE)
    return [side, replace(side, side=-1.0)]
