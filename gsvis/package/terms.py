"""Encode terms of SRBF colors as records of a few bytes, and decode them with the scene's tables."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.color.records import Grids, QuantizedColors
from gsvis.package.layout import TermLayout

__all__ = ["Terms", "decode_terms", "encode_terms"]

U8 = NDArray[np.uint8]
U16 = NDArray[np.uint16]


class Terms(NamedTuple):
    """T terms as indices of the tables of `Grids`.

    Attributes:
        functions: (T,) uint8.
        centers: (T, 2) uint16.
        decays: (T,) uint16.
        intensities: (T, I) uint16.
    """

    functions: U8
    centers: U16
    decays: U16
    intensities: U16


def encode_terms(colors: QuantizedColors) -> U8:
    """Encode all terms as records, (T, B) uint8, in order.

    Args:
        colors: Rounded colors.

    Raises:
        ValueError: If a term needs more than 64 bits.
    """
    layout = TermLayout.from_grids(colors.grids)
    parts = [colors.functions, colors.centers[:, 0], colors.centers[:, 1], colors.decays, *colors.intensities.T]
    words = np.zeros(colors.num_terms, "<u8")
    shift = 0
    for part, width in zip(parts, layout.widths.tolist(), strict=True):
        words |= part.astype(np.uint64) << np.uint64(shift) if width else np.uint64(0)
        shift += width
    return np.ascontiguousarray(words.view(np.uint8).reshape(-1, 8)[:, : layout.nbytes])


def decode_terms(records: ArrayLike, grids: Grids) -> Terms:
    """Decode terms from records. Any bytes decode to terms that can be drawn.

    Args:
        records: (T, B) uint8.
        grids: The tables that the terms point into.

    Raises:
        ValueError: If the shape of the records is wrong.
    """
    layout = TermLayout.from_grids(grids)
    packed = _check.integers("records", records, ("T", layout.nbytes), np.uint8)
    padded = np.zeros((len(packed), 8), np.uint8)
    padded[:, : layout.nbytes] = packed
    words = padded.view("<u8")[:, 0]
    shift = 0
    parts: list[U16] = []
    for width in layout.widths.tolist():
        parts.append(((words >> np.uint64(shift)) & np.uint64((1 << width) - 1)).astype(np.uint16))
        shift += width
    last = len(grids.kind.functions) - 1
    most = (1 << layout.intensity) - 2
    functions, theta, phi, decays, *intensities = parts
    values = np.minimum(np.stack(intensities, axis=1), most)
    return Terms(np.minimum(functions, last).astype(np.uint8), np.stack([theta, phi], axis=1), decays, values)
