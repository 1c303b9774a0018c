"""Terms that lack bits have places that are multiples of powers of two, the same tables, and intensities that fit."""

from __future__ import annotations

import numpy as np
import pytest

from gsvis.color.coarse import coarsen_terms
from gsvis.color.evaluate import evaluate_along
from gsvis.color.records import QuantizedColors, quantize
from tests.color.samples import random_colors

N = 60


def packed(variant: str = "rgb") -> QuantizedColors:
    return quantize(random_colors(np.random.default_rng(7), N, variant), "wire")


def coarse(colors: QuantizedColors, bits: int) -> QuantizedColors:
    t = colors.num_terms
    return coarsen_terms(colors, np.full(t, bits), np.full(t, bits), np.full(N, bits))


@pytest.mark.parametrize("variant", ["rgb", "hsl"])
@pytest.mark.parametrize("bits", [1, 2, 3])
def test_places_are_multiples(variant: str, bits: int) -> None:
    before = packed(variant)
    after = coarse(before, bits)
    step = 1 << bits
    assert after.grids == before.grids
    assert not (after.centers % step).any()
    assert not (after.decays % step).any()
    middle = (1 << (before.grids.precision.intensity - 1)) - 1
    assert not ((after.intensities.astype(int) - middle) % step).any()


def test_lobes_that_lack_nothing_stay() -> None:
    before = packed()
    after = coarse(before, 0)
    assert np.array_equal(after.centers, before.centers)
    assert np.array_equal(after.decays, before.decays)


def test_intensities_fit_the_rounded_lobes() -> None:
    """Better than the same intensities on rounded lobes."""
    before = packed()
    after = coarsen_terms(before, np.full(before.num_terms, 3), np.zeros(before.num_terms, int), np.zeros(N, int))
    kept = QuantizedColors(
        before.grids,
        before.base,
        before.scales,
        before.offsets,
        before.functions,
        after.centers,
        after.decays,
        before.intensities,
    )
    directions = np.random.default_rng(1).normal(size=(400, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    truth, fitted, left = (evaluate_along(c.dequantize(), directions) for c in (before, after, kept))
    assert np.square(fitted - truth).mean() < 0.9 * np.square(left - truth).mean()


def test_wrong_lengths_are_refused() -> None:
    colors = packed()
    with pytest.raises(ValueError, match="intensities"):
        coarsen_terms(colors, np.zeros(colors.num_terms, int), np.zeros(colors.num_terms, int), np.zeros(3, int))
