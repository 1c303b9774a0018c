"""Views of fixed geometry: images and gradients are those of the rasterizer, for any colors."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gsvis.render import rasterize, view_weights
from gsvis.render.fixed_view import FixedView
from gsvis.render.tensors import GaussianTensors
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians


@pytest.fixture(scope="module")
def scene() -> Gaussians:
    rng = np.random.default_rng(8)
    n = 300
    return Gaussians(
        rng.normal(size=(n, 3)),
        rng.normal(size=(n, 4)),
        rng.uniform(0.02, 0.4, (n, 3)),
        rng.uniform(0.05, 1.0, n),
        rng.normal(size=(n, 1, 3)),
        np.zeros((n, 0, 3)),
    )


@pytest.fixture(scope="module")
def camera() -> Cameras:
    return Cameras.look_at([[0.0, 0.5, -3.0]], [[0.2, 0.0, 0.0]], width=45, height=37)


@pytest.mark.parametrize("antialiased", [False, True])
def test_image_and_gradient_are_those_of_the_rasterizer(scene: Gaussians, camera: Cameras, antialiased: bool) -> None:
    rng = np.random.default_rng(2)
    view = FixedView(scene, camera, antialiased=antialiased)
    colors = torch.tensor(rng.normal(size=(len(scene), 3)).astype(np.float32), requires_grad=True)
    tensors = GaussianTensors.from_gaussians(scene)
    image = rasterize(tensors, camera, colors=colors, antialiased=antialiased).images[0]
    by_image = rng.normal(size=image.shape).astype(np.float32)
    image.backward(torch.from_numpy(by_image))
    assert colors.grad is not None
    assert np.allclose(view.image(colors.detach().numpy()[view.ids]), image.detach().numpy(), atol=1e-5)
    expected = colors.grad.numpy()
    assert np.allclose(view.by_colors(by_image), expected[view.ids], atol=1e-4)
    others = np.setdiff1d(np.arange(len(scene)), view.ids)
    assert np.array_equal(expected[others], np.zeros((len(others), 3)))


def test_it_holds_what_has_weight(scene: Gaussians, camera: Cameras) -> None:
    view = FixedView(scene, camera)
    assert np.array_equal(view.ids, np.flatnonzero(view_weights(scene, camera).largest[0]))
    assert 0 < len(view) < len(scene)


def test_a_view_of_nothing_is_black(scene: Gaussians) -> None:
    away = Cameras.look_at([[0.0, 0.0, 90.0]], [[0.0, 0.0, 200.0]], width=16, height=12)
    view = FixedView(scene, away)
    assert len(view) == 0
    assert not view.image(np.zeros((0, 3))).any()
    assert view.by_colors(np.ones((12, 16, 3))).shape == (0, 3)


def test_bad_input_is_refused(scene: Gaussians, camera: Cameras) -> None:
    view = FixedView(scene, camera)
    with pytest.raises(ValueError, match="camera: expected one camera"):
        FixedView(scene, Cameras.orbit((0, 0, 0), 3.0, 2))
    with pytest.raises(ValueError, match="colors"):
        view.image(np.zeros((len(view) + 1, 3)))
    with pytest.raises(ValueError, match="by_image"):
        view.by_colors(np.zeros((3, 3, 3)))
