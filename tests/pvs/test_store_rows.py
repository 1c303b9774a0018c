"""Rows of cells with right checksums that contradict each other, and what a store says of itself."""

from __future__ import annotations

import json
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from pyroaring import BitMap

from gsvis.errors import FormatError
from gsvis.files.sections import SectionFile, SectionWriter
from gsvis.pvs._order import MAX_DEPTH
from gsvis.pvs._writer import CELL_ROW, FILE_KIND
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.store import CellSet, StoreInfo, VisibilityStore, write_store
from gsvis.pvs.stored_certificates import CERTIFIED_ROW
from gsvis.scene.content import scene_hash
from gsvis.scene.levels import Levels, levels_record
from gsvis.scene.procedural import random_scene

CELLS, N = 8, 50
EDGES = np.array([1 / 255, 1 / 16])


def seen_by(cell: int) -> np.ndarray:
    """Gaussian 0 is seen by cell 5 alone, 1 to 4 by none, the others by most cells."""
    return np.array([i for i in range(5, N) if i % (cell + 2)] if cell != 5 else [0, 49])


@pytest.fixture
def path(tmp_path: Path) -> Path:
    coords = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.int32)
    grid = CellGrid(np.zeros(3), 1.0, (2, 2, 2), coords, np.array([0.0, 0.0, 1.0]))
    cells = [CellSet(ids, ids % 2, viewpoints=c, bound=0.5) for c in range(CELLS) for ids in [seen_by(c)]]
    return write_store(tmp_path / "x.pvs", grid, StoreInfo(N, "0" * 64, 1 / 255, EDGES), cells, np.zeros((N, 10), "u1"))


def forge(path: Path, rows: np.ndarray) -> None:
    """Replace the rows of cells and make all checksums fit."""
    data = bytearray(path.read_bytes())
    place = struct.unpack_from("<Q", data, 24)[0]
    header = json.loads(data[place:])
    listed = next(section for section in header["sections"] if section[0] == "cells")
    assert rows.nbytes == listed[2]
    data[listed[1] : listed[1] + listed[2]] = rows.tobytes()
    listed[3] = zlib.crc32(rows.tobytes())
    text = json.dumps(header).encode()
    fields = struct.pack("<QQII", place + len(text), place, len(text), zlib.crc32(text))
    head = bytes(data[:12]) + struct.pack("<I", zlib.crc32(fields)) + fields
    path.write_bytes(head + data[40:place] + text)


def rows_of(path: Path) -> np.ndarray:
    with VisibilityStore.open(path) as store:
        return np.array(store._rows, CELL_ROW)


def opens(path: Path, rows: np.ndarray) -> bool:
    """Whether a store with these rows opens; nothing but FormatError about cells may stop it."""
    forge(path, rows)
    try:
        VisibilityStore.open(path).close()
    except FormatError as error:
        assert "section 'cells'" in str(error)
        return False
    return True


def test_rows_that_agree_open(path: Path) -> None:
    rows = rows_of(path)
    assert opens(path, rows)
    rows["visible"] = N  # believed until the set is read
    assert opens(path, rows)
    with VisibilityStore.open(path) as store, pytest.raises(FormatError, match=f"expected {N} visible Gaussians"):
        store.visible(0)


@pytest.mark.parametrize("kind", ["set", "class"])
def test_cells_that_do_not_fill_their_section_in_order_are_refused(path: Path, kind: str) -> None:
    good = rows_of(path)
    for cell in (0, 3, CELLS - 1):
        for field in (f"{kind}_offset", f"{kind}_length"):
            for change in (-1, 1):
                rows = good.copy()
                rows[field][cell] = (int(rows[field][cell]) + change) % (1 << 32)
                assert not opens(path, rows), (field, cell, change)
    swapped = good.copy()
    swapped[[0, 1]] = swapped[[1, 0]]
    assert not opens(path, swapped)


def test_a_set_is_no_larger_than_the_scene(path: Path) -> None:
    rows = rows_of(path)
    rows["visible"][2] = N + 1
    assert not opens(path, rows)


def test_parents_are_cells_and_their_chains_are_short(path: Path) -> None:
    good = rows_of(path)
    for parent in (-2, CELLS, 1 << 30):
        rows = good.copy()
        rows["parent"][1] = parent
        assert not opens(path, rows), parent
    for length in range(1, CELLS):  # cell 0 has no parent, 1 has 0, 2 has 1, ...
        rows = good.copy()
        rows["parent"] = -1
        rows["parent"][: length + 1] = np.arange(length + 1) - 1
        assert opens(path, rows) == (length <= MAX_DEPTH), length
    for ring in (1, 2, CELLS):  # ends nowhere
        rows = good.copy()
        rows["parent"] = -1
        rows["parent"][:ring] = (np.arange(ring) + 1) % ring
        assert not opens(path, rows), ring


def test_sizes_are_those_of_the_sections(path: Path) -> None:
    with VisibilityStore.open(path) as store:
        sizes = store.sizes()
        sections = {name: section.length for name, section in store._file.sections.items()}
    assert {name: sizes[name] for name in sections} == sections
    file, pairs = path.stat().st_size, sum(len(seen_by(c)) for c in range(CELLS))
    assert sizes["file"] == file
    without = file - sections["classes"] - sections["directions"]
    assert sizes["bits_per_pair"] == pytest.approx(8 * without / pairs)
    assert sizes["class_bits_per_pair"] == pytest.approx(8 * sections["classes"] / pairs)


