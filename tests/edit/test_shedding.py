"""What is left out of a scene for a budget: hidden and redundant Gaussians first, and no more than has to go."""

from __future__ import annotations

import numpy as np
import pytest

from gsvis.edit import Budget
from gsvis.edit.shedding import Load, Pictures, excess, look, shares, shed
from gsvis.errors import SceneError
from gsvis.render import measure_fill
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians

VIEWS = Cameras.cubemap(np.zeros((1, 3)), 32)
PICTURES = Pictures(VIEWS, VIEWS)


def shells(count: int = 300) -> Gaussians:
    """Opaque splats on a sphere that hides as many on one behind it; the hidden ones come first."""
    rng = np.random.default_rng(0)
    ways = rng.normal(size=(2 * count, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    radius = np.repeat([5.0, 2.0], count)[:, None]
    quats = np.tile([1.0, 0, 0, 0], (2 * count, 1))
    scales = np.repeat([[0.3], [0.5]], count, axis=0) * np.ones(3)
    return Gaussians(radius * ways, quats, scales, np.full(2 * count, 0.98), ways[:, None, :] / 4.0)


def test_loads_are_the_fill_of_views() -> None:
    loads = look(shells(), VIEWS)
    found = measure_fill(shells(), VIEWS)
    assert np.allclose([len(each.ids) for each in loads], found.splats)
    assert np.allclose([each.covered.sum() for each in loads], found.mean, rtol=1e-5)


def test_shares_and_excess_have_known_values() -> None:
    loads = [
        Load(np.arange(8, dtype=np.int32), np.full(8, 0.5, np.float32)),
        Load(np.zeros(0, np.int32), np.zeros(0, "f4")),
    ]
    assert shares(loads, Budget(splats=4)).tolist() == [2.0, 0.0]
    assert shares(loads, Budget(splats=16, fill=1.0)).tolist() == [4.0, 0.0]
    assert excess(loads, Budget(splats=4), 1.0) == 0.5
    assert excess(loads, Budget(splats=8), 1.0) == 0.0


def test_what_is_hidden_goes_first() -> None:
    g = shells()
    loads = look(g, VIEWS)
    most = float(shares(loads, Budget(splats=1)).max())
    left, after = shed(g, loads, Budget(splats=int(0.9 * most)), 1.0, PICTURES)
    assert shares(after, Budget(splats=int(0.9 * most))).max() <= 1.0
    gone = len(g) - len(left)
    near = np.linalg.norm(left.means, axis=1) < 3.0
    assert near.sum() == len(g) // 2  # nothing of the front
    assert gone > 0


def test_loads_that_come_with_the_rest_are_those_of_the_rest() -> None:
    left, loads = shed(shells(), look(shells(), VIEWS), Budget(fill=6.0), 1.0, PICTURES)
    again = look(left, VIEWS)
    for one, other in zip(loads, again, strict=True):
        assert np.array_equal(one.ids, other.ids)
        assert np.array_equal(one.covered, other.covered)


def test_a_scene_that_holds_the_budget_stays_and_nothing_is_refused() -> None:
    g = shells()
    loads = look(g, VIEWS)
    assert shed(g, loads, Budget(splats=10_000), 1.0, PICTURES)[0] is g
    one = g[-1:]
    with pytest.raises(SceneError, match="allow more splats or more fill"):
        shed(one, look(one, VIEWS), Budget(fill=1e-6), 1.0, PICTURES)
