"""Few Gaussians stand for many: large ones stay, and the covered area is that of the scene."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsvis.scene.gaussians import Gaussians
from gsvis.scene.glance import stand_ins


def specks(n: int) -> Gaussians:
    """Equal small Gaussians, and a large one in front of them."""
    scales = np.full((n, 3), 0.01)
    scales[0] = 5.0
    means = np.random.default_rng(0).uniform(-1, 1, (n, 3))
    return Gaussians(means, np.tile([1.0, 0, 0, 0], (n, 1)), scales, np.full(n, 0.5), np.zeros((n, 1, 3)))


def area(g: Gaussians) -> float:
    return float((g.scales[:, 0].astype(np.float64) ** 2 * g.opacities).sum())


def test_large_ones_stay_and_the_area_is_kept() -> None:
    whole = specks(20_000)
    found = stand_ins(whole, len(whole), 500)
    assert 400 < len(found) < 600
    assert found.scales.max() == np.float32(5.0)
    small = found.scales[:, 0] < 1.0
    expected = area(whole) - 0.5 * 25.0
    assert 0.8 < area(found[np.flatnonzero(small)]) / expected < 1.25


def test_a_sample_stands_for_all_that_were_not_read() -> None:
    whole = specks(20_000)
    part = whole[np.arange(0, 20_000, 4) + 1]
    found = stand_ins(part, len(whole), 500)
    assert 0.8 < area(found) / (area(whole) - 0.5 * 25.0) < 1.25


def test_fewer_than_wanted_are_all_of_the_sample() -> None:
    part = specks(100)
    found = stand_ins(part, 400, 1000)
    assert len(found) == 100
    assert np.allclose(found.scales, 2.0 * part.scales)


def test_what_nobody_sees_and_what_is_huge_stand_for_themselves() -> None:
    part = specks(100)
    unseen = replace(part, opacities=np.zeros(100, np.float32))
    assert len(stand_ins(unseen, 400, 1000)) == 100
    huge = replace(part, scales=np.full((100, 3), np.finfo(np.float32).max))
    assert np.isfinite(stand_ins(huge, 40_000, 10).scales).all()
