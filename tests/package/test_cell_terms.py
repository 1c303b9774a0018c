"""The terms that cells need are found anew as lists held them, and packages of version 2 are read."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest

from gsvis.errors import FormatError
from gsvis.export.static import write_static
from gsvis.package import Contents, Package, PackageInfo, write_package
from gsvis.package.active_terms import ActiveTerms
from gsvis.prepare.active_terms import list_package_terms
from gsvis.pvs.store import VisibilityStore
from gsvis.stream import StreamedScene
from tests.package.worlds import EPSILON, colors_of, levels_of, lists_of, sets_of
from tests.stream.worlds import package_of

OLD = Path(__file__).parent / "data" / "version2.zip"


@pytest.fixture
def old(tmp_path: Path) -> Path:
    """The folder of a package of version 2: 120 Gaussians, 9 cells, with lists of active terms."""
    with zipfile.ZipFile(OLD) as archive:
        archive.extractall(tmp_path / "old")
    return tmp_path / "old"


def test_cells_need_the_terms_that_lists_of_the_same_scene_hold(tmp_path: Path) -> None:
    with package_of(tmp_path / "p", 300) as package:
        levels, colors = package.contents.levels(), package.contents.colors().dequantize()
        with ActiveTerms.open(lists_of(tmp_path / "s", levels, colors)) as lists:
            assert len(lists) == len(package.active_terms) == 9
            for cell in range(9):
                assert np.array_equal(lists.active_ids(cell), package.active_terms.active_ids(cell))


def test_lists_in_a_package_are_what_it_computes_without_them(tmp_path: Path) -> None:
    levels, (_, colors) = levels_of(300), colors_of(300)
    info = PackageInfo(epsilon=EPSILON)
    with write_package(tmp_path / "p", levels, colors, info=info, visibility=sets_of(tmp_path, levels)) as package:
        known = [package.active_terms.active_ids(cell) for cell in range(9)]
        g = package.contents.gaussians()
        exact = package.contents.colors().dequantize()
        with VisibilityStore.open(sets_of(tmp_path, levels)) as store:
            path = tmp_path / "w.terms.arrow"
            list_package_terms(g, exact, store, EPSILON, path)
    parts = {"visibility": tmp_path / "w.pvs", "active_terms": path}
    with write_package(tmp_path / "listed", levels, colors, info=info, **parts) as listed:
        assert listed.manifest.sizes()["active_terms"] == path.stat().st_size
        assert listed.verify().strays == 0
        assert isinstance(listed.active_terms, ActiveTerms)
        assert listed.epsilon == EPSILON
        for cell in range(9):
            assert np.array_equal(listed.active_terms.active_ids(cell), known[cell])
    with StreamedScene.open(tmp_path / "listed").source as source:
        active = source.active()
        assert active is not None
        assert np.array_equal(active.active_ids(3), known[3])
    (part,) = [p for p in (tmp_path / "listed" / "parts").iterdir() if p.stat().st_size == path.stat().st_size]
    data = bytearray(part.read_bytes())
    data[len(data) // 2] ^= 1
    part.write_bytes(data)
    with Package.open(tmp_path / "listed") as broken, pytest.raises(FormatError):
        _ = broken.active_terms


def test_a_package_of_version_2_is_read(old: Path) -> None:
    with Package.open(old) as package:
        found = package.verify()
        assert (found.gaussians, found.cells, found.strays) == (120, 9, 0)
        assert package.manifest.version == 2
        assert package.manifest.sizes()["active_terms"] > 0
        assert package.epsilon == EPSILON
        made = Contents.from_levels(levels_of(120), colors_of(120)[1])
        for name in ("records", "term_counts", "term_records", "chunk_levels"):
            assert np.array_equal(getattr(package.contents, name), getattr(made, name))


def test_a_static_scene_of_version_2_has_the_same_bytes(
    old: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The lists of version 2 were made before rounding; no term of this scene is that near to epsilon."""
    with Package.open(old) as package:
        lists = ActiveTerms.open(package._join_blob(package.manifest.active_terms, "lists.arrow"))
        write_static(tmp_path / "found", package)
        monkeypatch.setattr(package, "active_terms", lists)
        write_static(tmp_path / "listed", package)
    names = sorted(p.relative_to(tmp_path / "found") for p in (tmp_path / "found").rglob("*") if p.is_file())
    assert [p for p in names if (tmp_path / "found" / p).read_bytes() != (tmp_path / "listed" / p).read_bytes()] == []
