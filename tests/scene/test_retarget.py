"""Walks brought into scenes: whatever frame they were recorded in, and where they may and may not end up."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from gsvis.io.poses import load_path
from gsvis.io.scenes import load_scene
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.paths import HeadPath
from gsvis.scene.procedural import two_rooms
from gsvis.scene.retarget import RetargetConfig, RetargetedPath, retarget
from gsvis.scene.similarity import Similarity

F64 = NDArray[np.float64]


def stroll(up: int = 1, size: float = 1.0, meters: float | None = 1.0, shift: float = 0.0) -> HeadPath:
    """A figure of eight with +`up` up, 3 `size` long, looking about."""
    t = np.linspace(0.0, 20.0, 401)
    turn = 2.0 * np.pi * t / 20.0
    flat = [1.5 * size * np.sin(turn) + shift, 0.7 * size * np.sin(2.0 * turn) + 0.1 * size * turn]
    positions = np.insert(np.stack(flat, axis=1), up, 0.05 * size * np.sin(5.0 * turn) + shift, axis=1)
    axis = np.eye(3)[up]
    level = {0: [1.0, 0.0, 0.0, 1.0], 1: [0.0, 1.0, 0.0, 0.0], 2: [1.0, -1.0, 0.0, 0.0]}[up]  # camera -y along +up
    quats = [_product(np.array([np.cos(a / 2), *np.sin(a / 2) * axis]), np.array(level)) for a in turn]
    return HeadPath(t, positions, np.array(quats), up=axis, meters_per_unit=meters)


def _product(a: F64, b: F64) -> F64:
    return np.array([a[0] * b[0] - a[1:] @ b[1:], *(a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:]))])


def hall(shape: tuple[int, int, int] = (60, 50, 26), up: int = 2, origin: float = 0.0) -> NavigableSpace:
    """A hall of 6 x 5 x 2.6 units in voxels of 0.1, its floor one voxel thick, the rest free but for the walls."""
    occupied = np.ones(shape, bool)
    occupied[1:-1, 1:-1, 1:-1] = False
    free = ~occupied
    order = {2: (0, 1, 2), 1: (0, 2, 1), 0: (2, 0, 1)}[up]
    return NavigableSpace(
        np.full(3, origin), 0.1, np.transpose(free, order), np.eye(3)[up], np.transpose(occupied, order)
    )


def checked(found: RetargetedPath, path: HeadPath, space: NavigableSpace) -> RetargetedPath:
    """What holds for all: the path is the similarity of the recording, upright, and the share is the share."""
    moved = found.similarity.apply(path.positions)
    assert found.inside == pytest.approx(float(space.contains(moved).mean()))
    if not found.moved:
        assert np.allclose(found.path.positions, moved)
    assert np.array_equal(found.path.times, path.times)
    assert np.allclose(found.path.forwards, path.forwards @ found.similarity.rotation.T, atol=1e-7)
    assert np.allclose(found.similarity.rotation @ path.upright, space.up, atol=1e-7)
    assert json.loads(json.dumps(found.as_dict()))["rule"] == found.rule
    return found


def floor_of(space: NavigableSpace) -> float:
    """Height of the top of the floor of `hall`."""
    return float(space.origin @ space.up) + space.voxel_size


def test_the_natural_scale_stands_on_the_floor() -> None:
    space = hall()
    for meters, scene in ((1.0, 1.0), (0.5, 1.0), (1.0, 1.25)):
        path = stroll(size=1.0 / meters, meters=meters)
        found = checked(retarget(path, space, RetargetConfig(meters_per_unit=scene)), path, space)
        assert found.similarity.scale == pytest.approx(meters / scene)
        assert found.inside >= 0.99
        assert found.rule == "natural scale, standing with the eyes at 1.6 m"
        eyes = float(np.median(found.path.positions @ space.up)) - floor_of(space)
        assert eyes * scene == pytest.approx(1.6, abs=0.25)
        assert found.path.meters_per_unit == scene


def test_the_largest_scale_fills_the_space_and_is_the_largest() -> None:
    space = hall()
    path = stroll(meters=None)
    found = checked(retarget(path, space), path, space)
    assert found.inside >= 0.99
    assert found.rule.startswith("largest scale")
    extent = np.sort(np.ptp(found.path.positions, axis=0))
    assert 4.0 < extent[-1] <= np.hypot(6.0, 5.0)
    much_larger = retarget(path, space, RetargetConfig(scale=2.0 * found.similarity.scale))
    assert much_larger.inside < 0.99
    largest = retarget(path, space, RetargetConfig(shrink=1.0)).similarity.scale
    assert 0.7 * largest <= found.similarity.scale <= largest
    assert retarget(path, space, RetargetConfig(enough=0.7, shrink=1.0)).similarity.scale >= largest


def test_with_meters_the_largest_scale_still_stands() -> None:
    space = hall()
    path = stroll()
    found = checked(retarget(path, space), path, space)
    assert "standing" in found.rule
    eyes = float(np.median(found.path.positions @ space.up)) - floor_of(space)
    assert eyes / found.similarity.scale == pytest.approx(1.6, abs=0.16 + 0.1 / found.similarity.scale)


@settings(max_examples=8)
@given(st.integers(0, 2**31), st.sampled_from([None, 1.0]))
def test_the_frame_of_the_recording_is_forgotten(seed: int, meters: float | None) -> None:
    rng = np.random.default_rng(seed)
    path = stroll(meters=meters)
    other = path.transform(Similarity(float(np.exp(rng.normal())), rng.normal(size=4), 5 * rng.normal(size=3)))
    space = hall((30, 25, 26))
    config = RetargetConfig(placements=256, yaws=8, seed=seed, keep=False, meters_per_unit=meters)
    here, there = (retarget(p, space, config) for p in (path, other))
    assert np.allclose(here.path.positions, there.path.positions, atol=1e-6)
    assert np.allclose(here.path.forwards, there.path.forwards, atol=1e-6)
    assert here.rule == there.rule


def test_a_moved_scene_moves_the_walk() -> None:
    path = stroll()
    here, there = retarget(path, hall()), retarget(path, hall(origin=64.0))
    assert np.allclose(here.path.positions + 64.0, there.path.positions)
    assert here.similarity.scale == there.similarity.scale


@pytest.mark.parametrize("recorded", [0, 1, 2])
@pytest.mark.parametrize("scene", [0, 1, 2])
def test_up_goes_to_up(recorded: int, scene: int) -> None:
    path, space = stroll(up=recorded, meters=None), hall(up=scene)
    found = checked(retarget(path, space, RetargetConfig(scale=1.0, keep=False)), path, space)
    assert found.inside >= 0.99
    assert np.allclose(found.path.head_ups, space.up, atol=1e-6)
    upside_down = replace(space, up=-space.up)
    assert np.allclose(
        retarget(path, upside_down, RetargetConfig(scale=0.5, keep=False)).path.head_ups, -space.up, atol=1e-6
    )


def test_a_walk_that_is_inside_stays() -> None:
    space = hall()
    path = retarget(stroll(), space, RetargetConfig(seed=3)).path
    again = retarget(path, space)
    assert again.rule.startswith("kept")
    assert np.array_equal(again.path.positions, path.positions)
    assert again.similarity.as_dict() == Similarity().as_dict()
    assert not retarget(path, space, RetargetConfig(keep=False)).rule.startswith("kept")
    tilted = path.transform(Similarity(quat=np.array([1.0, 0.05, 0.0, 0.0])))
    assert not retarget(tilted, space).rule.startswith("kept")


def test_seeds_are_places_and_the_same_seed_the_same_place() -> None:
    space, path = hall((120, 90, 26)), stroll()
    config = RetargetConfig(meters_per_unit=1.0)
    found = [retarget(path, space, replace(config, seed=seed)).path.positions[0] for seed in (0, 0, 1, 2)]
    assert np.array_equal(found[0], found[1])
    assert len({tuple(place) for place in found}) == 3


def test_what_is_outside_is_reported_and_moved_on_request() -> None:
    space = hall()
    path = stroll(meters=None)
    placed = checked(retarget(path, space, RetargetConfig(scale=3.0)), path, space)
    assert 0.3 < placed.inside < 0.99
    assert placed.moved == 0
    moved = checked(retarget(path, space, RetargetConfig(scale=3.0, project=True)), path, space)
    assert space.contains(moved.path.positions).all()
    assert moved.moved == round((1.0 - placed.inside) * len(path))
    assert np.array_equal(moved.similarity.translation, placed.similarity.translation)
    steps = np.linalg.norm(moved.path.positions - placed.path.positions, axis=1)
    assert np.count_nonzero(steps) == moved.moved
    assert moved.farthest_move == pytest.approx(steps.max())
    assert "nearest navigable voxel" in moved.rule


def test_nobody_stands_on_the_roof_where_there_is_a_floor() -> None:
    low = hall((60, 50, 52))
    occupied, free = low.occupied.copy(), low.free.copy()
    occupied[:, :, 26] = True  # a ceiling, with as free a loft above it
    free[:, :, 26] = False
    free[:, :, 27:] &= np.arange(60)[:, None, None] < 40  # but smaller
    space = NavigableSpace(low.origin, low.voxel_size, free, low.up, occupied)
    for seed in range(6):
        found = retarget(stroll(), space, RetargetConfig(meters_per_unit=1.0, seed=seed))
        assert found.path.positions[:, 2].max() < 2.6


def test_of_all_headings_it_takes_one_that_looks_at_the_scene() -> None:
    shape = (40, 40, 12)
    occupied = np.zeros(shape, bool)
    occupied[:, :2] = True  # a wall along x at low y; all else is open
    free = np.zeros(shape, bool)
    free[4:-4, 6:-4, 2:-2] = True
    space = NavigableSpace(np.zeros(3), 0.1, free, np.array([0.0, 0.0, 1.0]), occupied)
    staring = stroll(meters=None, up=2)
    staring = HeadPath(staring.times, staring.positions, np.tile(staring.quats[0], (len(staring), 1)), up=staring.up)
    for seed in range(4):
        found = retarget(staring, space, RetargetConfig(scale=0.3, seed=seed))
        assert found.inside >= 0.99
        assert np.all(found.path.forwards[:, 1] < -0.3)
        assert found.looking == 1.0


def test_without_floor_or_room_it_floats_or_shrinks_but_comes_to_an_end() -> None:
    air = NavigableSpace.from_box([0, 0, 0], [1, 1, 1], 16)
    found = retarget(stroll(), air)
    assert found.inside >= 0.99
    assert "floating" in found.rule
    assert found.looking == 0.0  # there is nothing to look at
    assert "floating" in retarget(stroll(), air, RetargetConfig(meters_per_unit=1.0)).rule
    one = NavigableSpace(np.zeros(3), 1.0, np.ones((1, 1, 1), bool), np.array([0.0, 0.0, 1.0]))
    assert retarget(stroll(size=100.0), one).inside == 1.0
    still = HeadPath([0.0], [[5.0, 5.0, 5.0]], [[1.0, 0, 0, 0]])  # type: ignore[arg-type]
    assert retarget(still, hall()).similarity.scale == 1.0
    straight_down = HeadPath([0.0], [[5.0, 5, 5]], [[1.0, 0, 0, 0]], up=np.array([0.0, 0.0, -1.0]))  # type: ignore[arg-type]
    assert retarget(straight_down, hall()).inside == 1.0


@pytest.mark.parametrize(
    "wrong",
    [
        {"scale": 0.0},
        {"meters_per_unit": np.inf},
        {"eye_height": -1.0},
        {"enough": 0.0},
        {"shrink": 2.0},
        {"yaws": 0},
        {"seed": -1},
    ],
)
def test_nonsense_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        RetargetConfig(**wrong)


@cache
def rooms() -> NavigableSpace:
    return two_rooms(2000, sh_degree=0).navigable


def test_a_built_in_scene() -> None:
    path = stroll()
    found = checked(retarget(path, rooms()), path, rooms())
    assert found.inside >= 0.99


@pytest.mark.slow
@pytest.mark.realdata
def test_recordings_walk_through_the_showroom_at_their_own_size(
    realdata: Path, real_space: Callable[[Gaussians], NavigableSpace]
) -> None:
    space = real_space(load_scene(realdata / "scenes" / "showroom" / "lod-meta.json", lod=3))
    for seed, name in enumerate(("room/user111_room", "room/user120_room", "truck/user107_truck")):
        path = load_path(realdata / "traces" / "eyenav_rutgers" / f"{name}.csv.gz").cut(0.0, 30.0)
        found = checked(retarget(path, space, RetargetConfig(meters_per_unit=1.0, seed=seed)), path, space)
        assert found.inside >= 0.99
        assert "standing" in found.rule
        assert 0.5 < float(np.median(found.path.positions[:, 2])) < 1.3  # the floor lies at -0.7
