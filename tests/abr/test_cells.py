"""Cells from real stores, as they stand and in another order of records."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gsvis.abr.cells import StoreCells, class_weights, term_places
from gsvis.pvs import CellGrid, VisibilityStore
from gsvis.pvs.codec import ids_of
from gsvis.pvs.store import CellSet, StoreInfo, write_store


def test_members_are_those_of_the_store_in_any_order(tmp_path: Path) -> None:
    rng, count, cells = np.random.default_rng(0), 500, 4
    coords = np.array([[k, 0, 0] for k in range(cells)], np.int32)
    grid = CellGrid(np.zeros(3), 1.0, (cells, 1, 1), coords, np.array([0.0, 0.0, 1.0]))
    edges = np.array([0.004, 0.016, 0.064])
    seen = [np.flatnonzero(rng.random(count) < 0.3) for _ in range(cells)]
    sets = [CellSet(ids, rng.integers(0, 3, len(ids)).astype(np.uint8)) for ids in seen]
    info = StoreInfo(count, "0" * 64, 0.004, edges, {})
    path = tmp_path / "some.pvs"
    write_store(path, grid, info, sets, np.zeros((count, 10), np.uint8))
    with VisibilityStore.open(path) as store:
        order = rng.permutation(count)
        plain, turned = StoreCells(store), StoreCells(store, order=order, max_bytes=1)
        for cell in (0, 3, 1, 2, 0):
            members = plain.members(cell)
            assert np.array_equal(ids_of(members.words), seen[cell])
            assert np.array_equal(members.classes, sets[cell].classes)
            moved = turned.members(cell)
            places = ids_of(moved.words)
            assert np.array_equal(np.sort(order[places]), seen[cell])
            back = np.argsort(order[places])
            assert np.array_equal(moved.classes[back], sets[cell].classes)
            assert len(plain.terms(cell)) == 0
        assert class_weights(store) == pytest.approx([0.008, 0.032, np.sqrt(0.064)], rel=1e-5)
        with pytest.raises(ValueError, match=r"^order"):
            StoreCells(store, order=np.zeros(count, np.int64))


def test_terms_go_with_their_gaussians() -> None:
    offsets = np.array([0, 2, 2, 5, 6])
    places = term_places(np.array([2, 0, 3, 1]), offsets)
    assert places.tolist() == [3, 4, 0, 1, 2, 5]
