"""Viewpoints: in the free part of their cell, spread before all else; shared ones near corners, for their cells."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsvis.pvs import CellGrid, CellViewpoints, SharedViewpoints
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.procedural import two_rooms

CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])


def some(seed: int) -> CellViewpoints:
    rng = np.random.default_rng(seed)
    free = rng.random(rng.integers(2, 12, size=3)) < 0.5
    free[0, 0, 0] = True
    space = NavigableSpace(rng.normal(0, 9, 3), float(rng.uniform(0.05, 2.0)), free, np.array([0.0, 0.0, 1.0]))
    return CellViewpoints(CellGrid.over(space, max_cells=9), space)


VIEWPOINTS = st.builds(some, st.integers(0, 10_000))


@given(VIEWPOINTS, st.integers(1, 30))
def test_they_are_in_their_cell_and_in_free_voxels(viewpoints: CellViewpoints, count: int) -> None:
    rng = np.random.default_rng(0)
    total = 0
    for cell in range(len(viewpoints.grid)):
        spread, drawn = viewpoints.spread(cell, count), viewpoints.draw(cell, count, rng)
        assert len(spread) == min(count, viewpoints.free_voxels(cell))
        assert len(drawn) == count
        for points in (spread, drawn):
            assert (viewpoints.grid.cell_at(points) == cell).all()
            assert viewpoints.space.contains(points).all()
        total += viewpoints.free_voxels(cell)
    assert total == np.count_nonzero(viewpoints.space.free)


@given(VIEWPOINTS)
def test_more_viewpoints_begin_with_the_fewer_and_none_comes_twice(viewpoints: CellViewpoints) -> None:
    for cell in range(len(viewpoints.grid)):
        many = viewpoints.spread(cell, 25)
        assert len(np.unique(many, axis=0)) == len(many)
        for count in (1, 2, 7):
            assert np.array_equal(viewpoints.spread(cell, count), many[:count])


@given(VIEWPOINTS)
def test_each_is_as_far_as_can_be_from_those_before(viewpoints: CellViewpoints) -> None:
    points = viewpoints.spread(0, 10_000)
    chosen = points[:8]
    for k in range(1, len(chosen)):
        apart = np.linalg.norm(points[:, None] - chosen[None, :k], axis=2).min(axis=1)
        assert apart[k] == pytest.approx(apart.max())


def test_opposite_corners_come_first_and_no_part_of_a_cell_is_left_out() -> None:
    space = NavigableSpace.from_box((0, 0, 0), (2, 2, 2), 10)
    points = CellViewpoints(CellGrid.over(space, max_cells=1), space).spread(0, 24)
    assert (np.abs(points[:2] - 1.0) > 0.9).all()
    assert (np.sign(points[0] - 1.0) == -np.sign(points[1] - 1.0)).all()
    assert len(np.unique(np.sign(points - 1.0), axis=0)) == 8


def test_draws_repeat_with_their_seed_and_fill_the_cell() -> None:
    made = two_rooms(1000, sh_degree=0)
    viewpoints = CellViewpoints(CellGrid.over(made.navigable, max_cells=4), made.navigable)
    first, second = (viewpoints.draw(1, 500, np.random.default_rng(5)) for _ in range(2))
    assert np.array_equal(first, second)
    low, high = viewpoints.grid.bounds(1)
    assert ((first.max(axis=0) - first.min(axis=0)) > 0.4 * np.minimum(high - low, 2.0)).all()
    assert viewpoints.draw(1, 0, np.random.default_rng(0)).shape == (0, 3)


def own_points(viewpoints: CellViewpoints, cell: int) -> np.ndarray:
    """(8, 3) the points that a cell would look from if it were alone."""
    return nearest_to_corners(viewpoints, cell)[0]


def nearest_to_corners(viewpoints: CellViewpoints, cell: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the points in the free voxels of a cell nearest to its corners, and their distances; one by one."""
    grid, space = viewpoints.grid, viewpoints.space
    rim = 0.05 * space.voxel_size
    found, apart = [], []
    for corner in grid.origin + grid.cell_size * (grid.coords[cell] + CORNERS):
        tried = []
        for voxel in viewpoints.voxels(cell).voxels:
            low = space.origin + space.voxel_size * voxel
            point = np.clip(corner, low + rim, low + space.voxel_size - rim)
            tried.append((round(float(np.linalg.norm(point - corner) / space.voxel_size), 4), *voxel, *point))
        nearest = min(tried)
        found.append(nearest[4:])
        apart.append(nearest[0])
    return np.array(found), np.array(apart)


