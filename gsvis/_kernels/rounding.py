"""Kernels for rounded records, shared by the coders of packages and of the wire: which low bits a record lacks.

The less light a Gaussian adds to an image, the more bits it lacks. All rules are in integers and follow from fields
that are coded earlier, so a reader knows what is missing. Sizes are logarithms, in 1/64 octaves of scene units.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gsvis._kernels.compiled import inner

__all__ = ["MOST_ROUNDED", "TURNS", "Chunks", "Limits", "bits_to_round", "light_of", "place_limit", "turn_bits"]

TURNS = 8
"""Numbers of bits that a component of a quaternion may lack: 0 to 7."""

MOST_ROUNDED = 5
"""Most bits that an opacity, a ratio of scales or a byte of color lacks."""

_NONE = np.int64(0)


class Limits(NamedTuple):
    """How the records of a scene are rounded, in 1/64 bits.

    Attributes:
        place: Limit of the steps of coordinates, see `place_limit`.
        turn: Limit of the bits that quaternions lack, see `turn_bits`.
        opacity: Bits that opacities lack where the outline has an area of 1 scene unit squared; see `bits_to_round`.
        shape: Bits that ratios of scales lack where the light is 1.
        color: Bits that each byte of the base color lacks where the light is 1.
        center: Bits that both angles of the center of a term lack where light and intensity are 1; one bit less for
            each octave of intensity, a quarter less for each of light.
        decay: The same of the decay.
        intensity: Bits that each intensity lacks where the light is 1.
    """

    place: int
    turn: int
    opacity: int
    shape: int
    color: int
    center: int
    decay: int
    intensity: int


class Chunks(NamedTuple):
    """Rows of chunks as kernels need them.

    Attributes:
        lows: (C,) int64, see `ChunkTable`.
        strides: (C,) int64, see `ChunkTable`.
        steps: (C, 3) int64, log2 of the longest step of each coordinate, rounded up.
        bits: (C, 3) int64, bits of a place.
    """

    lows: NDArray[np.int64]
    strides: NDArray[np.int64]
    steps: NDArray[np.int64]
    bits: NDArray[np.int64]


@inner(forceinline=True)
def place_limit(size, long, opacity, place, logs):
    """Return log2 of the longest allowed step of a coordinate: shorter for long and for opaque Gaussians.

    Args:
        size: Logarithm of the largest scale.
        long: The same minus that of the middle scale.
        opacity: 0 to 255.
        place: Limit of the scene.
        logs: First table of `logarithms`.
    """
    return min(place - (long >> 1) - logs[opacity], size - long) >> 6


@inner(forceinline=True)
def turn_bits(size, long, turn):
    """Return how many bits each quaternion component lacks: fewer for large and for long Gaussians."""
    return min(max((turn - (2 * size + long) // 4) >> 6, 0), TURNS - 1)


@inner(forceinline=True)
def light_of(size, long, opacity, logs):
    """Return the logarithm of the light of a Gaussian: area of its outline times squared opacity in 255ths."""
    return 2 * size - long + 2 * logs[opacity]


@inner(forceinline=True)
def bits_to_round(limit, weight):
    """Return how many bits are rounded: a quarter of a bit less for each octave of a weight in 1/64 octaves."""
    return min(max((limit - (weight >> 2)) >> 6, _NONE), np.int64(MOST_ROUNDED))
