"""Named functions on the sphere for figure 15's experiment: lightness as a Gaussian may show it to an eye all around.

Each is given for unit vectors, z up, and scaled to unit variance over the whole sphere. They were written down before
any of them had been fitted. Lights have soft edges, as a surface that is not a perfect mirror shows them: an edge of
softness s goes from 10% to 90% over 4.4 s. `environment` and `speckle` are Gaussian random fields up to degree 8.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

__all__ = ["FUNCTIONS", "STRESS", "even_directions", "unit_variance"]

F64 = NDArray[np.float64]
Function = Callable[[F64], F64]


def even_directions(count: int) -> F64:
    """(count, 3) unit vectors, each for an equal share of the sphere: a Fibonacci spiral."""
    at = np.arange(count) + 0.5
    z = 1.0 - 2.0 * at / count
    azimuth = np.pi * (1.0 + 5.0**0.5) * at
    ring = np.sqrt(1.0 - z * z)
    return np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), z], axis=1)


def unit_variance(function: Function) -> Function:
    """The function divided by its standard deviation over the sphere."""
    deviation = float(function(even_directions(200_000)).std())
    return lambda x: function(x) / deviation


def edge(inside: F64, softness: float) -> F64:
    """0 far outside, 1 far inside; `inside` is the distance from the edge, in degrees."""
    return 0.5 + 0.5 * np.tanh(0.5 * inside / softness)


def degrees_from(x: F64, polar: float, azimuth: float) -> F64:
    """Angle between x and the direction at these two angles, all in degrees."""
    t, p = np.radians([polar, azimuth])
    center = np.array([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)])
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(x, center), axis=1), x @ center))


def three_lamps(x: F64) -> F64:
    """Round lamps of radius 10, 16 and 24 degrees, softness 2.5, over light that grows upwards."""
    lamps = ((10.0, 1.0, 35.0, 20.0), (16.0, 0.7, 60.0, 150.0), (24.0, 0.5, 80.0, 265.0))
    value = 0.3 + 0.15 * x[:, 2]
    for radius, brightness, polar, azimuth in lamps:
        value += brightness * edge(radius - degrees_from(x, polar, azimuth), 2.5)
    return value


def window(x: F64) -> F64:
    """A bright rectangle, 50 degrees wide, 36 high, 10 above the horizon, softness 3, in a dim room."""
    azimuth, height = np.degrees(np.arctan2(x[:, 1], x[:, 0])), np.degrees(np.arcsin(np.clip(x[:, 2], -1.0, 1.0)))
    return 0.2 + 0.1 * x[:, 2] + edge(25.0 - np.abs(azimuth), 3.0) * edge(18.0 - np.abs(height - 10.0), 3.0)


def sky_and_ground(x: F64) -> F64:
    """Sky brighter toward the horizon, dark ground, softness 4 between them, and a sun of radius 8, softness 2.5."""
    height = np.degrees(np.arcsin(np.clip(x[:, 2], -1.0, 1.0)))
    sky = 0.5 + 0.3 * np.exp(-np.maximum(height, 0.0) / 25.0)
    return 0.12 + edge(height, 4.0) * (sky - 0.12) + 1.2 * edge(8.0 - degrees_from(x, 50.0, 30.0), 2.5)


def glossy(x: F64) -> F64:
    """A glossy surface: a highlight of exponent 32 at 40 degrees, and a rim of (1 - |cos|)^5 all around."""
    highlight = np.maximum(np.cos(np.radians(degrees_from(x, 40.0, 0.0))), 0.0) ** 32
    return 0.3 + highlight + 0.6 * (1.0 - np.abs(x[:, 2])) ** 5


def _random_field(powers: tuple[float, ...], seed: int) -> Function:
    """Random harmonics; `powers[l]` is the root of the variance of each coefficient of degree l."""
    rng = np.random.default_rng(seed)
    sources = rng.normal(size=(2048, 3))
    sources /= np.linalg.norm(sources, axis=1, keepdims=True)
    amounts = rng.normal(size=len(sources))
    zonal = [(2 * degree + 1) * power for degree, power in enumerate(powers)]

    def field(x: F64) -> F64:
        parts = np.array_split(x, max(1, len(x) // 2048))
        return np.concatenate([np.polynomial.legendre.legval(part @ sources.T, zonal) @ amounts for part in parts])

    return field


FUNCTIONS: dict[str, Function] = {
    "three lamps": three_lamps,
    "window": window,
    "sky and ground": sky_and_ground,
    "glossy": glossy,
    "environment": _random_field((0.0, *(1.0 / degree for degree in range(1, 9))), seed=15),
}
"""Lightness functions, not yet of unit variance. The power of `environment` falls with the square of the degree, about
as that of photographed surroundings does (Dror, Willsky and Adelson, Journal of Vision 2004)."""

STRESS: dict[str, Function] = {"speckle": _random_field((0.0, *(1.0 for _ in range(1, 9))), seed=15)}
"""No lightness of anything: 80 harmonics of equal power, of which no two lobes can explain much."""
