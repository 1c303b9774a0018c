"""Bytes of a cell and of direction sets: no more than a store of one cell, and most of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gsvis.pvs.cells import CellGrid
from gsvis.pvs.coded_size import bytes_of_cell, bytes_of_directions
from gsvis.pvs.store import CellSet, StoreInfo, write_store
from gsvis.scene.navigable import NavigableSpace


def test_a_store_of_one_cell_takes_these_bytes_and_a_head(tmp_path: Path) -> None:
    rng, count = np.random.default_rng(0), 3000
    space = NavigableSpace.from_box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), 8)
    grid = CellGrid.over(space, max_cells=1)
    edges = np.array([0.01, 0.1, 0.5])
    ids = np.sort(rng.choice(count, 900, replace=False))
    classes, sets = rng.integers(0, 3, 900).astype(np.uint8), np.zeros((count, 10), np.uint8)
    sets[ids] = rng.integers(0, 256, (900, 10))
    info = StoreInfo(count, "0" * 64, 0.01, edges)
    path = write_store(tmp_path / "a.pvs", grid, info, [CellSet(ids, classes)], sets)
    coded = bytes_of_cell(ids, classes, count, len(edges)) + bytes_of_directions(sets)
    assert path.stat().st_size == pytest.approx(coded, abs=1500)
    assert coded > 9000
