"""Largest weights from cameras and viewpoints against the contributions behind them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from gsvis.raycast import TAU, EllipsoidProxies, GaussianRays, Tracer, ray_image, visible_from, visible_in
from gsvis.raycast.reference import brute_force_contributions
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from tests.raycast.scenes import scene


def tracer_of(kind: str) -> Tracer:
    return Tracer(EllipsoidProxies.from_scene(scene(kind)))


def cameras() -> Cameras:
    return Cameras.orbit([0, 0, 0], 2.5, 3, width=24, height=16)


@pytest.mark.parametrize("kind", ["blobs", "discs", "mixed", "none"])
def test_visible_in_is_the_largest_contribution(kind: str) -> None:
    tracer, views = tracer_of(kind), cameras()
    weights = visible_in(tracer, views)
    assert weights.shape == (3, len(tracer.proxies.gaussians))
    for c in range(3):
        part = brute_force_contributions(tracer.proxies.gaussians, *views[c].rays())
        want = np.zeros(weights.shape[1], np.float32)
        np.maximum.at(want, part.gaussian_ids, part.weights)
        np.testing.assert_allclose(weights[c], want, atol=1e-6)


def test_pixels_around_a_viewpoint_are_those_of_its_cubemap() -> None:
    tracer = tracer_of("mixed")
    around = visible_from(tracer, [[0.1, 0.2, 0.3]], size=16)[0]
    faces = visible_in(tracer, Cameras.cubemap([[0.1, 0.2, 0.3]], 16))
    np.testing.assert_array_equal(around, faces.max(axis=0))


@pytest.mark.parametrize("kind", ["blobs", "discs", "mixed"])
def test_gaussian_rays_equal_the_oracle_along_the_same_rays(kind: str) -> None:
    tracer = tracer_of(kind)
    g = tracer.proxies.gaussians
    eye = np.array([0.3, -2.0, 0.4])
    weights = visible_from(tracer, [eye], sampling="gaussians", rays=GaussianRays(floor=0.0))[0]
    part = brute_force_contributions(g, np.tile(eye, (len(g), 1)), g.means.astype(float) - eye)
    own = part.gaussian_ids == part.ray_ids
    want = np.zeros(len(g))
    want[part.ray_ids[own]] = part.weights[own]
    np.testing.assert_allclose(weights, want, atol=1e-6)


def test_ids_choose_and_order() -> None:
    tracer = tracer_of("mixed")
    eyes = np.array([[0.0, -2.0, 0.0], [0.0, 0.0, 0.0]])
    ways: list[dict[str, Any]] = [{"sampling": "gaussians"}, {"sampling": "pixels", "size": 8}]
    for options in ways:
        whole = visible_from(tracer, eyes, **options)
        some = visible_from(tracer, eyes, ids=[9, 2, 250], **options)
        np.testing.assert_array_equal(some, whole[:, [9, 2, 250]])


def test_the_floor_only_drops_what_is_below_it() -> None:
    tracer = tracer_of("mixed")
    exact = visible_from(tracer, [[0, -2.0, 0]], sampling="gaussians", rays=GaussianRays(4, floor=0.0))[0]
    cut = visible_from(tracer, [[0, -2.0, 0]], sampling="gaussians", rays=GaussianRays(4, floor=TAU))[0]
    np.testing.assert_allclose(cut[exact >= TAU * 1.001], exact[exact >= TAU * 1.001], atol=1e-6)
    assert (cut[exact < TAU * 0.999] == 0).all()


def test_a_ring_of_rays_never_sees_less() -> None:
    tracer = tracer_of("discs")
    center = visible_from(tracer, [[0, -2.0, 0]], sampling="gaussians")[0]
    ring = visible_from(tracer, [[0, -2.0, 0]], sampling="gaussians", rays=GaussianRays(6))[0]
    assert (ring >= center).all()
    assert (ring > center).any()


def test_an_eye_in_the_very_center_sees_that_gaussian() -> None:
    g = Gaussians([[1, 2, 3]], [[1, 0, 0, 0]], [[0.5] * 3], [0.7], [[[0, 0, 0]]])
    weights = visible_from(
        Tracer(EllipsoidProxies.from_scene(g)), [[1, 2, 3]], sampling="gaussians", rays=GaussianRays(4)
    )
    np.testing.assert_allclose(weights, [[0.7]], rtol=1e-6)


def test_more_opacity_in_front_never_shows_more_behind() -> None:
    g = scene("blobs")
    means = g.means.copy()
    views = Cameras.look_at([[0, -3.0, 0]], [0, 0, 0], width=32, height=24)
    front = means[:, 1] < -0.5
    last = None
    for opacity in (0.0, 0.3, 0.6, 0.99):
        opacities = np.where(front, opacity, g.opacities)
        covered = Gaussians(means, g.quats, g.scales, opacities, g.sh0)
        part = visible_in(Tracer(EllipsoidProxies.from_scene(covered)), views)[0][means[:, 1] > 0.5]
        if last is not None:
            assert (part <= last + 1e-6).all()
            assert part.sum() < last.sum()
        last = part


def test_an_image_is_the_weighted_sum_of_colors() -> None:
    red, green = (0.5 / 0.28209479177387814), -(0.5 / 0.28209479177387814)
    sh0 = np.array([[[red, green, green]], [[green, red, green]]])
    g = Gaussians([[0, 0, 2.0], [0, 0, 4.0]], [[1, 0, 0, 0]] * 2, [[0.5] * 3, [2.0] * 3], [0.6, 0.9], sh0)
    camera = Cameras.look_at([[0, 0, 0]], [0, 0, 1.0], up=(0, -1, 0), width=9, height=9, fov=20)
    image = ray_image(Tracer(EllipsoidProxies.from_scene(g)), camera, background=(0, 0, 1.0))
    np.testing.assert_allclose(image[4, 4], [0.6, 0.4 * 0.9, 0.4 * 0.1], atol=1e-6)
    with pytest.raises(ValueError, match=r"^camera: expected one camera, got 3"):
        ray_image(tracer_of("one"), cameras())


def test_progress_runs_from_none_to_all_and_may_interrupt() -> None:
    calls: list[tuple[str, int, int]] = []
    visible_in(tracer_of("one"), cameras(), progress=lambda *call: calls.append(call))
    assert calls == [("cameras", i, 3) for i in range(4)]

    def stop(stage: str, done: int, total: int) -> None:
        if done == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        visible_from(tracer_of("one"), np.zeros((3, 3)), progress=stop)


def test_refusals_name_the_argument() -> None:
    with pytest.raises(ValueError, match=r"^sampling: expected one of 'pixels', 'gaussians', got 'rays'"):
        visible_from(tracer_of("one"), [[0, 0, 0]], sampling="rays")
    with pytest.raises(ValueError, match=r"^viewpoints: expected finite"):
        visible_from(tracer_of("one"), [[0, 0, np.inf]])
    with pytest.raises(ValueError, match=r"^ring: expected an integer of at least 0"):
        GaussianRays(ring=-1)
    with pytest.raises(ValueError, match=r"^floor: expected a weight"):
        GaussianRays(floor=2.0)
