"""The torch face of evaluation: equal to the kernels, gradients equal to differences, torch only when asked for."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import torch

from gsvis.color import reference
from gsvis.color.evaluate import evaluate
from gsvis.color.evaluate_torch import SrbfTensors, evaluate_torch
from gsvis.color.variants import VARIANTS
from tests.color.samples import random_colors

EYE = np.array([0.3, -0.2, 0.1])
LEAVES = ("base", "centers", "decays", "intensities")


@pytest.mark.parametrize("name", VARIANTS)
@pytest.mark.parametrize("count", [0, 1, 300])
def test_values_equal_the_twin(name: str, count: int) -> None:
    rng = np.random.default_rng(count)
    colors, means = random_colors(rng, count, name), rng.normal(size=(count, 3))
    active = rng.random(colors.num_terms) < 0.6
    exact = SrbfTensors.from_colors(colors, torch.float64)
    single = SrbfTensors.from_colors(colors)
    for mask in (None, active):
        want = reference.evaluate(colors, means, EYE, active=mask)
        got = evaluate_torch(exact, torch.from_numpy(means), EYE, active=mask)
        assert got.dtype == torch.float64
        np.testing.assert_allclose(got.numpy(), want, atol=1e-6)  # amplitudes of arrays are float32
        tensors = torch.from_numpy(means).float()
        mask_tensor = None if mask is None else torch.from_numpy(mask)
        got = evaluate(single, tensors, torch.from_numpy(EYE), active=mask_tensor)
        assert got.dtype == torch.float32
        np.testing.assert_allclose(got.numpy(), want, atol=1e-5)


@pytest.mark.parametrize("name", VARIANTS)
def test_gradients_equal_differences(name: str) -> None:
    rng = np.random.default_rng(4)
    colors = random_colors(rng, 3, name, 3)
    means = torch.from_numpy(rng.normal(size=(3, 3))).requires_grad_()
    eye = torch.from_numpy(EYE).requires_grad_()
    tensors = SrbfTensors.from_colors(colors, torch.float64, requires_grad=True)
    assert tensors.requires_grad
    assert not tensors.scales.requires_grad
    leaves = [n for n in LEAVES if getattr(tensors, n).numel()]

    def color(means: torch.Tensor, eye: torch.Tensor, *values: torch.Tensor) -> torch.Tensor:
        fields = vars(tensors) | dict(zip(leaves, values, strict=True))
        return evaluate_torch(SrbfTensors(**fields), means, eye)

    assert torch.autograd.gradcheck(color, (means, eye, *(getattr(tensors, n) for n in leaves)))


@pytest.mark.parametrize("name", VARIANTS)
def test_gradients_are_finite_at_the_edges(name: str) -> None:
    """Eyes at a mean, colors out of range, gray, black: values and gradients stay finite."""
    rng = np.random.default_rng(5)
    colors = random_colors(rng, 40, name, 4)
    tensors = SrbfTensors.from_colors(colors, requires_grad=True)
    with torch.no_grad():
        tensors.base[:10, 1:], tensors.base[10:20, 2] = 0.0, 1.0
        tensors.decays[::3] = 1e4
        tensors.intensities[::2] *= 50.0
    means = torch.zeros((40, 3), requires_grad=True)
    image = evaluate_torch(tensors, means, np.zeros(3)) + evaluate_torch(tensors, means, EYE)
    assert torch.isfinite(image).all()
    torch.autograd.backward(image.sum())
    for leaf in (means, *(getattr(tensors, n) for n in LEAVES if getattr(tensors, n).numel())):
        assert torch.isfinite(leaf.grad).all()


def test_there_and_back() -> None:
    colors = random_colors(np.random.default_rng(6), 20, "hsl")
    back = SrbfTensors.from_colors(colors, torch.float64).to_colors()
    for name, value in vars(colors).items():
        np.testing.assert_array_equal(getattr(back, name), value)
    assert "hsl" in repr(SrbfTensors.from_colors(colors))


def test_a_step_of_descent_lowers_the_error() -> None:
    rng = np.random.default_rng(7)
    means = torch.from_numpy(rng.normal(size=(50, 3)))
    target = evaluate_torch(SrbfTensors.from_colors(random_colors(rng, 50), torch.float64), means, EYE)
    tensors = SrbfTensors.from_colors(random_colors(rng, 50), torch.float64, requires_grad=True)
    leaves = [getattr(tensors, n) for n in LEAVES if getattr(tensors, n).numel()]
    optimizer = torch.optim.SGD(leaves, lr=0.1)
    errors = []
    for _ in range(5):
        optimizer.zero_grad()
        error = (evaluate_torch(tensors, means, EYE) - target).square().sum()
        torch.autograd.backward(error)
        optimizer.step()
        errors.append(float(error.detach()))
    assert errors == sorted(errors, reverse=True)


def test_bad_arguments() -> None:
    tensors = SrbfTensors.from_colors(random_colors(np.random.default_rng(8), 4))
    fields = vars(tensors)
    with pytest.raises(ValueError, match=r"means: expected shape \(4, 3\), got \(5, 3\)"):
        evaluate(tensors, torch.zeros(5, 3), EYE)
    with pytest.raises(ValueError, match="active: expected bool of shape"):
        evaluate(tensors, torch.zeros(4, 3), EYE, active=np.ones(tensors.num_terms))
    with pytest.raises(ValueError, match=r"eye: expected shape \(3,\)"):
        evaluate(tensors, torch.zeros(4, 3), torch.zeros(2))
    with pytest.raises(ValueError, match=r"decays: expected one float dtype for all, got torch\.float64"):
        SrbfTensors(**fields | {"decays": tensors.decays.double()})
    with pytest.raises(ValueError, match=r"offsets: expected int64, got torch\.int32"):
        SrbfTensors(**fields | {"offsets": tensors.offsets.int()})
    with pytest.raises(ValueError, match=r"scales: expected shape \(4,\), got \(3,\)"):
        SrbfTensors(**fields | {"scales": tensors.scales[:3]})


def test_arrays_need_no_torch() -> None:
    """The array face, in a fresh process."""
    code = (
        "import sys, numpy as np\n"
        "from gsvis.color.evaluate import evaluate\n"
        "from gsvis.color.srbf import SrbfColors\n"
        "evaluate(SrbfColors.without_terms(np.ones((2, 3))), np.zeros((2, 3)), [0, 0, 1])\n"
        "assert 'torch' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
