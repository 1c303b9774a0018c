"""Kernels for terms that the coders of packages and of the wire share: bits of fields, and what predicts them."""

from __future__ import annotations

from typing import NamedTuple

from gsvis._kernels.compiled import njit

__all__ = ["TermFields", "near", "upper_bits"]


class TermFields(NamedTuple):
    """Bits of the fields of a term; `others` is whether there are three intensities."""

    function: int
    polar: int
    azimuth: int
    decay: int
    intensity: int
    others: bool


@njit(inline="always")
def upper_bits(value, bits, most):
    """Return the upper bits of a value of so many bits, `most` of them."""
    return value >> (bits - most) if bits > most else value << (most - bits)


@njit(inline="always")
def near(value, bits):
    """Return a difference, which is modulo 2^bits, cut to -6 to 6, plus 6; of its upper six bits if it has more."""
    if bits > 6:
        value = value >> (bits - 6)
        bits = 6
    if value >> (bits - 1):
        value -= 1 << bits
    return min(max(value, -6), 6) + 6
