"""Colors while they are learned: values and gradients are those of torch."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from gsvis.color.evaluate_torch import SrbfTensors, evaluate_torch
from gsvis.color.learning import RowsOfView, see_rgb
from gsvis.color.srbf import MAX_DECAY, SrbfColors

COUNTS = np.array([0, 2, 1, 3, 0, 4])
EYE = np.array([0.25, -2.0, 0.5])


def colors_and_means() -> tuple[SrbfColors, np.ndarray]:
    rng = np.random.default_rng(4)
    terms = int(COUNTS.sum())
    colors = SrbfColors(
        "rgb",
        rng.uniform(-0.2, 0.8, (6, 3)),  # some are clipped
        np.ones(6),
        np.concatenate([[0], np.cumsum(COUNTS)]),
        np.zeros(terms, np.uint8),
        np.stack([rng.uniform(0.1, 3.0, terms), rng.uniform(-3.0, 3.0, terms)], axis=1),
        np.where(np.arange(terms) == 2, MAX_DECAY, rng.uniform(0.5, 9.0, terms)),
        rng.normal(size=(terms, 3)) * 0.3,
    )
    means = rng.normal(size=(6, 3)).astype(np.float32)
    means[1] = EYE  # an eye at a center looks along +z
    return colors, means


def test_values_and_gradients_are_those_of_torch() -> None:
    colors, means = colors_and_means()
    growth = np.linspace(-0.3, 0.4, colors.num_terms, dtype=np.float32)[:, None]
    values = {"base": colors.base, "centers": colors.centers, "growth": growth, "intensities": colors.intensities}
    chosen = np.array([1, 3, 4, 5])
    terms = np.flatnonzero(np.isin(colors.gaussian_ids, chosen))
    rows = RowsOfView(chosen, terms, np.concatenate([[0], np.cumsum(COUNTS[chosen])]))
    seen = see_rgb(colors, {name: np.array(each) for name, each in values.items()}, rows, means, EYE)
    by_colors = np.random.default_rng(1).normal(size=(4, 3)).astype(np.float32)
    found = seen.gradients(by_colors)

    leaves = {name: torch.tensor(each, requires_grad=True) for name, each in values.items()}
    grown = (torch.tensor(colors.decays) * leaves["growth"][:, 0].exp()).clamp(max=MAX_DECAY)
    own = replace(SrbfTensors.from_colors(colors), base=leaves["base"], centers=leaves["centers"])
    own = replace(own, decays=grown, intensities=leaves["intensities"])
    drawn = evaluate_torch(own, torch.from_numpy(means), EYE)
    by_all = torch.zeros_like(drawn)
    by_all[chosen] = torch.from_numpy(by_colors)
    expected = torch.autograd.grad(drawn, list(leaves.values()), by_all)
    np.testing.assert_allclose(seen.colors, drawn.detach().numpy()[chosen], atol=2e-6)
    assert (seen.colors == 0.0).any()
    for (name, each), index in zip(zip(leaves, expected, strict=True), (chosen, terms, terms, terms), strict=True):
        np.testing.assert_allclose(found[name], each.numpy()[index], atol=2e-5, err_msg=name)
