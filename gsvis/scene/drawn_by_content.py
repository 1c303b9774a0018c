"""Draw a random number for each Gaussian by what it looks like, not by its place in a file.

Samples that are chosen by these numbers are the same Gaussians in any order, unit and frame: a package sorts its
Gaussians along a curve, and the order along that curve depends on the unit.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis._sorting import stable_order
from gsvis.scene.gaussians import Gaussians

__all__ = ["draw_by_content"]

U64 = NDArray[np.uint64]
_MIX = np.uint64(0x9E3779B97F4A7C15)
_SHELLS = 1024.0  # per octave of the distance from the middle, for Gaussians of one color and opacity


def draw_by_content(g: Gaussians, seed: int = 0) -> NDArray[np.float64]:
    """Return (N,) random numbers in [0, 1), one for each Gaussian.

    They depend on opacity and base color. Where these are equal they also depend on the distance from the middle, and
    where that is equal too, on the order.

    Args:
        g: The scene, N Gaussians.
        seed: Another seed gives other numbers.
    """
    mixed = np.full(len(g), _mix(np.array([seed], np.uint64))[0])
    for column in (g.opacities, *g.sh0[:, 0].T):
        mixed = _mix(mixed ^ np.ascontiguousarray(column, np.float32).view(np.uint32))
    order = stable_order(mixed)
    tied = _tied(mixed[order])
    if tied.any():
        ids = np.sort(order[tied])
        mixed[ids] = _mix(mixed[ids] ^ _shells(g)[ids])
        order = ids[np.argsort(mixed[ids], kind="stable")]
        first = np.append(True, np.diff(mixed[order]) != 0)
        place = np.arange(len(order)) - np.maximum.accumulate(np.where(first, np.arange(len(order)), 0))
        mixed[order] = _mix(mixed[order] ^ place.astype(np.uint64))
    return np.asarray(mixed >> np.uint64(11), np.float64) * 2.0**-53


def _mix(values: NDArray[Any]) -> U64:
    """Return a hash of each value (N,)."""
    mixed = np.asarray(values, np.uint64)
    with np.errstate(over="ignore"):
        mixed = (mixed + _MIX) * np.uint64(0xBF58476D1CE4E5B9)
        mixed = (mixed ^ (mixed >> np.uint64(29))) * np.uint64(0x94D049BB133111EB)
    return np.asarray(mixed ^ (mixed >> np.uint64(32)), np.uint64)


def _tied(ascending: U64) -> NDArray[np.bool_]:
    """Return which of ascending values (N,) occur more than once."""
    same = np.diff(ascending) == 0
    return np.append(same, False) | np.insert(same, 0, False) if len(ascending) else np.zeros(0, bool)


def _shells(g: Gaussians) -> U64:
    """Return (N,) the shell around the middle in which each Gaussian lies; the middle is where small ones are."""
    size = np.maximum(g.scales.astype(np.float64).max(axis=1), 1e-300)
    weights = (float(size.min()) / size) ** 2
    means = g.means.astype(np.float64)
    away = np.linalg.norm(means - weights @ means / weights.sum(), axis=1)
    shells = np.log2(np.maximum(away, 1e-300) / max(float(np.median(away)), 1e-300))
    return np.asarray(np.rint(_SHELLS * shells), np.int64).view(np.uint64)
