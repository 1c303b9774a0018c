"""Raw values and their moments: Adam against torch's own, rows that move together, frozen rows that stand."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gsvis.scene.gaussians import Gaussians
from gsvis.train.parameters import NAMES, Parameters, adam_reference

RATES = dict(zip(NAMES, (1e-3, 5e-3, 1e-3, 5e-2, 2e-3, 1e-4), strict=True))


def some_gaussians(count: int = 7, degree: int = 1, seed: int = 0) -> Gaussians:
    rng = np.random.default_rng(seed)
    return Gaussians(
        rng.normal(size=(count, 3)),
        rng.normal(size=(count, 4)),
        rng.uniform(0.1, 1.0, (count, 3)),
        rng.uniform(0.05, 0.95, count),
        rng.normal(size=(count, 1, 3)),
        rng.normal(size=(count, (degree + 1) ** 2 - 1, 3)),
    )


def test_there_and_back() -> None:
    g = some_gaussians()
    back = Parameters.from_gaussians(g).gaussians()
    for name in ("means", "quats", "sh0", "shN"):
        np.testing.assert_array_equal(getattr(back, name), getattr(g, name))
    np.testing.assert_allclose(back.scales, g.scales, rtol=1e-6)
    np.testing.assert_allclose(back.opacities, g.opacities, rtol=1e-5)


@pytest.mark.parametrize("opacity", [0.0, 1.0])
def test_opacities_of_nothing_and_all_stay_finite(opacity: float) -> None:
    g = Gaussians([[0, 0, 0]], [[1, 0, 0, 0]], [[1, 1, 1]], [opacity], [[[0, 0, 0]]])
    p = Parameters.from_gaussians(g)
    assert torch.isfinite(p.values["logit_opacities"]).all()
    assert p.gaussians().opacities[0] == pytest.approx(opacity, abs=1e-6)


def test_steps_are_those_of_adam() -> None:
    p, q = (Parameters.from_gaussians(some_gaussians(5)) for _ in range(2))
    optimizer = torch.optim.Adam([{"params": [q.values[n]], "lr": RATES[n]} for n in NAMES], eps=1e-15)
    generator = torch.Generator().manual_seed(3)
    for _ in range(4):
        for name in NAMES:
            gradient = torch.randn(p.values[name].shape, generator=generator)
            p.values[name].grad, q.values[name].grad = gradient, gradient.clone()
        p.adam_step(RATES)
        optimizer.step()
    for name in NAMES:
        assert torch.allclose(p.values[name], q.values[name], rtol=1e-5, atol=1e-6), name


def test_the_kernel_steps_as_its_twin() -> None:
    generator = torch.Generator().manual_seed(4)
    value, gradient, first = (torch.randn(40_000, generator=generator) for _ in range(3))
    second = torch.rand(40_000, generator=generator)
    fast = Parameters({"x": value.clone().requires_grad_()}, {"x": first.clone()}, {"x": second.clone()}, steps=9)
    fast.values["x"].grad = gradient
    fast.adam_step({"x": 0.01})
    adam_reference(value, gradient, first, second, 0.01 / (1 - 0.9**10), (1 - 0.999**10) ** 0.5, torch.empty(50_000))
    assert torch.allclose(fast.values["x"], value, rtol=1e-5, atol=1e-6)
    assert torch.allclose(fast.first["x"], first, atol=1e-6)
    assert torch.allclose(fast.second["x"], second, atol=1e-6)


def test_frozen_rows_do_not_move() -> None:
    p = Parameters.from_gaussians(some_gaussians(6), frozen=4)
    before = {name: value.detach().clone() for name, value in p.values.items()}
    for value in p.values.values():
        value.grad = torch.ones_like(value)
    p.adam_step(RATES)
    for name, value in p.values.items():
        assert torch.equal(value[:4], before[name][:4])
        assert not torch.isclose(value[4:], before[name][4:], atol=1e-7).any()
        assert not p.first[name][:4].any()


def test_rows_and_moments_move_together() -> None:
    p = Parameters.from_gaussians(some_gaussians(4))
    for name, value in p.values.items():
        p.first[name] = value.detach().clone()  # so that each row's moment names its row
    p.keep(torch.tensor([True, False, True, True]))
    for name, value in p.values.items():
        assert torch.equal(p.first[name], value)
        assert value.requires_grad
        assert value.is_leaf
    p.append({name: value.detach()[:2] for name, value in p.values.items()})
    assert len(p) == 5
    for name, value in p.values.items():
        assert torch.equal(value[3:], value[:2])
        assert not p.first[name][3:].any()


def test_a_higher_degree_begins_with_zeros() -> None:
    p = Parameters.from_gaussians(some_gaussians(3, degree=1))
    before = p.values["shN"].detach().clone()
    p.raise_sh_degree(3)
    assert p.values["shN"].shape == (3, 15, 3)
    assert torch.equal(p.values["shN"][:, :3], before)
    assert not p.values["shN"][:, 3:].any()
    assert p.activate().sh_degree == 3
    p.raise_sh_degree(2)
    assert p.values["shN"].shape == (3, 15, 3)


def test_what_is_frozen_is_activated_once_and_gets_no_gradient() -> None:
    g = some_gaussians(9)
    free = Parameters.from_gaussians(g)
    held = Parameters.from_gaussians(g, frozen=4)
    for turn in range(2):
        for p in (free, held):
            now = p.activate()
            weights = torch.linspace(1.0, 2.0, len(p))
            ((now.scales.sum(dim=1) + 3.0 * now.opacities) * weights).sum().backward()
        for name in ("log_scales", "logit_opacities"):
            gradients = [p.values[name].grad for p in (free, held)]
            assert torch.equal(gradients[0][4:], gradients[1][4:])
            assert not gradients[1][:4].any()
            assert gradients[1][4:].all()
        for p in (free, held):
            p.forget_gradients()
            if turn == 0:  # other rows, as many as before
                p.keep(torch.tensor([0, 1, 2, 3, 6, 7, 8]))
                p.append({name: value.detach()[:2] for name, value in p.values.items()})
        for name, value in vars(free.activate()).items():
            assert torch.equal(value, getattr(held.activate(), name))
