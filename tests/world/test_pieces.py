"""What stands around a tile: far towers count and rooms behind walls do not, levels by distance, runs of blocks."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks._worlds import house, sheet
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.procedural import random_scene
from gsvis.world import pieces
from gsvis.world.pieces import BLOCK, join_surroundings, part_of_district, parts_of_tile, runs_of
from gsvis.world.standing import distances_of, nodes_around


def test_a_far_tower_counts_and_the_room_behind_the_wall_does_not() -> None:
    gray = (0.5, 0.5, 0.5)
    x, y, z = np.eye(3)
    ground = sheet(np.array([-5.0, -5.0, 0.0]), 10 * x, 10 * y, 0.3, gray)
    wall = sheet(np.array([5.0, -20.0, 0.0]), 40 * y, 6 * z, 0.15, gray)
    room = house(np.array([8.0, -2.0, 0.0]), np.array([4.0, 3.0, 3.0]), 0.3, gray)
    tower = house(np.array([60.0, -4.0, 0.0]), np.array([8.0, 8.0, 60.0]), 1.0, gray)
    own = Levels.single(Gaussians.concatenate([ground, wall]))
    space = NavigableSpace.from_box([-4.0, -4.0, 0.5], [4.0, 4.0, 2.0], 8)
    assert pieces._look_coarsely(own, space, {4: room, 9: tower}, 12) == {9}
    open_ground = Levels.single(ground)
    assert pieces._look_coarsely(open_ground, space, {4: room, 9: tower}, 12) == {4, 9}


def levels(n: int = 4000) -> Levels:
    from gsvis.package import in_package_order

    g = random_scene(np.random.default_rng(0), n)
    g = Gaussians(g.means * [20.0, 1.0, 1.0], g.quats, g.scales, g.opacities, g.sh0)
    first = np.repeat([0, 1, 2], [n // 4, n // 4, n // 2]).astype(np.uint8)
    last = np.full(n, 2, np.uint8)
    last[: n // 20] = 0
    return in_package_order(Levels(g, first, last, ("low", "medium", "high")))


def test_blocks_get_the_level_that_their_distance_deserves() -> None:
    found = levels()
    low = found.union.means.min(axis=0).astype(np.float64)
    box = (low - np.array([10.0, 0.0, 0.0]), low + np.array([-0.5, 5.0, 5.0]))
    parts = list(parts_of_tile(found, (0.4, 0.2, 0.1), 3, box, 0.02))
    assert [part.level for part in parts] == [2, 1, 0]
    ids = [np.concatenate([np.arange(a, a + n) for a, n in part.runs]) for part in parts]
    assert len(np.unique(np.concatenate(ids))) == sum(map(len, ids))
    away = np.linalg.norm(np.maximum(found.union.means - box[1], 0.0), axis=1)
    for part, some in zip(parts, ids, strict=True):
        assert (found.first[some] <= part.level).all()
        assert len(part.around) == len(some)
    assert away[ids[2]].min() >= 0.4 / 0.02
    near = np.flatnonzero((away < 0.2 / 0.02) & (found.first == 2))
    assert np.isin(near, ids[0]).all()


def test_surroundings_stand_in_the_levels_of_the_tile() -> None:
    found = levels()
    box = (np.full(3, -1e4), np.full(3, -9e3))  # far: the lowest level of everything
    (part,) = parts_of_tile(found, (0.4, 0.2, 0.1), 3, box, 0.02)
    assert part.level == 0
    assert (part.around.first == 0).all()
    assert (part.around.last == 2).all()
    one = list(parts_of_tile(found, (1e9, 1e9, 1e9), 1, box, 0.02))
    assert sum(len(each.around) for each in one) == found.counts[2]
    district = part_of_district(random_scene(np.random.default_rng(1), 30), 3)
    joined = join_surroundings([part.around, district.around])
    assert len(joined) == len(part.around) + 30
    own = levels(400)
    both = joined.joined(own)
    assert both.counts == tuple(count + len(joined) for count in own.counts)


def test_runs_and_gaps() -> None:
    assert runs_of(np.array([1, 1, 0, 0, 1], bool)) == [(0, 2), (4, 1)]
    assert runs_of(np.zeros(0, bool)) == []
    boxes = [{"low": [1.0, 4.0, 0.0], "high": [2.0, 5.0, 1.0]}, {"low": [0.5] * 3, "high": [0.6] * 3}]
    assert distances_of(np.zeros(3), np.ones(3), boxes) == pytest.approx([3.0, 0.0])
    assert len(distances_of(np.zeros(3), np.ones(3), [])) == 0
    assert BLOCK == 256


def test_each_other_tile_stands_once_and_as_coarsely_as_its_distance_allows() -> None:
    plans = [*({"children": [k], "tiles": [k]} for k in range(4)), {"children": [6, 7], "tiles": [2, 3]}]
    params = {"tile": 0, "tiles": 4, "districts": plans, "angle": 0.1}
    facts = [{"spacing": 1.0}] * 4 + [{"spacing": 2.0}]
    assert nodes_around(params, facts, np.array([0.0, 0.0, 30.0, 30.0, 30.0])) == ([4], [1])
    assert nodes_around(params, facts, np.array([0.0, 0.0, 12.0, 30.0, 12.0])) == ([2, 3], [1])
    assert nodes_around(params, facts, np.array([0.0, 0.0, 9.0, 30.0, 9.0])) == ([3], [1, 2])
