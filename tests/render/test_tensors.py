"""Gaussians as tensors: what they copy and what they refuse."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from gsvis.render.tensors import GaussianTensors
from gsvis.scene.gaussians import Gaussians

FIELDS = ("means", "quats", "scales", "opacities", "sh0", "shN")


def scene(n: int = 3) -> Gaussians:
    rng = np.random.default_rng(0)
    return Gaussians(
        rng.normal(size=(n, 3)),
        rng.normal(size=(n, 4)),
        rng.uniform(0.1, 1, (n, 3)),
        rng.uniform(0, 1, n),
        rng.normal(size=(n, 1, 3)),
        rng.normal(size=(n, 8, 3)),
    )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_scene_is_copied_as_leaves(dtype: torch.dtype) -> None:
    g = scene()
    tensors = GaussianTensors.from_gaussians(g, dtype, requires_grad=True)
    assert len(tensors) == 3
    assert tensors.sh_degree == 2
    for name in FIELDS:
        value = getattr(tensors, name)
        assert value.dtype == dtype
        assert value.is_leaf
        assert value.requires_grad
        assert np.array_equal(value.detach().numpy(), getattr(g, name))
    with torch.no_grad():
        tensors.means.add_(1.0)
    assert np.array_equal(g.means, scene().means)
    tensors.check_values()
    assert repr(tensors) == f"GaussianTensors(3 of SH degree 2, {dtype} on cpu)"


def test_an_empty_scene_is_well_formed() -> None:
    tensors = GaussianTensors.from_gaussians(Gaussians.empty(3))
    tensors.check_values()
    assert len(tensors) == 0
    assert tensors.sh_degree == 3


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("quats", torch.zeros(3, 3), r"quats: expected shape \(3, 4\), got \(3, 3\)"),
        ("means", torch.tensor(0.0), r"means: expected shape \(N, 3\)"),
        ("scales", torch.zeros(2, 3), r"scales: expected shape \(3, 3\)"),
        ("opacities", torch.zeros(3, 1), r"opacities: expected shape \(3\)"),
        ("sh0", torch.zeros(3, 3), r"sh0: expected shape \(3, 1, 3\)"),
        ("shN", torch.zeros(3, 4, 4), r"shN: expected shape \(3, K-1, 3\)"),
        ("shN", torch.zeros(3, 4, 3), "expected 1, 4, 9 or 16 coefficients"),
        ("scales", torch.zeros(3, 3).double(), "scales: expected one float dtype"),
        ("means", torch.zeros(3, 3).int(), "means: expected one float dtype"),
        ("scales", np.zeros((3, 3)), "scales: expected a torch tensor, got ndarray"),
        ("scales", torch.zeros(3, 3, device="meta"), "scales: expected all on cpu, got meta"),
    ],
)
def test_what_does_not_fit_is_refused(name: str, value: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(GaussianTensors.from_gaussians(scene()), **{name: value})


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("means", float("nan"), r"means: expected finite values, got nan at index \(1, 0\)"),
        ("sh0", float("inf"), "sh0: expected finite values"),
        ("quats", 0.0, "quats: expected non-zero quaternions, got a zero one at index 1"),
        ("scales", 0.0, "scales: expected values > 0"),
        ("opacities", -0.5, r"opacities: expected values in \[0, 1\], got -0.5"),
        ("opacities", 1.5, r"opacities: expected values in \[0, 1\], got 1.5"),
    ],
)
def test_values_out_of_range_are_named(name: str, value: float, message: str) -> None:
    tensors = GaussianTensors.from_gaussians(scene())
    getattr(tensors, name)[1] = value
    with pytest.raises(ValueError, match=message):
        tensors.check_values()
