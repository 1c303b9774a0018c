"""SRBF colors through `rasterize`: backends agree, each camera sees its own, gradients reach the terms."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gsvis.color.evaluate import Evaluator, evaluate
from gsvis.color.evaluate_torch import SrbfTensors
from gsvis.color.variants import VARIANTS
from gsvis.render import GaussianTensors, Rendering, RenderingTensors, rasterize
from gsvis.render.device import why_no_cuda
from gsvis.scene.cameras import Cameras
from tests.color.samples import random_colors
from tests.raycast.scenes import scene

VIEWS = Cameras.orbit([0, 0, 0], 3.0, 2, width=30, height=20)


@pytest.mark.parametrize("name", VARIANTS)
def test_backends_agree(name: str) -> None:
    g = scene("blobs")
    colors = random_colors(np.random.default_rng(0), len(g), name)
    fast = rasterize(g, VIEWS, backend="cpu", colors=colors)
    slow = rasterize(GaussianTensors.from_gaussians(g, torch.float64), VIEWS, backend="reference", colors=colors)
    plain = rasterize(g, VIEWS, backend="reference", colors=colors)
    np.testing.assert_allclose(fast.images, slow.images, atol=1e-3, rtol=0)
    np.testing.assert_allclose(plain.images, slow.images, atol=1e-5, rtol=0)
    for c in range(2):
        seen = evaluate(colors, g.means, VIEWS.viewpoints[c])
        torch.testing.assert_close(fast.images[c], rasterize(g, VIEWS[c], colors=seen).images[0], atol=0, rtol=0)
    assert np.abs(fast.images[0] - fast.images[1]).max() > 0.01


def test_every_way_to_give_them_is_the_same() -> None:
    g = scene("blobs")
    colors = random_colors(np.random.default_rng(1), len(g), "hsl")
    plain = rasterize(g, VIEWS, colors=colors).images
    torch.testing.assert_close(rasterize(g, VIEWS, colors=Evaluator(colors)).images, plain, atol=0, rtol=0)
    tensors = GaussianTensors.from_gaussians(g)
    np.testing.assert_array_equal(rasterize(tensors, VIEWS, colors=colors).images, plain)
    as_tensors = SrbfTensors.from_colors(colors)
    np.testing.assert_allclose(rasterize(g, VIEWS, colors=as_tensors).images, plain, atol=1e-4, rtol=0)
    for given in (colors, Evaluator(colors), as_tensors):
        slow = rasterize(g, VIEWS, backend="reference", colors=given).images
        np.testing.assert_allclose(slow, plain, atol=1e-3, rtol=0)
    assert len(rasterize(g, VIEWS[:0], colors=colors).images) == 0


def test_colors_without_terms_are_colors() -> None:
    g = scene("blobs")
    colors = random_colors(np.random.default_rng(2), len(g)).first(0)
    plain = rasterize(g, VIEWS, colors=colors.base)
    torch.testing.assert_close(rasterize(g, VIEWS, colors=colors).images, plain.images, atol=0, rtol=0)


def test_arrays_that_share_memory_with_tensors_are_arrays() -> None:
    g = scene("blobs")
    values = torch.linspace(0.0, 1.0, 3 * len(g)).reshape(-1, 3)
    shared, own = (rasterize(g, VIEWS, colors=each) for each in (values.numpy(), values.numpy().copy()))
    assert isinstance(shared, Rendering)
    np.testing.assert_array_equal(shared.images, own.images)
    assert isinstance(rasterize(g, VIEWS, colors=values), RenderingTensors)


@pytest.mark.parametrize("name", VARIANTS)
def test_gradients_agree(name: str) -> None:
    g = scene("blobs")
    colors = random_colors(np.random.default_rng(3), len(g), name)
    by_image = torch.from_numpy(np.random.default_rng(4).normal(size=(2, 20, 30, 3)))
    gradients = []
    for backend, dtype in (("cpu", torch.float32), ("reference", torch.float64)):
        tensors = GaussianTensors.from_gaussians(g, dtype, requires_grad=True)
        terms = SrbfTensors.from_colors(colors, dtype, requires_grad=True)
        torch.autograd.backward((rasterize(tensors, VIEWS, backend=backend, colors=terms).images * by_image).sum())
        leaves = [terms.base, terms.centers, terms.decays, terms.intensities, tensors.means, tensors.opacities]
        gradients.append([leaf.grad.double() for leaf in leaves])  # type: ignore[union-attr]
    for fast, slow in zip(*gradients, strict=True):
        assert (fast - slow).norm() <= 2e-3 * slow.norm() + 1e-6


def test_fixed_colors_still_move_the_means() -> None:
    """The direction to a Gaussian changes with it, and its color with the direction."""
    g = scene("blobs")
    colors = random_colors(np.random.default_rng(5), len(g))
    tensors = GaussianTensors.from_gaussians(g, requires_grad=True)
    torch.autograd.backward(rasterize(tensors, VIEWS, colors=colors).images.sum())
    frozen = GaussianTensors.from_gaussians(g, requires_grad=True)
    seen = np.stack([evaluate(colors, g.means, eye) for eye in VIEWS.viewpoints])
    torch.autograd.backward(rasterize(frozen, VIEWS, colors=seen).images.sum())
    assert tensors.means.grad is not None
    assert frozen.means.grad is not None
    assert (tensors.means.grad - frozen.means.grad).norm() > 1e-2 * frozen.means.grad.norm()
    torch.testing.assert_close(tensors.opacities.grad, frozen.opacities.grad, atol=1e-3, rtol=1e-3)


def test_wrong_lengths_and_values() -> None:
    g = scene("blobs")
    short = random_colors(np.random.default_rng(6), len(g) - 1)
    for given in (short, Evaluator(short), SrbfTensors.from_colors(short)):
        with pytest.raises(ValueError, match=f"colors: expected those of {len(g)} Gaussians, got {len(g) - 1}"):
            rasterize(g, VIEWS, colors=given)
    broken = SrbfTensors.from_colors(random_colors(np.random.default_rng(7), len(g)))
    broken.base[0] = np.nan
    with pytest.raises(ValueError, match="colors: expected finite"):
        rasterize(g, VIEWS, colors=broken)


@pytest.mark.skipif(bool(why_no_cuda()), reason=why_no_cuda() or "gsplat runs here")
@pytest.mark.parametrize("name", ["rgb", "hsl"])
def test_cuda_agrees(name: str) -> None:
    g = scene("blobs")
    colors = random_colors(np.random.default_rng(8), len(g), name)
    there = GaussianTensors.from_gaussians(g, device="cuda")
    slow = rasterize(g, VIEWS, backend="reference", colors=colors)
    for given in (colors, SrbfTensors.from_colors(colors, device="cuda")):
        fast = rasterize(there, VIEWS, backend="cuda", colors=given)
        np.testing.assert_allclose(fast.images.cpu(), slow.images, atol=2e-3, rtol=0)
