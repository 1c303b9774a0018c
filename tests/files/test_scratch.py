"""Arrays in temporary files: they hold what was written, also when their memory was given back, and leave no file."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import numpy as np
import pytest

from gsvis.errors import OutputError
from gsvis.files.mapped import release_mapped
from gsvis.files.scratch import Scratch

ROWS = 300_000


def in_memory(array: np.ndarray) -> int:
    """Return the bytes of an array's pages that this process maps."""
    place = array.ctypes.data
    size = 0
    inside = False
    for line in Path("/proc/self/smaps").read_text().splitlines():
        words = line.split()
        if "-" in words[0] and not words[0].endswith(":"):
            low, high = (int(end, 16) for end in words[0].split("-"))
            inside = low <= place < high
        elif inside and words[0] == "Rss:":
            size += 1024 * int(words[1])
    return size


@pytest.mark.parametrize("in_file", [False, True])
def test_content_stays(tmp_path: Path, in_file: bool) -> None:
    scratch = Scratch(tmp_path / "new" if in_file else None)
    zeros = scratch.zeros((ROWS, 2))
    copied = scratch.copy(np.arange(ROWS, dtype=np.int32))
    zeros[5:9] = 3.0
    scratch.release()
    copied[7] = -1
    scratch.release()
    assert zeros.dtype == np.float32
    assert zeros.sum() == 24.0
    expected = np.arange(ROWS)
    expected[7] = -1
    assert np.array_equal(copied, expected)


def test_small_and_empty_arrays(tmp_path: Path) -> None:
    scratch = Scratch(tmp_path)
    assert scratch.zeros((0, 3)).shape == (0, 3)
    assert scratch.copy(np.ones((1, 1), np.float32)).tolist() == [[1.0]]


def test_no_file_is_seen(tmp_path: Path) -> None:
    kept = Scratch(tmp_path).zeros((ROWS,))
    kept[0] = 1.0
    assert os.listdir(tmp_path) == []


@pytest.mark.skipif(not Path("/proc/self/smaps").exists(), reason="needs Linux")
def test_memory_is_given_back(tmp_path: Path) -> None:
    scratch = Scratch(tmp_path)
    array = scratch.zeros((ROWS,))
    array[:] = 1.0
    assert in_memory(array) >= array.nbytes
    scratch.release()
    assert in_memory(array) <= 4096
    array[:] += 1.0
    array.flags.writeable = False
    release_mapped([array])
    assert in_memory(array) <= 2 * 4096
    assert (array == 2.0).all()


def test_a_full_disk_is_an_error_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("os.posix_fallocate", full)
    with pytest.raises(OutputError, match=tmp_path.name):
        Scratch(tmp_path).zeros((ROWS,))