def test_a_gaussian_that_no_cell_sees_has_no_seer(path: Path) -> None:
    with VisibilityStore.open(path) as store:
        assert store.ever_visible() == BitMap([0, *range(5, N)])
        assert store.nearest_seer(3, 0) == (-1, np.inf)
        assert store.nearest_seer(0, 5) == (5, 0.0)
        assert store.nearest_seer(0, 4) == (5, 1.0)
        assert store.nearest_seer(0, 2) == (5, pytest.approx(np.sqrt(3.0)))
        assert [store.class_of(i, 5) for i in (0, 49, 7)] == [0, 1, -1]
        assert not store.direction_sets.flags.writeable


def test_a_store_of_levels_is_of_these_levels(tmp_path: Path) -> None:
    union = random_scene(np.random.default_rng(0), N)
    grid = CellGrid(np.zeros(3), 1.0, (1, 1, 1), np.zeros((1, 3), np.int32), np.array([0.0, 0.0, 1.0]))
    levels = Levels(union, np.arange(N, dtype=np.uint8) % 2, np.ones(N, np.uint8), ("low", "high"))
    other = Levels(union, np.arange(N, dtype=np.uint8) % 3 // 2, np.ones(N, np.uint8), ("low", "high"))
    info = StoreInfo(N, scene_hash(union), 1 / 255, EDGES, {"levels": levels_record(levels)})
    path = write_store(tmp_path / "x.pvs", grid, info, [CellSet([1], [0])], np.zeros((N, 10), "u1"))
    for right in (levels, union, Levels(union, levels.first, levels.last, levels.names)):
        VisibilityStore.open(path, scene=right).close()
    for wrong in (other, Levels.single(union)):
        with pytest.raises(FormatError, match="other levels"):
            VisibilityStore.open(path, scene=wrong)


def test_verify_reports_each_cell(path: Path) -> None:
    calls: list[tuple[str, int, int]] = []
    with VisibilityStore.open(path) as store:
        store.verify(progress=lambda *call: calls.append(call))
        assert calls == [("verify", c, CELLS) for c in range(CELLS + 1)]
        for level, interval in ((0, (1 / 255, 1 / 16)), (1, (1 / 16, 1.0))):
            assert store.class_interval(level) == pytest.approx(interval)
        for level in (-1, 2, True, 0.5):
            with pytest.raises(ValueError, match=r"level: expected a class in \[0, 2\)"):
                store.class_interval(level)


def sections_of(path: Path) -> tuple[dict, dict[str, bytes]]:
    """The header and the sections of a store."""
    file = SectionFile(path, FILE_KIND)
    try:
        return {k: v for k, v in file.header.value.items() if k != "sections"}, {
            name: file.read(name) for name in file.sections
        }
    finally:
        file.close()


def written(path: Path, header: dict, sections: dict[str, bytes]) -> Path:
    """A store of these sections, under right checksums."""
    with path.open("wb") as file:
        container = SectionWriter(file, FILE_KIND)
        for name, data in sections.items():
            container.append(data)
            container.close_section(name)
        container.finish(header)
    return path


def test_a_store_of_an_older_version_has_no_certificates(path: Path, tmp_path: Path) -> None:
    header, sections = sections_of(path)
    assert written(tmp_path / "same.pvs", header, sections).read_bytes() == path.read_bytes()
    sections.pop("certificates")
    rows = np.frombuffer(sections["cells"], CELL_ROW).copy()
    rows["unused"] = 0.25  # a growth stood there
    older = written(tmp_path / "older.pvs", header, {**sections, "cells": rows.tobytes()})
    with VisibilityStore.open(older) as store, VisibilityStore.open(path) as new:
        store.verify()
        certified = store.certificates
        assert not certified.known.any()
        for name in ("missed", "bound", "tile"):
            assert np.isnan(getattr(certified, name)).all()
            assert certified.as_dict()[name] is None
        assert certified.rays.tolist() == certified.inner.tolist() == [0] * CELLS
        assert (certified.as_dict()["cells"], certified.as_dict()["rays"]) == (0, 0)
        assert store.viewpoints.tolist() == new.viewpoints.tolist()
        for cell in range(CELLS):
            assert store.visible(cell) == new.visible(cell)
            assert store.classes(cell)[1].tolist() == new.classes(cell)[1].tolist()
        assert new.certificates.as_dict()["bound"] == {"mean": 0.5, "max": 0.5}


@pytest.mark.parametrize("name", ["missed", "bound", "tile"])
@pytest.mark.parametrize("value", [-0.5, 1.5, np.inf, -np.inf])
def test_a_share_out_of_range_is_damage(path: Path, tmp_path: Path, name: str, value: float) -> None:
    header, sections = sections_of(path)
    rows = np.frombuffer(sections["certificates"], CERTIFIED_ROW).copy()
    rows[name][3] = value
    bad = written(tmp_path / "bad.pvs", header, {**sections, "certificates": rows.tobytes()})
    with pytest.raises(FormatError, match=rf"section 'certificates'.*{name}"):
        VisibilityStore.open(bad)


@pytest.mark.parametrize("change", [slice(0, 0), slice(0, -1), slice(CERTIFIED_ROW.itemsize, None)])
def test_certificates_of_too_few_cells_are_damage(path: Path, tmp_path: Path, change: slice) -> None:
    header, sections = sections_of(path)
    sections["certificates"] = sections["certificates"][change]
    with pytest.raises(FormatError, match="section 'certificates'"):
        VisibilityStore.open(written(tmp_path / "bad.pvs", header, sections))


def test_a_changed_byte_of_a_certificate_is_damage(path: Path) -> None:
    with VisibilityStore.open(path) as store:
        place = store._file.section("certificates").offset
    data = bytearray(path.read_bytes())
    data[place] ^= 1
    path.write_bytes(data)
    with pytest.raises(FormatError, match="section 'certificates'"):
        VisibilityStore.open(path)
