"""Archives of arrays that are kept between runs: the same comes back, and no damage is believed or escapes."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest

from gsvis.errors import FormatError
from gsvis.files.archive import load_arrays, save_arrays
from gsvis.jobs.resume import KeptWork

ARRAYS = {"sets": np.arange(20, dtype=np.uint8).reshape(2, 10), "traced": np.array([7])}
LIKE = {"sets": ((2, 10), np.uint8), "traced": ((1,), np.int64)}


def same(found: dict[str, np.ndarray], wanted: dict[str, np.ndarray]) -> bool:
    return list(found) == list(wanted) and all(
        found[name].dtype == wanted[name].dtype and np.array_equal(found[name], wanted[name]) for name in wanted
    )


def test_what_is_saved_comes_back_and_numpy_reads_it(tmp_path: Path) -> None:
    arrays = ARRAYS | {
        "none": np.zeros((0, 3), np.float32), "one": np.array(2.5), "by column": np.asfortranarray(np.eye(3)[:2])
    }  # fmt: skip
    save_arrays(tmp_path / "a", arrays)
    found = load_arrays(tmp_path / "a", sealed=True)
    assert same(found, arrays)
    found["sets"][0] = 1  # it may be changed
    with np.load(tmp_path / "a") as archive:
        assert same(dict(archive), arrays)
    before = (tmp_path / "a").read_bytes()
    save_arrays(tmp_path / "a", arrays)
    assert [path.name for path in tmp_path.iterdir()] == ["a"]
    assert len(before) == (tmp_path / "a").stat().st_size


def test_every_flipped_bit_and_every_cut_counts_as_missing(tmp_path: Path) -> None:
    kept = KeptWork.beside(tmp_path / "out", {"what": 1})
    kept.keep_arrays("a.npz", ARRAYS)
    path = kept.folder / "a.npz"
    whole = path.read_bytes()
    assert same(kept.read_arrays("a.npz", LIKE), ARRAYS)
    for bit in range(8 * len(whole)):
        changed = bytearray(whole)
        changed[bit >> 3] ^= 1 << (bit & 7)
        path.write_bytes(changed)
        assert kept.read_arrays("a.npz", LIKE) == {}
    for length in range(len(whole)):
        path.write_bytes(whole[:length])
        assert kept.read_arrays("a.npz", LIKE) == {}


def test_arrays_of_another_shape_or_type_count_as_missing(tmp_path: Path) -> None:
    kept = KeptWork.beside(tmp_path / "out", {})
    others = {"sets": ARRAYS["sets"].astype(np.float32), "traced": ARRAYS["traced"][None], "other": ARRAYS["sets"]}
    kept.keep_arrays("a.npz", others)
    assert kept.read_arrays("a.npz", LIKE) == {}
    assert kept.read_arrays("b.npz", LIKE) == {}


def test_damage_of_an_archive_without_checksum_is_a_format_error(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    np.savez(path, **ARRAYS)  # type: ignore[arg-type]
    whole = path.read_bytes()
    assert same(load_arrays(path), ARRAYS)
    with pytest.raises(FormatError, match="expected a checksum at the end"):
        load_arrays(path, sealed=True)
    refused = 0
    for bit in range(8 * len(whole)):
        changed = bytearray(whole)
        changed[bit >> 3] ^= 1 << (bit & 7)
        path.write_bytes(changed)
        try:
            load_arrays(path)
        except FormatError:
            refused += 1
    assert refused > len(whole)
    for length in range(len(whole)):
        path.write_bytes(whole[:length])
        with pytest.raises(FormatError):
            load_arrays(path)


def archive_of(name: str, content: bytes, compression: int = zipfile.ZIP_STORED) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", compression) as archive:
        archive.writestr(name, content)
    return out.getvalue()


def test_what_promises_more_than_it_holds_is_refused(tmp_path: Path) -> None:
    good = io.BytesIO()
    np.save(good, np.zeros(16, np.uint8))
    data = good.getvalue()
    path = tmp_path / "a"
    for content, compression in (
        (data.replace(b"(16,)", b"(1<<", 1), zipfile.ZIP_STORED),
        (data.replace(b"(16,), }      ", b"(16000000000,)", 1), zipfile.ZIP_STORED),
        (data.replace(b"'|u1'", b"'|O8'", 1), zipfile.ZIP_STORED),
        (data, zipfile.ZIP_DEFLATED),
        (data[:-1], zipfile.ZIP_STORED),
        (data + b"x", zipfile.ZIP_STORED),
        (b"", zipfile.ZIP_STORED),
    ):
        path.write_bytes(archive_of("a.npy", content, compression))
        with pytest.raises(FormatError, match="an archive of arrays"):
            load_arrays(path)
    path.write_bytes(archive_of("a.npy", data))
    assert len(load_arrays(path)["a"]) == 16