@settings(max_examples=25)
@given(VIEWPOINTS)
def test_unmerged_each_cell_looks_from_its_own_free_points_nearest_to_its_corners(viewpoints: CellViewpoints) -> None:
    alone = SharedViewpoints(viewpoints, merged=0.0)
    for cell in range(len(viewpoints.grid)):
        points = alone.points[alone.of_cell(cell)]
        assert (viewpoints.grid.cell_at(points) == cell).all()
        assert viewpoints.space.contains(points).all()
        wanted = np.unique(np.round(own_points(viewpoints, cell), 9), axis=0)
        assert np.unique(np.round(points, 9), axis=0) == pytest.approx(wanted)


@settings(max_examples=25)
@given(VIEWPOINTS, st.floats(0.0, 5.0))
def test_a_shared_viewpoint_stands_for_points_within_the_merge_distance(
    viewpoints: CellViewpoints, merged: float
) -> None:
    shared = SharedViewpoints(viewpoints, merged=merged)
    near = merged * viewpoints.space.voxel_size * (1 + 1e-6)
    used = set()
    for cell in range(len(viewpoints.grid)):
        numbers = shared.of_cell(cell)
        used |= set(numbers.tolist())
        assert 1 <= len(numbers) <= 8
        assert (np.diff(numbers) > 0).all()
        apart = np.linalg.norm(own_points(viewpoints, cell)[:, None] - shared.points[numbers], axis=2)
        assert apart.min(axis=1).max() <= near + 1e-9  # each corner of the cell is looked from
        assert apart.min(axis=0).max() <= near + 1e-9  # and no viewpoint comes from elsewhere
    assert used == set(range(len(shared)))
    assert viewpoints.space.contains(shared.points).all()
    apart = np.linalg.norm(shared.points[:, None] - shared.points, axis=2)
    assert (apart[~np.eye(len(shared), dtype=bool)] > near * (1 - 1e-6)).all()  # what stands for others is not merged


@given(VIEWPOINTS, st.floats(0.0, 4.0))
def test_a_larger_merge_distance_leaves_every_cell_some_viewpoint(viewpoints: CellViewpoints, one: float) -> None:
    counts = [len(SharedViewpoints(viewpoints, merged=each)) for each in (one, 0.0)]
    assert counts[0] <= counts[1] <= 8 * len(viewpoints.grid)
    everything = SharedViewpoints(viewpoints, merged=1e6)
    assert len(everything) == 1
    assert all(everything.of_cell(cell).tolist() == [0] for cell in range(len(viewpoints.grid)))


@given(VIEWPOINTS, st.floats(0.25, 4.0), st.integers(-5, 5))
def test_shared_viewpoints_move_and_grow_with_the_space(viewpoints: CellViewpoints, factor: float, step: int) -> None:
    space, grid = viewpoints.space, viewpoints.grid
    offset = step * space.voxel_size
    moved = NavigableSpace(factor * space.origin + offset, factor * space.voxel_size, space.free, space.up)
    other = CellGrid(moved.origin, factor * grid.cell_size, grid.shape, grid.coords, grid.up)
    before, after = SharedViewpoints(viewpoints), SharedViewpoints(CellViewpoints(other, moved))
    assert after.points == pytest.approx(factor * before.points + offset, rel=1e-9, abs=1e-6 * space.voxel_size)
    for cell in range(len(grid)):
        assert np.array_equal(before.of_cell(cell), after.of_cell(cell))


@given(VIEWPOINTS)
def test_shared_viewpoints_of_one_space_are_always_the_same(viewpoints: CellViewpoints) -> None:
    once, again = SharedViewpoints(viewpoints), SharedViewpoints(CellViewpoints(viewpoints.grid, viewpoints.space))
    assert np.array_equal(once.points, again.points)


@settings(max_examples=25)
@given(VIEWPOINTS, st.integers(0, 3))
def test_voxels_of_a_cell_that_are_far_from_its_corners_change_nothing(viewpoints: CellViewpoints, seed: int) -> None:
    space = viewpoints.space
    side = round(viewpoints.grid.cell_size / space.voxel_size)
    free = space.free.copy()
    rng = np.random.default_rng(seed)
    used = set()
    for cell in range(len(viewpoints.grid)):
        points = own_points(viewpoints, cell)
        used |= set(map(tuple, np.floor((points - space.origin) / space.voxel_size).astype(int).tolist()))
    for voxel in np.argwhere(free).tolist():
        if tuple(voxel) not in used and rng.random() < 0.5:
            free[tuple(voxel)] = False
    fewer = NavigableSpace(space.origin, space.voxel_size, free, space.up)
    grid = CellGrid.over(fewer, cell_size=side * space.voxel_size, max_cells=1000)
    before, after = SharedViewpoints(viewpoints), SharedViewpoints(CellViewpoints(grid, fewer))
    assert np.array_equal(grid.coords, viewpoints.grid.coords)
    assert np.array_equal(before.points, after.points)


