"""Bake light into the charts of the flat: sky through windows, the sun, lamps, and light reflected by surfaces.

`Baked.light` is irradiance over pi, so that a matte surface emits its color times this, in linear units. Shadows,
ambient occlusion and the bleeding of colors follow from the rays; nothing is painted by hand.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsvis.scene.flat.charts import Chart, cross
from gsvis.scene.flat.tracing import OFF, Rays

__all__ = ["Baked", "Lamp", "Sky", "Window", "across", "bake", "linear", "resized", "sky_color", "sun_map"]

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Pair = tuple[float, float]
Triple = tuple[float, float, float]

PITCH = 0.10  # meters between samples of soft light
SUN_PITCH = 0.03
MOST = 64  # samples along a side of a chart
ROUNDS = 4  # reflections from surface to surface
GAMMA = 2.2


@dataclass(frozen=True)
class Window:
    """An opening to the sky: a corner, two edges, and the normal that points into the room."""

    corner: Triple
    u_edge: Triple
    v_edge: Triple
    normal: Triple


@dataclass(frozen=True)
class Lamp:
    """A small lamp: its position, its light at a distance of one meter, and its radius."""

    position: Triple
    light: Triple
    radius: float = 0.08


@dataclass(frozen=True)
class Sky:
    """The light sources of the flat.

    Args:
        windows: Openings through which the sky is seen.
        lamps: Lamps that are on.
        to_sun: Unit vector to the sun.
        sun: Light of the sun on a surface that faces it.
        brightness: Brightness of the sky, a factor of its color.
    """

    windows: tuple[Window, ...]
    lamps: tuple[Lamp, ...]
    to_sun: Triple
    sun: Triple
    brightness: float


@dataclass(frozen=True)
class Grids:
    """Grids of samples of C charts: (C,) starts of the samples, rows along v, columns along u."""

    starts: I64
    rows: I64
    columns: I64

    def at(self, charts: I64, where: F64) -> I64:
        """Return (n,) samples nearest to (n, 2) places on charts; 0 for no chart."""
        chosen = np.maximum(charts, 0)
        rows = self.rows[chosen]
        columns = self.columns[chosen]
        column = np.clip((where[:, 0] * columns).astype(np.int64), 0, columns - 1)
        row = np.clip((where[:, 1] * rows).astype(np.int64), 0, rows - 1)
        return np.where(charts >= 0, self.starts[chosen] + row * columns + column, 0)

    def reshape(self, i: int, values: F64) -> F64:
        """Return the values (rows, columns, 3) of one chart, out of the values of all."""
        rows = int(self.rows[i])
        columns = int(self.columns[i])
        start = int(self.starts[i])
        return values[start : start + rows * columns].reshape(rows, columns, 3)


@dataclass(frozen=True)
class Baked:
    """Light on the charts.

    Args:
        rays: Ray tracer of the charts.
        grids: Grids of the samples of each chart.
        light: (S, 3) light at all samples.
        albedo: (S, 3) linear colors at the samples.
        glow: (S, 3) light emitted at the samples.
        sunny: (C,) whether a sample of the chart is in the sun.
        sky: The light sources.
        coarseness: Spacing of samples, relative to the usual.
    """

    rays: Rays
    grids: Grids
    light: F64
    albedo: F64
    glow: F64
    sunny: NDArray[np.bool_]
    sky: Sky
    coarseness: float

    def map_of(self, i: int) -> F64:
        """Return (rows, columns, 3) light on chart `i`."""
        return self.grids.reshape(i, self.light)

    def look_along(self, starts: F64, directions: F64) -> F64:
        """Return (n, 3) light that comes back along rays, from the surface they meet or from the sky."""
        charts, where = self.rays.hits(starts, directions)
        at = self.grids.at(charts, where)
        found = self.light[at] * self.albedo[at] + self.glow[at]
        return np.where(charts[:, None] >= 0, found, self.sky.brightness * sky_color(directions))


def linear(color: F64) -> F64:
    """Return linear colors of sRGB colors."""
    return np.asarray(np.clip(color, 0.0, 1.0) ** GAMMA)


def sky_color(directions: F64) -> F64:
    """Return (n, 3) light of the outside along directions: blue above, bright at the horizon, dim below."""
    height = directions[:, 2] / np.linalg.norm(directions, axis=1)
    above = np.clip(height, 0.0, 1.0)[:, None]
    bright = np.array([0.96, 1.0, 1.06]) * (1.0 - 0.35 * above) + np.array([-0.22, -0.05, 0.22]) * above
    return np.where(height[:, None] < -0.02, np.array([0.30, 0.31, 0.28]), bright)


def bake(charts: Sequence[Chart], sky: Sky, rng: np.random.Generator, coarseness: float = 1.0) -> Baked:
    """Return the light on all charts.

    Args:
        charts: The surfaces.
        sky: The light sources.
        rng: Source of randomness for soft shadows.
        coarseness: Spacing of samples, relative to the usual.
    """
    rays = Rays(charts)
    grids, points, normals, albedo, glow = _samples(charts, PITCH * coarseness)
    light = _smoothed(_direct(rays, points, normals, sky, rng), grids, 0.7)
    charts_met, where = _gather(rays, points, normals, rng)
    met_at = grids.at(charts_met, where)
    seen = (charts_met >= 0)[:, None]
    per_point = len(met_at) // len(points)
    total = light
    for _ in range(ROUNDS):
        radiance = np.where(seen, (total * albedo)[met_at], 0.0)
        passed_on = radiance.reshape(len(points), per_point, 3).mean(axis=1)
        total = light + _smoothed(passed_on, grids, 1.4)
    lit = _in_the_sun(rays, points, normals, np.array(sky.to_sun))
    sunny = np.add.reduceat(lit, grids.starts) > 0
    return Baked(rays, grids, total, albedo, glow, sunny, sky, coarseness)


def _direct(rays: Rays, points: F64, normals: F64, sky: Sky, rng: np.random.Generator) -> F64:
    """Return (n, 3) light of windows, lamps and the sun at points, shadows included."""
    light = np.zeros(points.shape)
    for window in sky.windows:
        _add_window(light, rays, points, normals, window, sky.brightness, rng)
    for lamp in sky.lamps:
        _add_lamp(light, rays, points, normals, lamp, rng)
    return light


def sun_map(rays: Rays, chart: Chart, sky: Sky, pitch: float = SUN_PITCH) -> F64:
    """Return (rows, columns, 3) direct sun on a chart."""
    to_sun = np.array(sky.to_sun)
    rows, columns = (int(np.clip(np.ceil(side / pitch), 2, 256)) for side in (chart.size[1], chart.size[0]))
    u, v = _centers(rows, columns)
    _, _, normals = chart.frame(u, v)
    lit = _in_the_sun(rays, chart.place(u, v) + OFF * normals, normals, to_sun)
    found = (lit * (normals @ to_sun))[:, None] * np.array(sky.sun)
    return np.asarray(found.reshape(rows, columns, 3))


def resized(values: F64, rows: int, columns: int) -> F64:
    """Return (rows, columns, 3) a map resampled to a new size, linear between samples."""
    for axis, size in ((0, rows), (1, columns)):
        at = (np.arange(size) + 0.5) * values.shape[axis] / size - 0.5
        at = np.clip(at, 0.0, values.shape[axis] - 1.0)
        low = np.minimum(at.astype(np.int64), max(values.shape[axis] - 2, 0))
        high = np.minimum(low + 1, values.shape[axis] - 1)
        part = (at - low).reshape((-1, 1, 1) if axis == 0 else (1, -1, 1))
        values = np.asarray(values.take(low, axis) * (1.0 - part) + values.take(high, axis) * part)
    return values


def _in_the_sun(rays: Rays, points: F64, normals: F64, to_sun: F64) -> NDArray[np.bool_]:
    """Return a mask (n,): whether points face the sun and see it."""
    lit = normals @ to_sun > 0.0
    lit[lit] = ~rays.blocked(points[lit], points[lit] + 40.0 * to_sun)
    return np.asarray(lit, bool)


def _centers(rows: int, columns: int) -> tuple[F64, F64]:
    """Return the centers of the cells of a grid in [0, 1]^2."""
    u = np.tile((np.arange(columns) + 0.5) / columns, rows)
    v = np.repeat((np.arange(rows) + 0.5) / rows, columns)
    return u, v


def _samples(charts: Sequence[Chart], pitch: float) -> tuple[Grids, F64, F64, F64, F64]:
    """Return grids, and of all samples: (S, 3) points off the surface, normals, linear colors, glow."""
    sides = np.array([chart.size for chart in charts])
    sides[:, 0] *= 1.0 + np.array([chart.bend for chart in charts])  # curved charts need more samples around
    columns, rows = np.clip(np.ceil(sides / pitch), 2, MOST).astype(np.int64).T
    parts: list[tuple[F64, F64, F64, F64]] = []
    for i, chart in enumerate(charts):
        u, v = _centers(int(rows[i]), int(columns[i]))
        _, _, normals = chart.frame(u, v)
        color = _mean_color(chart, u, v)
        parts.append((chart.place(u, v) + OFF * normals, normals, color, chart.look.glow * color))
    points, normals, albedo, glow = (np.concatenate(each) for each in zip(*parts, strict=True))
    return Grids(np.cumsum([0, *(rows * columns)[:-1]]), rows, columns), points, normals, albedo, glow


def _mean_color(chart: Chart, u: F64, v: F64) -> F64:
    """Return (n, 3) linear colors around samples, from two points each."""
    total = np.zeros((len(u), 3))
    for shift_u, shift_v in ((-0.27, -0.17), (0.23, 0.31)):
        total += linear(chart.look.paint(u * chart.size[0] + PITCH * shift_u, v * chart.size[1] + PITCH * shift_v))
    return total / 2.0


def _gather(rays: Rays, points: F64, normals: F64, rng: np.random.Generator, count: int = 16) -> tuple[I64, F64]:
    """Return the hits of `count` rays from each point, distributed as the cosine to the normal; order (n, count)."""
    i = (np.arange(count) + rng.random((len(points), 1))) / count
    angle = 2.0 * np.pi * (np.arange(count) * 0.6180339887 + rng.random((len(points), 1)))
    radius = np.sqrt(i)
    height = np.sqrt(np.maximum(1.0 - i, 1e-4))
    first, second = across(normals)
    directions = (
        (radius * np.cos(angle))[..., None] * first[:, None]
        + (radius * np.sin(angle))[..., None] * second[:, None]
        + height[..., None] * normals[:, None]
    )
    return rays.hits(np.repeat(points, count, axis=0), directions.reshape(-1, 3))


def across(normals: F64) -> tuple[F64, F64]:
    """Return two unit vectors for each normal, perpendicular to it and to each other."""
    upright = np.abs(normals[:, 2:]) > 0.9
    helper = np.where(upright, np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]))
    first = cross(helper, normals)
    first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-12)
    return first, cross(normals, first)


def _add_window(
    light: F64, rays: Rays, points: F64, normals: F64, window: Window, brightness: float, rng: np.random.Generator
) -> None:
    """Add the light of the sky through a window, with nine rays for each point."""
    inward = np.array(window.normal)
    corner = np.array(window.corner)
    u_edge = np.array(window.u_edge)
    v_edge = np.array(window.v_edge)
    area = float(np.linalg.norm(np.cross(u_edge, v_edge)))
    inside = np.flatnonzero((points - corner) @ inward > 0.0)
    cells = 3
    for k in range(cells * cells):
        jitter = rng.random(2)
        end = corner + (k % cells + jitter[0]) / cells * u_edge + (k // cells + jitter[1]) / cells * v_edge
        way = end - points[inside]
        squared = np.einsum("ij,ij->i", way, way)
        cosines = np.einsum("ij,ij->i", way, normals[inside]) * -(way @ inward) / squared
        factor = np.clip(cosines, 0.0, None) / (np.pi * np.maximum(squared, 0.05)) * area / cells**2
        near = np.flatnonzero(factor > 6e-4)
        free = ~rays.blocked(points[inside[near]], end)
        chosen = near[free]
        light[inside[chosen]] += brightness * factor[chosen, None] * sky_color(way[chosen])


def _add_lamp(light: F64, rays: Rays, points: F64, normals: F64, lamp: Lamp, rng: np.random.Generator) -> None:
    """Add the light of a lamp, with four rays for each point."""
    near = np.flatnonzero(np.linalg.norm(points - np.array(lamp.position), axis=1) < 6.0)
    for _ in range(4):
        offset = rng.normal(size=3)
        offset *= lamp.radius / np.linalg.norm(offset)
        end = np.array(lamp.position) + offset
        way = end - points[near]
        squared = np.einsum("ij,ij->i", way, way)
        cosine = np.einsum("ij,ij->i", way, normals[near]) / np.sqrt(squared)
        strength = np.clip(cosine, 0.0, None) / np.maximum(squared, 0.01) / 4.0
        lit = np.flatnonzero(strength > 1e-4)
        free = lit[~rays.blocked(points[near[lit]], end)]
        light[near[free]] += strength[free, None] * np.array(lamp.light)


def _smoothed(values: F64, grids: Grids, width: float) -> F64:
    """Return values with the noise of few rays smoothed, chart by chart; charts of one size together."""
    from scipy.ndimage import gaussian_filter

    smooth: F64 = values.copy()
    sizes = np.stack([grids.rows, grids.columns], axis=1)
    for rows, columns in np.unique(sizes[sizes.prod(axis=1) > 9], axis=0).tolist():
        starts = grids.starts[(sizes == (rows, columns)).all(axis=1)]
        at = starts[:, None] + np.arange(rows * columns)
        patches = values[at].reshape(len(starts), rows, columns, 3)
        found = gaussian_filter(patches, (0.0, width, width, 0.0), mode="nearest", truncate=2.5)
        smooth[at] = found.reshape(*at.shape, 3)
    return smooth
