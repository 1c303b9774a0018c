"""The floor of a walker is as even in a scene that lies askew as in one whose rooms lie along the axes."""

from __future__ import annotations

import numpy as np
import pytest

from gsvis.io.convert import rotation_about_axes
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.floor import floor_of_cells
from gsvis.scene.navigable import NavigableSpace

LOW, HIGH = np.array([0.0, 0.0, 0.0]), np.array([8.0, 5.0, 2.8])


@pytest.mark.parametrize("degrees", [(0.0, 0.0, 0.0), (45.0, 0.0, 20.0), (33.0, 20.0, -50.0), (0.0, 10.0, 0.0)])
def test_the_eye_of_a_walker_stays_at_its_height_in_a_room_that_lies_askew(degrees: tuple[float, ...]) -> None:
    turn = rotation_about_axes(degrees)
    corners = np.stack(np.meshgrid(*zip(LOW, HIGH, strict=True), indexing="ij"), axis=-1).reshape(-1, 3) @ turn.T
    box = NavigableSpace.from_box(corners.min(axis=0), corners.max(axis=0), 96, up=turn[:, 2])
    voxels = np.indices(box.free.shape).reshape(3, -1).T
    inside = box.origin + box.voxel_size * (voxels + 0.5)
    free = np.all((inside @ turn >= LOW) & (inside @ turn <= HIGH), axis=1).reshape(box.free.shape)
    grid = CellGrid.over(NavigableSpace(box.origin, box.voxel_size, free, turn[:, 2]), max_cells=400)
    found = floor_of_cells(grid, 1.0)
    eyes = np.random.default_rng(0).uniform([0.3, 0.3, 1.4], [7.7, 4.7, 1.4], (500, 3)) @ turn.T - found["origin"]
    column, row = (np.floor(eyes @ found[axis] / found["side"]).astype(int) for axis in ("first", "second"))
    heights = np.array(found["heights"], np.float64).reshape(found["rows"], found["columns"])
    walked = heights[row, column]
    assert np.isfinite(walked).all()
    assert np.abs(walked - 1.4).max() <= 0.6 * grid.cell_size
    assert np.ptp(walked) <= 0.7 * grid.cell_size
