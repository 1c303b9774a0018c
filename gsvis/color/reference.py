"""Plain twins of the fast paths of this room: short, in float64, one formula after the other.

Tests compare the two; nothing else needs these.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis.color.spaces import hsl_to_rgb, hsv_to_rgb, yuv_to_rgb
from gsvis.color.srbf import SrbfColors, srbf, unit_vectors

__all__ = ["evaluate"]

F64 = NDArray[np.float64]


def evaluate(colors: SrbfColors, means: ArrayLike, eye: ArrayLike, *, active: ArrayLike | None = None) -> F64:
    """(N, 3) colours as one eye sees them; arguments as `gsvis.color.evaluate`."""
    offsets = np.asarray(means, np.float64).reshape(-1, 3) - np.asarray(eye, np.float64)
    lengths = np.linalg.norm(offsets, axis=1, keepdims=True)
    directions = np.where(lengths > 0, offsets / np.where(lengths > 0, lengths, 1.0), [0.0, 0.0, 1.0])
    terms = np.arange(colors.num_terms) if active is None else np.flatnonzero(active)
    ids = colors.gaussian_ids[terms]
    lobes = srbf(directions[ids], unit_vectors(colors.centers[terms]), colors.decays[terms])
    values = colors.base.astype(np.float64)
    np.add.at(values, ids, lobes[:, None] * colors.amplitudes()[terms])
    return _to_rgb(colors, values)


def _to_rgb(colors: SrbfColors, values: F64) -> F64:
    """RGB of (N, 3) values in the variant's space."""
    space = colors.kind.space
    if space == "hsl":
        values = np.asarray(hsl_to_rgb(np.clip(values, [-np.inf, 0, 0], [np.inf, 1, 1])))
    elif space == "hsv":
        values = np.asarray(hsv_to_rgb(np.clip(values, [-np.inf, 0, 0], [np.inf, 1, 1])))
    elif space == "yuv":
        values = np.asarray(yuv_to_rgb(values))
    scales = 1.0 if space == "rgb" else colors.scales[:, None].astype(np.float64)
    return np.asarray(np.maximum(values, 0.0) * scales)
