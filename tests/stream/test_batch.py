"""Batches to the byte: any Arrow client reads them, and codes of ids are what the plain twin makes of them."""

from __future__ import annotations

import random
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsvis.abr.classes import FieldOfView
from gsvis.stream import Session, StreamedScene, reference
from gsvis.stream._kernels import ids as kernels
from gsvis.stream.batch import CHUNK_ROW, FIXED_BYTES, Sections
from gsvis.stream.header import HEAD, SCHEMA, SceneHeader
from gsvis.stream.reference import decode_values, encode_values
from tests.stream.worlds import package_of

IDS = st.lists(st.integers(0, 2**31 - 2), max_size=60, unique=True).map(sorted)


def test_any_arrow_client_reads_a_stream(tmp_path: Path) -> None:
    with package_of(tmp_path / "s.gsvis", 1500, "hsl") as package:
        scene = StreamedScene.open(package)
        session = Session(scene, FieldOfView.from_degrees(90, 70))
        messages = [session.welcome(0.0).data]
        for k in range(4):
            session.on_pose(k / 10, [0, 0, 0], [1, 0.1 * k, 0, 0])
            message = session.next_message(k / 10, 3000.0)
            assert message is not None
            messages.append(message.data)
        stream = b"".join(data[HEAD.size :] for data in messages) + b"\xff\xff\xff\xff\0\0\0\0"
        with pa.ipc.open_stream(stream) as reader:
            assert reader.schema.remove_metadata() == SCHEMA
            batches = list(reader)
        assert len(batches) == 4
        for data, batch in zip(messages[1:], batches, strict=True):
            batch.validate(full=True)
            found, rows = Sections.parse(data, scene.about), batch.column(0).to_pylist()
            assert len(rows) == 4
            assert rows[1:3] == [found.rows.tobytes(), found.records.tobytes()]
            assert rows[3] == found.term_records.tobytes()
            assert batch.column(0).is_valid().to_pylist() == 4 * [True]


def test_bytes_around_the_rows_are_those_of_pyarrow() -> None:
    about = header()
    for size in (0, 1, 500):
        s = sections(np.arange(size) * 3)
        rows = pa.array(pa.ipc.read_record_batch(s.to_message(about)[HEAD.size :], SCHEMA).column(0).to_pylist())
        again = pa.record_batch([rows.cast(pa.binary())], schema=SCHEMA).serialize().to_pybytes()
        assert s.to_message(about)[HEAD.size :] == again
    assert len(sections(np.zeros(0, int)).to_message(about)) <= FIXED_BYTES


