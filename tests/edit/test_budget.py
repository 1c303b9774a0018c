"""Versions of a scene that hold a budget: laws, and a scene whose answer is known."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from gsvis.edit import Budget, fit_budget
from gsvis.errors import SceneError
from gsvis.render import fill_around
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace

FEW: Any = {"eyes": 2, "steps": 25}
SPACE = NavigableSpace.from_box((-0.2, -0.2, -0.2), (0.2, 0.2, 0.2), 4)


@pytest.fixture(scope="module", autouse=True)
def small_views() -> object:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gsvis.edit.budget.SIDE", 48)
        yield


def ball(count: int = 3000) -> Gaussians:
    """Splats on a sphere around the space, with colors of their places."""
    rng = np.random.default_rng(0)
    means = rng.normal(size=(count, 3))
    means *= 2.0 / np.linalg.norm(means, axis=1, keepdims=True)
    quats = np.tile([1.0, 0, 0, 0], (count, 1))
    return Gaussians(means, quats, np.full((count, 3), 0.05), np.full(count, 0.9), means[:, None, :] / 4.0)


@pytest.mark.parametrize("budget", [Budget(splats=250, **FEW), Budget(fill=4.0, **FEW), Budget(300, 5.0, **FEW)])
def test_a_version_holds_the_budget_at_other_eyes(budget: Budget) -> None:
    g = ball()
    found = fit_budget(g, SPACE, budget)
    assert found.held
    assert len(found.scene) < len(g)
    for figure, limit in (("splats", budget.splats), ("mean", budget.fill)):
        if limit is not None:
            assert found.after[figure] <= limit < found.before[figure]
    assert 15.0 < found.worst_db <= found.mean_db < 60.0


def test_a_scene_that_holds_it_stays_as_it_is() -> None:
    g = ball(300)
    found = fit_budget(g, SPACE, Budget(splats=5000, eyes=2))
    assert found.scene is g
    assert (found.held, found.mean_db) == (True, 100.0)
    assert found.before == found.after


def test_more_budget_is_not_worse() -> None:
    tight, loose = (fit_budget(ball(), SPACE, Budget(splats=n, eyes=1, steps=25)) for n in (120, 450))
    assert loose.mean_db > tight.mean_db
    assert len(loose.scene) > len(tight.scene)


def test_a_budget_that_cannot_be_held_says_what_can() -> None:
    haze = replace(ball(40), scales=np.full((40, 3), 9.0, np.float32), opacities=np.full(40, 0.05, np.float32))
    least = fill_around(haze[:1], np.zeros((1, 3))).largest()["mean"]
    assert least > 0.9  # one splat covers a view
    with pytest.raises(SceneError, match="allow more splats or more fill"):
        fit_budget(haze, SPACE, Budget(fill=0.5, eyes=1))


@pytest.mark.parametrize("values", [{}, {"splats": 0}, {"fill": -1.0}, {"splats": 5, "eyes": 0}])
def test_bad_budgets_are_refused(values: dict[str, int]) -> None:
    with pytest.raises(ValueError, match="expected"):
        Budget(**values)
