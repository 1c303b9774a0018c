"""Name directions: the six axes of a frame, the axis nearest to a direction, a direction in words.

Directions are unit vectors in the scene's frame. Up may be any direction; only grids that are cut along axes, such as
the tiles of a world, need the nearest one. This module knows no Gaussian and no file.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check

__all__ = ["AXES", "axis_vector", "describe_direction", "nearest_axis", "snap_to_axis", "tilt_of"]

F64 = NDArray[np.float64]

AXES = ("+x", "-x", "+y", "-y", "+z", "-z")
_ON_AXIS = 1.0  # degrees within which a direction goes by the name of the axis


def axis_vector(axis: str) -> F64:
    """Return the (3,) unit vector of an axis such as "+z" or "-y".

    Raises:
        ValueError: If it is not the name of an axis.
    """
    if axis not in AXES:
        raise ValueError(f"axis: expected one of {', '.join(map(repr, AXES))}, got {axis!r}")
    vector = np.zeros(3)
    vector["xyz".index(axis[1])] = 1.0 if axis[0] == "+" else -1.0
    return vector


def nearest_axis(direction: ArrayLike) -> str:
    """Return the name of the axis nearest to a direction, for grids that are cut along axes.

    Of equally near axes, the first in `AXES` is returned.

    Args:
        direction: (3,) any length but zero.

    Examples:
        >>> nearest_axis([0.1, -0.9, 0.2])
        '-y'
    """
    unit = _unit(direction)
    return max(AXES, key=lambda name: float(axis_vector(name) @ unit))


def snap_to_axis(direction: ArrayLike) -> F64:
    """Return the (3,) axis within a degree of a direction, or the direction as a unit vector if there is none.

    Guesses are accurate to a degree at best, and programs align scenes with axes.

    Args:
        direction: (3,) any length but zero.
    """
    axis = axis_vector(nearest_axis(direction))
    return axis if tilt_of(direction, axis) <= _ON_AXIS else _unit(direction)


def tilt_of(direction: ArrayLike, other: ArrayLike) -> float:
    """Return the angle between two directions (3,), degrees in [0, 180]."""
    a = _unit(direction)
    b = _unit(other)
    return float(np.degrees(2.0 * np.arctan2(np.linalg.norm(a - b), np.linalg.norm(a + b))))


def describe_direction(direction: ArrayLike) -> str:
    """Return a direction in words: the name of an axis, or the vector and its angle to the nearest axis.

    Args:
        direction: (3,) any length but zero.

    Examples:
        >>> describe_direction([0.0, 0.001, 1.0])
        '+z'
        >>> describe_direction([0.12, -0.98, 0.15])
        '(0.12, -0.98, 0.15), 11 degrees off -y'
    """
    unit = _unit(direction)
    axis = nearest_axis(unit)
    off = tilt_of(unit, axis_vector(axis))
    if off <= _ON_AXIS:
        return axis
    x, y, z = (round(float(value), 2) + 0.0 for value in unit)
    return f"({x:.2f}, {y:.2f}, {z:.2f}), {off:.0f} degrees off {axis}"


def _unit(direction: ArrayLike) -> F64:
    """Return a checked direction as a unit vector."""
    rows = np.reshape(np.asarray(direction, np.float64), (1, -1))
    return np.asarray(_check.unit_vectors("direction", rows)[0], np.float64)
