"""Cells and the part of a space along a walk: a partition of the free voxels, whatever the space looks like."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsvis.errors import SceneError
from gsvis.pvs import CellGrid
from gsvis.scene.corridor import corridor, space_along
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.procedural import two_rooms

UP = np.array([0.0, 0.0, 1.0])


def some_space(seed: int, share: float = 0.4) -> NavigableSpace:
    rng = np.random.default_rng(seed)
    shape = rng.integers(1, 14, size=3)
    free = rng.random(shape) < share
    free[tuple(rng.integers(shape))] = True
    return NavigableSpace(rng.normal(0, 50, 3), float(rng.uniform(0.01, 3.0)), free, UP)


def centers_of(space: NavigableSpace) -> np.ndarray:
    return space.origin + space.voxel_size * (np.argwhere(space.free) + 0.5)


SPACES = st.builds(some_space, st.integers(0, 10_000))


@given(SPACES, st.integers(1, 60))
def test_every_free_voxel_lies_in_one_cell_and_no_cell_is_without(space: NavigableSpace, most: int) -> None:
    grid = CellGrid.over(space, max_cells=most)
    assert 1 <= len(grid) <= most
    centers = centers_of(space)
    cells = grid.cell_at(centers)
    assert (cells >= 0).all()
    assert set(cells.tolist()) == set(range(len(grid)))
    corners = np.array([grid.bounds(int(cell)) for cell in cells])
    assert (corners[:, 0] <= centers).all()
    assert (centers <= corners[:, 1]).all()


@given(SPACES)
def test_cells_are_the_smallest_that_the_cap_allows(space: NavigableSpace) -> None:
    grid = CellGrid.over(space, max_cells=10)
    side = round(grid.cell_size / space.voxel_size)
    if side > 1:
        finer = np.unique(np.argwhere(space.free) // (side - 1), axis=0)
        assert len(finer) > 10


@given(SPACES, st.integers(0, 1000))
def test_bounds_and_cell_at_are_inverse(space: NavigableSpace, seed: int) -> None:
    grid = CellGrid.over(space, max_cells=20)
    rng = np.random.default_rng(seed)
    for cell in range(len(grid)):
        low, high = grid.bounds(cell)
        inside = low + (high - low) * rng.uniform(0.001, 0.999, (20, 3))
        assert (grid.cell_at(inside) == cell).all()
        assert np.allclose(grid.centers[cell], 0.5 * (low + high))
    far = grid.origin + rng.normal(0, 1e6, (20, 3)) * grid.cell_size
    for point, cell in zip(far, grid.cell_at(far), strict=True):
        if cell >= 0:
            low, high = grid.bounds(int(cell))
            assert ((low <= point) & (point <= high)).all()


@given(SPACES)
def test_neighbors_touch_and_gaps_are_distances(space: NavigableSpace) -> None:
    grid = CellGrid.over(space, max_cells=30)
    gaps = np.array([grid.gaps(cell) for cell in range(len(grid))])
    assert np.array_equal(gaps, gaps.T)
    assert (np.diag(gaps) == 0).all()
    for cell in range(len(grid)):
        neighbors = grid.neighbors(cell)
        assert (np.diff(neighbors) > 0).all()
        assert set(neighbors.tolist()) == set(np.flatnonzero(gaps[cell] == 0).tolist()) - {cell}
    for a in range(min(len(grid), 6)):
        for b in range(len(grid)):
            (low_a, high_a), (low_b, high_b) = grid.bounds(a), grid.bounds(b)
            apart = np.maximum(np.maximum(low_b - high_a, low_a - high_b), 0.0)
            assert gaps[a, b] == pytest.approx(np.linalg.norm(apart), abs=1e-9 * np.abs(low_a).max())


def test_a_size_is_rounded_to_voxels_and_bounded() -> None:
    space = NavigableSpace.from_box((0, 0, 0), (8, 8, 4), 16)
    assert CellGrid.over(space, cell_size=2.1).cell_size == pytest.approx(2.0)
    assert CellGrid.over(space, cell_size=0.001, max_cells=10_000).cell_size == pytest.approx(0.5)
    assert len(CellGrid.over(space, max_cells=1)) == 1
    with pytest.raises(ValueError, match="expected at most 10 cells, got 256 of side 1"):
        CellGrid.over(space, max_cells=10, cell_size=1.0)


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"max_cells": 0}, "max_cells"),
        ({"max_cells": 2.5}, "max_cells"),
        ({"cell_size": 0.0}, "cell_size"),
        ({"cell_size": float("nan")}, "cell_size"),
        ({"cell_size": -1.0}, "cell_size"),
    ],
)
def test_bad_sizes_are_refused(bad: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        CellGrid.over(NavigableSpace.from_box((0, 0, 0), (1, 1, 1), 4), **bad)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"coords": np.array([[0, 0, 0], [0, 0, 0]])}, "once"),
        ({"coords": np.array([[1, 0, 0], [0, 0, 0]])}, "lexicographic"),
        ({"coords": np.array([[0, 0, 2]])}, "inside a grid"),
        ({"coords": np.array([[0, -1, 0]])}, "inside a grid"),
        ({"coords": np.array([[0.5, 0, 0]])}, "coords"),
        ({"coords": np.zeros((1, 2), int)}, "coords"),
        ({"cell_size": 0.0}, "cell_size"),
        ({"cell_size": float("inf")}, "cell_size"),
        ({"origin": np.array([0.0, np.nan, 0.0])}, "origin"),
        ({"shape": (2, 2)}, "shape"),
        ({"shape": (2, 0, 2)}, "inside a grid"),
        ({"up": np.zeros(3)}, "up"),
    ],
)
def test_bad_grids_are_refused(change: dict[str, Any], message: str) -> None:
    good = {
        "origin": np.zeros(3),
        "cell_size": 1.0,
        "shape": (2, 2, 2),
        "coords": np.array([[0, 0, 0], [1, 1, 1]]),
        "up": UP,
    }
    assert len(CellGrid(**good)) == 2
    with pytest.raises(ValueError, match=message):
        CellGrid(**{**good, **change})


def test_no_cell_and_no_such_cell() -> None:
    with pytest.raises(SceneError, match="no cell"):
        CellGrid(np.zeros(3), 1.0, (1, 1, 1), np.zeros((0, 3), int), UP)
    grid = CellGrid.over(NavigableSpace.from_box((0, 0, 0), (1, 1, 1), 4), max_cells=8)
    for bad in (-1, 8, 1.0, True, None):
        with pytest.raises(ValueError, match=r"expected a number in \[0, 7\]"):
            grid.bounds(bad)  # type: ignore[arg-type]
    assert grid.cell_at([[1e300, 0, 0], [-1e300, 0, 0], [0.1, 0.1, 0.1]]).tolist() == [-1, -1, 0]
    with pytest.raises(ValueError, match="positions"):
        grid.cell_at([[np.nan, 0, 0]])


def test_outliers_far_away_do_not_blow_up_the_grid() -> None:
    made = two_rooms(4000, sh_degree=0)
    g = made.gaussians
    rng = np.random.default_rng(0)
    far = rng.normal(0, 1, (8, 3))
    far *= 1e4 * 8.0 / np.linalg.norm(far, axis=1, keepdims=True)
    strays = Gaussians(
        far, np.tile([1.0, 0, 0, 0], (8, 1)), np.full((8, 3), 0.05), np.full(8, 0.9), np.zeros((8, 1, 3))
    )
    plain = CellGrid.over(NavigableSpace.from_scene(g), max_cells=64)
    with_strays = CellGrid.over(NavigableSpace.from_scene(Gaussians.concatenate([g, strays])), max_cells=64)
    assert np.linalg.norm(with_strays.centers - g.means.mean(axis=0), axis=1).max() < 20.0
    assert 0.5 < with_strays.cell_size / plain.cell_size < 2.0


def test_a_corridor_is_the_free_space_near_the_walk() -> None:
    room = NavigableSpace.from_box((0, 0, 0), (4, 4, 4), 40)
    walk = np.array([[0.55, 2.05, 2.05], [3.55, 2.05, 2.05]])
    found = corridor(room, walk, 0.5)
    centers = centers_of(found)
    along = np.clip(centers[:, 0], 0.55, 3.55)
    apart = np.linalg.norm(centers - np.stack([along, *np.full((2, len(along)), 2.05)], axis=1), axis=1)
    assert apart.max() <= 0.5 + 1.5 * room.voxel_size
    assert found.contains(np.linspace(*walk, 200)).all()
    assert (found.free <= room.free).all()
    wider = corridor(room, walk, 0.8)
    assert (found.free <= wider.free).all()
    assert found.volume < wider.volume < room.volume
    assert corridor(room, walk[:1], 0.2).volume < 0.2
    assert "along a path" in found.rule


def test_a_corridor_stays_out_of_walls() -> None:
    made = two_rooms(1000, sh_degree=0)
    walk = np.array([[2.0, 2.0, 1.5], [6.0, 2.0, 1.5]])
    found = corridor(made.navigable, walk, 0.4)
    assert (found.free <= made.navigable.free).all()


def test_eyes_along_a_walk_are_clear_near_it_and_fewer_for_a_smaller_margin() -> None:
    g = two_rooms(1000, sh_degree=0).gaussians
    walk = np.linspace([1.0, 2.0, 1.5], [7.0, 2.0, 1.5], 25)
    found, wider = space_along(g, walk, 0.4, up="+z"), space_along(g, walk, 0.8, up="+z")
    centers = centers_of(found)
    assert np.linalg.norm(centers[:, None] - walk, axis=2).min(axis=1).max() <= 0.4
    assert not (found.free & found.occupied).any()
    assert (found.free <= wider.free).all()
    assert found.volume < wider.volume


def test_eyes_are_along_a_walk_in_a_room_and_outside_of_it() -> None:
    g = two_rooms(1000, sh_degree=0).gaussians
    walk = np.concatenate([np.linspace([1.0, 2.0, 1.5], [3.0, 2.0, 1.5], 9), [[-1.0, -1.0, 1.5]]])
    found = space_along(g, walk, 0.4, up="+z")
    assert found.contains(walk).all()


def test_a_walk_along_which_nothing_is_clear_is_refused() -> None:
    g = two_rooms(1000, sh_degree=0).gaussians
    for bad in (0.0, -1.0, np.inf, np.nan):
        with pytest.raises(ValueError, match="margin"):
            space_along(g, [[2.0, 2.0, 1.5]], bad)
    with pytest.raises(ValueError, match="positions"):
        space_along(g, np.zeros((0, 3)), 1.0)
    with pytest.raises(SceneError, match="navigable"):
        space_along(g, [[2.0, 2.0, 1.5]], 1e-4)


def test_a_walk_of_another_frame_is_refused() -> None:
    room = NavigableSpace.from_box((0, 0, 0), (4, 4, 4), 16)
    with pytest.raises(ValueError, match=r"path: expected positions in the navigable space.*got 33%.*retarget"):
        corridor(room, [[1, 1, 1], [90, 1, 1], [1e12, 2, 2]])
    for bad in (0.0, -1.0, np.inf, np.nan):
        with pytest.raises(ValueError, match="margin"):
            corridor(room, [[1, 1, 1]], bad)
    with pytest.raises(ValueError, match="positions"):
        corridor(room, np.zeros((0, 3)))
