"""No length is absolute: the same scene in other units is drawn, weighed and seen alike."""

from __future__ import annotations

import numpy as np
import pytest

from gsvis import Cameras, Gaussians
from gsvis.hpr.zbuffer import Splats, look_around
from gsvis.render import rasterize, view_weights
from gsvis.scene.lengths import length_factor

EYE = np.array([0.3, -0.2, 0.1])


def cloud(scale: float) -> Gaussians:
    rng = np.random.default_rng(0)
    means, sizes = rng.uniform(-2, 2, (400, 3)), rng.uniform(0.05, 0.2, (400, 3))
    return Gaussians(
        means * scale,
        rng.normal(size=(400, 4)),
        sizes * scale,
        rng.uniform(0.1, 0.9, 400),
        rng.normal(size=(400, 1, 3)),
    )


def camera(scale: float) -> Cameras:
    return Cameras.look_at([EYE * scale], np.array([1.0, 0.5, -0.2]) * scale, width=48, height=36, fov=80.0)


@pytest.mark.parametrize("scale", [2.0**-20, 2.0**-10, 2.0**10, 2.0**20])
@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_images_are_the_same_in_any_units(backend, scale):
    one, other = (rasterize(cloud(s), camera(s), backend=backend) for s in (1.0, scale))
    np.testing.assert_allclose(other.images, one.images, atol=2e-3)
    np.testing.assert_allclose(other.depths / scale, one.depths, rtol=1e-2, atol=1e-3)


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_weights_and_sets_are_the_same_in_any_units(scale):
    one, other = (view_weights(cloud(s), camera(s)).summed for s in (1.0, scale))
    assert np.abs(other - one).sum() < 0.01 * one.sum()
    seen = [look_around(Splats.from_gaussians(cloud(s)), EYE * s, size=32, spent=0.3) for s in (1.0, scale)]
    assert len(np.setxor1d(seen[0].ids, seen[1].ids)) <= 0.01 * len(seen[0].ids)
    both = np.isfinite(seen[0].zbuffer.depths) & np.isfinite(seen[1].zbuffer.depths)
    assert np.median(seen[1].zbuffer.depths[both] / seen[0].zbuffer.depths[both]) == pytest.approx(scale, rel=1e-3)
    hidden = [seen[k].zbuffer.hides(Splats.from_gaussians(cloud(s))).sum() for k, s in enumerate((1.0, scale))]
    assert hidden[1] == pytest.approx(hidden[0], abs=4)


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_gradients_follow_the_units(scale):
    torch = pytest.importorskip("torch")
    from gsvis.render import GaussianTensors

    found = []
    for s in (1.0, scale):
        tensors = GaussianTensors.from_gaussians(cloud(s))
        tensors.means.requires_grad_(True)
        rasterize(tensors, camera(s), backend="cpu").images.sum().backward()
        found.append(tensors.means.grad * s)
    assert torch.linalg.norm(found[1] - found[0]) < 0.02 * torch.linalg.norm(found[0])


def test_outliers_and_usual_scenes_do_not_set_the_factor():
    means = cloud(1.0).means.astype(float)
    assert length_factor(means) == 1.0
    means[0] = 1e9
    assert length_factor(means) == 1.0
    assert length_factor(means * 1e-3) == 4.0 * length_factor(means * 4e-3)
