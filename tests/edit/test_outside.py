"""Cuts for eyes outside: where a box is open, what stands in the way, and how much of the inside is seen then."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from gsvis.edit import CutConfig, EyesInSpace, Opening, OutsideCut, cut_from_outside
from gsvis.edit.outside import light_from_inside, outside_cameras
from gsvis.errors import SceneError
from gsvis.raycast import EllipsoidProxies, Tracer
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.procedural import two_rooms
from gsvis.scene.view_sampling import ViewSampling

QUICK = CutConfig(size=32, rays=512, max_stages=2, limit=0.05, views=ViewSampling(2, 48, 36, 90.0))
UP = (0.0, 0.0, 1.0)


@cache
def rooms() -> Gaussians:
    """Return two rooms, 8 x 4 x 3 units, closed on all sides."""
    return two_rooms(4000, sh_degree=0).gaussians


@cache
def space() -> NavigableSpace:
    """Return a small part of one room: the inside reaches farther than the eyes."""
    return NavigableSpace.from_box((1.0, 1.0, 1.0), (3.0, 3.0, 2.0), 12)


@cache
def opening(direction: tuple[float, float, float] = UP) -> Opening:
    return Opening.from_space(space(), Tracer(EllipsoidProxies.from_scene(rooms())), direction)


@cache
def opened() -> OutsideCut:
    return cut_from_outside(rooms(), EyesInSpace(space(), boxes=1), None, QUICK)


def test_the_ceiling_is_found_over_all_that_eyes_see_from_a_part_of_a_room() -> None:
    found = opening()
    assert np.allclose(found.heights[found.open], 3.0, atol=0.15)
    assert 8.0 * 4.0 * 0.4 < found.open.sum() * found.side**2 < 8.0 * 4.0 * 1.2  # the room, and more through the door


def test_the_ceiling_is_in_the_way_and_floor_and_walls_are_not() -> None:
    means = rooms().means
    blocks = opening().blocks(rooms())
    over = np.all((means[:, :2] > 0.3) & (means[:, :2] < [3.7, 3.7]), axis=1)
    assert blocks[over & (means[:, 2] > 2.9)].all()
    assert not blocks[means[:, 2] < 2.7].any()


def test_another_direction_opens_another_side() -> None:
    means = rooms().means
    blocks = opening((-2.0, 0.0, 0.0)).blocks(rooms())
    assert blocks[(means[:, 0] < 0.05) & (np.abs(means[:, 1] - 2.0) < 1.5) & (np.abs(means[:, 2] - 1.5) < 1.0)].all()
    assert not blocks[means[:, 0] > 0.5].any()


def test_rays_enter_from_above_and_not_through_a_wall_or_from_below() -> None:
    starts = np.array([[2.0, 2.0, 9.0], [-4.0, 2.0, 1.5], [2.0, 2.0, -5.0], [2.0, 2.0, 9.0], [30.0, 2.0, 9.0]])
    ways = np.array([[0.1, 0.0, -1.0], [1.0, 0.0, -0.05], [0.0, 0.0, 1.0], [0.0, 3.0, -1.0], [0.0, 0.0, -1.0]])
    assert opening().enters(starts, ways).tolist() == [True, False, False, False, False]


def test_eyes_outside_see_the_inside_once_it_is_open() -> None:
    found = opened()
    assert found.light_before.max() < 0.1
    assert found.light_after.min() > 0.9  # eyes inside do not see all of the other room
    assert not (found.kept & found.blocking).any()
    assert found.inside.kept[~found.blocking & ~found.kept].sum() == 0  # all that eyes inside see stays
    assert found.as_dict()["gaussians_out"] == found.kept.sum()


def test_light_from_inside_is_all_where_all_counts_and_none_where_nothing_does() -> None:
    cameras = outside_cameras(opening(), UP, 2)
    every = light_from_inside(rooms(), np.ones(len(rooms()), bool), opening(), cameras)
    none = light_from_inside(rooms(), np.zeros(len(rooms()), bool), opening(), cameras)
    assert every.min() > 0.95
    assert none.max() == 0.0


def test_a_space_that_is_open_already_is_refused_and_so_is_no_direction() -> None:
    g = rooms()
    without = Tracer(EllipsoidProxies.from_scene(g[g.means[:, 2] < 2.7]))
    with pytest.raises(SceneError, match="see into it already"):
        Opening.from_space(space(), without, UP)
    with pytest.raises(ValueError, match="not all 0"):
        Opening.from_space(space(), without, (0.0, 0.0, 0.0))
