"""The CPU rasterizer against the reference: images, gradients, and what must not change them."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numba
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gsvis.errors import BackendError
from gsvis.render import GaussianTensors, Rendering, RenderingTensors, rasterize
from gsvis.render.cpu import Frozen, rasterize_cpu
from gsvis.render.splats import View
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.procedural import random_scene
from tests.raycast.scenes import KINDS, scene

NAMES = ("means", "quats", "scales", "opacities", "sh0", "shN")
EYES = {"outside": (0.2, -3.0, 0.3), "inside": (0.1, 0.0, 0.1), "far": (1000.2, 997.0, 1000.3)}


def camera(kind: str = "outside", width: int = 50, height: int = 37) -> Cameras:
    target = np.array([0, 0.01, 0]) + (1000.0 if kind == "far" else 0.0)
    return Cameras.look_at([EYES[kind]], target, width=width, height=height, fov=50)


def both(g: Gaussians, views: Cameras, **options: object) -> tuple[Rendering, Rendering]:
    fast = rasterize(g, views, backend="cpu", **options)
    slow = rasterize(g, views, backend="reference", **options)
    return fast, slow


def assert_same_images(fast: Rendering, slow: Rendering) -> None:
    assert all(part.dtype == np.float32 for drawn in (fast, slow) for part in vars(drawn).values())
    assert np.isfinite(fast.images).all()
    np.testing.assert_allclose(fast.images, slow.images, atol=1e-3, rtol=0)
    np.testing.assert_allclose(fast.alphas, slow.alphas, atol=1e-3, rtol=0)
    np.testing.assert_allclose(fast.depths, slow.depths, atol=1e-3, rtol=1e-3)
    apart = np.abs(fast.median_depths - slow.median_depths) > 1e-3 * (1 + slow.median_depths)
    assert apart.mean() < 2e-3  # where the light crosses one half within rounding


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("where", ["outside", "inside"])
def test_images_equal_the_reference(kind: str, antialiased: bool, where: str) -> None:
    view = camera("far" if kind == "far" else where)
    assert_same_images(*both(scene(kind), view, antialiased=antialiased, background=(0.1, 0.2, 0.9)))


@pytest.mark.parametrize("kind", KINDS)
def test_gaussians_that_do_not_show_are_not_there(kind: str) -> None:
    g = scene(kind)
    some = np.arange(len(g)) % 3 > 0
    view = camera("far" if kind == "far" else "outside")
    shown, chosen = (rasterize(each, view, backend="cpu") for each in (g.showing(some), g[some]))
    np.testing.assert_array_equal(shown.images, chosen.images)
    np.testing.assert_array_equal(shown.median_depths, chosen.median_depths)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("antialiased", [False, True])
def test_tensors_are_drawn_as_arrays_are(kind: str, antialiased: bool) -> None:
    g, view = scene(kind), camera("far" if kind == "far" else "outside", 30, 20)
    options: dict[str, Any] = {"antialiased": antialiased, "background": (0.1, 0.2, 0.9)}
    arrays, tensors = (rasterize(s, view, **options) for s in (g, GaussianTensors.from_gaussians(g)))
    exact = rasterize(GaussianTensors.from_gaussians(g, torch.float64), view, backend="reference", **options)
    plain = rasterize(g, view, backend="reference", **options)
    assert isinstance(arrays, Rendering)
    assert isinstance(tensors, RenderingTensors)
    for name in ("images", "alphas", "depths", "median_depths"):
        np.testing.assert_array_equal(getattr(arrays, name), getattr(tensors, name), err_msg=name)
    for name in ("images", "alphas"):
        np.testing.assert_allclose(getattr(plain, name), getattr(exact, name), atol=2e-6, rtol=0, err_msg=name)
    np.testing.assert_allclose(plain.depths, exact.depths, atol=2e-5, rtol=1e-5)
    assert (np.abs(plain.median_depths - exact.median_depths.numpy()) > 1e-4).mean() < 2e-3


@given(seed=st.integers(0, 10_000), kind=st.sampled_from(KINDS), width=st.integers(1, 40), height=st.integers(1, 40))
@settings(max_examples=25)
def test_images_equal_the_reference_at_any_size(seed: int, kind: str, width: int, height: int) -> None:
    view = camera("far" if kind == "far" else ("outside", "inside")[seed % 2], width, height)
    assert_same_images(*both(scene(kind, seed, 60), view))


@pytest.mark.parametrize("kind", ["blobs", "discs", "needles", "mixed", "coincident", "nested", "faint", "one"])
@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("where", ["outside", "inside"])
def test_gradients_equal_the_reference(kind: str, antialiased: bool, where: str) -> None:
    g, view = scene(kind), camera(where)
    rng = np.random.default_rng(0)
    by_image, by_alpha, by_depth = (torch.from_numpy(rng.normal(size=(1, 37, 50, *s))) for s in ((3,), (), ()))
    gradients = []
    for backend, dtype in (("cpu", torch.float32), ("reference", torch.float64)):
        tensors = GaussianTensors.from_gaussians(g, dtype, requires_grad=True)
        drawn = rasterize(tensors, view, backend=backend, antialiased=antialiased, background=(0.3, 0.6, 0.9))
        loss = (drawn.images * by_image).sum() + (drawn.alphas * by_alpha).sum() + 0.1 * (drawn.depths * by_depth).sum()
        torch.autograd.backward(loss)
        gradients.append([getattr(tensors, name).grad.double() for name in NAMES] + [drawn.means2d.grad.double()])
    for name, fast, slow in zip((*NAMES, "means2d"), *gradients, strict=True):
        if name == "quats" and kind in ("nested", "coincident"):
            assert fast.abs().max() < 1e-3  # balls have no orientation
            continue
        assert (fast - slow).norm() <= 1e-3 * slow.norm() + 1e-6, name
        assert torch.isfinite(fast).all()


def test_gradients_equal_finite_differences() -> None:
    rng = np.random.default_rng(1)
    n = 5
    g = Gaussians(
        rng.uniform(-0.5, 0.5, (n, 3)),
        rng.normal(size=(n, 4)),
        rng.uniform(0.2, 0.5, (n, 3)),
        rng.uniform(0.3, 0.8, n),
        rng.normal(size=(n, 1, 3)),
        0.3 * rng.normal(size=(n, 15, 3)),
    )
    view = Cameras.look_at([[0.2, -3.0, 0.3]], [0, 0, 0], width=24, height=20, fov=22)
    weights = torch.from_numpy(rng.normal(size=(1, 20, 24, 3)))
    fast = GaussianTensors.from_gaussians(g, requires_grad=True)
    torch.autograd.backward((rasterize(fast, view, backend="cpu").images * weights).sum())
    exact = GaussianTensors.from_gaussians(g, torch.float64)

    def loss(name: str, value: torch.Tensor) -> float:
        fields = {other: getattr(exact, other) for other in NAMES} | {name: value}
        return float((rasterize(GaussianTensors(**fields), view, backend="reference").images * weights).sum())

    for name in NAMES:
        base, gradient = getattr(exact, name), getattr(fast, name).grad
        for index in rng.permutation(base.numel())[:6]:
            step = torch.zeros(base.numel(), dtype=torch.float64)
            step[index] = 1e-6
            step = step.reshape(base.shape)
            difference = (loss(name, base + step) - loss(name, base - step)) / 2e-6
            np.testing.assert_allclose(gradient.reshape(-1)[index], difference, rtol=2e-3, atol=2e-3)


@pytest.mark.parametrize("kind", ["blobs", "coincident", "mixed", "nested"])
def test_permutation_and_threads_change_nothing(kind: str) -> None:
    g = scene(kind)
    order = np.random.default_rng(1).permutation(len(g))
    plain = rasterize(g, camera())
    torch.testing.assert_close(rasterize(g[order], camera()).images, plain.images, atol=0, rtol=0)
    threads = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        torch.testing.assert_close(rasterize(g, camera()).images, plain.images, atol=0, rtol=0)
    finally:
        numba.set_num_threads(threads)


def test_a_wall_of_equal_depths_does_not_depend_on_order() -> None:
    rng = np.random.default_rng(0)
    n = 500
    means = np.stack([rng.uniform(-1, 1, n), rng.uniform(-1, 1, n), np.full(n, 2.0)], axis=1)
    g = Gaussians(means, [[1, 0, 0, 0]] * n, np.full((n, 3), 0.2), np.full(n, 0.5), rng.normal(size=(n, 1, 3)))
    view = Cameras(np.eye(4)[None], [[[40, 0, 20], [0, 40, 20], [0, 0, 1]]], 40, 40)
    plain = rasterize(g, view).images
    torch.testing.assert_close(rasterize(g[::-1], view).images, plain, atol=0, rtol=0)


def test_colors_given_instead_of_sh() -> None:
    g, views = scene("blobs"), Cameras.orbit([0, 0, 0], 3.0, 2, width=30, height=20)
    rng = np.random.default_rng(2)
    shared, own = rng.uniform(0, 1, (len(g), 3)), rng.uniform(0, 1, (2, len(g), 3))
    assert_same_images(*both(g, views, colors=shared))
    fast, slow = both(g, views, colors=own)
    assert_same_images(fast, slow)
    for c in range(2):
        alone = rasterize(g, views[c], colors=own[c]).images[0]
        torch.testing.assert_close(fast.images[c], alone, atol=0, rtol=0)
    colors = torch.tensor(shared, dtype=torch.float32, requires_grad=True)
    torch.autograd.backward(rasterize(g, views, colors=colors).images.sum())
    assert colors.grad is not None
    weights = rasterize(g, views, colors=np.ones((len(g), 3))).images[..., 0].astype(np.float64)
    np.testing.assert_allclose(colors.grad.sum(), 3 * weights.sum(), rtol=1e-4)


def test_lower_sh_degree_forgets_the_rest() -> None:
    g = scene("blobs")
    flat = Gaussians(g.means, g.quats, g.scales, g.opacities, g.sh0)
    torch.testing.assert_close(rasterize(g, camera(), sh_degree=0).images, rasterize(flat, camera()).images)
    assert np.abs(rasterize(g, camera()).images - rasterize(flat, camera()).images).max() > 0.01


def test_nothing_to_draw() -> None:
    empty = rasterize(Gaussians.empty(), camera(), background=(1.0, 0.5, 0.0))
    assert (empty.images == [1.0, 0.5, 0.0]).all()
    assert (empty.alphas == 0).all()
    assert (empty.depths == 0).all()
    none = rasterize(scene("blobs"), camera()[[]])
    assert none.images.shape == (0, 37, 50, 3)
    assert none.depths.shape == (0, 37, 50)
    tensors = GaussianTensors.from_gaussians(Gaussians.empty(), requires_grad=True)
    torch.autograd.backward(rasterize(tensors, camera()).images.sum())


def test_behind_and_at_the_near_plane() -> None:
    z = np.array([-1.0, 0.0, 0.01, 0.011, 1.0])
    for k, depth in enumerate(z):
        g = Gaussians([[0, 0, depth]], [[1, 0, 0, 0]], [[0.3] * 3], [0.9], np.ones((1, 1, 3)))
        view = Cameras(np.eye(4)[None], [[[20, 0, 10], [0, 20, 10], [0, 0, 1]]], 20, 20)
        drawn = rasterize(g, view).alphas.max()
        assert (drawn > 0.5) == (k >= 3)


def test_a_broken_gaussian_in_training_spoils_nothing_else() -> None:
    g = scene("blobs")
    for name, bad in (("means", float("nan")), ("scales", float("inf")), ("quats", float("nan"))):
        tensors = GaussianTensors.from_gaussians(g)
        getattr(tensors, name)[7] = bad
        tensors.means.requires_grad_()
        without = rasterize(g[np.arange(len(g)) != 7], camera())
        drawn = rasterize(tensors, camera())
        np.testing.assert_array_equal(drawn.images.detach(), without.images)
        torch.autograd.backward(drawn.images.sum())
        assert torch.isfinite(tensors.means.grad).all()


def test_images_of_several_cameras_are_those_of_each() -> None:
    g, views = scene("mixed"), Cameras.orbit([0, 0, 0], 3.0, 3, width=33, height=17)
    together = rasterize(g, views)
    for c in range(3):
        torch.testing.assert_close(together.images[c], rasterize(g, views[c]).images[0], atol=0, rtol=0)
    assert together.images.shape == (3, 17, 33, 3)


def test_refusals_name_the_argument() -> None:
    g = scene("one")
    with pytest.raises(ValueError, match=r"^backend: expected one of"):
        rasterize(g, camera(), backend="vulkan")
    with pytest.raises(ValueError, match=r"^background: expected shape \(3,\)"):
        rasterize(g, camera(), background=(0.0, 0.0))
    with pytest.raises(ValueError, match=r"^background: expected finite"):
        rasterize(g, camera(), background=(0.0, 0.0, np.nan))
    with pytest.raises(ValueError, match=r"^sh_degree: expected 0 to 3"):
        rasterize(g, camera(), sh_degree=4)
    with pytest.raises(ValueError, match=r"^colors: expected shape \(1, 3\) or \(1, 1, 3\)"):
        rasterize(g, camera(), colors=np.zeros((2, 3)))
    with pytest.raises(ValueError, match=r"^colors: expected finite"):
        rasterize(g, camera(), colors=np.full((1, 3), np.inf))
    with pytest.raises(ValueError, match=r"^gaussians: expected Gaussians or GaussianTensors, got dict"):
        rasterize({}, camera())
    with pytest.raises(ValueError, match=r"^gaussians: expected Gaussians or GaussianTensors, got SimpleNamespace"):
        rasterize(SimpleNamespace(means=torch.zeros(1, 3)), camera())  # type: ignore[call-overload]
    with pytest.raises(ValueError, match=r"^cameras: expected Ks without skew"):
        rasterize(g, Cameras(np.eye(4)[None], [[[20, 1, 10], [0, 20, 10], [0, 0, 1]]], 20, 20))
    broken = GaussianTensors.from_gaussians(scene("blobs"))
    broken.means[3, 1] = float("nan")
    with pytest.raises(ValueError, match=r"^means: expected finite values, got nan at index \(3, 1\)"):
        rasterize(broken, camera())
    if not torch.cuda.is_available():
        with pytest.raises(BackendError, match=r"device 'cuda': expected a "):
            rasterize(g, camera(), backend="cuda")


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA GPU here")
@pytest.mark.parametrize("kind", ["blobs", "mixed"])
def test_cuda_equals_cpu(kind: str) -> None:
    pytest.importorskip("gsplat", reason="gsplat is not installed")
    g = scene(kind)
    tensors = GaussianTensors.from_gaussians(g, device="cuda", requires_grad=True)
    there, here = rasterize(tensors, camera()), rasterize(g, camera())
    np.testing.assert_allclose(there.images.detach().cpu(), here.images, atol=5e-3, rtol=0)
    np.testing.assert_allclose(rasterize(g, camera(), backend="cuda").images, here.images, atol=5e-3, rtol=0)
    torch.autograd.backward(there.images.sum())
    assert there.means2d.grad is not None
    assert there.means2d.grad.abs().sum() > 0


@pytest.mark.parametrize("backend", ["cpu", "reference"])
@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("degree", [0, 2])
def test_frozen_gaussians_gather_no_gradient_but_that_of_their_centers(
    backend: str, antialiased: bool, degree: int
) -> None:
    scene = random_scene(np.random.default_rng(3), 40, sh_degree=degree)
    camera = Cameras.look_at([[0, 0, -6]], [0, 0, 0], up=(0, 1, 0), width=40, height=32)
    found = []
    for frozen in (0, 25, 40):
        tensors = GaussianTensors.from_gaussians(scene, requires_grad=True)
        drawn = rasterize(tensors, camera, backend=backend, antialiased=antialiased, frozen=frozen)
        weights = torch.linspace(0.5, 1.5, drawn.images.numel()).reshape(drawn.images.shape)
        (drawn.images * weights).sum().backward()
        found.append((tensors, drawn.means2d.grad))
    (whole, centers), *others = found
    assert centers is not None
    assert centers.abs().sum() > 0
    for frozen, (tensors, by_centers) in zip((25, 40), others, strict=True):
        assert torch.allclose(by_centers, centers, rtol=1e-5, atol=1e-5 * float(centers.abs().max()))
        for name, tensor in vars(tensors).items():
            if tensor.numel():
                assert not tensor.grad[:frozen].any(), name
                assert torch.allclose(tensor.grad[frozen:], vars(whole)[name].grad[frozen:], rtol=1e-5, atol=1e-6), name


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("frozen", [0, 150, 300])
def test_gradients_do_not_depend_on_whether_those_of_centers_are_wanted(antialiased: bool, frozen: int) -> None:
    g = random_scene(np.random.default_rng(7), 300, sh_degree=1)
    one = Cameras.look_at([[0, 0, -5]], [0, 0, 0], up=(0, 1, 0), width=70, height=40)
    view = View.from_matrices(one.viewmats[0], one.Ks[0], one.width, one.height)
    found = []
    for probe in (None, torch.zeros((len(g), 2), requires_grad=True)):
        tensors = GaussianTensors.from_gaussians(g, requires_grad=True)
        drawn = rasterize_cpu(
            tensors,
            view,
            background=np.full(3, 0.3, np.float32),
            sh_degree=1,
            antialiased=antialiased,
            probe=probe,
            frozen=Frozen(frozen),
        )
        sum((part * torch.linspace(0.5, 1.5, part.numel()).reshape(part.shape)).sum() for part in drawn[:3]).backward()
        found.append([value.grad for value in vars(tensors).values()])
    for without, wanted in zip(*found, strict=True):
        assert torch.equal(without, wanted)
        assert not without[:frozen].any()
    assert frozen == 300 or found[0][0].any()


def test_frozen_gaussians_that_are_not_shown_are_not_there() -> None:
    g = random_scene(np.random.default_rng(8), 200, sh_degree=1)
    shown = np.arange(120) % 3 > 0
    one = camera()
    view = View.from_matrices(one.viewmats[0], one.Ks[0], one.width, one.height)
    options = {"background": np.zeros(3, np.float32), "sh_degree": 1}
    hidden, *_ = rasterize_cpu(GaussianTensors.from_gaussians(g), view, frozen=Frozen(120, shown), **options)
    left = g[np.append(shown, np.ones(80, bool))]
    without, *_ = rasterize_cpu(GaussianTensors.from_gaussians(left), view, **options)
    everything, *_ = rasterize_cpu(GaussianTensors.from_gaussians(g), view, **options)
    assert torch.equal(hidden, without)
    assert not torch.equal(hidden, everything)
