"""Where the bits of a record are: geometry and base color of one Gaussian in 16 bytes, and one term in a few.

A record of a Gaussian is, in this order: opacity and three components of the base color, one byte each; the scale of
the color in one byte where the variant has one; then a little-endian string of bits, lowest first: for x, y and z in
turn the place in the chunk's box, a component of the quaternion, and the log-scale. A record of a term is one such
string. docs/design/016-package.md says why. This module holds numbers only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsvis.color.records import Grids, has_scales
from gsvis.color.variants import variant

__all__ = ["PACKED_VARIANTS", "RECORD_BYTES", "RecordLayout", "TermLayout", "check_packed"]

RECORD_BYTES = 16
"""Bytes of geometry and base color of a Gaussian."""

PACKED_VARIANTS = ("rgb", "hsl")
"""Variants of colors that packages and streams hold; the others are there to be compared."""


def check_packed(name: str) -> str:
    """Return the name of a variant if packages hold it.

    Raises:
        ValueError: If they do not; names those that they hold.
    """
    if name not in PACKED_VARIANTS:
        known = " or ".join(PACKED_VARIANTS)
        raise ValueError(f"variant: expected {known} in a package, got {name!r}; fit the colors with one of these")
    return name


@dataclass(frozen=True)
class RecordLayout:
    """How the 128 bits of a Gaussian are used.

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
        """Return the layout for a variant of colors; those with a scale have fewer bits for the rest.

        Raises:
            ValueError: If packages do not hold the variant.
        """
        return cls(13, 8, 8, True) if has_scales(variant(check_packed(name))) else cls(14, 9, 9, False)

    @property
    def packed_from(self) -> int:
        """The byte at which the string of bits begins."""
        return 5 if self.color_scale else 4

    @property
    def bits(self) -> tuple[int, int, int]:
        """Of place, component of the quaternion and log-scale: what each of x, y and z has in the string."""
        return self.position, self.rotation, self.scale


@dataclass(frozen=True)
class TermLayout:
    """How the bits of a term are used.

    Attributes:
        function: Bits of the index of the function; 0 where a variant has one.
        theta: Bits of the polar angle of the center.
        phi: Bits of its azimuth.
        decay: Bits of the decay.
        intensity: Bits of each intensity.
        intensities: How many intensities a term has.
    """

    function: int
    theta: int
    phi: int
    decay: int
    intensity: int
    intensities: int

    @classmethod
    def from_grids(cls, grids: Grids) -> TermLayout:
        """The layout for colors that were rounded to these tables.

        Raises:
            ValueError: If a term needs more than 64 bits, or a part of a base color more than 8.
        """
        p, kind = grids.precision, grids.kind
        function = (len(kind.functions) - 1).bit_length()
        layout = cls(function, p.center, p.center + 1, p.decay, p.intensity, kind.intensities)
        if p.base > 8 or (has_scales(kind) and p.scale > 8):
            raise ValueError(f"precision: expected at most 8 bits for base and scale, got {p}; use 'wire'")
        if sum(layout.widths) > 64:
            raise ValueError(f"precision: expected terms of at most 64 bits, got {sum(layout.widths)}; use 'wire'")
        return layout

    @property
    def widths(self) -> NDArray[np.int64]:
        """Bits of function, polar angle, azimuth, decay and each intensity, lowest bits first."""
        return np.array(
            [self.function, self.theta, self.phi, self.decay, *[self.intensity] * self.intensities], np.int64
        )

    @property
    def nbytes(self) -> int:
        """Bytes of a record."""
        return -(-int(self.widths.sum()) // 8)
