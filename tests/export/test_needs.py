"""The sidecar: what a cell needs is what it sees, bytes are as documented, and merged cells need no less."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsvis.export.leaves import Leaves, cut_leaves
from gsvis.export.needs import LeafNeeds, LevelTable, find_needs, scene_sum
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.store import CellSet, StoreInfo, VisibilityStore, write_store
from gsvis.scene.content import scene_hash
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels
from gsvis.scene.procedural import random_scene

Triple = tuple[int, int, int]
SIDE = np.array([[-10.0, 0, 0], [10.0, 0, 0]])


def two_heaps(n: int = 100) -> Gaussians:
    """Two heaps of n Gaussians each, 20 apart along x."""
    g = random_scene(np.random.default_rng(0), 2 * n)
    means = 0.2 * g.means + np.repeat(SIDE, n, axis=0)
    return Gaussians(means, g.quats, g.scales, g.opacities, g.sh0, g.shN)


def store_of(path: Path, g: Gaussians, seen: list[np.ndarray], shape: Triple = (2, 1, 1)) -> VisibilityStore:
    """One cell for each set, along x."""
    coords = np.array(list(np.ndindex(shape))[: len(seen)], np.int32)
    grid = CellGrid(np.array([-2.0, -1.0, -1.0]), 2.0, shape, coords, np.array([0.0, 0, 1]))
    info = StoreInfo(len(g), scene_hash(g), 1 / 255, np.array([1 / 255, 0.1]))
    sets = [CellSet(ids, np.ones(len(ids), np.uint8), 1) for ids in seen]
    write_store(path, grid, info, sets, np.zeros((len(g), 10), np.uint8))
    return VisibilityStore.open(path)


@pytest.fixture
def heaps() -> tuple[Gaussians, Leaves]:
    g = two_heaps()
    return g, cut_leaves(Levels.single(g), most=100)


def plain(leaves: int) -> LevelTable:
    """A table of one level, with nothing to say."""
    ones = np.ones((1, leaves), np.int64)
    return LevelTable(ones, ones, np.zeros((1, leaves)))


def decode_table(data: bytes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Read the table of levels as docs/streamed.md says: splats, bytes, and bytes of errors, (L, B) each."""
    length = int.from_bytes(data[:4], "little")
    header = json.loads(data[4 : 4 + length])
    shape = header["levels"], header["leaves"]
    size = shape[0] * shape[1]
    counts = np.frombuffer(data, "<u4", size, 4 + length).reshape(shape)
    sizes = np.frombuffer(data, "<u4", size, 4 + length + 4 * size).reshape(shape)
    return counts, sizes, np.frombuffer(data, np.uint8, size, 4 + length + 8 * size).reshape(shape)


