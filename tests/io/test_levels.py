"""Levels come back from their folder bit by bit; what was lost or changed there is reported by name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsvis.errors import FormatError
from gsvis.files.arrow import ArrowFile, write_arrow
from gsvis.files.limits import Budget
from gsvis.io.levels import MAP, levels_info, load_levels, save_levels
from gsvis.io.ply import load_ply, save_ply
from gsvis.scene.content import scene_hash
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels

NAMES = ("low", "medium", "high")


def levels_of(n: int = 200, seed: int = 0, degree: int = 1) -> Levels:
    rng = np.random.default_rng(seed)
    scales = np.exp(rng.normal(-4, 2, (n, 3)))
    opacities = np.concatenate([[0.0, 1.0, 1e-42], rng.uniform(0, 1, n - 3)])
    shN = rng.normal(size=(n, (degree + 1) ** 2 - 1, 3))
    g = Gaussians(rng.normal(size=(n, 3)), rng.normal(size=(n, 4)), scales, opacities, rng.normal(size=(n, 1, 3)), shN)
    first = rng.integers(0, 3, n).astype(np.uint8)
    first[:3] = 0, 1, 2
    last = np.maximum(first, rng.integers(0, 3, n)).astype(np.uint8)
    return Levels(g, first, last, NAMES)


def same(a: Levels, b: Levels) -> None:
    assert a.names == b.names
    assert scene_hash(a.union) == scene_hash(b.union)
    np.testing.assert_array_equal(a.first, b.first)
    np.testing.assert_array_equal(a.last, b.last)


@given(seed=st.integers(0, 1 << 30), n=st.integers(4, 60), degree=st.integers(0, 3))
def test_what_is_loaded_is_what_was_saved_bit_by_bit(tmp_path: Path, seed: int, n: int, degree: int) -> None:
    levels = levels_of(n, seed, degree)
    save_levels(levels, tmp_path / "out")
    same(load_levels(tmp_path / "out"), levels)


def test_each_level_is_a_ply_in_the_order_of_the_union(tmp_path: Path) -> None:
    levels = levels_of()
    save_levels(levels, tmp_path, {"shares": [0.25, 0.5, 1.0]})
    for k, name in enumerate(NAMES):
        np.testing.assert_array_equal(load_ply(tmp_path / f"{name}.ply").means, levels.level(k).means)
    info = levels_info(tmp_path)
    assert info.names == NAMES
    assert info.files == ("low.ply", "medium.ply", "high.ply")
    assert info.counts == levels.counts
    assert info.gaussians == len(levels.union)
    assert info.extra == {"shares": [0.25, 0.5, 1.0]}


def test_one_level_and_a_level_of_shared_gaussians_alone(tmp_path: Path) -> None:
    g = levels_of().union
    save_levels(Levels.single(g), tmp_path / "one")
    same(load_levels(tmp_path / "one"), Levels.single(g))
    shared = Levels(g, np.zeros(len(g), np.uint8), np.arange(len(g)) % 2, ("low", "high"))
    save_levels(shared, tmp_path / "two")
    same(load_levels(tmp_path / "two"), shared)


def test_same_levels_same_bytes_and_other_files_stay(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "notes.txt").write_text("mine")
    save_levels(levels_of(seed=1), tmp_path / "a")
    save_levels(levels_of(), tmp_path / "a", {"x": 1})
    save_levels(levels_of(), tmp_path / "b", {"x": 1})
    for name in ("low.ply", "medium.ply", "high.ply", MAP):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    assert (tmp_path / "a" / "notes.txt").read_text() == "mine"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a", "b"]


def test_a_failed_write_leaves_what_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save_levels(levels_of(), tmp_path / "out")

    def fail(*_: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr("gsvis.io.levels.write_arrow", fail)
    with pytest.raises(OSError, match="disk full"):
        save_levels(levels_of(seed=1), tmp_path / "out")
    same(load_levels(tmp_path / "out"), levels_of())
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_a_missing_or_changed_ply_is_refused(tmp_path: Path) -> None:
    save_levels(levels_of(), tmp_path)
    data = bytearray((tmp_path / "low.ply").read_bytes())
    data[-1] ^= 1
    (tmp_path / "low.ply").write_bytes(data)
    with pytest.raises(FormatError, match=r"low\.ply: expected a content of SHA-256"):
        load_levels(tmp_path)
    save_ply(levels_of().union, tmp_path / "low.ply")  # a valid PLY of another count
    with pytest.raises(FormatError, match="changed since"):
        load_levels(tmp_path)
    (tmp_path / "low.ply").unlink()
    with pytest.raises(FormatError, match="no such file"):
        load_levels(tmp_path)
    (tmp_path / MAP).unlink()
    with pytest.raises(FileNotFoundError):
        load_levels(tmp_path)


def rewritten(folder: Path, **changes: object) -> None:
    """The map with another header, under a checksum that fits."""
    file = ArrowFile(folder / MAP, "gsvis-levels", 1)
    batches = [pa.RecordBatch.from_pylist(b.to_pylist(), schema=b.schema) for b in file.batches(Budget(MAP, 1 << 20))]
    write_arrow(folder / MAP, list(file.schema), file.header.value | changes, batches)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"version": 2}, "update gsvis"),
        ({"gaussians": 7}, "rows"),
        ({"levels": []}, "1 to 16"),
        ({"extra": 3}, "extra"),
        ({"format": "other"}, "gsvis-levels"),
    ],
)
def test_a_header_that_does_not_fit_is_refused(tmp_path: Path, changes: dict[str, object], message: str) -> None:
    save_levels(levels_of(20), tmp_path)
    rewritten(tmp_path, **changes)
    with pytest.raises(FormatError, match=message):
        load_levels(tmp_path)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("file", "../low.ply", "leave the folder"),
        ("file", "/etc/passwd", "leave the folder"),
        ("count", 3, "3 Gaussians"),
        ("name", "high", "a unique name"),
        ("name", 7, "a unique name"),
        ("sha256", "no", "64 hexadecimal"),
    ],
)
def test_a_level_row_that_does_not_fit_is_refused(tmp_path: Path, key: str, value: object, message: str) -> None:
    save_levels(levels_of(40), tmp_path)
    rows = ArrowFile(tmp_path / MAP, "gsvis-levels", 1).header.items("levels")
    rows[0][key] = value
    rewritten(tmp_path, levels=rows)
    with pytest.raises(FormatError, match=message):
        load_levels(tmp_path)


def test_no_damaged_byte_of_the_map_passes(tmp_path: Path) -> None:
    save_levels(levels_of(20), tmp_path)
    whole = (tmp_path / MAP).read_bytes()
    for place in range(0, len(whole), max(1, len(whole) // 60)):
        damaged = bytearray(whole)
        damaged[place] ^= 0x55
        (tmp_path / MAP).write_bytes(damaged)
        with pytest.raises(FormatError):
            load_levels(tmp_path)
    (tmp_path / MAP).write_bytes(whole[:-20])
    with pytest.raises(FormatError):
        load_levels(tmp_path)


@pytest.mark.parametrize("name", ["", "a/b", "..", "a b", "levels.arrow"])
def test_a_level_whose_name_is_no_file_name_is_refused(tmp_path: Path, name: str) -> None:
    levels = levels_of(10)
    with pytest.raises(ValueError, match="names: expected"):
        save_levels(Levels.single(levels.union, name), tmp_path)
    with pytest.raises(ValueError, match="more than case"):
        save_levels(Levels(levels.union, levels.first, levels.last, ("low", "LOW", "high")), tmp_path)


def test_extra_is_json(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="extra: expected JSON values"):
        save_levels(levels_of(10), tmp_path, {"x": float("nan")})
