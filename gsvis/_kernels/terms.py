"""Kernels for records of terms, shared by the coders of packages and of the wire: bits of fields, and contexts."""

from __future__ import annotations

from typing import NamedTuple

from gsvis._kernels.compiled import njit

__all__ = ["TermFields", "near", "upper_bits"]


class TermFields(NamedTuple):
    """Bits of the fields of a term; `others` says whether there are three intensities or one."""

    function: int
    polar: int
    azimuth: int
    decay: int
    intensity: int
    others: bool


@njit(inline="always")
def upper_bits(value, bits, most):
    """Return the upper `most` bits of a value of `bits` bits."""
    return value >> (bits - most) if bits > most else value << (most - bits)


@njit(inline="always")
def near(value, bits):
    """Return the context of a difference modulo 2^bits: its upper six bits as a signed number in [-6, 6], plus 6."""
    if bits > 6:
        value = value >> (bits - 6)
        bits = 6
    if value >> (bits - 1):
        value -= 1 << bits
    return min(max(value, -6), 6) + 6
