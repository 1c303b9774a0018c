"""Build plants: leaves are small bent charts on stems, rotated by the golden angle."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsvis.scene.flat.charts import Chart, Look, move, tube
from gsvis.scene.flat.furniture import pot
from gsvis.scene.flat.materials import tinted, wood
from gsvis.scene.flat.noise import chance, grain

__all__ = ["bush", "palm", "tree"]

F64 = NDArray[np.float64]
Triple = tuple[float, float, float]


def tree(height: float, seed: int, vessel: Look, count: int = 44) -> list[Chart]:
    """Return a rubber plant: a stem with broad leaves, in a pot."""
    found = pot(0.17, 0.32, vessel)
    found.append(tube((0.0, 0.0, 0.28), height - 0.4, (0.018, 0.010), wood((0.36, 0.27, 0.19))))
    for i in range(count):
        share = (i + 0.5) / count
        base = (0.02 * np.sin(3.0 * i), 0.02 * np.cos(3.0 * i), 0.45 + (height - 0.55) * share)
        length = 0.30 - 0.12 * share + 0.06 * float(chance(i, seed))
        found += move([_leaf(length, 0.42 * length, 0.5 - 1.1 * share, i, seed)], base, 137.5 * i + 50.0 * seed)
    return found


def palm(height: float, seed: int, vessel: Look, count: int = 34) -> list[Chart]:
    """Return a plant with long narrow leaves that lean over, in a pot."""
    found = pot(0.15, 0.28, vessel)
    for i in range(count):
        length = (height - 0.25) * (0.65 + 0.5 * float(chance(i, seed)))
        lean = -1.25 + 0.9 * float(chance(i, seed, 2))
        found += move([_leaf(length, 0.065, lean, i, seed)], (0.0, 0.0, 0.25), 137.5 * i)
    return found


def bush(size: float, seed: int, vessel: Look, count: int = 30) -> list[Chart]:
    """Return a small plant for a shelf or a window sill."""
    found = pot(0.30 * size, 0.45 * size, vessel)
    for i in range(count):
        length = size * (0.32 + 0.25 * float(chance(i, seed)))
        base = (0.0, 0.0, size * (0.40 + 0.25 * float(chance(i, seed, 1))))
        found += move([_leaf(length, 0.5 * length, -0.9 + 1.2 * float(chance(i, seed, 2)), i, seed)], base, 137.5 * i)
    return found


def _leaf(length: float, width: float, lean: float, i: int, seed: int) -> Chart:
    """Return a leaf that grows from the origin along +x and droops.

    Args:
        length: Meters.
        width: Meters at its widest.
        lean: Angle at the stem, radians below the horizontal; negative rises.
        i: Number of the leaf.
        seed: Of the plant.
    """
    droop = 0.7 + 0.5 * float(chance(i, seed, 3))

    def place(u: F64, v: F64) -> F64:
        """Return (n, 3) points of the chart at u and v."""
        angle = lean + droop * u
        along = length * np.stack(
            [np.cos(0.5 * (lean + angle)), np.zeros_like(u), -np.sin(0.5 * (lean + angle))], axis=1
        )
        half = width * (v - 0.5) * np.sin(np.pi * np.clip(0.06 + 0.92 * u, 0.0, 1.0)) ** 0.8
        cupped = 0.35 * np.abs(half)
        return np.asarray(along * u[:, None] + np.stack([np.zeros_like(u), half, cupped], axis=1))

    tone = (0.17 + 0.10 * float(chance(i, seed, 4)), 0.32 + 0.11 * float(chance(i, seed, 5)), 0.17)

    def paint(u: F64, v: F64) -> F64:
        """Return the color at u and v."""
        rib = np.abs(v / width - 0.5) < 0.05
        factor = np.where(rib, 1.35, 1.0 + 0.10 * grain(0.9 * u + 0.1 * i, 0.9 * v))
        return tinted(tone, factor)

    return Chart(place, (length, width), Look(paint, texel=0.012, gloss=0.03), bend=0.25)
