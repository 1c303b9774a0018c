"""SH colors: arrays, tensors and the basis say one thing, seen from the right side."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from gsvis.color import sh_colors, sh_colors_along, towards_gaussian
from gsvis.color.sh_torch import sh_basis_torch, sh_colors_torch
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.sh import SH_C0, sh_basis

DEGREES = (0, 1, 2, 3)


@dataclass(frozen=True)
class Tensors:
    means: torch.Tensor
    sh0: torch.Tensor
    shN: torch.Tensor  # noqa: N815


def cloud(seed: int, count: int = 40, degree: int = 3, spread: float = 1.0) -> Gaussians:
    rng = np.random.default_rng(seed)
    higher = rng.normal(size=(count, (degree + 1) ** 2 - 1, 3)) * spread
    quats, scales = np.tile([1.0, 0, 0, 0], (count, 1)), np.ones((count, 3))
    return Gaussians(rng.normal(size=(count, 3)), quats, scales, np.ones(count), rng.normal(size=(count, 1, 3)), higher)


def tensors(g: Gaussians, dtype: torch.dtype = torch.float64, requires_grad: bool = False) -> Tensors:
    return Tensors(*(torch.tensor(a, dtype=dtype, requires_grad=requires_grad) for a in (g.means, g.sh0, g.shN)))


def plain(g: Gaussians, directions: np.ndarray) -> np.ndarray:
    """(N, D, 3), unclipped."""
    basis = sh_basis(directions, g.sh_degree)
    return 0.5 + np.einsum("dk,nkc->ndc", basis, np.concatenate([g.sh0, g.shN], axis=1).astype(np.float64))


def unit(seed: int, count: int) -> np.ndarray:
    d = np.random.default_rng(seed).normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def test_a_constant_harmonic_is_the_color_from_everywhere() -> None:
    g = cloud(0, degree=0)
    expected = 0.5 + SH_C0 * g.sh0[:, 0]
    assert expected.min() < 0.1
    np.testing.assert_allclose(sh_colors(g, [1.0, 2.0, 3.0]), np.maximum(expected, 0), atol=1e-6)
    along = sh_colors_along(g.sh0, g.shN, unit(0, 7))
    np.testing.assert_allclose(along, np.maximum(expected, 0)[:, None].repeat(7, axis=1), atol=1e-6)


def test_directions_run_from_the_eye_to_the_gaussian() -> None:
    higher = np.zeros((1, 3, 3))
    higher[0, 1, 0] = 1.0  # the harmonic that grows with z, in red
    g = Gaussians([[0, 0, 5]], [[1, 0, 0, 0]], [[1, 1, 1]], [1], [[[0, 0, 0]]], higher)
    c1 = np.sqrt(3 / (4 * np.pi))
    np.testing.assert_allclose(sh_colors(g, [0, 0, 0]), [[0.5 + c1, 0.5, 0.5]], atol=1e-6)
    np.testing.assert_allclose(sh_colors(g, [0, 0, 9], clipped=False), [[0.5 - c1, 0.5, 0.5]], atol=1e-6)
    seen_from_below = towards_gaussian([[0.0, 0.0, -1.0]])  # Gaussian to eye
    np.testing.assert_allclose(sh_colors_along(g.sh0, g.shN, seen_from_below)[:, 0], sh_colors(g, [0, 0, 0]), atol=1e-6)


@pytest.mark.parametrize("clipped", [True, False])
@pytest.mark.parametrize("degree", DEGREES)
def test_one_eye_and_many_directions_are_the_basis_times_the_coefficients(degree: int, clipped: bool) -> None:
    g, eye = cloud(degree, 1500, degree), np.array([0.3, -0.2, 0.1])
    toward = g.means - eye
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    expected = plain(g, toward)[np.arange(len(g)), np.arange(len(g))]
    assert expected.min() < 0
    assert expected.max() > 1
    found = sh_colors(g, eye, clipped=clipped)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, np.maximum(expected, 0) if clipped else expected, atol=5e-6)

    directions = unit(degree, 13)
    along = sh_colors_along(g.sh0, g.shN, 3.0 * directions, clipped=clipped)
    assert along.dtype == np.float32
    expected = plain(g, directions)
    np.testing.assert_allclose(along, np.maximum(expected, 0) if clipped else expected, atol=1e-5)
    some = slice(100, 130)
    np.testing.assert_allclose(
        sh_colors_along(g.sh0[some], g.shN[some], directions, clipped=clipped), along[some], atol=1e-6
    )


@given(st.integers(0, 1000), st.sampled_from(DEGREES), st.floats(-8, 8))
def test_scale_and_place_of_the_scene_do_not_matter(seed: int, degree: int, exponent: float) -> None:
    g, scale = cloud(seed, 8, degree), 10.0**exponent
    eye = np.random.default_rng(seed + 1).normal(size=3)
    larger = Gaussians(g.means * np.float64(scale), g.quats, g.scales, g.opacities, g.sh0, g.shN)
    np.testing.assert_allclose(sh_colors(larger, eye * scale), sh_colors(g, eye), atol=2e-4)


@pytest.mark.parametrize("degree", DEGREES)
def test_a_lower_degree_forgets_the_rest(degree: int) -> None:
    g = cloud(4)
    short = Gaussians(g.means, g.quats, g.scales, g.opacities, g.sh0, g.shN[:, : (degree + 1) ** 2 - 1])
    np.testing.assert_array_equal(sh_colors(g, [1, 1, 1], sh_degree=degree), sh_colors(short, [1, 1, 1]))
    assert torch.equal(sh_colors(tensors(g), [1, 1, 1], sh_degree=degree), sh_colors(tensors(short), [1, 1, 1]))


@pytest.mark.parametrize("degree", DEGREES)
def test_tensors_say_the_same(degree: int) -> None:
    d = unit(degree, 50)
    np.testing.assert_allclose(sh_basis_torch(torch.tensor(d), degree).numpy(), sh_basis(d, degree), atol=1e-14)
    g, eye = cloud(degree + 10, degree=degree), np.array([0.3, -0.2, 0.1])
    for clipped in (True, False):
        for dtype, tolerance in ((torch.float64, 5e-6), (torch.float32, 1e-5)):
            found = sh_colors(tensors(g, dtype), eye, clipped=clipped)
            assert found.dtype == dtype
            np.testing.assert_allclose(found.numpy(), sh_colors(g, eye, clipped=clipped), atol=tolerance)
    as_tensor = sh_colors(tensors(g), torch.tensor(eye, dtype=torch.float32))
    np.testing.assert_allclose(as_tensor.numpy(), sh_colors(g, eye), atol=1e-5)


@pytest.mark.parametrize("degree", DEGREES)
def test_gradients_are_finite_differences(degree: int) -> None:
    g = tensors(cloud(degree + 20, 8, degree), requires_grad=True)
    eye = torch.tensor([0.3, -0.2, 4.0], dtype=torch.float64, requires_grad=True)
    assert sh_colors(g, eye).detach().min() == 0.0  # some are clipped
    if degree == 0:  # nothing else has a say in it
        assert torch.autograd.gradcheck(lambda sh0: sh_colors_torch(g.means, sh0, g.shN, eye), (g.sh0,))
        return
    assert torch.autograd.gradcheck(sh_colors_torch, (g.means, g.sh0, g.shN, eye))


def test_a_gaussian_at_the_eye_is_seen_along_z() -> None:
    g = cloud(30, 3)
    eye = g.means[1].astype(np.float64)
    expected = np.maximum(plain(g, np.array([[0.0, 0.0, 1.0]]))[1, 0], 0)
    np.testing.assert_allclose(sh_colors(g, eye)[1], expected, atol=5e-6)
    leaf = tensors(g, requires_grad=True)
    colors = sh_colors(leaf, eye)
    np.testing.assert_allclose(colors[1].detach().numpy(), expected, atol=5e-6)
    colors.sum().backward()
    for part in (leaf.means, leaf.sh0, leaf.shN):
        assert part.grad is not None
        assert torch.isfinite(part.grad).all()


@pytest.mark.parametrize("degree", [0, 3])
def test_nothing_to_color(degree: int) -> None:
    g = Gaussians.empty(degree)
    assert sh_colors(g, [0, 0, 0]).shape == (0, 3)
    assert sh_colors(tensors(g), [0, 0, 0]).shape == (0, 3)
    assert sh_colors_along(g.sh0, g.shN, unit(0, 5)).shape == (0, 5, 3)
    full = cloud(0, 4, degree)
    assert sh_colors_along(full.sh0, full.shN, np.zeros((0, 3))).shape == (4, 0, 3)


def test_the_sign_changes_and_nothing_else() -> None:
    d = unit(1, 5)
    np.testing.assert_array_equal(towards_gaussian(d), -d)
    assert towards_gaussian(d.astype(np.float32)).dtype == np.float32
    tensor = torch.tensor(d, dtype=torch.float32, requires_grad=True)
    turned = towards_gaussian(tensor)
    assert turned.dtype == torch.float32
    assert turned.requires_grad
    assert torch.equal(turned, -tensor)


def test_refusals_name_the_argument() -> None:
    g = cloud(0, 4)
    cases: list[tuple[str, Any]] = [
        (r"eye: expected shape \(3,\)", lambda: sh_colors(g, [0, 0])),
        (r"eye: expected shape \(3,\)", lambda: sh_colors(tensors(g), torch.zeros(2))),
        ("eye: expected finite values", lambda: sh_colors(g, [0, np.nan, 0])),
        ("eye: expected finite values", lambda: sh_colors(tensors(g), [0, np.inf, 0])),
        ("sh_degree: expected 0 to 3, the scene's own, got 4", lambda: sh_colors(g, [0, 0, 0], sh_degree=4)),
        ("sh_degree: expected an integer", lambda: sh_colors(g, [0, 0, 0], sh_degree=-1)),
        ("1, 4, 9 or 16 coefficients", lambda: sh_colors_along(g.sh0, g.shN[:, :7], [[0, 0, 1]])),
        (r"sh0: expected shape \(N, 1, 3\)", lambda: sh_colors_along(g.sh0[:, 0], g.shN, [[0, 0, 1]])),
        ("sh0 / shN: expected one length", lambda: sh_colors_along(g.sh0, g.shN[1:], [[0, 0, 1]])),
        ("shN: expected finite values", lambda: sh_colors_along(g.sh0, g.shN * np.float32(np.nan), [[0, 0, 1]])),
        ("directions: expected non-zero", lambda: sh_colors_along(g.sh0, g.shN, [[0, 0, 0]])),
        (r"sh0: expected shape \(4, 1, 3\)", lambda: sh_colors(replace(tensors(g), sh0=torch.zeros(4, 3)), [0, 0, 0])),
        ("directions: expected finite", lambda: towards_gaussian([0, 0, np.nan])),
    ]
    for message, call in cases:
        with pytest.raises(ValueError, match=message):
            call()
