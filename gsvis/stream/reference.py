"""The codes of ids, written simply, as strings of 0 and 1: the slow twin of the kernels."""

from __future__ import annotations

__all__ = ["decode_values", "encode_values"]


def encode_values(values: list[int], order: int) -> str:
    """Return values >= 0 as exponential Golomb codes, in the order in which the bits are written.

    Examples:
        >>> encode_values([0, 1, 2], 0), encode_values([0, 5], 2)
        ('1010011', '10001100')
    """
    out = ""
    for value in values:
        lower = f"{value + (1 << order):b}"[1:][::-1]
        out += "0" * (len(lower) - order) + "1" + lower
    return out


def decode_values(bits: str, order: int, count: int) -> list[int]:
    """Return the first `count` values of a string of codes: the inverse of `encode_values`."""
    values, at = [], 0
    for _ in range(count):
        zeros = bits.index("1", at) - at
        at += zeros + 1
        lower = bits[at : at + order + zeros][::-1]
        at += order + zeros
        values.append(int("1" + lower, 2) - (1 << order))
    return values