def decode(data: bytes) -> tuple[dict[str, Any], list[tuple[list[int], int]], list[dict[int, int]]]:
    """Read a sidecar as docs/streamed.md says: header, cells (box, row), and the light byte of each leaf of a row."""
    length = int.from_bytes(data[:4], "little")
    header = json.loads(data[4 : 4 + length])
    assert (4 + length) % 4 == 0
    at, cells, rows = 4 + length + 9 * header["levels"] * header["leaves"], [], []
    for _ in range(header["cells"]):
        *box, row = np.frombuffer(data, "<u2", 4, at).tolist()
        cells.append((box, row))
        at += 8
    for _ in range(header["rows"]):
        width = -(-header["leaves"] // 8)
        bits = [k for k in range(header["leaves"]) if data[at + k // 8] >> k % 8 & 1]
        at += width
        rows.append(dict(zip(bits, data[at : at + len(bits)], strict=True)))
        at += len(bits)
    assert at == len(data)
    return header, cells, rows


def test_a_cell_needs_the_leaves_that_it_sees(heaps: tuple[Gaussians, Leaves], tmp_path: Path) -> None:
    g, leaves = heaps
    left, both = leaves.of_ids[0], sorted({int(leaves.of_ids[0]), int(leaves.of_ids[150])})
    with store_of(tmp_path / "s.pvs", g, [np.arange(100), np.arange(200)]) as store:
        needs = find_needs(leaves, store, lost=0.0)
    header, cells, rows = decode(needs.encode({"name": "heaps"}, plain(2)))
    assert (header["name"], header["leaves"], header["cells"]) == ("heaps", 2, 2)
    assert (header["origin"], header["size"]) == ([-2.0, -1.0, -1.0], 2.0)
    assert [sorted(rows[row]) for _, row in cells] == [[left], both]
    assert [box for box, _ in cells] == [[0, 0, 0], [1, 0, 0]]
    assert sorted(rows[0]) == both  # outside of all cells


def test_light_is_weight_times_solid_angle(heaps: tuple[Gaussians, Leaves], tmp_path: Path) -> None:
    g, leaves = heaps
    with store_of(tmp_path / "s.pvs", g, [np.arange(200), np.arange(200)]) as store:
        lights = find_needs(leaves, store, lost=0.0).lights
    near, far = leaves.of_ids[0], leaves.of_ids[150]
    assert lights[0, near] > lights[1, near]  # the first cell is nearer to the first heap
    assert lights[0, far] < lights[1, far]
    ratio = lights[0, near] / lights[1, near]
    assert ratio == pytest.approx((11.0 / 9.0) ** 2, rel=0.1)  # centers of cells at -1 and 1


def test_the_least_light_is_left_out_up_to_a_share(heaps: tuple[Gaussians, Leaves], tmp_path: Path) -> None:
    g, _ = heaps
    leaves = cut_leaves(Levels.single(g), most=10)
    with store_of(tmp_path / "s.pvs", g, [np.arange(200)], (1, 1, 1)) as store:
        whole, part = find_needs(leaves, store, lost=0.0).lights[0], find_needs(leaves, store, lost=0.2).lights[0]
    gone = part == 0.0
    assert 0.0 < whole[gone].sum() <= 0.2 * whole.sum()
    assert whole[gone].max() <= whole[~gone].min()
    assert whole[gone].sum() + whole[~gone].min() > 0.2 * whole.sum()
    assert np.array_equal(part[~gone], whole[~gone])


def test_cells_that_agree_share_a_row_and_cells_are_merged_to_fit(
    heaps: tuple[Gaussians, Leaves], tmp_path: Path
) -> None:
    g, leaves = heaps
    seen = [np.arange(100)] * 5 + [np.arange(100, 200)] * 3
    with store_of(tmp_path / "s.pvs", g, seen, (2, 2, 2)) as store:
        needs = find_needs(leaves, store)
    header, cells, rows = decode(needs.encode({}, plain(2)))
    assert (header["cells"], header["rows"]) == (8, 3)
    assert len({row for _, row in cells}) == 2
    merged = needs.encode_within({}, plain(2), 1)
    header, cells, rows = decode(merged)
    assert (header["cells"], header["size"]) == (1, 4.0)
    assert sorted(rows[cells[0][1]]) == [0, 1]  # what any of the cells needs
    assert needs.encode_within({}, plain(2), 10_000) == needs.encode({}, plain(2))


def test_bytes_of_light_keep_the_order(heaps: tuple[Gaussians, Leaves]) -> None:
    lights = np.array([[8.0, 0.0, 1.0, 1e-30]])
    needs = LeafNeeds(np.zeros(3), 1.0, np.zeros((1, 3), np.int64), lights, np.maximum(lights[0], 1e-9))
    header, _, rows = decode(needs.encode({}, plain(4)))
    assert rows[1] == {0: 255, 2: 255 - 12, 3: 1}  # four steps an octave, at least 1
    assert header["top"] == 12
    assert sorted(rows[0]) == [0, 1, 2, 3]


def test_without_visible_sets_there_is_one_row_for_all(heaps: tuple[Gaussians, Leaves]) -> None:
    _, leaves = heaps
    header, cells, rows = decode(find_needs(leaves, None).encode({}, plain(2)))
    assert (header["cells"], header["size"], cells) == (0, 0.0, [])
    assert [sorted(row) for row in rows] == [[0, 1]]
    with pytest.raises(ValueError, match="lost"):
        find_needs(leaves, None, lost=1.0)


def test_the_table_of_levels_has_splats_bytes_and_errors(heaps: tuple[Gaussians, Leaves]) -> None:
    _, leaves = heaps
    counts, sizes = np.array([[100, 100], [7, 0]]), np.array([[9000, 8000], [70000, 0]])
    table = LevelTable(counts, sizes, np.array([[0.0, 0.0], [0.25, 1.0]]))
    found = decode_table(find_needs(leaves, None).encode({}, table))
    assert np.array_equal(found[0], counts)
    assert np.array_equal(found[1], sizes)
    assert found[2].tolist() == [[0, 0], [255 - 8, 255]]  # four steps an octave; 0 is no error


def test_names_of_files_name_the_scene() -> None:
    assert scene_sum([]) == 0x811C9DC5
    assert scene_sum(["a"]) == 0xE40C292C  # FNV-1a of "a"
    assert scene_sum(["a", "b"]) != scene_sum(["b", "a"])
