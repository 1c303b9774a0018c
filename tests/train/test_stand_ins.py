"""Stand-ins: each Gaussian has one, they are there as far as theirs go, in any order of the scene."""

from __future__ import annotations

import numpy as np

from gsvis.render.removal import removal_effects
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.train.pairs import merge_pairs
from gsvis.train.stand_ins import StandIns
from tests.raycast.scenes import scene


def made(count: int = 400) -> Gaussians:
    return scene("mixed", 2, count)


def test_each_gaussian_has_a_stand_in_that_is_there_as_far_as_its_own_go() -> None:
    g = made()
    stand_ins = StandIns(g, None, share=0.05)
    assert len(stand_ins.gaussians) == 20
    assert set(stand_ins.groups.tolist()) == set(range(20))
    every = np.arange(len(g))
    assert (stand_ins.presence(every, np.ones(len(g), np.float32)) == 0.0).all()
    assert (stand_ins.presence(every[:0], np.ones(0, np.float32)) == 1.0).all()
    np.testing.assert_allclose(stand_ins.presence(every, np.full(len(g), 0.25, np.float32)), 0.75, atol=1e-6)
    alone = stand_ins.groups == 3
    gone = stand_ins.presence(every[~alone], np.ones(int((~alone).sum()), np.float32))
    assert gone.tolist() == [float(k == 3) for k in range(20)]


def test_they_are_what_merging_makes_and_do_not_depend_on_the_order() -> None:
    g = made()
    turn = np.random.default_rng(0).permutation(len(g))
    one = StandIns(g, None, share=0.05)
    other = StandIns(g[turn], None, share=0.05)
    for name in ("means", "scales", "opacities", "sh0"):
        np.testing.assert_array_equal(getattr(one.gaussians, name), getattr(other.gaussians, name))
    np.testing.assert_array_equal(one.groups[turn], other.groups)
    merged = merge_pairs(g[np.lexsort(g.means.T)], 20)
    np.testing.assert_array_equal(one.gaussians.means, merged.means)


def test_beside_them_a_plain_wall_counts_less_against_a_pattern() -> None:
    """Two walls of disks, one of one color, one of random colors: a stand-in looks like the first, not the second."""
    rng = np.random.default_rng(1)
    x, y = np.meshgrid(np.linspace(-1.0, 1.0, 20), np.linspace(-1.0, 1.0, 20))
    plain = np.stack([x.ravel() - 1.2, y.ravel(), np.zeros(400)], axis=1)
    means = np.concatenate([plain, plain + np.array([2.4, 0.0, 0.0])])
    colors = np.concatenate([np.full((400, 1, 3), 0.5), rng.uniform(-0.5, 1.5, (400, 1, 3))])
    g = Gaussians(means, [[1, 0, 0, 0]] * 800, [[0.07, 0.07, 0.002]] * 800, [0.99] * 800, colors)
    cameras = Cameras.look_at([[-1, 0, -4], [1, 0, -4]], [[0, 0, 0]] * 2, up=[0, -1, 0], width=96, height=48)
    chances = np.full(800, 0.25, np.float32)
    stand_ins = StandIns(g, None)
    both = Gaussians.concatenate([g, stand_ins.gaussians])
    presence = np.concatenate([chances, stand_ins.presence(np.arange(800), chances)])

    def pattern_over_plain(squared: np.ndarray) -> float:
        return float(squared[400:800].mean() / squared[:400].mean())

    without = pattern_over_plain(removal_effects(g, cameras, presence=chances).squared)
    beside = pattern_over_plain(removal_effects(both, cameras, presence=presence).squared)
    assert beside > 1.1 * without
