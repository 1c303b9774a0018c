"""Flyaways: up to a fourth of a scene lies far outside of it, and box, kind and space stay those of the scene alone."""

from __future__ import annotations

import numpy as np
import pytest

from gsvis.scene.flyaways import find_flyaways
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.inspection import inspect_scene
from gsvis.scene.navigable import NavigableSpace
from tests.scene.places import apartment, outside, statue, street


def flown(g: Gaussians) -> np.ndarray:
    return find_flyaways(g.means, g.scales, g.opacities)


@pytest.mark.parametrize("how", ["sphere", "ball", "every scale", "one side", "one point"])
@pytest.mark.parametrize("share", [0.02, 0.05, 0.1, 0.2])
def test_all_of_them_are_found_and_the_box_is_that_of_the_scene(how: str, share: float) -> None:
    g = apartment()
    more = outside(g, share, how)
    found = flown(more)
    assert not found[: len(g)].any()
    assert found[len(g) :].mean() > (0.99 if how == "ball" else 0.9999)  # some of a ball lie within
    np.testing.assert_allclose(more.bounds(), g.bounds(), atol=0.02)
    assert np.ptp(more.bounds(1.0)[:, 2]) > 50.0  # the exact box holds all


@pytest.mark.parametrize("make", [apartment, statue, street])
def test_a_scene_without_has_none_and_the_box_of_its_quantiles(make: object) -> None:
    g = make()  # type: ignore[operator]
    assert not flown(g).any()
    few = outside(g, 0.009)
    assert not flown(few).any()
    for each in (g, few):
        np.testing.assert_array_equal(each.bounds(), np.quantile(each.means.astype(np.float64), [0.01, 0.99], axis=0))


def test_what_covers_the_sky_is_part_of_the_scene() -> None:
    g = apartment()
    small = outside(g, 0.05)
    scales = small.scales.copy()
    scales[len(g) :] = 400.0  # as a trained sky has it
    sky = Gaussians(small.means, small.quats, scales, small.opacities, small.sh0)
    assert flown(small).any()
    assert not flown(sky).any()


def test_order_place_and_unit_do_not_matter() -> None:
    more = outside(apartment(), 0.05, "every scale")
    found = flown(more)
    order = np.random.default_rng(0).permutation(len(more))
    np.testing.assert_array_equal(flown(more[order]), found[order])
    means, scales = more.means.astype(np.float64), more.scales.astype(np.float64)
    for factor in (1e-3, 1e3):
        np.testing.assert_array_equal(find_flyaways(factor * (means + 7.0), factor * scales, more.opacities), found)


def test_degenerate_scenes_have_none() -> None:
    for means in (np.zeros((500, 3)), np.zeros((0, 3)), np.eye(3)):
        assert not find_flyaways(means, np.ones_like(means), np.ones(len(means))).any()
    most = np.concatenate([np.zeros((400, 3)), np.full((100, 3), 1e6)])  # most in one point: no size to compare with
    assert not find_flyaways(most, np.ones_like(most), np.ones(500)).any()


@pytest.mark.parametrize("share", [0.02, 0.05, 0.1])
def test_kind_and_space_are_those_of_the_scene(share: float) -> None:
    g = apartment()
    alone, among = NavigableSpace.from_scene(g), NavigableSpace.from_scene(outside(g, share))
    assert among.kind.kind == alone.kind.kind == "rooms"
    np.testing.assert_array_equal(among.free, alone.free)
    np.testing.assert_array_equal(among.origin, alone.origin)


def test_they_are_reported_as_floaters_of_a_scene_in_meters() -> None:
    g = apartment()
    report = inspect_scene(outside(g, 0.05))
    assert report.floaters == round(0.05 / 0.95 * len(g))
    assert not any("units long" in problem for problem in report.problems)
