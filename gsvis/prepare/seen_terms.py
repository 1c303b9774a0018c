"""Leave out terms that no eye needs: those active only in directions from which nobody sees their Gaussian."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.color.activation import Activation
from gsvis.color.epsilon import DEFAULT_EPSILON
from gsvis.color.srbf import SrbfColors, unit_vectors
from gsvis.raycast.directions import NUM_FACES, face_of
from gsvis.scene.icosphere import icosphere

__all__ = ["drop_unseen_terms", "seen_terms"]

Mask = NDArray[np.bool_]

_PART = 2048  # terms at a time


def seen_terms(colors: SrbfColors, sets: ArrayLike, epsilon: float = DEFAULT_EPSILON) -> Mask:
    """Find the terms that are active in some direction from which their Gaussian is seen.

    A face of a direction set counts as a whole. A term is active within a cap around its center, so it is if the face
    of its center is in the set, or one of 15 points of another face of the set, evenly spread, lies in the cap.

    Args:
        colors: N Gaussians with T terms.
        sets: (N, 10) uint8 direction sets, from the Gaussian to the eye.
        epsilon: Contribution above which a term is active, >= 0.

    Returns:
        (T,) bool.
    """
    packed = _check.integers("sets", sets, (len(colors), NUM_FACES // 8), np.uint8)
    least = Activation(colors, np.zeros((len(colors), 3)), epsilon).least_cosines()
    toward = -unit_vectors(colors.centers)  # to the eye
    of = colors.gaussian_ids
    own = face_of(toward)
    found: Mask = (packed[of, own >> 3] >> (own & 7) & 1).astype(bool) & (least <= 1.0)
    points = _points_of_faces().reshape(-1, 3).T
    left = np.flatnonzero(~found & (least <= 1.0))
    for start in range(0, len(left), _PART):
        some = left[start : start + _PART]
        nearest = (toward[some].astype(np.float32) @ points).reshape(len(some), NUM_FACES, -1).max(axis=2)
        seen = np.unpackbits(packed[of[some]], axis=1, bitorder="little").astype(bool)
        found[some] = (seen & (nearest >= least[some, None])).any(axis=1)
    return found


def drop_unseen_terms(colors: SrbfColors, sets: ArrayLike) -> SrbfColors:
    """Return colors without the terms that are active in no direction from which their Gaussian is seen."""
    return colors.keep(seen_terms(colors, sets)) if colors.num_terms else colors


def _points_of_faces() -> NDArray[np.float32]:
    """Return (80, 15, 3) unit vectors: the corners of the 16 parts of each face."""
    vertices, parts = icosphere(3)
    corners = np.array([np.unique(of_face) for of_face in parts.reshape(NUM_FACES, -1)])
    return np.asarray(vertices[corners], np.float32)
