"""Find Gaussians that repeat earlier ones bit for bit; no tracer can order such ties on a ray."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsvis.scene.gaussians import Gaussians

__all__ = ["first_equal", "hash_columns"]


def first_equal(g: Gaussians) -> NDArray[np.int64]:
    """Return (N,) the first Gaussian with the same place, shape and opacity as each, itself if there is none before.

    Args:
        g: The scene; colors do not count.
    """
    mixed = hash_columns((*g.means.T, *g.scales.T, *g.quats.T, g.opacities))
    _, first, numbers = np.unique(mixed, return_index=True, return_inverse=True)
    return np.asarray(first[numbers], np.int64)


def hash_columns(columns: tuple[NDArray[np.float32], ...]) -> NDArray[np.uint64]:
    """Return (N,) a 64-bit hash of each row of columns of N numbers; equal rows have equal hashes."""
    mixed = np.zeros(len(columns[0]), np.uint64)
    for column in columns:
        mixed ^= np.ascontiguousarray(column, np.float32).view(np.uint32)
        mixed *= np.uint64(0x9E3779B97F4A7C15)
        mixed ^= mixed >> np.uint64(29)
    return mixed
