"""The work: what is packed comes back, what is damaged is not believed."""

from __future__ import annotations

import json
import os
import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st

from gsvis.files.atomic import _host, atomic_path
from gsvis.files.sums import seal, unseal
from gsvis.jobs.resume import KeptWork
from gsvis.pvs._journal import (
    find_kept,
    name_cell,
    name_viewpoint,
    pack_sighting,
    pack_view,
    read_sighting,
    read_view,
    unpack_sighting,
    unpack_view,
)
from gsvis.pvs.cell_view import CellView, Figures
from gsvis.pvs.sightings import Sighting

N = 400
"""Gaussians of the scene."""


def some_ids(rng: np.random.Generator) -> np.ndarray:
    return np.flatnonzero(rng.random(int(rng.integers(0, N))) < rng.random()).astype(np.int32)


def some_view(seed: int) -> CellView:
    rng = np.random.default_rng(seed)
    ids = some_ids(rng)
    classes = rng.integers(0, 4, len(ids)).astype(np.uint8)
    directions = rng.integers(0, 256, (len(ids), 10)).astype(np.uint8)
    missed, bound, tile = rng.random(3) if seed % 4 else np.full(3, np.nan)
    figures = Figures(*rng.integers(0, 1 << 20, 3).tolist(), float(missed), float(bound), float(tile))
    return CellView(ids, classes, directions, figures, rng.normal(size=(int(rng.integers(0, 9)), 6)))


def some_sighting(seed: int) -> Sighting:
    rng = np.random.default_rng(seed)
    ids = some_ids(rng)
    return Sighting(rng.normal(size=3), seed % 4, ids, rng.integers(-6, 4, len(ids)).astype(np.int8))


VIEWS = st.builds(some_view, st.integers(0, 100_000))
SIGHTINGS = st.builds(some_sighting, st.integers(0, 100_000))


def same(a: CellView | None, b: CellView) -> bool:
    return (
        a is not None
        and all(np.array_equal(getattr(a, name), getattr(b, name)) for name in ("ids", "classes", "directions"))
        and repr(a.figures) == repr(b.figures)  # NaN is not equal to itself
        and np.array_equal(a.checked, b.checked)
        and (a.ids.dtype, a.classes.dtype, a.directions.dtype) == (np.int32, np.uint8, np.uint8)
    )


def same_sighting(a: Sighting | None, b: Sighting) -> bool:
    return (
        a is not None
        and all(np.array_equal(getattr(a, name), getattr(b, name)) for name in ("ids", "classes", "viewpoint"))
        and (a.looks, a.ids.dtype, a.classes.dtype) == (b.looks, np.int32, np.int8)
    )


def kept_bytes(kept: CellView | Sighting) -> bytes:
    return seal(pack_view(kept) if isinstance(kept, CellView) else pack_sighting(kept))


def unkept(data: bytes, gaussians: int = N) -> CellView | None:
    body = unseal(data)
    return None if body is None else unpack_view(body, gaussians)


def unkept_sighting(data: bytes, gaussians: int = N) -> Sighting | None:
    body = unseal(data)
    return None if body is None else unpack_sighting(body, gaussians)


@given(VIEWS)
def test_what_is_packed_comes_back(view: CellView) -> None:
    assert same(unpack_view(pack_view(view), N), view)
    assert pack_view(view) == pack_view(view)


@given(SIGHTINGS)
def test_what_a_viewpoint_sees_comes_back(sighting: Sighting) -> None:
    assert same_sighting(unpack_sighting(pack_sighting(sighting), N), sighting)
    assert pack_sighting(sighting) == pack_sighting(sighting)


@given(VIEWS | SIGHTINGS, st.data())
def test_a_changed_byte_or_a_cut_is_noticed(kept: CellView | Sighting, data: st.DataObject) -> None:
    packed = kept_bytes(kept)
    place = data.draw(st.integers(0, len(packed) - 1))
    changed = bytearray(packed)
    changed[place] ^= 1 << data.draw(st.integers(0, 7))
    for read in (unkept, unkept_sighting):
        assert read(bytes(changed)) is None
        assert read(packed[:place]) is None
        assert read(packed + b"x") is None


