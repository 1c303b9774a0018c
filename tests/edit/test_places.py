"""The space of a scene with many places: parcels find rooms that one grid misses, and a grid that is right is kept."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from gsvis.edit import CleanConfig, clean, clean_large, find_in_parcels
from gsvis.edit.parcels import mixed_space, rows_near
from gsvis.edit.places import is_well_known, join_parcels, parcels_of
from gsvis.io import batches, save_scene
from gsvis.jobs.graph import Facts
from gsvis.jobs.objects import open_store
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.world.tiling import TilingConfig
from tests.scene.places import apartment, box, sheet, statue

F64 = NDArray[np.float64]

APART, COUNT = 52.0, 5
MIDDLES = np.array([[APART * k, 0.0, 0.0] for k in range(COUNT)])
HALF, BOX = np.array([1.8, 1.5, 1.25]), np.array([0.9, 0.6, -1.1])
LIGHT = CleanConfig(eyes=6, size=48, resolution=64, held_out=0)
VOXELS = 60  # along a parcel: rooms of 3 units are 20 wide


def flats() -> Gaussians:
    """A row of five closed rooms, each with a box in it: less than two voxels high in a grid over all."""
    rooms = [box(tuple(m - HALF), tuple(m + HALF), 0.25) for m in MIDDLES]
    return Gaussians.concatenate([*rooms, *(box(tuple(m + BOX), tuple(m + BOX + 0.6), 0.1) for m in MIDDLES)])


@pytest.fixture(scope="module")
def whole() -> NavigableSpace:
    return NavigableSpace.from_scene(flats(), up="+z")


@pytest.fixture(scope="module")
def joined(whole: NavigableSpace) -> NavigableSpace:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gsvis.edit.places.VOXELS", VOXELS)
        return find_in_parcels(flats(), whole, most=1000)


def test_one_grid_shows_no_flat(whole: NavigableSpace) -> None:
    assert not is_well_known(whole)
    assert not whole.contains(MIDDLES).any()


def test_parcels_show_all_flats(whole: NavigableSpace, joined: NavigableSpace) -> None:
    assert joined.contains(MIDDLES).all()
    assert joined.parcels > 2
    assert joined.voxel_size < 0.5 * whole.voxel_size
    assert not (joined.free & joined.occupied).any()


def test_walls_stop_views_in_the_grid_of_parcels(joined: NavigableSpace) -> None:
    inner = MIDDLES[1:-1]  # the robust box ends in the first room and in the last
    ways = np.tile([0.0, 0.0, 1.0], (len(inner), 1))
    np.testing.assert_allclose(joined.free_distances(inner, ways), HALF[2], atol=2.0 * joined.voxel_size)


def test_rooms_that_one_grid_shows_stay_as_they_are() -> None:
    space = NavigableSpace.from_scene(apartment(), up="+z")
    assert is_well_known(space)
    assert find_in_parcels(apartment(), space, most=20_000) is space
    halves: list[Facts] = [
        {"low": [low, 0.0], "high": [low + 4.0, 5.0], "axes": [0, 1], "up": "+z"} for low in (0.0, 4.0)
    ]
    parcels = [(1, mixed_space(apartment(), half, 0.05)) for half in halves]
    assert all(found is not None for _, found in parcels)
    assert join_parcels(space, parcels) is space


def test_a_street_that_the_grid_shows_does_not_outvote_rooms() -> None:
    rooms = np.array([[12.0 * x, 12.0 * y, 1.25] for x in range(4) for y in range(4)])
    scene = Gaussians.concatenate(
        [*(box(tuple(m - HALF), tuple(m + HALF), 0.3) for m in rooms), sheet(2, -0.05, (-6.0, -6.0), (42.0, 42.0), 0.3)]
    )
    whole = NavigableSpace.from_scene(scene, up="+z")
    assert whole.kind.kind == "open place"
    assert not whole.contains(rooms).any()
    squares: list[Facts] = [
        {"low": [12.0 * x - 6.0, -6.0], "high": [12.0 * x + 6.0, 42.0], "axes": [0, 1], "up": "+z"} for x in range(4)
    ]
    parcels = [(1, mixed_space(rows_near([scene], each), each, 0.15)) for each in squares]
    joined = join_parcels(whole, parcels)
    assert joined.contains(rooms).all()
    assert joined.contains([[6.0, 6.0, 1.5]]).all()  # on the ground between them


def test_an_object_stays_one() -> None:
    space = NavigableSpace.from_scene(statue(), up="+z")
    assert space.kind.kind == "object"
    assert find_in_parcels(statue(), space, most=3000) is space


def test_a_scene_of_one_parcel_is_not_looked_at_again(whole: NavigableSpace) -> None:
    assert find_in_parcels(flats(), whole, most=10**8) is whole


def test_without_any_place_in_parcels_the_space_stays(whole: NavigableSpace) -> None:
    assert join_parcels(whole, [(100, None), (50, None)]) is whole


def test_clean_keeps_all_flats(joined: NavigableSpace) -> None:
    found = clean(flats(), navigable=joined, config=LIGHT)
    assert found.kept.mean() > 0.9


def clean_flats(folder: Path, g: Gaussians) -> NDArray[np.uint8]:
    """The classes that cleaning in tiles finds."""
    save_scene(g, folder / "flats.ply")
    tiling, store = TilingConfig(3000, up="+z"), open_store(folder / "work")
    found = clean_large((str(folder / "flats.ply"), None), LIGHT, tiling, store)
    assert found.tiles >= 3
    return np.concatenate(list(found.classes()))


def test_clean_in_tiles_keeps_all_flats_in_any_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsvis.edit.tiles.parcels_of", partial(parcels_of, most=2000))
    monkeypatch.setattr("gsvis.edit.places.VOXELS", VOXELS)
    above = flats()[:40].transform(np.eye(3), (0.0, 0.0, 400.0), 1.0)  # in no tile
    scene = Gaussians.concatenate([flats(), above])
    classes = clean_flats(tmp_path, scene)
    assert (classes == 0).mean() > 0.9  # all but what the boxes stand on
    monkeypatch.setattr(batches, "ROWS", 4000)
    turn = np.random.default_rng(3).permutation(len(scene))
    (tmp_path / "again").mkdir()
    np.testing.assert_array_equal(clean_flats(tmp_path / "again", scene[turn]), classes[turn])
