"""Where eyes may be in a scene of many places: what one grid misses is found in pieces, and what it shows stays."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from gsvis.edit import CleanConfig, clean, clean_large, find_in_pieces
from gsvis.edit.places import is_well_known, join_pieces, lay_pieces, space_near
from gsvis.files.objects import open_store
from gsvis.io import save_scene
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.kinds import SpaceKind
from gsvis.scene.navigable import NavigableSpace
from gsvis.world.tiles import near_tile
from gsvis.world.tiling import TilingConfig
from tests.scene.places import apartment, box, statue

F64 = NDArray[np.float64]

APART, COUNT = 32.0, 8
MIDDLES = np.array([[APART * k, 0.0, 0.0] for k in range(COUNT)])
HALF, BOX = np.array([1.8, 1.5, 1.25]), np.array([0.9, 0.6, -1.1])
LIGHT = CleanConfig(eyes=6, size=48, resolution=64, held_out=2)


def flats() -> Gaussians:
    """A row of eight closed rooms, each with a box in it: less than two voxels high in a grid over all."""
    rooms = [box(tuple(m - HALF), tuple(m + HALF), 0.25) for m in MIDDLES]
    return Gaussians.concatenate([*rooms, *(box(tuple(m + BOX), tuple(m + BOX + 0.6), 0.1) for m in MIDDLES)])


@pytest.fixture(scope="module")
def whole() -> NavigableSpace:
    return NavigableSpace.from_scene(flats(), up="+z")


@pytest.fixture(scope="module")
def joined(whole: NavigableSpace) -> NavigableSpace:
    return find_in_pieces(flats(), whole, most=1000)


def test_one_grid_shows_no_flat(whole: NavigableSpace) -> None:
    assert not is_well_known(whole)
    assert not whole.contains(MIDDLES).any()


def test_pieces_show_all_flats(whole: NavigableSpace, joined: NavigableSpace) -> None:
    assert joined.contains(MIDDLES).all()
    assert joined.pieces > 2
    assert joined.voxel_size < 0.5 * whole.voxel_size
    assert not (joined.free & joined.occupied).any()


def test_walls_stop_views_in_the_grid_of_pieces(joined: NavigableSpace) -> None:
    inner = MIDDLES[1:-1]  # the robust box ends in the first room and in the last
    ways = np.tile([0.0, 0.0, 1.0], (len(inner), 1))
    np.testing.assert_allclose(joined.free_distances(inner, ways), HALF[2], atol=2.0 * joined.voxel_size)


def test_rooms_that_one_grid_shows_stay_as_they_are() -> None:
    space = NavigableSpace.from_scene(apartment(), up="+z")
    assert is_well_known(space)
    assert find_in_pieces(apartment(), space, most=2000) is space
    unknown = replace(space, kind=SpaceKind("open place", "", None, ""))  # asked, pieces show what the grid shows
    assert find_in_pieces(apartment(), unknown, most=12_000) is unknown


def test_an_object_stays_one() -> None:
    space = NavigableSpace.from_scene(statue(), up="+z")
    assert space.kind.kind == "object"
    assert find_in_pieces(statue(), space, most=1000) is space


def test_a_scene_of_one_piece_is_not_looked_at_again(whole: NavigableSpace) -> None:
    assert find_in_pieces(flats(), whole) is whole


def test_without_any_place_in_pieces_the_space_stays(whole: NavigableSpace) -> None:
    assert join_pieces(whole, [(100, None), (50, None)]) is whole


def test_pieces_cover_what_the_sample_holds_and_are_as_wide_as_asked() -> None:
    squares = lay_pieces(flats(), 1, "+z", 1000)
    assert all(each["axes"] == [0, 1] and each["up"] == "+z" for each in squares)
    sides = np.array([np.subtract(each["high"], each["low"]) for each in squares])
    np.testing.assert_allclose(sides, sides[0, 0])
    own = np.array([near_tile(flats().means, each, 0.0) for each in squares])
    assert own.sum(axis=0).max() == 1  # no two squares hold the same
    assert own.any(axis=0).mean() > 0.95  # of the centers within the robust box
    wider = lay_pieces(flats(), 1, "+z", 4000)
    assert wider[0]["high"][0] - wider[0]["low"][0] == pytest.approx(2.0 * sides[0, 0])
    assert lay_pieces(flats()[::2], 2, "+z", 1000)[0]["high"] == pytest.approx(squares[0]["high"], rel=0.2)


def test_what_lies_in_one_point_has_no_pieces() -> None:
    g = flats()[:9]
    point = Gaussians(np.zeros((9, 3)), g.quats, g.scales, g.opacities, g.sh0)
    assert lay_pieces(point, 1, "+z") == []


def test_space_near_a_piece_is_that_of_the_whole_there(joined: NavigableSpace) -> None:
    square = {"low": [-2.0, -2.0], "high": [2.0, 2.0], "axes": [0, 1]}
    near = space_near(joined, square)
    assert near is not None
    assert near.contains(MIDDLES).tolist() == [True] + [False] * (COUNT - 1)
    inside = near.origin + near.voxel_size * (np.argwhere(near.free) + 0.5)
    assert joined.contains(inside).all()
    assert near.volume == pytest.approx(joined.volume / COUNT, rel=0.1)
    assert space_near(joined, {"low": [14.0, -1.0], "high": [18.0, 1.0], "axes": [0, 1]}) is None


def test_clean_keeps_all_flats(joined: NavigableSpace) -> None:
    found = clean(flats(), navigable=joined, config=LIGHT)
    assert found.kept.mean() > 0.97


def test_clean_in_tiles_keeps_all_flats(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save_scene(flats(), tmp_path / "flats.ply")
    monkeypatch.setattr("gsvis.edit.tiles.lay_pieces", partial(lay_pieces, most=1000))
    tiling, store = TilingConfig(3000, up="+z"), open_store(tmp_path / "work")
    found = clean_large((str(tmp_path / "flats.ply"), None), LIGHT, tiling, store)
    assert found.tiles >= 3
    assert found.kept > 0.97 * found.gaussians
