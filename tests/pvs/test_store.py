from __future__ import annotations

import errno
import json
import struct
import threading
import zlib
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyroaring import BitMap

from gsvis.errors import FormatError
from gsvis.files import sections
from gsvis.pvs import _writer
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.store import CellSet, StoreInfo, StoreWriter, VisibilityStore, write_store
from gsvis.scene.content import scene_hash
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.procedural import random_scene

EDGES = np.array([1 / 255, 1 / 64, 1 / 16, 1 / 4])
SHARES = ("missed", "bound", "tile")


def figures_of(cell: int) -> dict[str, Any]:
    """The certificate of a cell; every third has none."""
    if cell % 3 == 2:
        return {}
    return {"inner": cell, "rays": 256 * cell, "missed": 0.01 * cell, "bound": 0.02 * cell, "tile": 0.1}


@dataclass(frozen=True)
class Truth:
    """What went into a store: (C, N) class plus 1, 0 where the cell does not see the Gaussian."""

    grid: CellGrid
    levels: np.ndarray
    directions: np.ndarray

    @property
    def seen(self) -> np.ndarray:
        return self.levels > 0

    def cells(self) -> list[CellSet]:
        return [
            CellSet(ids := np.flatnonzero(row), row[ids] - 1, viewpoints=4 + c, **figures_of(c))
            for c, row in enumerate(self.levels)
        ]

    def info(self, scene: str = "0" * 64) -> StoreInfo:
        return StoreInfo(self.levels.shape[1], scene, 1 / 255, EDGES, {"method": "raycast", "rays": 128})

    def write(self, path: Path, scene: str = "0" * 64) -> VisibilityStore:
        write_store(path, self.grid, self.info(scene), self.cells(), self.directions)
        return VisibilityStore.open(path)


def grid_of(cells: int, rng: np.random.Generator) -> CellGrid:
    """So many cells anywhere in a grid of 4 x 5 x 3 boxes."""
    flat = np.sort(rng.choice(60, cells, replace=False))
    coords = np.stack(np.unravel_index(flat, (4, 5, 3)), axis=1).astype(np.int32)
    return CellGrid(np.array([-1.0, 2.0, 0.25]), 0.75, (4, 5, 3), coords, np.array([0.0, 0.0, 1.0]))


