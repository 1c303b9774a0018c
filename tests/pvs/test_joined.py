"""Laws of joined cells and shared direction sets."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gsvis.errors import FormatError
from gsvis.pvs._writer import CellSet, StoreInfo, share_directions, write_store
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.joined import (
    DIRECTIONS_RUN,
    MOST_SHARE,
    RECORD_BYTES,
    JoinedCells,
    join_cells,
    join_until_small,
    measure_sets,
    walks_through,
)
from gsvis.pvs.reference import split_classes_reference
from gsvis.pvs.shipped import CLASSES_RUN, split_classes
from gsvis.pvs.store import VisibilityStore

GAUSSIANS = 1_000
EDGES = np.array([1 / 255, 0.1, 0.5])


def noise_store(path: Path, side: int = 4, seed: int = 0) -> VisibilityStore:
    """Return a store of `side`^3 cells, each of which sees other random Gaussians."""
    rng = np.random.default_rng(seed)
    coords = np.argwhere(np.ones((side, side, side - 1), bool)).astype(np.int32)
    grid = CellGrid(np.zeros(3), 0.5, (side, side, side - 1), coords, np.array([0.0, 0.0, 1.0]))
    cells = []
    for _ in coords:
        ids = np.flatnonzero(rng.random(GAUSSIANS) < 0.1)
        missed, bound, tile = np.sort(rng.random(3))
        cells.append(CellSet(ids, rng.integers(0, 3, len(ids)).astype(np.uint8), 4, 1, 100, missed, bound, tile))
    sets = rng.integers(0, 256, (GAUSSIANS, 10)).astype(np.uint8)
    return VisibilityStore.open(write_store(path, grid, StoreInfo(GAUSSIANS, "made", 1 / 255, EDGES), cells, sets))


@pytest.mark.parametrize("factor", [1, 2, 3, 4])
def test_a_joined_cell_sees_what_its_cells_see(tmp_path: Path, factor: int) -> None:
    with noise_store(tmp_path / "fine.pvs") as fine:
        of = np.array(join_cells(fine, tmp_path / "joined.pvs", factor))
        with VisibilityStore.open(tmp_path / "joined.pvs") as joined:
            joined.verify()
            assert len(joined) == len(set(of.tolist()))
            assert np.array_equal(joined.grid.cell_at(fine.grid.centers), of)
            for cell in range(len(joined)):
                best = np.zeros(GAUSSIANS, np.int64)
                for part in np.flatnonzero(of == cell):
                    ids, classes = fine.classes(int(part))
                    best[ids] = np.maximum(best[ids], classes.astype(np.int64) + 1)
                ids, classes = joined.classes(cell)
                assert np.array_equal(ids, np.flatnonzero(best))
                assert np.array_equal(classes.astype(np.int64) + 1, best[ids])
                assert joined.certificates.bound[cell] == fine.certificates.bound[of == cell].max()
                assert joined.certificates.rays[cell] == 100 * np.count_nonzero(of == cell)


@pytest.mark.parametrize("run", [1, 7, 16, 2_000])
def test_neighbors_share_the_union_of_their_directions(tmp_path: Path, run: int) -> None:
    with noise_store(tmp_path / "own.pvs") as own:
        own_sets = own.direction_sets
        share_directions(own.path, tmp_path / "shared.pvs", run)
        with VisibilityStore.open(tmp_path / "shared.pvs") as shared:
            shared.verify()
            assert shared.directions_run == run
            for start in range(0, GAUSSIANS, run):
                union = np.bitwise_or.reduce(own_sets[start : start + run], axis=0)
                assert (shared.direction_sets[start : start + run] == union).all()
            for cell in range(len(own)):
                assert np.array_equal(shared.visible_ids(cell), own.visible_ids(cell))


@pytest.mark.parametrize("run", [1, 7, 64, 2_000])
def test_classes_are_those_of_gaussians_and_shifts_of_runs(tmp_path: Path, run: int) -> None:
    with noise_store(tmp_path / "own.pvs", 3) as own:
        cells = [dict(zip(*(part.tolist() for part in own.classes(cell)), strict=True)) for cell in range(len(own))]
        common, shifts = split_classes_reference(cells, GAUSSIANS, run, len(EDGES))
        found = split_classes(own, run)
        assert found.common.tolist() == common
        assert found.shifts.tolist() == shifts
        share_directions(own.path, tmp_path / "shared.pvs", 16, classes=found)
        with VisibilityStore.open(tmp_path / "shared.pvs") as shared:
            shared.verify()
            assert (shared.classes_run, shared.directions_run) == (run, 16)
            assert np.array_equal(shared.certificates.bound, own.certificates.bound)
            assert np.array_equal(shared.viewpoints, own.viewpoints)
            for cell in range(len(own)):
                ids, classes = shared.classes(cell)
                assert ids.tolist() == sorted(cells[cell])
                wanted = [min(max(common[i] + shifts[cell][i // run], 0), len(EDGES) - 1) for i in ids.tolist()]
                assert classes.tolist() == wanted


def test_runs_of_one_gaussian_keep_all_classes(tmp_path: Path) -> None:
    with noise_store(tmp_path / "own.pvs", 3) as own:
        share_directions(own.path, tmp_path / "shared.pvs", 16, classes=split_classes(own, 1))
        with VisibilityStore.open(tmp_path / "shared.pvs") as shared:
            for cell in range(len(own)):
                assert np.array_equal(shared.classes(cell)[1], own.classes(cell)[1])


def test_runs_that_a_cell_sees_one_class_lower_keep_all_classes(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    base = rng.integers(1, 3, GAUSSIANS)
    lower = rng.integers(0, 2, (3, -(-GAUSSIANS // 64)))
    lower[0], lower[1] = 0, 0  # so that the mean over the cells is the class in two of them
    grid = CellGrid(np.zeros(3), 0.5, (3, 1, 1), np.array([[k, 0, 0] for k in range(3)], np.int32), np.eye(3)[2])
    ids = np.arange(GAUSSIANS)
    cells = [CellSet(ids, (base - lower[cell][ids // 64]).astype(np.uint8)) for cell in range(3)]
    info = StoreInfo(GAUSSIANS, "made", 1 / 255, EDGES)
    write_store(tmp_path / "own.pvs", grid, info, cells, np.zeros((GAUSSIANS, 10), np.uint8))
    with VisibilityStore.open(tmp_path / "own.pvs") as own:
        found = split_classes(own, 64)
    assert np.array_equal(found.common, base)
    assert np.array_equal(found.shifts, -lower)


def test_cells_are_joined_until_sets_are_a_fifth_and_no_longer(tmp_path: Path) -> None:
    most = MOST_SHARE * RECORD_BYTES * GAUSSIANS
    with noise_store(tmp_path / "fine.pvs") as fine:
        tried = join_until_small(fine, tmp_path / "small.pvs")
        assert [each.nbytes <= most for each in tried] == [False] * (len(tried) - 1) + [True]
        assert [each.factor for each in tried] == [1, 2, 3, 4][: len(tried)]
        with VisibilityStore.open(tmp_path / "small.pvs") as small:
            assert len(small) == tried[-1].cells < len(fine)
            assert (small.directions_run, small.classes_run) == (DIRECTIONS_RUN, 0)
            assert small.ever_visible() == fine.ever_visible()
        assert [path.name for path in tmp_path.iterdir() if "partial" in path.name] == []


def test_cells_that_somebody_chose_stay(tmp_path: Path) -> None:
    with noise_store(tmp_path / "fine.pvs") as fine:
        (only,) = join_until_small(fine, tmp_path / "kept.pvs", may_join=False)
        assert only.factor == 1
        with VisibilityStore.open(tmp_path / "kept.pvs") as kept:
            assert np.array_equal(kept.grid.coords, fine.grid.coords)


@pytest.mark.parametrize("may_join", [True, False])
def test_classes_are_in_runs_if_that_is_asked_for(tmp_path: Path, may_join: bool) -> None:
    with noise_store(tmp_path / "fine.pvs") as fine:
        tried = join_until_small(fine, tmp_path / "small.pvs", may_join=may_join, in_runs=True)
        with VisibilityStore.open(tmp_path / "small.pvs") as small:
            small.verify()
            assert small.classes_run == CLASSES_RUN
            assert len(small) == tried[-1].cells
            sizes = small.sizes()
            assert tried[-1].nbytes == sizes["file"] - sizes["directions"]


@pytest.mark.parametrize("in_runs", [True, False])
def test_the_same_store_gives_the_same_bytes(tmp_path: Path, in_runs: bool) -> None:
    with noise_store(tmp_path / "fine.pvs") as fine:
        first = join_until_small(fine, tmp_path / "a.pvs", in_runs=in_runs)
        assert join_until_small(fine, tmp_path / "b.pvs", in_runs=in_runs) == first
    assert (tmp_path / "a.pvs").read_bytes() == (tmp_path / "b.pvs").read_bytes()


def test_a_walk_saves_what_it_does_not_need() -> None:
    small = JoinedCells(1, 8, RECORD_BYTES * 60, walk=40.0, ever=100)
    assert small.saved == RECORD_BYTES * 60
    assert small.pays
    assert not replace(small, nbytes=small.nbytes + 1).pays


def test_sets_are_measured_as_a_package_has_them(tmp_path: Path) -> None:
    with noise_store(tmp_path / "fine.pvs") as fine:
        found = measure_sets(fine)
        assert found == join_until_small(fine, tmp_path / "small.pvs")[0]
        walks = [np.unique(np.concatenate([fine.visible_ids(c) for c in walk])) for walk in walks_through(fine.grid)]
    assert found.walk == np.mean([len(walk) for walk in walks])


def test_walks_go_from_neighbor_to_neighbor() -> None:
    coords = np.array([[0, 0, 0], [1, 0, 0], [5, 0, 0]], np.int32)
    grid = CellGrid(np.zeros(3), 1.0, (6, 1, 1), coords, np.array([0.0, 0.0, 1.0]))
    assert set(walks_through(grid)) == {(0, 1), (2,)}


@pytest.mark.parametrize("name", ["directions_run", "classes_run"])
def test_a_damaged_run_is_refused(tmp_path: Path, name: str) -> None:
    with noise_store(tmp_path / "own.pvs") as own:
        share_directions(own.path, tmp_path / "shared.pvs", 16, classes=split_classes(own, 16))
    data = (tmp_path / "shared.pvs").read_bytes()
    at = data.rindex(f'"{name}":16'.encode()) + len(name) + 3
    (tmp_path / "bad.pvs").write_bytes(data[:at] + b"99" + data[at + 2 :])
    with pytest.raises(FormatError):
        VisibilityStore.open(tmp_path / "bad.pvs").verify()


@pytest.mark.parametrize("part", ["common", "shifts"])
def test_classes_out_of_range_are_refused(tmp_path: Path, part: str) -> None:
    with noise_store(tmp_path / "own.pvs") as own:
        good = split_classes(own, 64)
        too_high = {"common": good.common + np.uint8(3), "shifts": good.shifts + np.int8(3)}[part]
        share_directions(own.path, tmp_path / "bad.pvs", 16, classes=replace(good, **{part: too_high}))
    with VisibilityStore.open(tmp_path / "bad.pvs") as bad, pytest.raises(FormatError, match="expected"):
        bad.verify()
