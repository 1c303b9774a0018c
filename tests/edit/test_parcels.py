"""Parcels: as wide as asked, each Gaussian in one of them, rooms found that one grid does not show."""

from __future__ import annotations

import numpy as np
import pytest

from gsvis.edit.parcels import find_side, join_spaces, lay_parcels, mixed_space
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.world.tiles import cut_to_tile, near_tile, within_tile
from tests.scene.places import box

MIDDLES = np.array([[32.0 * k, 0.0, 0.0] for k in range(4)])
HALF = np.array([1.8, 1.5, 1.25])
AT_FIRST = {"low": [-2.0, -2.0], "high": [2.0, 2.0], "axes": [0, 1], "up": "+z"}


def rooms() -> Gaussians:
    """Four closed rooms in a row, far from each other."""
    return Gaussians.concatenate([box(tuple(m - HALF), tuple(m + HALF), 0.25) for m in MIDDLES])


def square_around(middle: float) -> dict[str, object]:
    return {**AT_FIRST, "low": [middle - 2.0, -2.0], "high": [middle + 2.0, 2.0]}


@pytest.fixture(scope="module")
def spaces() -> list[NavigableSpace]:
    squares = [square_around(32.0 * k) for k in range(4)]
    found = [mixed_space(rooms()[near_tile(rooms().means, each, 0.5)], each, 0.08) for each in squares]
    return [space for space in found if space is not None]


def test_parcels_cover_what_the_sample_holds_and_are_as_wide_as_asked() -> None:
    squares = lay_parcels(rooms(), 1, "+z", 1000)
    assert all(each["axes"] == [0, 1] and each["up"] == "+z" for each in squares)
    sides = np.array([np.subtract(each["high"], each["low"]) for each in squares])
    np.testing.assert_allclose(sides, sides[0, 0])
    own = np.array([near_tile(rooms().means, each, 0.0) for each in squares])
    assert own.sum(axis=0).max() == 1  # no two squares hold the same
    assert own.any(axis=0).mean() > 0.95  # of the centers within the robust box
    wider = lay_parcels(rooms(), 1, "+z", 4000)
    assert wider[0]["high"][0] - wider[0]["low"][0] == pytest.approx(2.0 * sides[0, 0])
    assert lay_parcels(rooms()[::2], 2, "+z", 1000)[0]["high"] == pytest.approx(squares[0]["high"], rel=0.2)


def test_what_lies_in_one_point_has_no_parcels() -> None:
    g = rooms()[:9]
    point = Gaussians(np.zeros((9, 3)), g.quats, g.scales, g.opacities, g.sh0)
    assert lay_parcels(point, 1, "+z") == []


def test_the_side_follows_the_gaussians_that_the_sample_stands_for() -> None:
    side = find_side(rooms(), 1, "+z", 1000)
    assert find_side(rooms(), 4, "+z", 1000) == pytest.approx(0.5 * side)
    assert find_side(rooms(), 1, "+z", 4000) == pytest.approx(2.0 * side)


def test_each_room_is_found_in_its_square(spaces: list[NavigableSpace]) -> None:
    assert len(spaces) == 4
    assert [space.contains(MIDDLES).tolist() for space in spaces] == np.eye(4, dtype=bool).tolist()


def test_where_nothing_is_there_is_no_space() -> None:
    nowhere = square_around(16.0)
    assert mixed_space(rooms()[:0], nowhere, 0.08) is None
    assert mixed_space(rooms(), nowhere, 0.5) is None


def test_joined_spaces_are_the_spaces(spaces: list[NavigableSpace]) -> None:
    joined = join_spaces(spaces)
    assert joined.contains(MIDDLES).all()
    assert joined.parcels == 4
    assert joined.volume == pytest.approx(sum(space.volume for space in spaces), rel=0.1)
    assert not (joined.free & joined.occupied).any()
    ways = np.tile([0.0, 0.0, 1.0], (4, 1))
    np.testing.assert_allclose(joined.free_distances(MIDDLES, ways), HALF[2], atol=2.0 * joined.voxel_size)


def test_walls_of_the_space_below_count_only_where_nothing_else_is_known(spaces: list[NavigableSpace]) -> None:
    low, high = (-3.0, -3.0, -3.0), (100.0, 3.0, 3.0)
    box_ = NavigableSpace.from_box(low, high, 103)
    full = NavigableSpace(box_.origin, box_.voxel_size, _only(box_.free, 0), box_.up, np.ones_like(box_.free))
    joined = join_spaces(spaces[1:], full)
    ways = np.tile([0.0, 0.0, 1.0], (3, 1))
    np.testing.assert_allclose(joined.free_distances(MIDDLES[1:], ways), HALF[2], atol=2.0 * joined.voxel_size)
    assert joined.free_distances([[16.0, 0.0, 0.0]], [[0.0, 0.0, 1.0]])[0] < 1.0
    assert joined.contains([full.origin + 0.5 * full.voxel_size]).all()


def test_a_space_is_cut_to_a_square(spaces: list[NavigableSpace]) -> None:
    joined = join_spaces(spaces)
    near = cut_to_tile(joined, AT_FIRST)
    assert near is not None
    assert near.contains(MIDDLES).tolist() == [True, False, False, False]
    inside = near.origin + near.voxel_size * (np.argwhere(near.free) + 0.5)
    assert joined.contains(inside).all()
    assert near.volume == pytest.approx(spaces[0].volume, rel=0.1)
    assert cut_to_tile(joined, square_around(16.0)) is None
    half = within_tile(joined, {**AT_FIRST, "high": [0.0, 2.0]})
    assert half is not None
    assert half.volume == pytest.approx(0.5 * near.volume, rel=0.1)
    assert not half.contains([[0.5, 0.0, 0.0]]).any()


def _only(mask: np.ndarray, voxel: int) -> np.ndarray:
    """A mask of one voxel."""
    found = np.zeros_like(mask)
    found.flat[voxel] = True
    return found