def truth_of(n: int, cells: int, share: float, seed: int) -> Truth:
    """Random sets; the first cell sees nothing and the last everything, where there are as many."""
    rng = np.random.default_rng(seed)
    levels = np.where(rng.random((cells, n)) < share, rng.integers(1, 5, (cells, n)), 0).astype(np.uint8)
    levels[:, : n // 5] = 0  # never seen from anywhere, but for the last cell of several
    if cells > 2:
        levels[0], levels[-1] = 0, rng.integers(1, 5, n)
    return Truth(grid_of(cells, rng), levels, rng.integers(0, 256, (n, 10)).astype(np.uint8))


def naive_distances(truth: Truth, cell: int) -> np.ndarray:
    centers = truth.grid.centers
    apart = np.linalg.norm(centers - centers[cell], axis=1)
    return np.where(truth.seen, apart[:, None], np.inf).min(axis=0)


@settings(max_examples=16)
@given(st.sampled_from([0, 1, 64, 300, 70_000]), st.integers(1, 9), st.sampled_from([0.0, 0.1, 0.5, 1.0]))
def test_queries_agree_with_plain_sets(tmp_path: Path, n: int, cells: int, share: float) -> None:
    truth = truth_of(n, cells, share, seed=n + cells)
    with truth.write(tmp_path / "x.pvs") as store:
        assert (len(store), store.gaussians) == (cells, n)
        assert np.array_equal(store.visible_counts, truth.seen.sum(axis=1))
        assert np.array_equal(store.viewpoints, 4 + np.arange(cells))
        for name in ("inner", "rays", *SHARES):
            wanted = [figures_of(c).get(name, np.nan if name in SHARES else 0) for c in range(cells)]
            assert np.allclose(getattr(store.certificates, name), wanted, equal_nan=True)
        assert store.certificates.known.tolist() == [bool(figures_of(c)) for c in range(cells)]
        assert np.array_equal(store.direction_sets, truth.directions)
        assert store.ever_visible() == BitMap(np.flatnonzero(truth.seen.any(axis=0)).tolist())
        for cell in range(cells):
            ids, classes = store.classes(cell)
            assert np.array_equal(ids, np.flatnonzero(truth.seen[cell]))
            assert np.array_equal(classes, truth.levels[cell][ids] - 1)
            for least in range(4):
                wanted = np.flatnonzero(truth.levels[cell] > least)
                assert np.array_equal(store.visible_ids(cell, least_class=least), wanted)
                assert store.visible(cell, least_class=least) == BitMap(wanted.tolist())
            assert np.allclose(store.distance_to_visibility(cell), naive_distances(truth, cell), rtol=1e-6)
        other = cells // 2
        assert store.difference(0, other) == store.visible(0) - store.visible(other)
        assert store.union([0, other]) == store.visible(0) | store.visible(other)
        assert store.union(range(cells)) == store.ever_visible()
        assert store.union([]) == BitMap()
        store.verify()


def test_a_search_within_a_distance_stops_there(tmp_path: Path) -> None:
    truth = truth_of(500, 9, 0.3, seed=3)
    with truth.write(tmp_path / "x.pvs") as store:
        whole = naive_distances(truth, 4)
        for within in (0.0, 0.8, 1.5, 3.0):
            found = store.distance_to_visibility(4, within=within)
            assert np.allclose(found, np.where(whole <= within, whole, np.inf), rtol=1e-6)
        for gaussian in range(0, 500, 7):
            seer, distance = store.nearest_seer(gaussian, 4)
            assert np.isclose(distance, whole[gaussian]) or np.isinf([distance, whole[gaussian]]).all()
            assert seer == -1 if np.isinf(distance) else truth.seen[seer, gaussian]
            assert store.class_of(gaussian, 4) == int(truth.levels[4, gaussian]) - 1
        with pytest.raises(ValueError, match="within: expected a distance of at least 0, got -1"):
            store.distance_to_visibility(4, within=-1.0)


def test_places_and_neighbors_are_those_of_the_grid(tmp_path: Path) -> None:
    truth = truth_of(100, 30, 0.2, seed=1)
    with truth.write(tmp_path / "x.pvs") as store:
        for cell in range(30):
            assert store.cell_at(store.grid.centers[cell]) == cell
            assert np.array_equal(store.neighbors(cell), truth.grid.neighbors(cell))
            assert np.array_equal(store.grid.bounds(cell), truth.grid.bounds(cell))
        assert store.cell_at([1e9, 0.0, 0.0]) == -1
        assert store.info.config == {"method": "raycast", "rays": 128}
        assert store.tau == pytest.approx(1 / 255)
        assert store.class_interval(0) == pytest.approx((1 / 255, 1 / 64))
        assert store.class_interval(3) == pytest.approx((1 / 4, 1.0))
        assert "30 cells" in repr(store)


def structured(n: int = 20_000, cells: int = 40) -> Truth:
    """Gaussians in shuffled groups, each group seen by the same cells; large enough for labels."""
    rng = np.random.default_rng(7)
    groups = rng.permutation(np.arange(n) % 120)
    seen = rng.random((cells, 120)) < 0.3
    levels = np.where(seen[:, groups] ^ (rng.random((cells, n)) < 0.001), 1 + groups % 4, 0).astype(np.uint8)
    return Truth(grid_of(cells, rng), levels, np.zeros((n, 10), np.uint8))


def test_equal_content_makes_equal_bytes(tmp_path: Path) -> None:
    truth = structured()
    with truth.write(tmp_path / "a.pvs") as store:
        assert store.order[0] != 0 or np.any(np.diff(store.order) != 1)  # stored in an order of its own
        store.verify()
        for cell in (0, 17, 39):
            assert np.array_equal(store.visible_ids(cell), np.flatnonzero(truth.seen[cell]))
        assert store.sizes()["bits_per_pair"] < 3.0
        assert store.sizes()["file"] == (tmp_path / "a.pvs").stat().st_size
    with StoreWriter(tmp_path / "b.pvs", truth.grid, truth.info()) as writer:
        for cell in truth.cells():
            writer.add_cell(CellSet(np.asarray(cell.ids).tolist(), *(getattr(cell, f.name) for f in fields(cell)[1:])))
        writer.finish(truth.directions)
    assert (tmp_path / "a.pvs").read_bytes() == (tmp_path / "b.pvs").read_bytes()


def test_a_cache_of_any_size_changes_no_answer(tmp_path: Path) -> None:
    truth = structured(5000, 12)
    truth.write(tmp_path / "x.pvs").close()
    for room in (0, 10_000, 1 << 30):
        with VisibilityStore.open(tmp_path / "x.pvs", max_cache=room) as store:
            for cell in (3, 4, 3, 11):
                assert np.array_equal(store.classes(cell)[0], np.flatnonzero(truth.seen[cell]))
                assert np.allclose(store.distance_to_visibility(cell), naive_distances(truth, cell), rtol=1e-6)
            assert store.cache.nbytes <= room


def test_threads_may_share_a_store(tmp_path: Path) -> None:
    truth = structured(5000, 20)
    wrong: list[int] = []
    with truth.write(tmp_path / "x.pvs") as store:

        def ask(start: int) -> None:
            for k in range(40):
                cell = (start + 3 * k) % 20
                ids, classes = store.classes(cell)
                if not np.array_equal(classes + 1, truth.levels[cell][ids]) or len(store.visible(cell)) != len(ids):
                    wrong.append(cell)

        threads = [threading.Thread(target=ask, args=(k,)) for k in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert wrong == []


def small_store(path: Path) -> Truth:
    truth = truth_of(90, 4, 0.3, seed=2)
    truth.write(path).close()
    return truth


def assert_never_wrong(path: Path, truth: Truth) -> bool:
    """Open, ask everything and verify; True if some step refused, and every answer before was right."""
    try:
        with VisibilityStore.open(path) as store:
            for cell in range(len(truth.grid)):
                ids, classes = store.classes(cell)
                assert np.array_equal(store.visible_ids(cell), np.flatnonzero(truth.seen[cell]))
                assert np.array_equal(classes, truth.levels[cell][ids] - 1)
                assert np.allclose(store.distance_to_visibility(cell), naive_distances(truth, cell), rtol=1e-6)
            assert np.array_equal(store.direction_sets, truth.directions)
            store.verify()
    except FormatError as error:
        assert "\n" not in str(error)
        assert str(path) in str(error)
        return True
    return False


def test_a_changed_byte_is_never_believed(tmp_path: Path) -> None:
    path = tmp_path / "x.pvs"
    truth = small_store(path)
    assert not assert_never_wrong(path, truth)
    data = path.read_bytes()
    for at in [*range(48), *range(48, len(data), 5)]:
        broken = bytearray(data)
        broken[at] ^= (1, 0x80, 0xFF)[at % 3]
        path.write_bytes(broken)
        assert assert_never_wrong(path, truth), f"byte {at} of {len(data)}"


def test_a_cut_or_lengthened_file_is_refused_when_it_is_opened(tmp_path: Path) -> None:
    path = tmp_path / "x.pvs"
    small_store(path)
    data = path.read_bytes()
    for length in [*range(60), *range(60, len(data), 7), len(data) - 1, len(data) + 1, len(data) + 100]:
        path.write_bytes((data + bytes(100))[:length])
        with pytest.raises(FormatError, match=r"head of 40 bytes|a file of \d+ bytes"):
            VisibilityStore.open(path)


def test_damage_in_one_cell_leaves_the_others_usable(tmp_path: Path) -> None:
    path = tmp_path / "x.pvs"
    truth = small_store(path)
    with VisibilityStore.open(path) as store:
        place = store._file.section("sets").offset + int(store._rows["set_offset"][2])
    data = bytearray(path.read_bytes())
    data[place + 9] ^= 1
    path.write_bytes(data)
    with VisibilityStore.open(path) as store:
        assert np.array_equal(store.visible_ids(1), np.flatnonzero(truth.seen[1]))
        with pytest.raises(FormatError, match=r"set of cell 2, byte \d+: expected bytes that fit their checksum"):
            store.visible(2)


def forge(path: Path, **changes: object) -> None:
    """Change entries of the header and make all checksums fit again."""
    data = path.read_bytes()
    place = struct.unpack_from("<Q", data, 24)[0]
    header = {**json.loads(data[place:]), **changes}
    with path.open("wb") as file:
        file.write(data[:place])
        text = json.dumps({k: v for k, v in header.items() if v is not None}).encode()
        file.write(text)
        fields = struct.pack("<QQII", place + len(text), place, len(text), zlib.crc32(text))
        file.seek(12)
        file.write(struct.pack("<I", zlib.crc32(fields)) + fields)


@pytest.mark.parametrize(
    "changes",
    [
        {"format": "another"},
        {"gaussians": 91},
        {"gaussians": -1},
        {"gaussians": 1 << 30},
        {"gaussians": "many"},
        {"scene": 5},
        {"tau": 0.5},
        {"tau": None},
        {"class_edges": [0.5, 0.1]},
        {"class_edges": []},
        {"config": []},
        {"grid": {}},
        {"grid": {"cells": 5, "origin": [0, 0, 0], "cell_size": 1, "shape": [4, 5, 3], "up": [0, 0, 1]}},
        {"grid": {"cells": 4, "origin": [0, 0, 0], "cell_size": 0, "shape": [4, 5, 3], "up": [0, 0, 1]}},
        {"grid": {"cells": 4, "origin": [0, 0, 0], "cell_size": 1, "shape": [1, 1, 1], "up": [0, 0, 1]}},
        {"grid": {"cells": 4, "origin": [0, 0, 0], "cell_size": 1, "shape": [4, 5, 3], "up": [0, 0, 0]}},
        {"sections": None},
        {"sections": []},
        {"sections": [["sets", 40, 10, 1]]},
        {"sections": [["sets", 40, -10, "x"]]},
    ],
)
def test_a_header_that_lies_is_refused(tmp_path: Path, changes: dict[str, object]) -> None:
    path = tmp_path / "x.pvs"
    truth = small_store(path)
    forge(path)
    assert not assert_never_wrong(path, truth)
    forge(path, **changes)
    assert assert_never_wrong(path, truth)


@pytest.mark.parametrize(("count", "place"), [((1 << 31) - 1, "header"), (1 << 31, "gaussians")])
def test_a_header_counts_fewer_gaussians_than_ids_of_31_bits_name(tmp_path: Path, count: int, place: str) -> None:
    path = tmp_path / "x.pvs"
    small_store(path)
    forge(path, gaussians=count)
    with pytest.raises(FormatError) as caught:
        VisibilityStore.open(path)
    assert caught.value.where == place


def test_other_files_and_newer_versions_are_named_as_such(tmp_path: Path) -> None:
    path = tmp_path / "x.pvs"
    for foreign in (b"ply\nformat ascii 1.0\n", b"PK\x03\x04" + bytes(100)):
        path.write_bytes(foreign)
        with pytest.raises(FormatError, match="expected a store of visible sets, got a file that begins"):
            VisibilityStore.open(path)
    small_store(path)
    data = bytearray(path.read_bytes())
    data[8] = 2
    path.write_bytes(data)
    with pytest.raises(FormatError, match="expected version 1, got version 2; update gsvis"):
        VisibilityStore.open(path)
    with pytest.raises(FileNotFoundError):
        VisibilityStore.open(tmp_path / "none.pvs")


def test_a_closed_store_says_so(tmp_path: Path) -> None:
    small_store(tmp_path / "x.pvs")
    store = VisibilityStore.open(tmp_path / "x.pvs")
    store.close()
    with pytest.raises(ValueError, match="file: expected an open one, got one that was closed"):
        store.visible(0)


def test_a_store_knows_its_scene(tmp_path: Path) -> None:
    path = tmp_path / "x.pvs"
    scene = random_scene(np.random.default_rng(0), 90, 1)
    truth_of(90, 4, 0.3, seed=2).write(path, scene_hash(scene)).close()
    turned = scene[::-1]
    with VisibilityStore.open(path, scene=scene) as store:  # it knows this scene, and refuses others still
        for other, message in ((turned, "a store of scene"), (scene[:50], "a store of 50 Gaussians, got one of 90")):
            with pytest.raises(FormatError, match=message):
                VisibilityStore.open(path, scene=other)
            with pytest.raises(FormatError, match=message):
                store.check_scene(other)
        store.check_scene(scene)


def test_the_hash_is_of_the_content_alone() -> None:
    scene = random_scene(np.random.default_rng(0), 20, 1)
    again = Gaussians(scene.means, scene.quats, scene.scales, scene.opacities, scene.sh0, scene.shN)
    assert scene_hash(scene) == scene_hash(again) == scene_hash(scene[np.arange(20)])
    flat = Gaussians(scene.means, scene.quats, scene.scales, scene.opacities, scene.sh0)
    moved = Gaussians(scene.means + 1, scene.quats, scene.scales, scene.opacities, scene.sh0, scene.shN)
    hashes = {scene_hash(s) for s in (scene, scene[::-1], scene[:19], flat, moved, Gaussians.empty())}
    assert len(hashes) == 6
    assert all(len(h) == 64 for h in hashes)


def test_numbers_out_of_range_are_refused(tmp_path: Path) -> None:
    with truth_of(90, 4, 0.3, seed=2).write(tmp_path / "x.pvs") as store:
        for bad in (-1, 4, 1.5, True):
            for ask in (store.visible, store.classes, store.distance_to_visibility, store.neighbors):
                with pytest.raises(ValueError, match=r"cell: expected a number in \[0, 3\]"):
                    ask(bad)  # type: ignore[arg-type]
            with pytest.raises(ValueError, match="cell"):
                store.union([0, bad])  # type: ignore[list-item]
        for bad in (-1, 90, 0.5, "a"):
            with pytest.raises(ValueError, match=r"gaussian: expected an id in \[0, 90\)"):
                store.why(bad, 0)  # type: ignore[arg-type]
        with pytest.raises(ValueError, match=r"least_class: expected a class in \[0, 4\), got 4"):
            store.visible(0, least_class=4)
        with pytest.raises(ValueError, match="position"):
            store.cell_at([0.0, 1.0])
        with pytest.raises(ValueError, match="position: expected finite values"):
            store.cell_at([0.0, 1.0, np.nan])


@pytest.mark.parametrize(
    ("cell", "message"),
    [
        (CellSet([3, 2], [0, 0]), "ids: expected rising ids"),
        (CellSet([2, 2], [0, 0]), "ids: expected rising ids"),
        (CellSet([-1], [0]), "ids: expected rising ids"),
        (CellSet([90], [0]), "ids: expected rising ids"),
        (CellSet([1, 2], [0]), "ids / classes"),
        (CellSet([1], [4]), "classes: expected numbers below 4, got 4"),
        (CellSet([1], [-1]), "classes"),
        (CellSet([1.5], [0]), "ids: expected integers"),
        (CellSet([1], [0], viewpoints=-1), "viewpoints"),
        (CellSet([1], [0], inner=-1), "inner"),
        (CellSet([1], [0], rays=0.5), "rays"),  # type: ignore[arg-type]
        (CellSet([1], [0], missed=-0.1), "missed"),
        (CellSet([1], [0], bound=1.5), "bound"),
        (CellSet([1], [0], tile=np.inf), "tile"),
    ],
)
def test_a_wrong_cell_is_refused_and_the_writer_goes_on(tmp_path: Path, cell: CellSet, message: str) -> None:
    truth = truth_of(90, 2, 0.3, seed=2)
    with StoreWriter(tmp_path / "x.pvs", truth.grid, truth.info()) as writer:
        with pytest.raises(ValueError, match=message):
            writer.add_cell(cell)
        for good in truth.cells():
            writer.add_cell(good)
        with pytest.raises(ValueError, match="expected 2 cells, got one more"):
            writer.add_cell(cell)
        writer.finish(truth.directions)
    with VisibilityStore.open(tmp_path / "x.pvs") as store:
        assert np.array_equal(store.visible_ids(1), np.flatnonzero(truth.seen[1]))


def test_a_store_that_is_not_finished_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "x.pvs"
    truth = small_store(path)
    before = path.read_bytes()
    with (
        pytest.raises(ValueError, match="cells: expected 4, got 3"),
        StoreWriter(path, truth.grid, truth.info()) as writer,
    ):
        for cell in truth.cells()[:3]:
            writer.add_cell(cell)
        writer.finish(truth.directions)
    with pytest.raises(ValueError, match=r"direction_sets: expected \(90, 10\) uint8"):
        write_store(path, truth.grid, truth.info(), truth.cells(), truth.directions[:5])

    def full(self: sections.SectionWriter, name: str) -> None:
        if name == "classes":
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(sections.SectionWriter, "close_section", full)
    with pytest.raises(OSError, match="cannot be written: no space left"):
        write_store(path, truth.grid, truth.info(), truth.cells(), truth.directions)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["x.pvs"]


def test_what_a_store_says_of_itself_is_checked() -> None:
    good = {"gaussians": 5, "scene": "x", "tau": EDGES[0], "class_edges": EDGES}
    StoreInfo(**good)
    for change, message in (
        ({"gaussians": -1}, "gaussians"),
        ({"gaussians": 1 << 31}, "gaussians: expected fewer"),
        ({"tau": 0.5}, "tau: expected the lowest class edge"),
        ({"class_edges": EDGES[::-1]}, "class_edges: expected 1 to 16 rising weights"),
        ({"class_edges": np.linspace(0.1, 0.9, 17)}, "class_edges"),
        ({"config": {"x": object()}}, "config: expected what JSON can hold"),
        ({"config": {"x": np.nan}}, "config"),
    ):
        with pytest.raises(ValueError, match=message):
            StoreInfo(**{**good, **change})


def test_only_a_few_sets_are_held_while_writing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_writer, "_HELD", 3)
    truth = structured(3000, 20)
    with StoreWriter(tmp_path / "x.pvs", truth.grid, truth.info()) as writer:
        for cell in truth.cells():
            writer.add_cell(cell)
            assert len(writer._held) == 0
        writer.finish(truth.directions)
        assert len(writer._held) <= 3
    assert (tmp_path / "x.pvs").read_bytes() == Path(structured(3000, 20).write(tmp_path / "y.pvs").path).read_bytes()


@pytest.mark.parametrize("free", [1 << 30, 0], ids=["as it is", "without a free GiB"])
def test_a_store_of_many_gaussians_in_a_small_file_opens(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, free: int
) -> None:
    monkeypatch.setattr(_writer, "FREE_BYTES", free)
    n, ids = 5_000_000, np.arange(0, 5000, 100)  # more than the 64 MiB that a file of any kind may ask for
    info = StoreInfo(n, "0" * 64, 1 / 255, EDGES)
    cell = CellSet(ids, np.zeros(len(ids), np.uint8))
    path = write_store(tmp_path / "x.pvs", grid_of(1, np.random.default_rng(0)), info, [cell], np.zeros((n, 10), "u1"))
    assert path.stat().st_size < 16 * n / 256 + 100_000
    with VisibilityStore.open(path) as store:
        assert np.array_equal(store.visible_ids(0), ids)
        store.verify()