@given(st.binary(max_size=100))
def test_other_bytes_are_no_view(data: bytes) -> None:
    assert unkept(data) is None
    assert unkept_sighting(data) is None
    unpack_view(data, N)  # without a checksum they may be anything; nothing is raised
    unpack_sighting(data, N)


def test_viewpoints_and_cells_are_kept_until_the_work_goes(tmp_path: Path) -> None:
    work = KeptWork(tmp_path / "deep" / "j", {"what": "a test"})
    assert find_kept(work, 9, 9, N) == ([], [])
    assert not work.folder.exists()
    with work.opened():
        for cell in (0, 3, 7):
            work.keep(name_cell(cell), pack_view(some_view(cell)))
        for number in (2, 3):
            work.keep(name_viewpoint(number), pack_sighting(some_sighting(number)))
        with pytest.raises(ValueError, match="no other process"), KeptWork(work.folder, {}).opened():
            raise AssertionError("not reached")
    assert find_kept(work, 9, 9, N) == ([2, 3], [0, 3, 7])
    assert find_kept(work, 3, 5, N) == ([2], [0, 3])
    assert same(read_view(work, 3, N), some_view(3))
    assert same_sighting(read_sighting(work, 3, N), some_sighting(3))
    assert read_view(work, 1, N) is None
    assert read_sighting(work, 1, N) is None
    assert json.loads((work.folder / "plan.json").read_text()) == {"what": "a test"}
    (work.folder / "cell-000003.bin").write_bytes(b"")
    (work.folder / "viewpoint-000002.bin").write_bytes(kept_bytes(some_sighting(2))[:-1])
    assert find_kept(work, 9, 9, N) == ([3], [0, 7])
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
                work.keep(name_cell(0), pack_view(some_view(0)))
    assert (work.folder / ".mine").exists()
    assert find_kept(work, 3, 3, N) == ([], [0])


@pytest.mark.parametrize("kept", [some_view(3), some_sighting(3)], ids=["cell", "viewpoint"])
def test_every_flipped_bit_and_every_cut_counts_as_missing(kept: CellView | Sighting) -> None:
    packed = kept_bytes(kept)
    read = unkept if isinstance(kept, CellView) else unkept_sighting
    assert read(packed) is not None
    for bit in range(8 * len(packed)):
        changed = bytearray(packed)
        changed[bit >> 3] ^= 1 << (bit & 7)
        assert read(bytes(changed)) is None
    assert all(read(packed[:length]) is None for length in range(len(packed)))


def forged(count: int, packed: bytes, checked: int = 0) -> bytes:
    """A view whose checksum is right."""
    return seal(struct.pack("<II3I3d", count, checked, 1, 0, 64, 0.0, 0.5, 0.0) + packed)


def forged_sighting(count: int, packed: bytes) -> bytes:
    """A sighting whose checksum is right."""
    return seal(struct.pack("<II3d", count, 1, 0.0, 0.5, 1.0) + packed)


def body_of(ids: list[int], more: int) -> bytes:
    """Ids as they are packed, and so many bytes more for each."""
    deltas = np.diff(ids, prepend=0).astype("<i4")
    body = deltas.view(np.uint8).reshape(-1, 4).T.tobytes() + bytes(more * len(ids))
    return zstandard.ZstdCompressor().compress(body)


def view_bytes(ids: list[int]) -> bytes:
    return body_of(ids, 11)


def sighting_bytes(ids: list[int]) -> bytes:
    return body_of(ids, 1)


WRONG = ([4, 9, 5], [4, 4, 5], [-4, 5, 9])


