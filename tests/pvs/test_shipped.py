"""Laws of shipped sets: nothing that is seen is missing, and cubes of cells share classes."""

from pathlib import Path

import numpy as np
import pytest

from gsvis.pvs import _order, codec
from gsvis.pvs._writer import CellSet, StoreInfo, write_store
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.completed import COMPLETE_FROM, Completion
from gsvis.pvs.shipped import write_shipped
from gsvis.pvs.store import VisibilityStore

GAUSSIANS = 6_000
EDGES = np.array([1 / 255, 0.02, 0.1, 0.5])


def two_rooms(path: Path, side: int = 4) -> VisibilityStore:
    """Return a store of `side`^3 cells in two rooms; a cell sees most of its room, and a little of the other."""
    rng = np.random.default_rng(side)
    coords = np.argwhere(np.ones((side, side, side), bool)).astype(np.int32)
    grid = CellGrid(np.zeros(3), 0.5, (side, side, side), coords, np.array([0.0, 0.0, 1.0]))
    rooms = np.arange(GAUSSIANS) % 2
    cells = []
    for coord in coords:
        own = rooms == (2 * coord[0] >= side)
        ids = np.flatnonzero(rng.random(GAUSSIANS) < np.where(own, 0.95, 0.02))
        missed, bound, tile = np.sort(rng.random(3))
        cells.append(CellSet(ids, rng.integers(0, 4, len(ids)).astype(np.uint8), 4, 1, 100, missed, bound, tile))
    sets = rng.integers(0, 256, (GAUSSIANS, 10)).astype(np.uint8)
    return VisibilityStore.open(write_store(path, grid, StoreInfo(GAUSSIANS, "made", 1 / 255, EDGES), cells, sets))


def mean_classes(store: VisibilityStore, cells: list[int]) -> dict[int, int]:
    """Return the mean class of each Gaussian that some cells see, halves up."""
    given: dict[int, list[int]] = {}
    for cell in cells:
        for gaussian, number in zip(*store.classes(cell), strict=True):
            given.setdefault(int(gaussian), []).append(int(number))
    return {gaussian: int(np.mean(numbers) + 0.5) for gaussian, numbers in given.items()}


@pytest.mark.parametrize("side", [1, 2, 3])
def test_cubes_of_cells_share_the_mean_of_their_classes(tmp_path: Path, side: int) -> None:
    with two_rooms(tmp_path / "own.pvs") as own:
        write_shipped(own, tmp_path / "shipped.pvs", side)
        cubes = [tuple(row) for row in (own.grid.coords // side).tolist()]
        with VisibilityStore.open(tmp_path / "shipped.pvs") as shipped:
            for cell in range(0, len(own), 9):
                mean = mean_classes(own, [k for k, cube in enumerate(cubes) if cube == cubes[cell]])
                ids, classes = shipped.classes(cell)
                assert classes.tolist() == [mean.get(int(i), 0) for i in ids]


def test_a_shipped_set_has_all_that_a_cell_sees_and_is_smaller(tmp_path: Path) -> None:
    with two_rooms(tmp_path / "own.pvs") as own:
        write_shipped(own, tmp_path / "shipped.pvs")
        with VisibilityStore.open(tmp_path / "shipped.pvs") as shipped:
            shipped.verify()
            assert (shipped.direction_sets == own.direction_sets).all()
            assert np.array_equal(shipped.certificates.bound, own.certificates.bound)
            assert np.array_equal(shipped.viewpoints, own.viewpoints)
            assert shipped.ever_visible() == own.ever_visible()
            for cell in range(len(own)):
                assert own.visible(cell) <= shipped.visible(cell)
            added = shipped.visible_counts.sum() / own.visible_counts.sum() - 1.0
            assert 0.0 < added < 0.1
            assert shipped.sizes()["sets"] < 0.8 * own.sizes()["sets"]


def test_classes_are_read_from_a_cell_of_the_same_cube(tmp_path: Path) -> None:
    with two_rooms(tmp_path / "own.pvs") as own:
        write_shipped(own, tmp_path / "shipped.pvs", 2)
        with VisibilityStore.open(tmp_path / "shipped.pvs") as shipped:
            cubes = shipped.grid.coords // 2
            parents = shipped._rows["parent"].astype(np.int64)
            apart = (cubes != cubes[parents]).any(axis=1) | (parents < 0)
            assert apart.sum() == len(np.unique(cubes, axis=0))  # one of each cube, its head


@pytest.mark.parametrize("seed", range(5))
def test_a_cell_gets_all_of_a_label_that_it_sees_three_quarters_of(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count = int(rng.integers(1, 3_000))
    labels = rng.integers(0, 40, count).astype(np.uint16)
    ever = rng.random(count) < 0.9
    seen = ever & (rng.random(count) < rng.random(40)[labels])
    found = Completion(labels, codec.pack(np.flatnonzero(ever), count))(codec.pack(np.flatnonzero(seen), count))
    expected = seen.copy()
    for label in set(labels.tolist()) if len(set(labels.tolist())) > 1 else ():
        members = ever & (labels == label)
        if seen[members].any() and seen[members].sum() >= COMPLETE_FROM * members.sum():
            expected |= members
    assert np.array_equal(codec.ids_of(found), np.flatnonzero(expected))


def test_without_labels_sets_stay() -> None:
    everything = codec.pack(np.arange(100), 100)
    most = codec.pack(np.arange(99), 100)
    assert np.array_equal(Completion(np.zeros(100, np.uint16), everything)(most), most)
    nothing = codec.pack(np.arange(0), 0)
    assert len(codec.ids_of(Completion(np.zeros(0, np.uint16), nothing)(nothing))) == 0


def test_a_label_of_nothing_seen_adds_nothing() -> None:
    labels = np.array([0, 0, 1, 1], np.uint16)
    ever = codec.pack(np.array([2, 3]), 4)
    assert np.array_equal(Completion(labels, ever)(codec.pack(np.array([2]), 4)), codec.pack(np.array([2]), 4))
    assert np.array_equal(Completion(labels, ever)(codec.pack(np.arange(0), 4)), codec.pack(np.arange(0), 4))


def test_labels_are_chosen_for_the_sets_that_are_written(tmp_path: Path) -> None:
    """The order by labels that were chosen with completion is that of the file."""
    with two_rooms(tmp_path / "own.pvs") as own:
        labels = _order.choose_labels(len(own.order), len(own), own.visible_words, completed=True)
        write_shipped(own, tmp_path / "shipped.pvs")
        with VisibilityStore.open(tmp_path / "shipped.pvs") as shipped:
            assert np.array_equal(shipped.order, _order.order_of(labels))
