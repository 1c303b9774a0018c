"""Mapped arrays that were written piece by piece are those that were written at once."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gsvis.errors import FormatError
from gsvis.files.mapped import ArrayFiles, MappedArrays, release_mapped, resident_bytes, write_arrays


def test_arrays_that_grow_in_pieces_are_read_as_those_written_at_once(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    first, second, wide = rng.random(3000), rng.random(3000), rng.integers(0, 9, (777, 3)).astype(np.int16)
    (tmp_path / "parts").mkdir()
    with ArrayFiles(tmp_path / "parts") as out:
        for k in range(3):
            out.append("x", first[1000 * k : 1000 * (k + 1)])
            out.append("y", second[1000 * k : 1000 * (k + 1)])
            out.append("wide", wide[259 * k : 259 * (k + 1)])
        out.append("none", np.zeros((0, 4), np.uint8))
        assert out.count("wide") == 777
        assert np.array_equal(out.rows("wide", 5, 300), wide[5:300])
        joined, same = {"rows": ["x", "y"]}, {"again": "wide"}
        out.write(tmp_path / "pieces", {"a": 1}, joined=joined, same=same, frozen=["wide"])
    found = MappedArrays(tmp_path / "pieces")
    assert found.facts == {"a": 1}
    assert np.array_equal(found.arrays["rows"], np.stack([first, second]))
    assert np.array_equal(found.arrays["wide"], wide)
    assert np.array_equal(found.arrays["again"], wide)
    assert found.arrays["none"].shape == (0, 4)
    assert not found.arrays["wide"].flags.writeable
    assert found.arrays["rows"].flags.writeable


def test_what_is_released_reads_as_before_and_only_shares_of_each_line_are(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    arrays = {"long": rng.random(1 << 16), "lines": rng.random((3, 1 << 15)).astype(np.float32), "none": np.zeros(0)}
    write_arrays(tmp_path / "x", arrays, {})
    found = MappedArrays(tmp_path / "x")
    assert sorted(size for _, size in found._lines if size) == [*3 * [4 << 15], 8 << 16]
    for array in found.arrays.values():
        array.reshape(-1)[:] = 0.0  # stays in this process until its page is given back
    found.release([(0.25, 0.5), (0.9, 0.9)])
    for name, whole in arrays.items():
        low, high = whole.shape[-1] // 4, whole.shape[-1] // 2
        assert np.array_equal(found.arrays[name][..., low:high], whole[..., low:high])
        assert not found.arrays[name][..., :low].any()
        assert not found.arrays[name][..., high:].any()
    found.release()
    for name, whole in arrays.items():
        assert np.array_equal(found.arrays[name], whole)


@pytest.mark.skipif(resident_bytes() == 0, reason="this system does not tell which files are in memory")
def test_arrays_know_the_file_that_they_lie_in(tmp_path: Path) -> None:
    large = np.random.default_rng(2).random((1 << 20, 2))
    large.flags.writeable = False
    write_arrays(tmp_path / "x", {"large": large}, {})
    found = MappedArrays(tmp_path / "x").arrays["large"].view()
    np.testing.assert_array_equal(found, large)
    before = resident_bytes()
    release_mapped([found, found[1::2], large, "no array", large.copy()])
    assert resident_bytes() < before - large.nbytes // 2
    np.testing.assert_array_equal(found, large)


def test_a_change_of_any_byte_that_counts_is_found(tmp_path: Path) -> None:
    """Flip a bit, blank a stretch, and swap two words, at places all over a file of more than one piece."""
    rng = np.random.default_rng(2)
    arrays = {"a": rng.integers(1, 255, 70_000, dtype=np.uint8), "b": rng.random((8_000, 7)), "c": np.ones(5, "u1")}
    write_arrays(tmp_path / "x", arrays, {"n": 1})
    whole = (tmp_path / "x").read_bytes()
    MappedArrays(tmp_path / "x").check()
    for place in [*range(24), *rng.integers(0, len(whole), 50), *range(len(whole) - 20, len(whole))]:
        flipped, blank = bytearray(whole), bytearray(whole)
        flipped[place] ^= 1 << int(rng.integers(8))
        blank[place : place + 4096] = bytes(len(blank[place : place + 4096]))
        swapped = np.frombuffer(whole, np.uint8).copy()
        swapped[[place, place // 2]] = swapped[[place // 2, place]]
        for data in (flipped, blank, swapped.tobytes()):
            (tmp_path / "y").write_bytes(data)
            try:
                found = MappedArrays(tmp_path / "y")
                found.check()
            except FormatError:
                continue
            assert found.facts == {"n": 1}
            assert all(np.array_equal(found.arrays[name], array) for name, array in arrays.items()), place


def test_a_check_reads_pieces_of_every_length(tmp_path: Path) -> None:
    for words in (0, 1, 512, (1 << 15) - 1, 1 << 15, (1 << 15) + 1, 3 << 15):
        write_arrays(tmp_path / "x", {"a": np.arange(words, dtype=np.uint64)}, {})
        MappedArrays(tmp_path / "x").check()
        data = bytearray((tmp_path / "x").read_bytes())
        if words:
            data[4096 + 8 * words - 1] ^= 1
            (tmp_path / "x").write_bytes(data)
            with pytest.raises(FormatError, match="the bytes that were written"):
                MappedArrays(tmp_path / "x").check()


def test_pages_larger_than_a_file_are_no_reason_to_refuse_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_arrays(tmp_path / "x", {"a": np.arange(10)}, {})
    monkeypatch.setattr("mmap.PAGESIZE", 1 << 16)
    found = MappedArrays(tmp_path / "x")
    found.check()
    found.release([(0.0, 1.0)])
    found.release()
    assert found.arrays["a"].tolist() == list(range(10))
