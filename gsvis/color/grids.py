"""Tables of ascending numbers for quantized values, and the nearest entry of a value.

A few parameters define a table. A table holds its ends exactly and is all a decoder needs. Nothing here knows colors.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["bend", "circle", "compand", "geometric", "middles", "nearest"]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
U16 = NDArray[np.uint16]


def bend(low: float, high: float, center: float, knee: float, bits: int) -> F32:
    """Return (2^bits,) from low to high: evenly spaced within `knee` of the center, in even ratios outside.

    The even spacing d follows from the range; outside it is d |x - center| / knee.

    Args:
        low: First entry.
        high: Last entry, >= low.
        center: Middle of the even part.
        knee: Half its width, > 0.
        bits: 1 to 16.
    """
    ends = np.array([low, high]) - center
    far = knee * (1.0 + np.log(np.maximum(np.abs(ends) / knee, 1.0)))
    start, stop = np.where(np.abs(ends) <= knee, ends, np.sign(ends) * far)
    places = np.linspace(start, stop, 1 << bits)
    outside = np.sign(places) * knee * np.exp(np.maximum(np.abs(places) / knee, 1.0) - 1.0)
    return _with_ends(center + np.where(np.abs(places) <= knee, places, outside), low, high)


def geometric(low: float, high: float, bits: int) -> F32:
    """Return (2^bits,) from low to high in even ratios, 0 < low <= high."""
    return _with_ends(np.geomspace(low, high, 1 << bits), low, high)


def compand(limit: float, floor: float, bits: int) -> F32:
    """Return (2^bits - 1,) from -limit to limit, with 0 in the middle and steps that grow with the size.

    Entry i from the middle is floor (exp(k i) - 1): even steps of k floor near 0, ratios of exp(k) far from it.

    Args:
        limit: Last entry, >= 0.
        floor: Size at which even steps change to even ratios, > 0.
        bits: 2 to 16.

    References:
        The mu-law of ITU-T G.711, mu = limit / floor.
    """
    half = (1 << (bits - 1)) - 1
    side = floor * np.expm1(np.log1p(limit / floor) * np.arange(1, half + 1) / half)
    return _with_ends(np.concatenate([-side[::-1], [0.0], side]), -limit, limit)


def circle(low: float, turn: float, count: int) -> F32:
    """Return (count + 1,) even steps from `low` once around; the last entry is the first plus one turn."""
    return np.asarray(low + np.arange(count + 1) * (turn / count), np.float32)


def _with_ends(values: F64, low: float, high: float) -> F32:
    """Return values as an ascending float32 table that holds both ends exactly."""
    table: F32 = np.clip(values, low, high).astype(np.float32)
    table[0] = low
    table[-1] = high
    return table


def middles(table: F32) -> F64:
    """Return (len - 1,) boundaries between the entries of a table."""
    return (table[1:].astype(np.float64) + table[:-1]) / 2.0


def nearest(values: ArrayLike, table: F32) -> U16:
    """Return the index of the nearest entry of an ascending table for each value, the lower one of a tie."""
    return np.asarray(np.searchsorted(middles(table), np.asarray(values, np.float64)), np.uint16)
