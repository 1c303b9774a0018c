"""Files in a row are read as one, wherever a part of them begins and ends."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from gsvis.errors import FormatError
from gsvis.files.joined import JoinedFiles


def written(folder: Path, sizes: list[int]) -> tuple[JoinedFiles, bytes]:
    whole, paths = np.random.default_rng(0).bytes(sum(sizes)), [folder / f"{k}" for k in range(len(sizes))]
    for path, end, size in zip(paths, np.cumsum(sizes).tolist(), sizes, strict=True):
        path.write_bytes(whole[end - size : end])
    return JoinedFiles(paths, sizes), whole


def test_any_part_is_that_of_the_joined_files(tmp_path: Path) -> None:
    joined, whole = written(tmp_path, [5, 0, 1, 7, 0])
    assert joined.size == len(whole) == 13
    for start in range(15):
        for length in range(16):
            assert joined.read(start, length) == whole[start : start + length]


def test_a_file_that_was_cut_or_is_gone_is_named(tmp_path: Path) -> None:
    joined, whole = written(tmp_path, [5, 6])
    (tmp_path / "1").write_bytes(b"abc")
    assert joined.read(0, 5) == whole[:5]
    with pytest.raises(FormatError, match="expected 6 bytes"):
        joined.read(3, 8)
    (tmp_path / "1").unlink()
    with pytest.raises(FileNotFoundError):
        joined.read(3, 8)


@pytest.mark.skipif(not hasattr(os, "pread"), reason="the system cannot read from a place of a file")
def test_files_that_are_held_are_read_after_they_are_gone(tmp_path: Path) -> None:
    _, whole = written(tmp_path, [5, 0, 6])
    paths = [tmp_path / f"{k}" for k in range(3)]
    joined = JoinedFiles(paths, [5, 0, 6], is_held=True)
    paths[0].unlink()
    paths[2].rename(tmp_path / "away")
    paths[2].write_bytes(b"abcdef")
    for start in range(12):
        assert joined.read(start, 11) == whole[start:]
    joined.close()
    with pytest.raises(ValueError, match="closed"):
        joined.read(0, 3)
