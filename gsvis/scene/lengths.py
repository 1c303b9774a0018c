"""Choose the unit of lengths that scenes do not state, such as the near plane.

Rasterizers of this field put the near plane at 0.01 units, which fits scenes in meters. A scene in kilometers or
millimeters is rendered as if scaled to a few units, by a power of two, so that no precision is lost.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

__all__ = ["length_factor", "spell_length", "spell_point", "spell_volume"]

_SAMPLE = 4096  # centers looked at, at even steps
_CORE = (0.1, 0.9)  # quantiles of the centers along each axis
_USUAL = (0.25, 256.0)  # diagonals of the core, in units, that are taken as they are
_WANTED = 8.0


def length_factor(means: ArrayLike) -> float:
    """Return the power of two that scales the core of a scene to the usual size.

    Args:
        means: (N, 3) centers, scene units. Outliers do not count.

    Returns:
        1 for a core of 0.25 to 256 units, an empty scene or a single place; else the factor that makes it about 8
        units.

    Examples:
        >>> length_factor([[0, 0, 0], [3, 4, 0]]), length_factor([[0, 0, 0], [3e-3, 4e-3, 0]])
        (1.0, 2048.0)
    """
    centers = np.asarray(means)
    some = centers[:: max(1, len(centers) // _SAMPLE)].astype(np.float64)
    if len(some) < 2:
        return 1.0
    with np.errstate(all="ignore"):  # tensors in training may hold NaN and infinity
        low, high = np.quantile(some, _CORE, axis=0)
        size = float(np.linalg.norm(high - low))
    if not np.isfinite(size) or size == 0.0 or _USUAL[0] <= size <= _USUAL[1]:
        return 1.0
    return float(2.0 ** np.clip(np.rint(np.log2(_WANTED / size)), -60, 60))


def spell_length(length: float, meters_per_unit: float | None) -> str:
    """Return a length in words, also in meters if the size of a unit is known.

    Args:
        length: Length in scene units.
        meters_per_unit: Meters in a scene unit; None or 0 if unknown.

    Examples:
        >>> spell_length(0.5, None), spell_length(0.5, 0.1)
        ('0.5 units', '0.5 units (0.05 m)')
    """
    return f"{length:.3g} units" + (f" ({length * meters_per_unit:.3g} m)" if meters_per_unit else "")


def spell_volume(volume: float, meters_per_unit: float | None) -> str:
    """Return a volume in words, also in cubic meters if the size of a unit is known.

    Args:
        volume: Volume in cubic scene units.
        meters_per_unit: Meters in a scene unit; None or 0 if unknown.
    """
    meters = f" ({volume * meters_per_unit**3:.3g} cubic m)" if meters_per_unit else ""
    return f"{volume:.3g} cubic units{meters}"


def spell_point(point: Sequence[float]) -> str:
    """Return a point (3,) as text: (1000000.0, 0.0, -0.5) -> "1,000,000, 0, -0.5"."""
    return ", ".join(f"{value:,.12g}" for value in point)
