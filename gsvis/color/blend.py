"""Colors between two that differ in the values of their terms alone: a share of the way from one to the other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsvis import _check
from gsvis.color.srbf import SrbfColors, spherical_coordinates, unit_vectors

__all__ = ["blend_colors"]


def blend_colors(begun: SrbfColors, ended: SrbfColors, share: float) -> SrbfColors:
    """Return colors a share of the way from some to others.

    Base colors and intensities go straight, decays by a constant factor, centers along the chord between their unit
    vectors. What is equal in both stays so to the bit.

    Args:
        begun: N Gaussians with T terms.
        ended: The same Gaussians with the same functions.
        share: 0 gives `begun`, 1 gives `ended`.

    Raises:
        ValueError: If the variants, functions or numbers of terms differ, or the share lies outside of [0, 1].
    """
    _check.in_range("share", np.asarray(share), 0.0, 1.0)
    same = begun.variant == ended.variant and np.array_equal(begun.offsets, ended.offsets)
    if not same or not np.array_equal(begun.functions, ended.functions):
        raise ValueError("ended: expected the variant, functions and numbers of terms of begun, got others")
    if share in (0.0, 1.0):
        return ended if share else begun
    part = np.float32(share)
    centers = begun.centers.copy()
    moved = (ended.centers != begun.centers).any(axis=1)
    start = unit_vectors(begun.centers[moved])
    centers[moved] = spherical_coordinates(start + share * (unit_vectors(ended.centers[moved]) - start))
    return replace(
        begun,
        base=begun.base + part * (ended.base - begun.base),
        centers=centers,
        decays=begun.decays * (ended.decays / begun.decays) ** part,
        intensities=begun.intensities + part * (ended.intensities - begun.intensities),
    )
