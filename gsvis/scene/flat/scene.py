"""Assemble the flat: build shell, furniture and outside, light them, cut them into pieces, convert to Gaussians."""

from __future__ import annotations

import itertools
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.scene.flat import dress
from gsvis.scene.flat.charts import Chart
from gsvis.scene.flat.dress import Batch
from gsvis.scene.flat.furnish import furniture, lamps
from gsvis.scene.flat.light import Sky, bake
from gsvis.scene.flat.outside import outside
from gsvis.scene.flat.pieces import cut
from gsvis.scene.flat.plan import DOORS, HEIGHT, ROOMS, opening_windows
from gsvis.scene.flat.shell import shell
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace

__all__ = ["EYES", "UP", "furnished_flat", "navigable_space"]

F64 = NDArray[np.float64]

USUAL = 240_000
BASE = 0.06  # share of the Gaussians that lie behind the others
FLOATERS = 0.0015
CLEARANCE = 0.25  # meters between an eye and surfaces
UP = (0.0, 0.0, 1.0)
EYES = ((3.4, 1.1, 1.55), (5.2, 3.7, 1.6), (6.5, 3.9, 1.6), (2.6, 5.6, 1.6), (7.4, 5.2, 1.6), (6.4, 7.3, 1.5))


def furnished_flat(count: int = USUAL, sh_degree: int = 3, seed: int = 1) -> Gaussians:
    """Return a furnished flat of five rooms and a hall.

    Args:
        count: Approximate number of Gaussians.
        sh_degree: 0 to 3.
        seed: Seed of all random numbers.

    Raises:
        ValueError: If `count` or `sh_degree` is out of range.
    """
    _check.positive_int("count", count, at_least=1000)
    if sh_degree not in (0, 1, 2, 3):
        raise ValueError(f"sh_degree: expected 0, 1, 2 or 3, got {sh_degree!r}")
    rng = np.random.default_rng(seed)
    walls, others = _surfaces()
    inside = [*walls, *others]
    charts = [*inside, *outside()]
    coarseness = float(np.sqrt(max(USUAL / count, 1.0)))
    baked = bake(inside, _sky(), rng, coarseness)
    canvases = [dress.paint_canvas(chart, i, baked) for i, chart in enumerate(charts)]
    fine = cut(canvases, int((1.0 - BASE) * count), rng)
    coarse = cut(canvases[: len(walls)], int(BASE * count), rng)
    front = dress.gaussians_of(charts, fine, rng, width=0.53)
    front = dress.add_gloss(front, charts, fine, baked)
    back = dress.gaussians_of(charts, coarse, rng, width=0.46, behind=0.02)
    return dress.finish([front, back, _floaters(int(FLOATERS * count), rng)], sh_degree)


@cache
def _surfaces() -> tuple[tuple[Chart, ...], tuple[Chart, ...]]:
    """Return the charts of the walls and those of the furniture."""
    return tuple(shell()), tuple(furniture())


def navigable_space(g: Gaussians) -> NavigableSpace:
    """Return the space for the eyes of people who sit or stand: in rooms and doors, away from surfaces."""
    from scipy import ndimage  # slow to import, seldom needed

    grid = NavigableSpace.from_box((0.0, 0.0, 0.0), (10.0, 8.6, HEIGHT), 100)
    shape = grid.free.shape
    voxels = np.floor((_surface_points() - grid.origin) / grid.voxel_size).astype(np.int64)
    voxels = voxels[((voxels >= 0) & (voxels < shape)).all(axis=1)]
    occupied = np.zeros(shape, bool)
    occupied[tuple(voxels.T)] = True
    index = np.stack(np.unravel_index(np.arange(occupied.size), shape), axis=1)
    centers = grid.origin + grid.voxel_size * (index + 0.5)
    indoors = np.any([_inside(centers, room.x, room.y) for room in ROOMS], axis=0)
    for each in DOORS:
        sides = ((each.low, each.high), each.span)
        indoors |= _inside(centers, *(sides if each.axis == 0 else sides[::-1]))
    away = ndimage.distance_transform_edt(~occupied, sampling=grid.voxel_size) > CLEARANCE
    indoors &= _inside(centers, (CLEARANCE, 10.0 - CLEARANCE), (CLEARANCE, 8.6 - CLEARANCE))
    free = away & (indoors & (np.abs(centers[:, 2] - 1.4) < 0.6)).reshape(shape)
    labels, _ = ndimage.label(free)
    start = np.floor((np.array(EYES[0]) - grid.origin) / grid.voxel_size).astype(int)
    rule = f"eyes of people, {CLEARANCE} from all surfaces"
    targets = g.means[_inside(g.means, (0.0, 10.0), (0.0, 8.6))]
    spread: F64 = targets[:: max(len(targets) // 4096, 1)].astype(np.float64)
    return NavigableSpace(
        grid.origin, grid.voxel_size, labels == labels[tuple(start)], np.array(UP), occupied, spread, rule
    )


def _surface_points() -> F64:
    """Return points on all surfaces, less than a voxel apart."""
    found = []
    for chart in itertools.chain(*_surfaces()):
        columns, rows = (int(np.ceil(side / 0.07)) for side in chart.size)
        u = np.tile((np.arange(columns) + 0.5) / columns, rows)
        v = np.repeat((np.arange(rows) + 0.5) / rows, columns)
        kept = np.ones(len(u), bool)
        for u0, v0, u1, v1 in chart.holes:
            across = u * chart.size[0]
            up = v * chart.size[1]
            kept &= ~((across > u0) & (across < u1) & (up > v0) & (up < v1))
        found.append(chart.place(u[kept], v[kept]))
    return np.concatenate(found)


def _inside(points: NDArray[np.floating[Any]], x: tuple[float, float], y: tuple[float, float]) -> NDArray[np.bool_]:
    """Return whether points lie in a rectangle."""
    low = np.array((x[0], y[0]))
    high = np.array((x[1], y[1]))
    return np.asarray(((points[:, :2] >= low) & (points[:, :2] <= high)).all(axis=1))


def _sky() -> Sky:
    """Return the light sources."""
    to_sun = np.array([-0.42, -0.72, 0.62])
    x, y, z = (float(each) for each in to_sun / np.linalg.norm(to_sun))
    return Sky(opening_windows(), lamps(), (x, y, z), (15.0, 13.2, 10.5), 7.5)


def _floaters(count: int, rng: np.random.Generator) -> Batch:
    """Return faint Gaussians in the air of the rooms, as left by training."""
    low = np.array([0.2, 0.2, 0.2])
    high = np.array([9.8, 8.4, HEIGHT - 0.2])
    turns, _ = np.linalg.qr(rng.normal(size=(count, 3, 3)))
    return Batch(
        low + (high - low) * rng.random((count, 3)),
        turns * np.sign(np.linalg.det(turns))[:, None, None],
        np.exp(rng.normal(-3.6, 0.5, (count, 3))),
        0.02 + 0.10 * rng.random(count),
        rng.uniform(0.3, 0.8, (count, 1)) * np.array([1.0, 0.97, 0.9]),
        rng.normal(0.0, 0.02, (count, 15, 3)),
    )
