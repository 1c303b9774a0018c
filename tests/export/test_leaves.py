"""Leaves of a streamed scene: each Gaussian once, alike in size, boxes that hold them, and strays apart."""

from __future__ import annotations

import numpy as np
import pytest

from gsvis.errors import SceneError
from gsvis.export.leaves import cut_leaves
from gsvis.io.streamed_sog_writer import Tree
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels
from gsvis.scene.procedural import random_scene
from tests.package.worlds import levels_of


def leaves_in(tree: Tree) -> list[int]:
    return [tree] if isinstance(tree, int) else [leaf for part in tree for leaf in leaves_in(part)]


@pytest.mark.parametrize(("n", "most"), [(1, 1), (37, 1), (400, 50), (400, 400), (1000, 7)])
def test_every_gaussian_is_in_one_leaf_and_leaves_are_alike_in_size(n: int, most: int) -> None:
    levels = Levels.single(random_scene(np.random.default_rng(n), n))
    leaves = cut_leaves(levels, most=most)
    assert leaves_in(leaves.tree) == list(range(len(leaves)))
    assert sorted([*leaves.order.tolist(), *leaves.environment.tolist()]) == list(range(n))
    sizes = leaves.counts[0]
    assert sizes.max() <= most
    assert sizes.sum() == n - len(leaves.environment)
    assert len(leaves) == 1 or sizes.min() >= most // 2


def test_a_leaf_holds_the_members_of_each_level_in_its_box() -> None:
    levels = levels_of(400)
    leaves = cut_leaves(levels, most=40)
    for lod in range(3):
        found = [leaves.ids(lod, leaf) for leaf in range(len(leaves))]
        assert [len(ids) for ids in found] == leaves.counts[lod].tolist()
        members = np.flatnonzero(levels.member(2 - lod))
        assert np.array_equal(np.sort(np.concatenate(found)), np.setdiff1d(members, leaves.environment))
        for leaf, ids in enumerate(found):
            low, high = leaves.bounds[leaf]
            means, spread = levels.union.means[ids], np.sqrt(np.einsum("nii->ni", levels.union.covars()[ids]))
            assert (means - spread >= low - 1e-5).all()
            assert (means + spread <= high + 1e-5).all()


def test_neighbors_in_a_leaf_are_near_each_other() -> None:
    g = random_scene(np.random.default_rng(1), 2000)
    leaves = cut_leaves(Levels.single(g), most=2000)
    steps = np.linalg.norm(np.diff(g.means[leaves.ids(0, 0)], axis=0), axis=1)
    assert steps.mean() < 0.4 * np.linalg.norm(np.diff(g.means, axis=0), axis=1).mean()


def test_flyaways_become_the_environment_and_leave_boxes_small() -> None:
    g = random_scene(np.random.default_rng(2), 1000)
    means = g.means.copy()
    means[[5, 700]] += 1e4
    wild = Gaussians(means, g.quats, g.scales, g.opacities, g.sh0, g.shN)
    leaves = cut_leaves(Levels.single(wild), most=100)
    assert leaves.environment.tolist() == [5, 700]
    assert np.abs(leaves.bounds).max() < 100.0


def test_many_far_gaussians_are_no_strays() -> None:
    g = random_scene(np.random.default_rng(3), 1000)
    means = g.means.copy()
    means[:15] += 1e4
    leaves = cut_leaves(Levels.single(Gaussians(means, g.quats, g.scales, g.opacities, g.sh0, g.shN)), most=100)
    assert len(leaves.environment) == 0
    assert leaves.counts.sum() == 1000


def test_equal_positions_are_cut_too() -> None:
    g = random_scene(np.random.default_rng(4), 64)
    same = Gaussians(np.ones((64, 3)), g.quats, g.scales, g.opacities, g.sh0, g.shN)
    assert cut_leaves(Levels.single(same), most=8).counts.tolist() == [[8] * 8]


def test_what_is_not_kept_is_in_no_leaf() -> None:
    levels = Levels.single(random_scene(np.random.default_rng(5), 200))
    kept = np.arange(200) % 3 == 0
    leaves = cut_leaves(levels, most=20, kept=kept)
    held = np.concatenate([leaves.order, leaves.environment])
    assert np.array_equal(np.sort(held), np.flatnonzero(kept))
    with pytest.raises(SceneError, match="nothing to write"):
        cut_leaves(levels, kept=np.zeros(200, np.bool_))


def test_a_first_picture_is_no_level_of_detail() -> None:
    g = random_scene(np.random.default_rng(6), 330)
    kind = np.repeat([0, 1, 2], [10, 20, 300])  # merges of the first picture, of the level above, the scene
    first, last = np.array([0, 1, 1], np.uint8)[kind], np.array([0, 1, 2], np.uint8)[kind]
    first[130:] = 2
    levels = Levels(g, first, last, ("preview", "low", "high"))
    assert (levels.previews, Levels.single(g).previews) == (1, 0)
    leaves = cut_leaves(levels, most=50, lowest=levels.previews)
    assert (leaves.of_ids[:10] == -1).all()
    plain = cut_leaves(Levels(g[10:], first[10:] - 1, last[10:] - 1, ("low", "high")), most=50)
    assert np.array_equal(leaves.counts, plain.counts)
    assert np.array_equal(leaves.of_ids[10:], plain.of_ids)


def test_the_order_does_not_depend_on_other_leaves() -> None:
    levels = levels_of(300)
    first, second = cut_leaves(levels, most=30), cut_leaves(levels, most=30)
    assert first.tree == second.tree
    assert np.array_equal(first.order, second.order)
