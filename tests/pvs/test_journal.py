"""The work: what is packed comes back, what is damaged is not believed."""

from __future__ import annotations

import json
import os
import struct
import tracemalloc
import zlib
from pathlib import Path

import numpy as np
import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st

from gsvis.files.atomic import _host, atomic_path
from gsvis.files.resume import KeptWork, seal, unseal
from gsvis.pvs._journal import find_kept_cells, name_entry, pack_view, read_view, unpack_view
from gsvis.pvs.cell_view import CellView

N = 400
"""Gaussians of the scene."""


def some_view(seed: int) -> CellView:
    rng = np.random.default_rng(seed)
    ids = np.flatnonzero(rng.random(int(rng.integers(0, 400))) < rng.random()).astype(np.int32)
    classes = rng.integers(0, 4, len(ids)).astype(np.uint8)
    directions = rng.integers(0, 256, (len(ids), 10)).astype(np.uint8)
    return CellView(ids, classes, directions, int(rng.integers(0, 30)), float(np.float32(rng.random())))


VIEWS = st.builds(some_view, st.integers(0, 100_000))


def same(a: CellView | None, b: CellView) -> bool:
    return (
        a is not None
        and all(np.array_equal(getattr(a, name), getattr(b, name)) for name in ("ids", "classes", "directions"))
        and (a.viewpoints, a.growth, a.ids.dtype) == (b.viewpoints, b.growth, np.int32)
    )


def kept_bytes(view: CellView) -> bytes:
    return seal(pack_view(view))


def unkept(data: bytes, gaussians: int = N) -> CellView | None:
    body = unseal(data)
    return None if body is None else unpack_view(body, gaussians)


@given(VIEWS)
def test_what_is_packed_comes_back(view: CellView) -> None:
    assert same(unpack_view(pack_view(view), N), view)
    assert pack_view(view) == pack_view(view)


@given(VIEWS, st.data())
def test_a_changed_byte_or_a_cut_is_noticed(view: CellView, data: st.DataObject) -> None:
    packed = kept_bytes(view)
    place = data.draw(st.integers(0, len(packed) - 1))
    changed = bytearray(packed)
    changed[place] ^= 1 << data.draw(st.integers(0, 7))
    found = unkept(bytes(changed))
    assert found is None
    assert unkept(packed[:place]) is None
    assert unkept(packed + b"x") is None


@given(st.binary(max_size=100))
def test_other_bytes_are_no_view(data: bytes) -> None:
    assert unkept(data) is None


def test_cells_are_kept_until_the_work_goes(tmp_path: Path) -> None:
    work = KeptWork(tmp_path / "deep" / "j", {"what": "a test"})
    assert find_kept_cells(work, 9, N) == []
    assert not work.folder.exists()
    with work.opened():
        for cell in (0, 3, 7):
            work.keep(name_entry(cell), pack_view(some_view(cell)))
        with pytest.raises(ValueError, match="no other process"), KeptWork(work.folder, {}).opened():
            raise AssertionError("not reached")
    assert find_kept_cells(work, 9, N) == [0, 3, 7]
    assert find_kept_cells(work, 5, N) == [0, 3]
    assert same(read_view(work, 3, N), some_view(3))
    assert read_view(work, 1, N) is None
    assert json.loads((work.folder / "plan.json").read_text()) == {"what": "a test"}
    (work.folder / "cell-000003.bin").write_bytes(b"")
    assert find_kept_cells(work, 9, N) == [0, 7]
    work.remove()
    assert not work.folder.exists()


def test_what_a_killed_build_left_goes_once_and_cells_are_not_listed_for_each(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    work = KeptWork(tmp_path / "j", {})
    work.folder.mkdir()
    left = work.folder / f".cell-000001.gsvis-{_host()}01234567.bin"
    left.write_bytes(b"half")
    (work.folder / ".mine").write_text("somebody's")
    with atomic_path(work.folder / "cell-000002.bin") as live:
        live.write_bytes(b"")
        with work.opened():
            assert live.exists()
            assert left.exists() == (os.name != "posix")
            with monkeypatch.context() as patched:
                patched.delattr("gsvis.files.atomic.os.listdir")
                work.keep(name_entry(0), pack_view(some_view(0)))
    assert (work.folder / ".mine").exists()
    assert find_kept_cells(work, 3, N) == [0]


def test_every_flipped_bit_and_every_cut_counts_as_missing() -> None:
    packed = kept_bytes(some_view(3))
    for bit in range(8 * len(packed)):
        changed = bytearray(packed)
        changed[bit >> 3] ^= 1 << (bit & 7)
        assert unkept(bytes(changed)) is None
    assert all(unkept(packed[:length]) is None for length in range(len(packed)))


def forged(count: int, packed: bytes) -> bytes:
    """A view whose checksum is right."""
    rest = struct.pack("<IIf", count, 1, 0.5) + packed
    return struct.pack("<4sI", b"gvc2", zlib.crc32(rest)) + rest


def view_bytes(ids: list[int]) -> bytes:
    deltas = np.diff(ids, prepend=0).astype("<i4")
    body = deltas.view(np.uint8).reshape(-1, 4).T.tobytes() + bytes(11 * len(ids))
    return zstandard.ZstdCompressor().compress(body)


def test_a_right_checksum_over_a_wrong_view_counts_as_missing() -> None:
    good = unkept(forged(3, view_bytes([4, 5, 9])))
    assert good is not None
    assert good.ids.tolist() == [4, 5, 9]
    for count, packed in (
        (3, b"no zstd frame"),
        (3, view_bytes([4, 5])),
        (3, view_bytes([4, 9, 5])),
        (3, view_bytes([4, 4, 5])),
        (3, view_bytes([-4, 5, 9])),
        (0xFFFFFFFF, view_bytes([4, 5, 9])),
    ):
        assert unkept(forged(count, packed)) is None
    assert unkept(forged(3, view_bytes([4, 5, 9])), 10) is not None
    assert unkept(forged(3, view_bytes([4, 5, 9])), 9) is None  # there is no Gaussian 9
    assert unkept(forged(3, view_bytes([0, 1, 2])), 2) is None


def test_a_cell_may_see_all_of_a_large_scene(tmp_path: Path) -> None:
    count = 5_000_000  # 75 MB, of which zstd makes a few kB
    ids = np.arange(count, dtype=np.int32)
    view = CellView(ids, np.zeros(count, np.uint8), np.full((count, 10), 255, np.uint8), 9, 0.5)
    work = KeptWork(tmp_path / "j", {})
    work.folder.mkdir()
    work.keep(name_entry(0), pack_view(view))
    found = read_view(work, 0, count)
    assert found is not None
    assert np.array_equal(found.ids, ids)
    assert found.directions[-1].tolist() == [255] * 10


def test_what_a_file_promises_takes_no_more_memory_than_the_scene(tmp_path: Path) -> None:
    bomb = zstandard.ZstdCompressor().compress(bytes(15 << 24))
    work = KeptWork(tmp_path, {})
    (tmp_path / name_entry(0)).write_bytes(forged(1 << 24, bomb))
    (tmp_path / name_entry(1)).write_bytes(kept_bytes(some_view(1)) + bytes(1 << 24))
    tracemalloc.start()
    assert read_view(work, 0, 1000) is None
    assert read_view(work, 1, 1000) is None
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 1 << 20
