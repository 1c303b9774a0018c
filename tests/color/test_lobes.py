"""Inner products of rows: nothing beyond an array is read."""

from __future__ import annotations

import ctypes
import mmap
import sys

import numpy as np
import pytest

from gsvis.color._kernels.lobes import dots

PAGE = mmap.PAGESIZE
WIDTH = 320


@pytest.mark.skipif(sys.platform != "linux", reason="protects a page as Linux does")
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_targets_may_end_where_memory_ends(channels: int) -> None:
    room = mmap.mmap(-1, 3 * PAGE)
    start = ctypes.addressof(ctypes.c_char.from_buffer(room))
    libc = ctypes.CDLL(None, use_errno=True)
    assert libc.mprotect(ctypes.c_void_p(start + 2 * PAGE), ctypes.c_size_t(PAGE), 0) == 0  # reading there is fatal
    size = channels * WIDTH
    targets = np.frombuffer(room, np.float32, size, 2 * PAGE - 4 * size).reshape(channels, WIDTH)
    rng = np.random.default_rng(channels)
    targets[:] = rng.random((channels, WIDTH))
    rows = rng.random((8, WIDTH)).astype(np.float32)
    found = np.empty((8, channels))
    dots(rows, 8, targets, channels, WIDTH, np.empty(16, np.float32), found)
    np.testing.assert_allclose(found, rows.astype(np.float64) @ targets.T, rtol=1e-5)
