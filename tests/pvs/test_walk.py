"""Where a walker's feet can be: on the ground, off the walls, up stairs, and the same wherever the scene is turned."""

from __future__ import annotations

import json
import zlib

import numpy as np
import pytest

from gsvis.io.convert import rotation_about_axes
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.walk import WalkGrid, find_walk
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace

F64 = np.ndarray
STEP = 0.1
ROOM = ((0.0, 0.0, 0.0), (8.0, 4.0, 2.8))
WALL = ((3.9, 0.0, 0.0), (4.1, 3.0, 2.8))  # leaves a door of a meter
TABLE = ((5.5, 0.2, 0.7), (6.5, 1.2, 0.8))


def sides_of(low: tuple[float, ...], high: tuple[float, ...]) -> F64:
    """Return points (P, 3) on the sides of a box, a step apart."""
    axes = [np.arange(a, b + STEP / 2, STEP) for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return points[np.any((points < np.array(low) + STEP / 2) | (points > np.array(high) - STEP / 2), axis=1)]


def solid_scene(*boxes: tuple[tuple[float, ...], tuple[float, ...]]) -> Gaussians:
    """Return opaque balls on the sides of boxes."""
    means = np.concatenate([sides_of(*box) for box in boxes])
    n = len(means)
    quats = np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
    return Gaussians(means, quats, np.full((n, 3), 0.6 * STEP), np.full(n, 0.95), np.zeros((n, 1, 3)))


def cells_in(low: tuple[float, ...], high: tuple[float, ...]) -> CellGrid:
    return CellGrid.over(NavigableSpace.from_box(low, high, 32))


def stands(walk: WalkGrid, point: tuple[float, ...]) -> bool:
    """Return whether a walker can stand near a point of the ground."""
    x, y, z = np.floor((np.array(point) - walk.origin) @ walk.axes.T / walk.size).astype(int)
    inside = 0 <= x < walk.open.shape[0] and 0 <= y < walk.open.shape[1]
    return bool(inside and walk.open[x, y, max(z - 2, 0) : z + 3].any())


def test_a_walker_is_in_both_rooms_and_in_the_door_not_in_the_wall_nor_in_the_table() -> None:
    walk = find_walk(solid_scene(ROOM, WALL, TABLE), cells_in(*ROOM), 1.0)
    assert walk is not None
    assert walk.eye == pytest.approx(1.6)
    for place in ((1.0, 2.0, 0.1), (7.0, 3.0, 0.1), (4.0, 3.5, 0.1)):
        assert stands(walk, place), place
    for place in ((4.0, 1.5, 0.1), (3.7, 1.5, 0.1), (0.1, 2.0, 0.1), (6.0, 0.7, 0.1)):
        assert not stands(walk, place), place


def test_the_height_of_an_eye_follows_the_rooms_where_no_unit_is_known() -> None:
    scene = solid_scene(ROOM, WALL)
    one = find_walk(scene, cells_in(*ROOM))
    ten = find_walk(scene.transform(np.eye(3), scale=10.0), cells_in(*(tuple(10.0 * x for x in c) for c in ROOM)))
    assert one is not None
    assert ten is not None
    assert 1.3 < one.eye < 1.8
    assert ten.eye == pytest.approx(10.0 * one.eye)
    assert np.array_equal(one.open, ten.open)


def test_stairs_lead_up_and_a_hole_in_the_ground_is_closed() -> None:
    steps = [((2.0 + 0.3 * k, 0.0, 0.0), (6.0, 4.0, 0.17 * (k + 1))) for k in range(6)]
    scene = solid_scene(((0.0, 0.0, 0.0), (6.0, 4.0, 4.0)), *steps)
    hole = np.linalg.norm(scene.means - [1.0, 2.0, 0.0], axis=1) < 0.5
    walk = find_walk(scene[~hole], cells_in((0.0, 0.0, 0.0), (6.0, 4.0, 4.0)), 1.0)
    assert walk is not None
    assert stands(walk, (1.0, 2.0, 0.1))
    standing = walk.open & ~np.pad(walk.open, ((0, 0), (0, 0), (1, 0)))[:, :, :-1]
    heights = np.where(standing.any(axis=2), standing.argmax(axis=2), -1)
    middle = heights[:, heights.shape[1] // 2]
    assert np.ptp(middle[middle >= 0]) * walk.size == pytest.approx(6 * 0.17, abs=0.2)
    assert np.abs(np.diff(middle[middle >= 0])).max() <= walk.step


def test_a_turned_scene_is_walked_alike() -> None:
    scene = solid_scene(ROOM, WALL)
    turn = rotation_about_axes((90.0, 0.0, 0.0))
    box = np.array(ROOM) @ turn.T
    space = NavigableSpace.from_box(box.min(axis=0), box.max(axis=0), 32, up=turn[:, 2])
    plain = find_walk(scene, cells_in(*ROOM), 1.0)
    turned = find_walk(scene.transform(turn), CellGrid.over(space), 1.0)
    assert plain is not None
    assert turned is not None
    assert np.allclose(turned.axes[2], turn[:, 2])
    assert turned.open.sum() == pytest.approx(plain.open.sum(), rel=0.05)
    assert stands(turned, tuple(turn @ [1.0, 2.0, 0.1]))


def test_an_object_is_walked_around_on_its_own_foot() -> None:
    scene = solid_scene(((-0.5, -0.5, 0.0), (0.5, 0.5, 1.0)))
    walk = find_walk(scene, CellGrid.over(NavigableSpace.around(scene, up="+z")))
    assert walk is not None
    assert stands(walk, (1.0, 0.0, 0.0))
    assert not stands(walk, (0.0, 0.0, 0.0))


def test_bytes_hold_the_grid() -> None:
    walk = WalkGrid(np.array([1.0, 2.0, 3.0]), 0.1, np.eye(3), 1.6, 3, np.random.default_rng(0).random((3, 5, 7)) < 0.5)
    head, _, bits = zlib.decompress(walk.to_bytes()).partition(b"\n")
    said = json.loads(head)
    assert (said["shape"], said["step"], said["eye"]) == ([3, 5, 7], 3, 1.6)
    x, y, z = 2, 1, 4
    at = x + 3 * (y + 5 * z)
    assert bool(bits[at >> 3] >> (at & 7) & 1) == walk.open[x, y, z]
    assert len(bits) == -(-3 * 5 * 7 // 8)


def test_nobody_walks_where_no_body_fits() -> None:
    low = ((0.0, 0.0, 0.0), (4.0, 4.0, 1.0))
    assert find_walk(solid_scene(low), cells_in(*low), 1.0) is None
