"""Overdraw against the reference, and scenes whose fill is known."""

from __future__ import annotations

import numpy as np
import pytest

from gsvis.render import Fill, fill_around, measure_fill, view_weights
from gsvis.render.fill import fill_reference, sample_fill_around, sampled_view_fill, view_fill
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from tests.raycast.scenes import KINDS, scene


def views() -> Cameras:
    return Cameras.orbit([0, 0, 0], 3.0, 2, width=40, height=30)


def sheets(count: int, opacity: float) -> Gaussians:
    """Discs behind each other that fill the view of an eye at the origin along +z."""
    means = np.zeros((count, 3))
    means[:, 2] = 1.0 + 0.1 * np.arange(count)
    scales = np.tile([50.0, 50.0, 1e-3], (count, 1))
    return Gaussians(
        means, np.tile([1.0, 0, 0, 0], (count, 1)), scales, np.full(count, opacity), np.zeros((count, 1, 3))
    )


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind not in ("far", "none")])
def test_the_kernel_counts_as_the_reference(kind: str) -> None:
    g = scene(kind)
    for camera in (views()[0], views()[1]):
        fast, slow = view_fill(g, camera), fill_reference(g, camera)
        assert np.abs(fast.fill - slow.fill).max() <= 1  # an alpha at 1/255
        assert np.abs(fast.until - slow.until).max() <= 1
        assert abs(fast.fill.mean() - slow.fill.mean()) < 0.01 * max(slow.fill.mean(), 1.0)
        light = np.zeros((2, len(g)))
        light[0, fast.ids], light[1, slow.ids] = fast.light, slow.light
        np.testing.assert_allclose(light[0], light[1], atol=0.02)
        covered = np.zeros((2, len(g)))
        covered[0, fast.ids], covered[1, slow.ids] = fast.covered, slow.covered
        assert np.abs(covered[0] - covered[1]).max() <= 2


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind not in ("far", "none")])
@pytest.mark.parametrize("step", [1, 3, 4])
def test_sampled_pixels_have_the_fill_of_all_pixels(kind: str, step: int) -> None:
    g, camera = scene(kind), views()[0]
    exact = view_fill(g, camera)
    splats, fill = sampled_view_fill(g, camera, step)
    assert np.abs(fill - exact.fill[step // 2 :: step, step // 2 :: step]).max() <= 1  # an alpha at 1/255
    assert splats >= len(exact.ids)


def test_sampled_eyes_have_about_the_fill_of_eyes() -> None:
    g = scene("mixed")
    eyes = [[0.0, 0, 3], [2.0, 1, 0]]
    exact = fill_around(g, eyes)
    found = sample_fill_around(g, eyes)
    np.testing.assert_allclose(found.mean, exact.mean, rtol=0.02)
    assert (found.worst <= exact.worst + 1).all()
    np.testing.assert_allclose(found.splats, exact.splats, rtol=0.05)
    assert sample_fill_around(Gaussians.empty(), [[0.0, 0, 0]]).splats.tolist() == [0]


def test_covered_pixels_sum_to_the_fill_and_light_is_that_of_images() -> None:
    g, camera = scene("mixed"), views()[0]
    found = view_fill(g, camera)
    assert found.covered.sum() == found.fill.sum()
    summed = view_weights(g, camera).summed[0]
    more = found.light - summed[found.ids]  # images leave out the splat that makes a pixel opaque
    assert more.min() > -1e-2
    assert abs(more.sum()) < 0.02 * summed.sum()


def test_sheets_fill_every_pixel_and_hide_what_is_behind() -> None:
    camera = Cameras.look_at([[0.0, 0, 0]], [[0.0, 0, 1]], up=(0, -1, 0), width=32, height=32, fov=60)
    clear = measure_fill(sheets(12, 0.1), camera).largest()
    assert clear == {"splats": 12, "mean": 12, "worst": 12, "until": 12}
    found = measure_fill(sheets(12, 0.97), camera).largest()
    assert (found["mean"], found["until"]) == (12, 3)  # 0.03 cubed is below 1e-4


def test_an_eye_has_the_largest_of_its_six_views() -> None:
    found = fill_around(sheets(5, 0.5), [[0.0, 0, 0], [0.0, 0, -1e6]])
    assert isinstance(found, Fill)
    assert found.mean[0] > 4.9
    assert found.splats[0] == 5
    assert found.mean[1] < 0.1


def test_nothing_fills_nothing() -> None:
    assert fill_around(Gaussians.empty(), [[0.0, 0, 0]]).largest() == {"splats": 0, "mean": 0, "worst": 0, "until": 0}
    assert fill_around(scene("one"), np.zeros((0, 3))).largest()["splats"] == 0
