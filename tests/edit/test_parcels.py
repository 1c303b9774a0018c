"""Parcels: as wide as asked, each Gaussian in one of them, rooms found that one grid does not show."""

from __future__ import annotations

import numpy as np
import pytest

from gsvis.edit.parcels import find_side, indoors, join_spaces, lay_parcels, mixed_space, rows_near
from gsvis.scene.axes import axis_vector
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


def test_a_dense_spot_does_not_make_parcels_without_number() -> None:
    rng, g = np.random.default_rng(0), rooms()
    dense, wide = 0.3 * rng.normal(size=(3000, 3)), 100.0 * rng.random((2000, 3)) * (1.0, 1.0, 0.01)
    some = rng.integers(len(g), size=5000)
    spot = Gaussians(np.concatenate([dense, wide]), g.quats[some], g.scales[some], g.opacities[some], g.sh0[some])
    assert find_side(spot, 1, "+z", 2000) < 2.0
    assert 1 < len(lay_parcels(spot, 1, "+z", 2000)) <= 8 * (1 + 5000 / 2000)


def test_an_empty_sample_has_no_parcels() -> None:
    assert lay_parcels(rooms()[:0], 1, "+z") == []
    assert lay_parcels(rooms()[[0, len(rooms()) - 1]], 1, "+z") == []  # none of two is within their robust box


def test_rows_near_a_parcel_are_fewer_and_wider_where_they_are_too_many(monkeypatch: pytest.MonkeyPatch) -> None:
    parts = [rooms()[:700], rooms()[700:]]
    near = rows_near(parts, AT_FIRST)
    inside = near_tile(rooms().means, AT_FIRST, 0.4)
    np.testing.assert_array_equal(near.means, rooms().means[inside])
    monkeypatch.setattr("gsvis.edit.parcels._MOST_NEAR", inside.sum() // 3)
    fewer = rows_near(parts, AT_FIRST)
    assert len(fewer) == pytest.approx(inside.sum() / 4, abs=2)
    np.testing.assert_allclose(fewer.scales[0], 2.0 * near.scales[0])


@pytest.mark.parametrize("up", ["+z", "-z", "+x"])
def test_indoors_is_below_a_roof(up: str) -> None:
    free, occupied = np.zeros((5, 5, 5), bool), np.zeros((5, 5, 5), bool)
    free[1:4, 2, 2] = free[2, 2, 1:4] = True
    occupied[2, 2, 4] = occupied[4, 2, 2] = True
    space = NavigableSpace(np.zeros(3), 1.0, free, axis_vector(up), occupied)
    x, _, z = np.indices(free.shape)
    wanted = {"+z": free & (x == 2), "-z": np.zeros_like(free), "+x": free & (z == 2)}
    np.testing.assert_array_equal(indoors(space), wanted[up])


def test_indoors_is_below_a_roof_where_up_is_oblique() -> None:
    x, y, z = np.indices((24, 24, 24))
    up = np.array([0.0, 0.6, 0.8])
    height = 0.6 * (y - 12) + 0.8 * (z - 12)  # of voxels above the middle, along up
    occupied = (np.abs(height - 6.0) < 1.0) & (x < 12)
    free = np.abs(height) < 1.0
    inside = indoors(NavigableSpace(np.zeros(3), 1.0, free, up, occupied))
    across = np.abs(0.8 * (y - 12) - 0.6 * (z - 12)) < 4.0  # so that what is above lies in the grid
    assert inside[free & across & (x < 11)].all()
    assert not inside[x > 13].any()


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
