"""Viewpoints: inside the free part of their cell, spread before all else, and prefixes of one another."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsvis.pvs import CellGrid, CellViewpoints
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.procedural import two_rooms


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