def test_cells_that_touch_at_a_free_corner_share_its_viewpoint() -> None:
    space = NavigableSpace.from_box((0, 0, 0), (2, 3, 1), 12)
    grid = CellGrid.over(space, cell_size=4 * space.voxel_size)
    side = round(grid.cell_size / space.voxel_size)
    assert side == 4
    assert all(n % side == 0 for n in space.free.shape)
    assert space.free.all()
    shared = SharedViewpoints(CellViewpoints(grid, space))
    corners = np.unique((grid.coords[:, None] + CORNERS).reshape(-1, 3), axis=0)
    assert len(shared) == len(corners)  # one for each corner of the grid
    places = (shared.points - grid.origin) / grid.cell_size
    assert np.round(places) == pytest.approx(places, abs=0.05)
    for one in range(len(grid)):
        assert len(shared.of_cell(one)) == 8
        for other in range(len(grid)):
            touching = np.abs(grid.coords[one] - grid.coords[other])
            common = np.intersect1d(shared.of_cell(one), shared.of_cell(other))
            assert len(common) == (2 ** int(np.count_nonzero(touching == 0)) if touching.max() <= 1 else 0)


def test_cells_without_a_free_corner_look_from_their_own_part() -> None:
    free = np.zeros((8, 4, 4), bool)
    free[1:3, 1:3, 1:3] = True  # the middle of the first cell
    free[4:] = True
    space = NavigableSpace((0.0, 0.0, 0.0), 1.0, free, np.array([0.0, 0.0, 1.0]))
    grid = CellGrid.over(space, cell_size=4.0)
    viewpoints = CellViewpoints(grid, space)
    shared = SharedViewpoints(viewpoints, merged=0.5)
    middle, whole = (shared.points[shared.of_cell(cell)] for cell in (0, 1))
    assert np.unique(middle) == pytest.approx([1.05, 2.95])
    assert np.unique(whole[:, 1:]) == pytest.approx([0.05, 3.95])
    assert np.unique(whole[:, 0]) == pytest.approx([4.05, 7.95])
    merged = SharedViewpoints(viewpoints, merged=4.0)
    assert merged.points[merged.of_cell(0)] == pytest.approx(np.full((1, 3), 1.05))  # its first corner stands for all


def test_free_voxels_are_those_of_the_cell_and_drawn_points_lie_in_them() -> None:
    viewpoints = some(3)
    space, rng = viewpoints.space, np.random.default_rng(0)
    for cell in range(len(viewpoints.grid)):
        voxels = viewpoints.voxels(cell)
        assert voxels.cell == cell
        assert space.free[tuple(voxels.voxels.T)].all()
        assert len(voxels.voxels) == viewpoints.free_voxels(cell)
        drawn = np.floor((voxels.draw(2000, rng) - space.origin) / space.voxel_size).astype(int)
        assert np.array_equal(np.unique(drawn, axis=0), voxels.voxels)  # each of them, sooner or later
        assert voxels.draw(0, rng).shape == (0, 3)
        with pytest.raises(ValueError, match="count"):
            voxels.draw(-1, rng)


def test_bad_counts_cells_and_spaces_are_refused() -> None:
    made = two_rooms(1000, sh_degree=0)
    grid = CellGrid.over(made.navigable, max_cells=4)
    viewpoints = CellViewpoints(grid, made.navigable)
    for bad in (0, -1, 1.5):
        with pytest.raises(ValueError, match="count"):
            viewpoints.spread(0, bad)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="cell"):
        viewpoints.spread(len(grid), 1)
    with pytest.raises(ValueError, match="cell"):
        viewpoints.draw(-1, 1, np.random.default_rng(0))
    with pytest.raises(ValueError, match="got none in cell 0; use the space of the grid"):
        CellViewpoints(grid, NavigableSpace.from_box((90, 90, 90), (91, 91, 91), 2))


def test_each_cell_has_at_least_half_of_its_viewpoints_fine_and_no_fine_one_is_spare() -> None:
    made = two_rooms(1000, sh_degree=0)
    viewpoints = CellViewpoints(CellGrid.over(made.navigable, max_cells=40), made.navigable)
    shared = SharedViewpoints(viewpoints)
    own = [shared.of_cell(cell) for cell in range(len(viewpoints.grid))]
    assert all(2 * np.count_nonzero(shared.fine[some]) >= len(some) for some in own)
    for k in np.flatnonzero(shared.fine):
        without = shared.fine.copy()
        without[k] = False
        assert any(2 * np.count_nonzero(without[some]) < len(some) for some in own if k in some)
    assert not shared.fine.all()
