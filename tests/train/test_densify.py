"""Clone, split, prune and reset: each rule on Gaussians made to meet it, with known counts."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from gsvis.scene.gaussians import Gaussians
from gsvis.train.densify import Densifier, DensifyConfig
from gsvis.train.parameters import Parameters

RULES = DensifyConfig(start=0, stop=100, every=10, threshold=1.0, small=0.1, reset_every=0, largest=10.0)


def make(
    scales: list[float], opacities: list[float] | None = None, frozen: int = 0, **changes: Any
) -> tuple[Densifier, Parameters]:
    n = len(scales)
    g = Gaussians(
        np.arange(3.0 * n).reshape(n, 3),
        [[1, 0, 0, 0]] * n,
        np.repeat(np.array(scales)[:, None], 3, axis=1),
        opacities or [0.5] * n,
        np.zeros((n, 1, 3)),
    )
    p = Parameters.from_gaussians(g, frozen=frozen)
    return Densifier(DensifyConfig(**{**vars(RULES), **changes}), 1.0, p), p


def pull(densifier: Densifier, lengths: list[float]) -> None:
    """One view whose gradients have the given lengths in half image sizes."""
    densifier.observe(torch.tensor([[length, 0.0] for length in lengths]), 2, 2)


def refine(densifier: Densifier, step: int = 10) -> tuple[int, int]:
    return densifier.refine(step, torch.Generator().manual_seed(0))


def test_a_small_one_is_cloned_where_it_lies() -> None:
    densifier, p = make([0.05, 0.05])
    pull(densifier, [2.0, 0.5])
    assert refine(densifier) == (1, 0)
    assert torch.equal(p.values["means"][2], p.values["means"][0])
    assert len(densifier.total) == len(p) == 3


def test_a_large_one_becomes_two_smaller_ones_within_it() -> None:
    densifier, p = make([0.05, 0.5])
    pull(densifier, [0.5, 2.0])
    assert refine(densifier) == (1, 0)
    assert len(p) == 3
    assert torch.allclose(p.values["log_scales"][1:].exp(), torch.tensor(0.5 / 1.6))
    away = p.values["means"].detach()[1:] - torch.tensor([3.0, 4.0, 5.0])
    assert 0.0 < float(away.abs().max()) < 5 * 0.5


def test_without_splits_a_large_one_is_cloned() -> None:
    densifier, p = make([0.5], split=False)
    pull(densifier, [2.0])
    assert refine(densifier) == (1, 0)
    assert torch.equal(p.values["log_scales"][0], p.values["log_scales"][1])


def test_at_most_a_share_is_added_and_the_largest_gradients_come_first() -> None:
    densifier, p = make([0.05] * 50, most_share=0.04)
    pull(densifier, [2.0 + k for k in range(50)])
    assert refine(densifier) == (2, 0)
    assert torch.equal(p.values["means"][50:], p.values["means"][[48, 49]])


def test_no_more_than_the_most() -> None:
    densifier, p = make([0.05] * 5, most_count=6)
    pull(densifier, [2.0] * 5)
    assert refine(densifier) == (1, 0)
    pull(densifier, [2.0] * 6)
    assert refine(densifier) == (0, 0)
    assert len(p) == 6


def test_the_mean_is_over_views_that_saw_it() -> None:
    densifier, p = make([0.05, 0.05])
    pull(densifier, [1.5, 1.5])
    pull(densifier, [0.0, 0.2])
    assert refine(densifier) == (1, 0)  # 1.5 in one view; 0.85 in two
    assert torch.equal(p.values["means"][2], p.values["means"][0])


def test_gradients_are_in_half_image_sizes() -> None:
    densifier, _ = make([0.05])
    densifier.observe(torch.tensor([[0.03, 0.04]]), 200, 100)
    assert float(densifier.total[0]) == pytest.approx(np.hypot(3.0, 2.0))


def test_faint_and_after_a_reset_huge_ones_go() -> None:
    densifier, p = make([0.05, 20.0, 0.05], [0.001, 0.5, 0.5])
    assert refine(densifier) == (0, 1)
    assert refine(make([0.05, 20.0, 0.05], reset_every=20)[0]) == (0, 0)  # no reset yet
    densifier, p = make([0.05, 20.0, 0.05], [0.5, 0.5, 0.5], reset_every=9)
    assert refine(densifier) == (0, 1)
    assert torch.equal(p.values["means"][:, 0].detach(), torch.tensor([0.0, 6.0]))


def test_a_reset_lowers_opacities_and_forgets_their_moments() -> None:
    densifier, p = make([0.05, 0.05], [0.5, 0.008], reset_every=5)
    p.first["logit_opacities"] += 1.0
    refine(densifier, step=5)
    now = p.gaussians().opacities
    np.testing.assert_allclose(now, [0.01, 0.008], rtol=1e-4)
    assert not p.first["logit_opacities"].any()


def test_frozen_ones_are_cloned_but_never_split_pruned_or_reset() -> None:
    densifier, p = make([0.5, 0.5, 0.05], [0.001, 0.5, 0.5], frozen=2, reset_every=10)
    before = {name: value.detach()[:2].clone() for name, value in p.values.items()}
    pull(densifier, [2.0, 2.0, 0.1])
    added, _ = refine(densifier)
    assert added == 2
    for name, value in p.values.items():
        assert torch.equal(value[:2], before[name])
    assert p.gaussians().opacities[-1] == pytest.approx(0.05)  # the clone of one that cannot make room


@pytest.mark.parametrize("step", [0, 5, 11, 110])
def test_other_steps_change_nothing(step: int) -> None:
    densifier, p = make([0.05], start=5)
    pull(densifier, [2.0])
    assert refine(densifier, step) == (0, 0)
    assert len(p) == 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"every": 0}, "every: expected at least 1"),
        ({"threshold": 0.0}, "threshold: expected a finite number > 0"),
        ({"most_share": 0.0}, r"most_share: expected a share in \(0, 1\]"),
        ({"least_opacity": 1.0}, "least_opacity: expected"),
        ({"start": -1}, "start: expected at least 0"),
    ],
)
def test_rules_that_make_no_sense_are_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        DensifyConfig(**change)
