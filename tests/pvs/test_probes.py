"""Points far from all viewpoints, and what looking from them adds to a set."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice, pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from gsvis.pvs import PvsConfig
from gsvis.pvs.cell_view import Finder
from gsvis.pvs.probes import Tips, farthest_points
from gsvis.pvs.viewpoints import FreeVoxels
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels

F64 = NDArray[np.float64]
ROOM = FreeVoxels(0, np.argwhere(np.ones((4, 3, 2), bool)), np.array([1.0, 2.0, 3.0]), 0.5)
CONFIG = PvsConfig(size=64, limit=0.9, rays=256, max_inner=0, tile_limit=1.0)


def nowhere(points: F64) -> NDArray[np.bool_]:
    return np.zeros(len(points), bool)


def test_each_point_is_as_far_as_possible_from_viewpoints_and_points_before_it() -> None:
    rim, eyes = ROOM.rim(), np.array([[1.2, 2.2, 3.2], [2.0, 2.5, 3.4]])
    before = list(eyes)
    for point in islice(farthest_points(ROOM, eyes, nowhere), 8):
        apart = np.linalg.norm(rim[:, None] - np.array(before)[None], axis=2).min(axis=1)
        assert np.linalg.norm(np.array(before) - point, axis=1).min() == pytest.approx(apart.max())
        before.append(point)


def test_all_points_are_different_and_in_the_voxels() -> None:
    low, high = ROOM.bounds()
    points = np.array(list(farthest_points(ROOM, np.zeros((0, 3)), nowhere)))
    assert len(np.unique(points, axis=0)) == len(points) == len(ROOM.voxels)
    assert ((points > low) & (points < high)).all()


def test_points_inside_something_solid_are_left_out() -> None:
    assert list(farthest_points(ROOM, np.zeros((0, 3)), lambda points: ~nowhere(points))) == []
    right = list(farthest_points(ROOM, np.zeros((0, 3)), lambda points: points[:, 0] < 2.0))
    assert right
    assert min(point[0] for point in right) >= 2.0


def corner() -> Gaussians:
    """A wall that hides a ball from the left half of a room, not from its right half."""
    wall = [[x, y, 3.5] for x in np.linspace(-1.0, 2.3, 16) for y in (3.75, 3.8)]
    means, scales = [[3.0, 6.0, 3.5], *wall], [[0.1] * 3, *[[0.2, 0.02, 3.0]] * 32]
    return Gaussians(means, [[1, 0, 0, 0]] * 33, scales, [0.99] * 33, np.zeros((33, 1, 3)))


@pytest.mark.parametrize("probes", [0, 4])
def test_what_a_far_corner_sees_is_added(probes: int) -> None:
    finder = Finder(Levels.single(corner()), replace(CONFIG, probes=probes, rays=1))
    eye = np.array([1.1, 2.2, 3.25])
    sighting = finder.look(eye)
    assert 0 not in sighting.ids.tolist()
    view = finder.find_cell(ROOM, [sighting])
    assert (0 in view.ids.tolist()) == (probes > 0)
    assert view.figures.inner == (1 if probes else 0)


def test_probes_never_shrink_a_set_and_add_nothing_where_nothing_is_missing() -> None:
    g = corner()
    whole = Finder(Levels.single(g), replace(CONFIG, probes=12))
    all_seen = [whole.look(point) for point in ROOM.rim()]
    assert whole.find_cell(ROOM, all_seen).figures.inner == 0
    few = [Finder(Levels.single(g), replace(CONFIG, probes=n)).find_cell(ROOM, all_seen[:1]).ids for n in (0, 2, 12)]
    for less, more in pairwise(few):
        assert np.isin(less, more).all()


def test_every_tip_is_stood_for_at_the_end_and_none_was_looked_from_twice() -> None:
    eyes = ROOM.rim()[:1]
    tips, stood = Tips(ROOM, eyes, nowhere), list(eyes)
    low, high = ROOM.bounds()
    while (eye := tips.farthest()) is not None:
        assert np.linalg.norm(np.array(stood) - eye, axis=1).min() > 1.5 * ROOM.voxel_size
        assert ((eye > low) & (eye < high)).all()
        tips.stand(eye)
        stood.append(eye)
    assert len(stood) > 1
    corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    near = np.linalg.norm(corners[:, None] - np.array(stood), axis=2).min(axis=1)
    assert (near <= 1.6 * ROOM.voxel_size).all()


@pytest.mark.parametrize("found", [False, True])
def test_an_eye_that_found_something_stands_for_less(found: bool) -> None:
    tips = Tips(ROOM, np.zeros((0, 3)), nowhere)
    corner = tips.farthest()
    assert corner is not None
    tips.stand(corner + np.array([ROOM.voxel_size, 0.0, 0.0]), found=found)
    looked = []
    while (eye := tips.farthest()) is not None:
        tips.stand(eye)
        looked.append(eye)
    assert any((eye == corner).all() for eye in looked) == found


def test_no_tip_lies_inside_something_solid() -> None:
    assert Tips(ROOM, np.zeros((0, 3)), lambda points: ~nowhere(points)).farthest() is None


def past_a_wall() -> tuple[Gaussians, FreeVoxels, F64]:
    """A ball that shows past a wall at one edge of a room alone, the room, and eyes, two voxels beside this edge."""
    room = FreeVoxels(0, np.argwhere(np.ones((8, 4, 4), bool)), np.array([1.0, 3.0, 3.0]), 0.25)
    places = [(x, z) for x in np.arange(-1.0, 3.8, 0.06) for z in np.arange(2.0, 5.0, 0.12)]
    wall = [[x, 4.5, z] for x, z in places if x < 2.8 or z < 3.6]
    means, scales = [[3.0, 12.0, 4.1], *wall], [[0.1, 0.1, 0.1], *[[0.06, 0.02, 0.1]] * len(wall)]
    count = len(means)
    g = Gaussians(means, [[1, 0, 0, 0]] * count, scales, [0.99] * count, np.zeros((count, 1, 3)))
    return g, room, np.array([[x, y, z] for x in (1.02, 2.4) for y in (3.02, 3.98) for z in (3.02, 3.98)])


def test_what_a_tip_alone_sees_is_added_though_an_eye_stood_nearby() -> None:
    g, room, eyes = past_a_wall()
    finder = Finder(Levels.single(g), replace(CONFIG, probes=8, rays=1))
    sightings = [finder.look(eye) for eye in eyes]
    assert all(0 not in sighting.ids.tolist() for sighting in sightings)
    assert np.linalg.norm(eyes - room.rim().max(axis=0), axis=1).min() < 2.5 * room.voxel_size
    assert 0 in finder.find_cell(room, sightings).ids.tolist()