def test_a_right_checksum_over_a_wrong_view_counts_as_missing() -> None:
    good = unkept(forged(3, view_bytes([4, 5, 9])))
    assert good is not None
    assert good.ids.tolist() == [4, 5, 9]
    assert unkept(forged(0, view_bytes([]), 2)) is None  # two rays that are not there
    assert unkept(forged(0, zstandard.ZstdCompressor().compress(bytes(96)), 2)) is not None
    assert unkept(forged(0, view_bytes([]), 0xFFFFFFFF)) is None
    for count, packed in (
        (3, b"no zstd frame"),
        (3, view_bytes([4, 5])),
        *((3, view_bytes(ids)) for ids in WRONG),
        (0xFFFFFFFF, view_bytes([4, 5, 9])),
    ):
        assert unkept(forged(count, packed)) is None
    assert unkept(forged(3, view_bytes([4, 5, 9])), 10) is not None
    assert unkept(forged(3, view_bytes([4, 5, 9])), 9) is None  # there is no Gaussian 9
    assert unkept(forged(3, view_bytes([0, 1, 2])), 2) is None


def test_a_right_checksum_over_a_wrong_sighting_counts_as_missing() -> None:
    good = unkept_sighting(forged_sighting(3, sighting_bytes([4, 5, 9])))
    assert good is not None
    assert good.ids.tolist() == [4, 5, 9]
    assert good.viewpoint.tolist() == [0.0, 0.5, 1.0]
    for count, packed in (
        (3, b"no zstd frame"),
        (3, sighting_bytes([4, 5])),
        (3, view_bytes([4, 5, 9])),
        *((3, sighting_bytes(ids)) for ids in WRONG),
        (0xFFFFFFFF, sighting_bytes([4, 5, 9])),
    ):
        assert unkept_sighting(forged_sighting(count, packed)) is None
    assert unkept_sighting(forged_sighting(3, sighting_bytes([4, 5, 9])), 10) is not None
    assert unkept_sighting(forged_sighting(3, sighting_bytes([4, 5, 9])), 9) is None


def test_a_cell_or_a_viewpoint_may_see_all_of_a_large_scene(tmp_path: Path) -> None:
    count = 5_000_000  # 75 MB, of which zstd makes a few kB
    ids, classes = np.arange(count, dtype=np.int32), np.zeros(count, np.uint8)
    figures = Figures(9, 1, 8192, 0.0, 0.001, 0.0)
    work = KeptWork(tmp_path / "j", {})
    work.folder.mkdir()
    view = CellView(ids, classes, np.full((count, 10), 255, np.uint8), figures, np.zeros((8, 6)))
    work.keep(name_cell(0), pack_view(view))
    work.keep(name_viewpoint(0), pack_sighting(Sighting(np.zeros(3), 1, ids, classes.view(np.int8))))
    found, seen = read_view(work, 0, count), read_sighting(work, 0, count)
    assert found is not None
    assert seen is not None
    assert np.array_equal(found.ids, ids)
    assert np.array_equal(seen.ids, ids)
    assert found.directions[-1].tolist() == [255] * 10


def test_what_does_not_compress_is_not_taken_for_damage(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    work = KeptWork(tmp_path, {})
    ids = np.arange(N, dtype=np.int32)
    classes = rng.integers(0, 256, N).astype(np.uint8)
    directions = rng.integers(0, 256, (N, 10)).astype(np.uint8)
    view = CellView(ids, classes, directions, Figures(1, 0, 0, 0.0, 1.0, 0.0), rng.normal(size=(1024, 6)))
    work.keep(name_cell(0), pack_view(view))
    work.keep(name_viewpoint(0), pack_sighting(Sighting(rng.normal(size=3), 1, ids, classes.view(np.int8))))
    assert same(read_view(work, 0, N), view)
    assert read_sighting(work, 0, N) is not None


def test_what_a_file_promises_takes_no_more_memory_than_the_scene(tmp_path: Path) -> None:
    bomb = zstandard.ZstdCompressor().compress(bytes(15 << 24))
    work = KeptWork(tmp_path, {})
    for name, forge, some in (
        (name_cell, forged, some_view(1)),
        (name_viewpoint, forged_sighting, some_sighting(1)),
    ):
        (tmp_path / name(0)).write_bytes(forge(1 << 24, bomb))
        (tmp_path / name(1)).write_bytes(kept_bytes(some) + bytes(1 << 24))
        (tmp_path / name(2)).write_bytes(forge(0, bomb))
    tracemalloc.start()
    for number in range(3):
        assert read_view(work, number, 1000) is None
        assert read_sighting(work, number, 1000) is None
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 1 << 20
