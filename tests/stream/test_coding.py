"""Coded records: they come back, the plain twin reads the same, any bytes are read or refused, and they are shorter."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsvis.abr.classes import FieldOfView
from gsvis.color.records import Grids
from gsvis.errors import ProtocolError
from gsvis.package import Contents, base_rgb
from gsvis.package.codec import ChunkTable
from gsvis.package.layout import RecordLayout, TermLayout
from gsvis.package.rounding import Quality, chunks_of, sizes_of
from gsvis.stream import Receiver, Session, StreamedScene
from gsvis.stream._kernels import coder, records, terms
from gsvis.stream.coding import Coding, Steps, coarsen, table_sizes
from gsvis.stream.reference import PlainReader, longest_step, read_record, read_term, table_slots
from gsvis.stream.tables import MOST_LEVEL, Tables
from tests.package.worlds import colors_of, levels_of, without_wide_places
from tests.stream.worlds import package_of

SEEDS = st.integers(0, 2**32 - 1)


@cache
def contents_of(variant: str, n: int = 600) -> Contents:
    return Contents.from_levels(levels_of(n, 5), colors_of(n, variant, 5)[1])


@cache
def coded(variant: str, coarse: bool) -> tuple[Contents, Coding]:
    contents, steps = contents_of(variant), None
    if coarse:
        contents, steps = coarsen(contents, Quality())
    return contents, Coding.from_contents(contents, steps)


def hostile_table(rng: np.random.Generator, n: int, position: int) -> ChunkTable:
    """Chunks of n Gaussians with any lows, strides and steps, linear and logarithmic."""
    counts = []
    while sum(counts) < n:
        counts.append(min(int(rng.integers(1, 30)), n - sum(counts)))
    c = len(counts)
    steps = rng.choice([0.0, 1e-45, 1e-20, 3e-3, 1.0, 1e30], (c, 3)).astype(np.float32)
    origins, curved = np.zeros((c, 3), np.float32), rng.random(c) < 0.3
    origins[curved], steps[curved] = rng.uniform(-40, 40, (curved.sum(), 3)), -rng.choice([1e-30, 1e-4, 1e-3])
    return ChunkTable(
        origins, steps, rng.integers(-(2**15), 2**15, c).astype(np.int16),
        rng.integers(1, 256, c).astype(np.uint8), np.array(counts, np.uint16), rng.integers(0, position + 1, (c, 3)),
    )  # fmt: skip


@pytest.mark.parametrize("variant", ["rgb", "hsl"])
@pytest.mark.parametrize("coarse", [False, True])
@given(seed=SEEDS, share=st.floats(0.01, 1.0))
@settings(max_examples=20)
def test_records_of_a_package_come_back(variant: str, coarse: bool, seed: int, share: float) -> None:
    contents, code = coded(variant, coarse)
    ids = np.flatnonzero(np.random.default_rng(seed).random(len(contents)) < share)
    of, chunks = contents.chunks[ids], chunks_of(contents.table)
    data = code.encode_records(contents.records[ids], ids, of, chunks)
    assert np.array_equal(code.decode_records(data, ids, of, chunks), contents.records[ids])
    owners = np.repeat(np.arange(len(contents)), contents.term_counts)
    some = np.flatnonzero(np.random.default_rng(seed).random(len(owners)) < share)
    packed = code.encode_terms(contents.term_records[some], owners[some].astype(np.int32))
    assert np.array_equal(code.decode_terms(packed, owners[some]), contents.term_records[some])


def any_code(grids: Grids, steps: Steps | None, rng: np.random.Generator) -> Coding:
    """A code in which every symbol has some share."""
    sizes = table_sizes(grids)
    levels = np.ones(sum(sizes), np.uint8)
    levels[rng.random(len(levels)) < 0.1] = rng.integers(1, MOST_LEVEL)
    return Coding(grids, steps, Tables.from_levels(levels, sizes))


@pytest.mark.parametrize("variant", ["rgb", "hsl"])
@given(seed=SEEDS, n=st.integers(0, 60))
@settings(max_examples=40)
def test_any_records_and_terms_come_back(variant: str, seed: int, n: int) -> None:
    rng, grids = np.random.default_rng(seed), contents_of(variant).grids
    layout = RecordLayout.from_variant(variant)
    code, table = any_code(grids, None, rng), hostile_table(rng, n, layout.position)
    rows = without_wide_places(rng.integers(0, 256, (n, 16)).astype(np.uint8), table, layout)
    ids, of, chunks = np.arange(n), table.of_all(), chunks_of(table)
    data = code.encode_records(rows, ids, of, chunks)
    kept = rows
    if variant == "hsl":  # 87 of 88 bits are of fields
        kept = rows.copy()
        kept[:, 15] &= 127
    assert np.array_equal(code.decode_records(data, ids, of, chunks), kept)
    of_terms = TermLayout.from_grids(grids)
    words = rng.integers(0, 2 ** int(of_terms.widths.sum()), n).astype("<u8")
    packed, owners = words.view(np.uint8).reshape(-1, 8)[:, : of_terms.nbytes], np.sort(rng.integers(0, n + 1, n))
    coded_terms = code.encode_terms(packed, owners.astype(np.int32))
    assert np.array_equal(code.decode_terms(coded_terms, owners), packed)


@cache
def plain_slots(coarse: bool) -> list[list[int]]:
    """Slots of each table by the plain twin, which takes longer for them than for all records of an example."""
    tables = coded("rgb", coarse)[1].tables
    ends = zip(tables.offsets[:-1], tables.offsets[1:], strict=True)
    return [table_slots(tables.levels[low:high].tolist()) for low, high in ends]


@pytest.mark.parametrize("coarse", [False, True])
@given(seed=SEEDS, share=st.floats(0.01, 0.3))
@settings(max_examples=10)
def test_the_plain_twin_reads_the_same(coarse: bool, seed: int, share: float) -> None:
    contents, code = coded("rgb", coarse)
    slots = plain_slots(coarse)
    assert {sum(each) for each in slots} <= {0, 4096}
    ids = np.flatnonzero(np.random.default_rng(seed).random(len(contents)) < share)
    of, table = contents.chunks[ids], contents.table
    data = code.encode_records(contents.records[ids], ids, of, chunks_of(table)).tobytes()
    limits = None if code.steps is None else (code.steps.place, code.steps.turn)
    if len(ids):
        reader, strength = PlainReader(data, slots), 0
        for k in range(len(ids)):
            row = int(of[k])
            before = (int(ids[k] - ids[k - 1]), strength) if k and of[k - 1] == row else None
            bits = RecordLayout.from_variant("rgb").bits
            record, strength = read_record(reader, bits, (table, row), before, limits)
            assert record == contents.records[ids[k]].tobytes()
        reader.end()
    owners = np.repeat(np.arange(len(contents)), contents.term_counts)
    some = np.flatnonzero(np.random.default_rng(seed).random(len(owners)) < share)
    if len(some):
        reader, lead = PlainReader(code.encode_terms(contents.term_records[some], owners[some]).tobytes(), slots), 0
        for k in range(len(some)):
            word, lead = read_term(reader, lead if k and owners[some[k]] == owners[some[k - 1]] else None)
            assert word.to_bytes(5, "little") == contents.term_records[some[k]].tobytes()
        reader.end()


@given(seed=SEEDS)
@settings(max_examples=20)
def test_the_longest_step_is_that_of_the_plain_twin(seed: int) -> None:
    """Down to steps that float32 has as denormal numbers alone."""
    rng = np.random.default_rng(seed)
    table = hostile_table(rng, 300, 14)
    powers = np.where(table.logarithmic[:, None], 0, rng.integers(-149, 3, table.steps.shape))
    table = replace(table, steps=np.ldexp(table.steps, powers))
    found = chunks_of(table).steps
    assert found.tolist() == [[longest_step(table, row, k) for k in range(3)] for row in range(len(table))]


@pytest.mark.parametrize("variant", ["rgb", "hsl"])
@given(seed=SEEDS, n=st.integers(0, 40), size=st.integers(0, 900), sparse=st.booleans())
@settings(max_examples=60)
def test_any_bytes_are_read_or_refused(variant: str, seed: int, n: int, size: int, sparse: bool) -> None:
    """Also with tables that lack symbols, and with rows of chunks that make no sense."""
    rng, grids = np.random.default_rng(seed), contents_of(variant).grids
    code = coded(variant, bool(rng.integers(2)))[1] if sparse else any_code(grids, Steps(300, 300), rng)
    table = hostile_table(rng, n, RecordLayout.from_variant(variant).position)
    data = rng.integers(0, 256, size).astype(np.uint8)
    for found, width in (
        (code.decode_records(data, np.arange(n), table.of_all(), chunks_of(table)), 16),
        (code.decode_terms(data, np.zeros(n, np.int64)), TermLayout.from_grids(grids).nbytes),
    ):
        assert found is None or found.shape == (n, width)


@given(seed=SEEDS, kind=st.integers(0, 2))
@settings(max_examples=60)
def test_changed_bytes_are_read_or_refused(seed: int, kind: int) -> None:
    rng = np.random.default_rng(seed)
    contents, code = coded("rgb", bool(rng.integers(2)))
    ids, chunks = np.flatnonzero(rng.random(len(contents)) < 0.1), chunks_of(contents.table)
    of = contents.chunks[ids]
    data = code.encode_records(contents.records[ids], ids, of, chunks)
    if kind == 0:
        data[rng.integers(len(data))] ^= np.uint8(1 << rng.integers(8))
    elif kind == 1:
        data = data[: rng.integers(len(data))]
    else:
        data = np.concatenate([data, data[: rng.integers(1, 9)]])
    found = code.decode_records(data, ids, of, chunks)
    assert found is None or (kind == 0 and found.shape == (len(ids), 16))


@given(seed=SEEDS)
@settings(max_examples=20)
def test_tables_come_back_from_text(seed: int) -> None:
    rng, sizes = np.random.default_rng(seed), [256, 6, 512, 1, 64]
    counts = rng.integers(0, 5, sum(sizes)) * rng.integers(0, 2 ** rng.integers(1, 40), sum(sizes))
    counts[: 256 * int(rng.integers(2))] = 0
    tables = Tables.from_counts(counts, sizes)
    assert np.array_equal(tables.levels > 0, counts > 0)
    again = Tables.from_text(tables.to_text(), sizes)
    assert np.array_equal(again.levels, tables.levels)
    assert np.array_equal(again.inverses, tables.inverses)
    for k in range(len(sizes)):
        part = slice(tables.offsets[k], tables.offsets[k + 1])
        assert int((tables.decoder.spans[part] >> 16).sum()) in (0, coder.TOTAL)


@given(st.text(max_size=60) | st.binary(max_size=200).map(lambda b: __import__("base64").b64encode(b).decode()))
@settings(max_examples=60)
def test_any_text_is_tables_or_refused(text: str) -> None:
    try:
        tables = Tables.from_text(text, [256, 6, 64])
    except ProtocolError:
        return
    assert tables.levels.max(initial=0) <= MOST_LEVEL


@pytest.mark.parametrize("variant", ["rgb", "hsl"])
def test_coarse_records_are_shorter_and_near(variant: str) -> None:
    exact, code = coded(variant, False)
    coarse, rough = coded(variant, True)
    ids, chunks = np.arange(len(exact)), chunks_of(exact.table)
    sizes = [len(k.encode_records(c.records, ids, c.chunks, chunks)) for c, k in ((exact, code), (coarse, rough))]
    assert sizes[1] < 0.8 * sizes[0] < 0.8 * exact.records.nbytes
    again, steps = coarsen(coarse, Quality())
    assert (again.records[:, 0] == coarse.records[:, 0]).mean() > 0.9  # what rounding goes by is rounded too
    assert rough.steps is not None
    assert abs(steps.turn - rough.steps.turn) <= 64
    a, b = exact.gaussians(), coarse.gaussians()
    assert np.abs(a.means - b.means).max() <= b.scales.max()
    octaves = np.abs(np.log2(a.scales / b.scales)).max(axis=1)
    tints = np.abs(base_rgb(exact.records, exact.grids) - base_rgb(coarse.records, coarse.grids)).max(axis=1)
    _, area, light = sizes_of(exact)
    for errors, weight in ((octaves, light), (tints, light), (np.abs(a.opacities - b.opacities), area)):
        strong, weak = weight >= np.quantile(weight, 0.75), weight <= np.quantile(weight, 0.25)
        assert errors[strong].mean() < errors[weak].mean()
    assert octaves.max() < 1.0


def test_kernels_have_as_many_tables_as_there_are_sizes() -> None:
    assert len(table_sizes(contents_of("rgb").grids)) == records.TABLES + terms.TABLES


@pytest.mark.parametrize("place", [-2.0, None])
def test_a_stream_of_a_rounded_package_brings_its_records(tmp_path: Path, place: float | None) -> None:
    """It leaves out what they lack, and so takes fewer bytes."""
    sizes = []
    for name, quality in (("whole", None), ("rounded", Quality(place=place))):
        with package_of(tmp_path / f"{name}.gsvis", 800, lattice=True, stores=False, quality=quality) as package:
            scene = StreamedScene.open(package)
            session = Session(scene, FieldOfView.from_degrees(110, 90))
            session.on_pose(0.0, [0, 0, 0], [1, 0, 0, 0])
            message = session.next_message(0.0, 1e6)
            assert message is not None
            receiver = Receiver(scene.header)
            receiver.receive(message.data)
            contents = package.contents
        assert (scene.about.steps is None) == (quality is None)
        order = np.argsort(receiver.shown())
        g, _ = receiver.scene()
        expected = contents.gaussians(receiver.shown()[order])
        for field in ("means", "quats", "scales", "opacities"):
            np.testing.assert_array_equal(getattr(g, field)[order], getattr(expected, field))
        sizes.append(len(message.data))
    assert sizes[1] < sizes[0]