@given(IDS, st.integers(0, 24))
def test_codes_are_those_of_the_plain_twin(ids: list[int], order: int) -> None:
    values = np.diff(np.array([-1, *ids])) - 1
    wanted = encode_values(values.tolist(), order)
    out = np.full(8 * len(ids) + 16, 255, np.uint8)
    out[0] = 5
    bits = kernels.write(values, order, out, 3)
    assert "".join(f"{byte:08b}"[::-1] for byte in out.tolist())[:bits] == "101" + wanted
    found = np.empty(len(ids), np.int64)
    assert kernels.read(out[: -(-bits // 8)], 3, order, found) == bits
    assert found.tolist() == values.tolist() == decode_values(wanted, order, len(ids))
    back = np.empty(len(ids), np.int64)
    assert kernels.ids_from(found, 2**31, back)
    assert back.tolist() == ids
    if bits > 3 + 8:
        assert kernels.read(out[: bits // 8 - 1], 3, order, found) == -1


@given(IDS)
def test_the_order_is_about_the_best(ids: list[int]) -> None:
    values = np.diff(np.array([-1, *ids])) - 1
    sizes = [len(encode_values(values.tolist(), k)) for k in range(25)]
    assert sizes[kernels.best_order(values)] <= 1.35 * min(sizes) + 2


@given(st.lists(st.integers(0, 4), min_size=1, max_size=50), st.data())
def test_owners_go_on_with_their_terms(counts: list[int], data: st.DataObject) -> None:
    owners = np.repeat(np.arange(len(counts)), counts)
    chosen = np.array(sorted(data.draw(st.sets(st.integers(0, max(len(owners) - 1, 0))))), np.int64)
    chosen = chosen[chosen < len(owners)]
    share = (len(counts) << 16) // max(len(owners), 1)
    values, back = np.empty(len(chosen), np.int64), np.empty(len(chosen), np.int64)
    kernels.owner_distances(chosen, owners[chosen], share, values)
    assert (values >= 0).all()
    assert kernels.owners_from(values, chosen, share, len(counts), back)
    assert back.tolist() == owners[chosen].tolist()
    if len(back):
        assert not kernels.owners_from(values, chosen, share, int(back[-1]), back)


@given(st.sets(st.integers(0, 8191)), st.sampled_from([np.int32, np.uint32]), st.randoms())
def test_ids_are_sorted(some: set[int], kind: type[np.int32] | type[np.uint32], chance: random.Random) -> None:
    ids, marks, summary = np.array(chance.sample(sorted(some), len(some)), kind), *np.zeros((2, 128), np.uint64)
    out = np.empty_like(ids)
    kernels.ascend(ids, marks, summary, out)
    assert np.array_equal(out, np.sort(ids))
    assert not marks.any()
    assert not summary.any()


@given(st.sets(st.integers(0, 4095)), st.sets(st.integers(1, 4095), max_size=20), st.data())
def test_ids_are_laid_out_with_their_chunks(some: set[int], borders: set[int], data: st.DataObject) -> None:
    starts = np.array([0, *sorted(borders), 4096], np.int64)
    of = np.repeat(np.arange(len(starts) - 1, dtype=np.int32), np.diff(starts))
    known = np.array(data.draw(st.lists(st.booleans(), min_size=len(starts) - 1, max_size=len(starts) - 1)))
    ids = np.array(sorted(some), np.int32)
    before, rows, fresh = known.copy(), np.empty_like(ids), np.empty(len(known), np.int32)
    count = kernels.lay_out(ids, of, starts, known, rows, fresh)
    chunks, now = reference.lay_out(ids, of, before)
    np.testing.assert_array_equal(rows, of[ids])
    np.testing.assert_array_equal(fresh[:count], chunks)
    np.testing.assert_array_equal(known, now)


def test_what_is_read_is_what_was_written() -> None:
    about, s = header(), sections(np.array([0, 1, 2, 70, 4000]))
    found = Sections.parse(s.to_message(about), about)
    for name in ("chunks", "rows", "gaussians", "records", "terms", "owners", "term_records", "gone", "evicted"):
        np.testing.assert_array_equal(getattr(found, name), getattr(s, name), err_msg=name)
    assert found.sequence == s.sequence


def header() -> SceneHeader:
    from gsvis.color.records import PRECISIONS, Grids

    grids = Grids("rgb", PRECISIONS["wire"], ((0.0, 1.0),) * 3, (1.0, 1.0), (0.5, 9.0), 0.25)
    return SceneHeader(5000, 9000, 20, ("all",), (5000,), grids, (0.0, 0.0, 1.0), 0.0, 64 * "0", "")


def sections(ids: np.ndarray) -> Sections:
    rng, n = np.random.default_rng(1), len(ids)
    rows = np.zeros(min(n, 2), CHUNK_ROW)
    rows["count"] = 256
    terms = np.arange(n) * 2 + 1
    return Sections(
        7, ids[: len(rows)], rows, ids, rng.integers(0, 256, 9 * n, np.uint8), terms, np.sort(ids),
        rng.integers(0, 256, 3 * n, np.uint8), ids[:1] + 1, ids[-1:],
    )  # fmt: skip


def test_ids_past_the_scene_are_refused() -> None:
    from gsvis.errors import ProtocolError

    about = header()
    for ids in ([4999, 5000], [2**31 - 2]):
        with pytest.raises(ProtocolError, match=r"^BATCH 7: expected ids below"):
            Sections.parse(sections(np.array(ids)).to_message(about), about)
