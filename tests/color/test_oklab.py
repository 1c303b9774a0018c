"""OKLab: known answers, there and back, a ramp of even steps, a palette of different colors."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsvis.color.oklab import oklab_to_srgb, palette, ramp, srgb_to_oklab

CHANNEL = st.floats(0.0, 1.0)


def test_white_black_and_red_are_where_their_definition_puts_them() -> None:
    found = srgb_to_oklab([[1, 1, 1], [0, 0, 0], [1, 0, 0]])
    np.testing.assert_allclose(found, [[1, 0, 0], [0, 0, 0], [0.62796, 0.22486, 0.12585]], atol=2e-4)


@given(st.lists(st.tuples(CHANNEL, CHANNEL, CHANNEL), min_size=1, max_size=8))
def test_there_and_back(colors: list[tuple[float, float, float]]) -> None:
    np.testing.assert_allclose(oklab_to_srgb(srgb_to_oklab(colors)), colors, atol=1e-6)


def test_steps_of_the_ramp_look_alike() -> None:
    colors = ramp(np.linspace(0.0, 1.0, 65))
    assert colors.min() >= 0.0
    assert colors.max() <= 1.0
    lab = srgb_to_oklab(colors)
    np.testing.assert_allclose(np.diff(lab[:, 0]), np.diff(lab[:, 0]).mean(), rtol=1e-3)
    steps = np.linalg.norm(np.diff(lab, axis=0), axis=1)
    assert steps.max() < 1.3 * steps.min()


def test_categories_differ_from_their_neighbors() -> None:
    lab = srgb_to_oklab(palette(64))
    apart = np.linalg.norm(lab[:, None] - lab[None], axis=2)
    for away in (1, 2, 3):
        assert np.diagonal(apart, away).min() > 0.1
    assert (apart + np.eye(64)).min() > 0.01
    assert palette(0).shape == (0, 3)


def test_parts_outside_are_refused() -> None:
    with pytest.raises(ValueError, match="parts"):
        ramp([0.5, 1.1])
