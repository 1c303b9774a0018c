"""The store of active terms against the activation it was built from, and what it says of bad files."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyroaring import BitMap

from gsvis.color.activation import Activation
from gsvis.color.srbf import SrbfColors
from gsvis.errors import FormatError
from gsvis.package.active_terms import ActiveTerms, colors_hash, sets_hash
from gsvis.prepare.active_terms import build_active_terms
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.store import CellSet, StoreInfo, VisibilityStore, write_store
from gsvis.scene.content import scene_hash
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.procedural import random_scene
from tests.color.samples import random_colors

EPSILON = 0.03


@dataclass(frozen=True)
class World:
    """A scene, its colors, and the random sets of its cells; the first cell sees nothing."""

    g: Gaussians
    colors: SrbfColors
    seen: np.ndarray
    store: VisibilityStore

    @property
    def path(self) -> Path:
        return self.store.path.with_suffix(".terms.arrow")

    def build(self, weighted: bool = False) -> ActiveTerms:
        return build_active_terms(
            self.colors, self.g, self.store, EPSILON, self.path, provenance="a test", weighted=weighted
        )


def world(folder: Path, cells: int = 11, seed: int = 0, variant: str = "rgb", name: str = "w.pvs") -> World:
    rng = np.random.default_rng(seed)
    g = random_scene(rng, 150)
    coords = np.stack(np.unravel_index(np.sort(rng.choice(60, cells, replace=False)), (4, 5, 3)), axis=1)
    low, high = g.bounds(1.0)
    grid = CellGrid(low, float((high - low).max()) / 4.0, (4, 5, 3), coords.astype(np.int32), np.array([0.0, 0, 1]))
    seen = rng.random((cells, len(g))) < 0.4
    seen[0] = False
    info = StoreInfo(len(g), scene_hash(g), 1 / 255, np.array([1 / 255, 0.1]))
    sets = [CellSet(ids := np.flatnonzero(row), (ids % 2).astype(np.uint8), 4) for row in seen]
    write_store(folder / name, grid, info, sets, np.zeros((len(g), 10), np.uint8))
    return World(g, random_colors(rng, len(g), variant), seen, VisibilityStore.open(folder / name))


@pytest.mark.parametrize("variant", ["rgb", "hsl"])
@pytest.mark.parametrize("cells", [1, 8, 11])
def test_queries_give_what_the_activation_says(tmp_path: Path, cells: int, variant: str) -> None:
    w = world(tmp_path, cells, seed=cells, variant=variant)
    activation = Activation(w.colors, w.g.means, EPSILON)
    with w.build() as terms:
        assert len(terms) == cells
        assert terms.epsilon == EPSILON
        assert terms.info.provenance == "a test"
        assert (terms.info.variant, terms.info.terms) == (variant, w.colors.num_terms)
        for cell in range(cells):
            mask = activation.active_in_box(*w.store.grid.bounds(cell), np.flatnonzero(w.seen[cell]))
            assert terms.active_ids(cell).tolist() == np.flatnonzero(mask).tolist()
            assert terms.active(cell) == BitMap(np.flatnonzero(mask))
            share, theirs = terms.share(cell), int(w.colors.counts[w.seen[cell]].sum())
            assert share.active == mask.sum()
            assert share.of_visible == pytest.approx(mask.sum() / max(1, theirs))
            assert share.of_all == pytest.approx(mask.sum() / w.colors.num_terms)
        terms.verify()


def test_weighted_contributions_are_bounded_by_the_classes(tmp_path: Path) -> None:
    """Even Gaussians are of the class that ends at 0.1, odd ones of that which ends at 1."""
    w = world(tmp_path)
    activation = Activation(w.colors, w.g.means, EPSILON)
    with w.build() as plain:
        everything = [plain.active(cell) for cell in range(11)]
    with w.build(weighted=True) as terms:
        assert terms.info.weighted
        for cell in range(11):
            ids = np.flatnonzero(w.seen[cell])
            mask = activation.active_in_box(*w.store.grid.bounds(cell), ids, np.where(ids % 2, 1.0, 0.1))
            assert terms.active(cell) == BitMap(np.flatnonzero(mask))
            assert terms.active(cell) <= everything[cell]


def test_what_a_client_lacks_is_what_it_does_not_hold(tmp_path: Path) -> None:
    w = world(tmp_path)
    with w.build() as terms:
        held = terms.active(3)
        assert terms.difference(5, held) == terms.active(5) - held
        assert terms.difference(5, list(held)) == terms.active(5) - held
        assert terms.difference(5, ()) == terms.active(5)
        assert not terms.difference(3, held)
        assert terms.active(3) == held, "what the caller does with a bitmap changes nothing"
        held.add(1)


def test_eyes_in_a_cell_need_no_other_terms(tmp_path: Path) -> None:
    w = world(tmp_path, 5)
    activation = Activation(w.colors, w.g.means, EPSILON)
    rng = np.random.default_rng(1)
    with w.build() as terms:
        for cell in range(5):
            low, high = w.store.grid.bounds(cell)
            for eye in rng.uniform(low, high, (10, 3)):
                needed = np.flatnonzero(activation.active(eye, np.flatnonzero(w.seen[cell])))
                assert not BitMap(needed) - terms.active(cell)


def test_building_twice_gives_the_same_bytes(tmp_path: Path) -> None:
    w = world(tmp_path)
    w.build().close()
    first = w.path.read_bytes()
    w.build().close()
    assert w.path.read_bytes() == first


def test_it_is_an_arrow_file_that_others_can_read(tmp_path: Path) -> None:
    w = world(tmp_path)
    with w.build() as terms, pa.memory_map(str(w.path)) as source:
        table = pa.ipc.open_file(source).read_all()
        assert table["cell"].to_pylist() == list(range(11))
        assert BitMap.deserialize(table["terms"][4].as_py()) == terms.active(4)


def test_no_terms_at_all(tmp_path: Path) -> None:
    w = world(tmp_path)
    plain = SrbfColors.without_terms(np.full((len(w.g), 3), 0.5))
    with build_active_terms(plain, w.g, w.store, EPSILON, w.path) as terms:
        assert not terms.active(4)
        assert (terms.share(4).of_all, terms.share(4).of_visible) == (0.0, 0.0)


def test_it_belongs_to_its_scene_its_colors_and_its_sets(tmp_path: Path) -> None:
    w, other = world(tmp_path), world(tmp_path, seed=1, name="other.pvs")
    w.build().close()
    ActiveTerms.open(w.path, scene=w.g, colors=w.colors, sets=w.store).close()
    for wrong, message in (
        ({"scene": other.g}, "scene: expected active terms of scene"),
        ({"colors": w.colors.first(2)}, "colors: expected active terms of colors"),
        ({"colors": replace(w.colors, decays=w.colors.decays * 2)}, "of colors"),
        ({"sets": other.store}, "sets: expected active terms of visible sets"),
    ):
        with pytest.raises(FormatError, match=message):
            ActiveTerms.open(w.path, **wrong)
    with pytest.raises(FormatError, match="of scene"):
        build_active_terms(other.colors, other.g, w.store, EPSILON, tmp_path / "x.terms.arrow")
    with pytest.raises(ValueError, match="colors: expected those of 150 Gaussians, got 10"):
        build_active_terms(w.colors[:10], w.g, w.store, EPSILON, tmp_path / "x.terms.arrow")
    with pytest.raises(ValueError, match="epsilon: expected"):
        build_active_terms(w.colors, w.g, w.store, -1.0, tmp_path / "x.terms.arrow")
    assert not list(tmp_path.glob("*x*"))


def test_hashes_depend_on_content_alone(tmp_path: Path) -> None:
    w = world(tmp_path)
    copied = replace(w.colors, base=w.colors.base.copy())
    assert colors_hash(copied) == colors_hash(w.colors)
    assert colors_hash(replace(w.colors, functions=w.colors.functions.copy())) == colors_hash(w.colors)
    assert len({colors_hash(w.colors), colors_hash(w.colors.first(1)), colors_hash(w.colors[:5])}) == 3
    with VisibilityStore.open(w.store.path) as again:
        assert sets_hash(again) == sets_hash(w.store)


@pytest.mark.parametrize("stop", [0, 3, 10])
def test_an_interrupted_build_leaves_what_was_there(tmp_path: Path, stop: int) -> None:
    w = world(tmp_path)
    w.path.write_bytes(b"before")

    def interrupt(stage: str, done: int, total: int) -> None:
        assert (stage, total) == ("terms", 11)
        if done == stop:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        build_active_terms(w.colors, w.g, w.store, EPSILON, w.path, progress=interrupt)
    assert w.path.read_bytes() == b"before"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["w.pvs", "w.terms.arrow"]


def test_bad_files_are_refused(tmp_path: Path) -> None:
    w = world(tmp_path)
    w.build().close()
    whole = w.path.read_bytes()
    bad = tmp_path / "bad.terms.arrow"
    for data in (b"", b"ARROW1", b"ply\n" * 30, whole[:50], whole[: len(whole) // 2], whole[:-1], b"ARROW1\0\0" * 9):
        bad.write_bytes(data)
        with pytest.raises(FormatError, match=r"bad\.terms\.arrow"):
            ActiveTerms.open(bad)
    with pytest.raises(FileNotFoundError):
        ActiveTerms.open(tmp_path / "none.terms.arrow")
    with pa.OSFile(str(bad), "wb") as sink, pa.ipc.new_file(sink, pa.schema([("a", pa.int32())])):
        pass
    with pytest.raises(FormatError, match="an Arrow file without them"):
        ActiveTerms.open(bad)


def test_no_byte_can_change_unnoticed(tmp_path: Path) -> None:
    """Each changed byte is refused, or changes nothing that is read."""
    w = world(tmp_path, 3)
    with w.build() as terms:
        truth = [terms.active(cell) for cell in range(3)], [terms.share(cell) for cell in range(3)], terms.info
    whole = w.path.read_bytes()
    bad = tmp_path / "bad.terms.arrow"
    noticed = 0
    for place in range(0, len(whole), 7):
        data = bytearray(whole)
        data[place] ^= 1 << place % 8
        bad.write_bytes(data)
        try:
            with ActiveTerms.open(bad) as terms:
                found = [terms.active(cell) for cell in range(3)], [terms.share(cell) for cell in range(3)], terms.info
            assert found == truth
        except FormatError:
            noticed += 1
    assert noticed > len(whole) / 7 / 3


def test_other_versions_and_foreign_metadata(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    w = world(tmp_path)
    monkeypatch.setattr("gsvis.package.active_terms.VERSION", 2)
    w.build().close()
    monkeypatch.undo()
    with pytest.raises(FormatError, match="version: expected at most 1, got 2; update gsvis"):
        ActiveTerms.open(w.path)
    monkeypatch.setattr("gsvis.package.active_terms.FORMAT", "gsvis visible sets")
    w.build().close()
    monkeypatch.undo()
    with pytest.raises(FormatError, match="format: expected gsvis active terms, got 'gsvis visible sets'"):
        ActiveTerms.open(w.path)


def test_bad_cells_and_closed_stores_are_refused(tmp_path: Path) -> None:
    w = world(tmp_path)
    terms = w.build()
    for cell in (-1, 11, 1.0, True, None):
        with pytest.raises(ValueError, match=r"cell: expected a number in \[0, 10\]"):
            terms.active(cell)  # type: ignore[arg-type]
    terms.close()
    with pytest.raises(ValueError, match="closed"):
        terms.active(0)
