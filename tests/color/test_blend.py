"""Colors between two: both ends to the bit, and the middle of each value."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gsvis.color.blend import blend_colors
from gsvis.color.srbf import SrbfColors, spherical_coordinates, unit_vectors


def colors_of(centers: list[list[float]], decays: list[float]) -> SrbfColors:
    count = len(decays)
    return SrbfColors(
        "rgb",
        np.full((2, 3), 0.25),
        np.ones(2),
        np.array([0, count, count]),
        np.zeros(count, np.uint8),
        spherical_coordinates(centers),
        np.array(decays),
        np.full((count, 3), 0.5),
    )


def test_a_half_lies_in_the_middle_and_the_ends_are_the_colors() -> None:
    begun = colors_of([[1, 0, 0], [0, 0, 1]], [2.0, 3.0])
    turned = spherical_coordinates([[0, 1, 0], [0, 0, 1]]).astype(np.float32)
    ended = replace(
        begun,
        base=begun.base + np.float32(0.5),
        centers=turned,
        decays=np.array([8.0, 3.0], np.float32),
        intensities=begun.intensities * np.float32(3.0),
    )
    half = blend_colors(begun, ended, 0.5)
    np.testing.assert_allclose(half.base, 0.5)
    np.testing.assert_allclose(half.intensities, 1.0)
    np.testing.assert_allclose(half.decays, [4.0, 3.0])
    np.testing.assert_allclose(unit_vectors(half.centers[0]), np.array([1, 1, 0]) / np.sqrt(2.0), atol=1e-6)
    np.testing.assert_array_equal(half.centers[1], begun.centers[1])
    assert blend_colors(begun, ended, 0.0) is begun
    assert blend_colors(begun, ended, 1.0) is ended


def test_colors_of_other_terms_and_other_shares_are_refused() -> None:
    begun = colors_of([[1, 0, 0], [0, 0, 1]], [2.0, 3.0])
    fewer = colors_of([[1, 0, 0]], [2.0])
    with pytest.raises(ValueError, match="ended: expected the variant, functions and numbers of terms"):
        blend_colors(begun, fewer, 0.5)
    with pytest.raises(ValueError, match="share"):
        blend_colors(begun, begun, 1.5)
