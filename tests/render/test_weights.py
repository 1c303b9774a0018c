"""Weights per view and contributors per pixel against the reference and against the image they make."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from gsvis.color.sh import seen_sh_colors
from gsvis.render import GaussianTensors, contributors, rasterize, view_weights
from gsvis.render.reference_torch import rasterize_reference
from gsvis.render.weights import draw_and_weigh
from gsvis.scene.cameras import Cameras
from tests.raycast.scenes import KINDS, scene


def views() -> Cameras:
    return Cameras.orbit([0, 0, 0], 3.0, 3, width=40, height=30)


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "far"])
def test_weights_equal_the_reference(kind: str) -> None:
    g, cameras = scene(kind), views()
    weights = view_weights(g, cameras)
    assert weights.largest.shape == weights.summed.shape == (3, len(g))
    tensors = GaussianTensors.from_gaussians(g, torch.float64)
    for c in range(3):
        want = rasterize_reference(tensors, cameras.viewmats[c], cameras.Ks[c], 40, 30)
        np.testing.assert_allclose(weights.largest[c], want.largest_weights, atol=2e-4)
        np.testing.assert_allclose(weights.summed[c], want.summed_weights, atol=5e-3, rtol=1e-4)


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("kind", KINDS)
def test_one_projection_draws_and_weighs_as_two(kind: str, antialiased: bool) -> None:
    g = scene(kind)
    g = g.with_facts(replace(g.facts, antialiased=antialiased))
    for camera in (views()[0], views()[2]):
        image, summed = draw_and_weigh(g, camera)
        np.testing.assert_array_equal(image, rasterize(g, camera).images[0])
        np.testing.assert_array_equal(summed, view_weights(g, camera).summed[0])


def test_colors_of_one_view_draw_what_the_colors_of_the_scene_do() -> None:
    g = scene("mixed")
    camera = views()[0]
    image, summed = draw_and_weigh(g.without_harmonics(), camera, lambda ids, eye: seen_sh_colors(g, ids, eye))
    np.testing.assert_array_equal(image, draw_and_weigh(g, camera)[0])
    np.testing.assert_array_equal(summed, draw_and_weigh(g, camera)[1])
    assert g.sh_degree > 0
    assert not np.array_equal(image, draw_and_weigh(g.without_harmonics(), camera)[0])


def test_summed_weights_make_up_alpha() -> None:
    g, cameras = scene("mixed"), views()
    summed = view_weights(g, cameras).summed.sum(axis=1)
    np.testing.assert_allclose(summed, rasterize(g, cameras).alphas.sum(axis=(1, 2)), rtol=1e-4)


def test_contributors_make_up_their_pixel() -> None:
    g, camera = scene("mixed"), views()[1]
    drawn = rasterize(g, camera)
    ones = np.random.default_rng(0).uniform(0, 1, (len(g), 3))
    image = rasterize(g, camera, colors=ones).images[0]
    largest = np.zeros(len(g), np.float32)
    for x in range(40):
        for y in range(30):
            behind = contributors(g, camera, (x, y))
            np.testing.assert_allclose(behind.weights.sum(), drawn.alphas[0, y, x], atol=2e-5)
            np.testing.assert_allclose(behind.weights @ ones[behind.gaussian_ids], image[y, x], atol=2e-5)
            assert (np.diff(behind.depths) >= 0).all()
            transmittance = np.cumprod(np.concatenate([[1.0], 1.0 - behind.alphas.astype(float)]))[:-1]
            np.testing.assert_allclose(behind.weights, behind.alphas * transmittance, atol=1e-6)
            np.maximum.at(largest, behind.gaussian_ids, behind.weights)
    np.testing.assert_allclose(view_weights(g, camera).largest[0], largest, atol=2e-5)


def test_progress_and_refusals() -> None:
    g = scene("one")
    calls: list[tuple[str, int, int]] = []
    view_weights(g, views(), progress=lambda *call: calls.append(call))
    assert calls == [("views", i, 3) for i in range(4)]
    with pytest.raises(ValueError, match=r"^pixel: expected column and row inside 40 x 30, got \(40, 0\)"):
        contributors(g, views()[0], (40, 0))
    with pytest.raises(ValueError, match=r"^camera: expected one camera, got 3"):
        contributors(g, views(), (0, 0))
