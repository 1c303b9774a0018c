"""The layout of records: 16 bytes for geometry and base color of a Gaussian, a few bytes for a term.

A Gaussian's record holds, in this order: opacity and three components of the base color, one byte each; the scale of
the color, one byte, if the variant has one; then a little-endian bit string, lowest bits first. The bit string holds,
for x, then y, then z: the place in the chunk's box, a component of the quaternion, and the log-scale. A term's record
is one bit string. docs/design/016-package.md gives the reasons. This module only has numbers of bits.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsvis._kernels.terms import TermFields
from gsvis.color.records import Grids, has_scales
from gsvis.color.variants import variant

__all__ = ["RECORD_BYTES", "RecordLayout", "TermLayout", "term_fields"]

RECORD_BYTES = 16
"""Bytes of geometry and base color of a Gaussian."""


@dataclass(frozen=True)
class RecordLayout:
    """The layout of a Gaussian's 128 bits.

    Attributes:
        position: Bits of each coordinate in the box of the chunk.
        rotation: Bits of each of the three smaller components of the quaternion.
        scale: Bits of each log-scale.
        color_scale: Whether a byte holds the scale of the color.

    Examples:
        >>> RecordLayout.from_variant("rgb")
        RecordLayout(position=14, rotation=9, scale=9, color_scale=False)
    """

    position: int
    rotation: int
    scale: int
    color_scale: bool

    @classmethod
    def from_variant(cls, name: str) -> RecordLayout:
        """Return the layout for a variant of colors. Variants with a color scale have fewer bits for geometry.

        Raises:
            ValueError: If there is no such variant.
        """
        return cls(13, 8, 8, True) if has_scales(variant(name)) else cls(14, 9, 9, False)

    @property
    def packed_from(self) -> int:
        """Byte at which the bit string begins."""
        return 5 if self.color_scale else 4

    @property
    def bits(self) -> tuple[int, int, int]:
        """Bits of place, quaternion component and log-scale, for each of x, y and z."""
        return self.position, self.rotation, self.scale


@dataclass(frozen=True)
class TermLayout:
    """The layout of a term's bits.

    Attributes:
        function: Bits of the index of the function; 0 if the variant has only one function.
        theta: Bits of the polar angle of the center.
        phi: Bits of the azimuth of the center.
        decay: Bits of the decay.
        intensity: Bits of each intensity.
        intensities: Number of intensities of a term.
    """

    function: int
    theta: int
    phi: int
    decay: int
    intensity: int
    intensities: int

    @classmethod
    def from_grids(cls, grids: Grids) -> TermLayout:
        """Return the layout for colors that were rounded to these tables.

        Raises:
            ValueError: If a term needs more than 64 bits, or a part of a base color more than 8.
        """
        p = grids.precision
        kind = grids.kind
        function = (len(kind.functions) - 1).bit_length()
        layout = cls(function, p.center, p.center + 1, p.decay, p.intensity, kind.intensities)
        if p.base > 8 or (has_scales(kind) and p.scale > 8):
            raise ValueError(f"precision: expected at most 8 bits for base and scale, got {p}; use 'wire'")
        if sum(layout.widths) > 64:
            raise ValueError(f"precision: expected terms of at most 64 bits, got {sum(layout.widths)}; use 'wire'")
        return layout

    @property
    def widths(self) -> NDArray[np.int64]:
        """(4 + I,) bits of function, polar angle, azimuth, decay and each intensity, lowest bits first."""
        return np.array(
            [self.function, self.theta, self.phi, self.decay, *[self.intensity] * self.intensities], np.int64
        )

    @property
    def nbytes(self) -> int:
        """Bytes of a term's record."""
        return -(-int(self.widths.sum()) // 8)


def term_fields(layout: TermLayout) -> TermFields:
    """Return the layout of a term as kernels take it."""
    bits = layout.function, layout.theta, layout.phi, layout.decay, layout.intensity
    return TermFields(*bits, layout.intensities == 3)
