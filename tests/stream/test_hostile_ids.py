"""Ids beyond the range at every entrance: an error, never a write outside of an array."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsvis.abr.candidates import CandidateIndex
from gsvis.abr.classes import FieldOfView
from gsvis.abr.holdings import Holdings
from gsvis.abr.index import SceneIndex
from gsvis.errors import ProtocolError
from gsvis.pvs.codec import pack
from gsvis.pvs.store import CellSet, StoreInfo, StoreWriter
from gsvis.stream import Receiver, Session, StreamedScene
from gsvis.stream.batch import Sections
from gsvis.stream.header import SceneHeader
from gsvis.stream.wire import Hello, parse_client
from tests.abr.abr_scenes import ArrayCells, random_index
from tests.stream.worlds import package_of

VIEW = FieldOfView.from_degrees(90, 70)
Change = Callable[[np.ndarray], np.ndarray]
BEYOND = [[100], [0, 1 << 40], [-1], [-(1 << 62)], [(1 << 63) - 1]]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Iterator[StreamedScene]:
    with package_of(tmp_path_factory.mktemp("hostile") / "a.gsvis", 100) as package:
        yield StreamedScene.open(package)


@pytest.mark.parametrize("ids", BEYOND)
def test_sets_refuse_ids_beyond_the_range(ids: list[int]) -> None:
    given, none = np.array(ids), np.zeros(0, np.int64)
    with pytest.raises(ValueError, match="ids: expected"):
        pack(given, 100)
    for place in range(3):
        with pytest.raises(ValueError, match="expected values in"):
            Holdings(100, 100).add(*(given if k == place else none for k in range(3)))


@pytest.mark.parametrize("ids", BEYOND)
def test_the_writer_of_a_store_refuses_ids_beyond_the_range(tmp_path: Path, ids: list[int]) -> None:
    from tests.pvs.test_store import grid_of

    info = StoreInfo(100, "scene", 0.1, np.array([0.1]))
    grid = grid_of(2, np.random.default_rng(0))
    with StoreWriter(tmp_path / "a.pvs", grid, info) as writer, pytest.raises(ValueError, match="ids: expected rising"):
        writer.add_cell(CellSet(ids, np.zeros(len(ids), np.uint8)))


def array_container(*values: int) -> bytes:
    """A roaring bitmap of one container that lists these, in this order."""
    listed = struct.pack(f"<{len(values)}H", *values)
    return struct.pack("<IIHHI", 12346, 1, 0, len(values) - 1, 16) + listed


def containers(*keys: int) -> bytes:
    """A roaring bitmap of containers that hold their first place alone."""
    count = len(keys)
    described = b"".join(struct.pack("<HH", key, 0) for key in keys)
    offsets = struct.pack(f"<{count}I", *(8 + 8 * count + 2 * k for k in range(count)))
    return struct.pack("<II", 12346, count) + described + offsets + bytes(2 * count)


BITMAPS = {
    "beyond": array_container(5, 100),
    "out of order": array_container(60000, 5, 7),
    "twice": array_container(7, 7),
    "keys out of order": containers(9, 0),
    "a key twice": containers(0, 0),
    "another count of bits": struct.pack("<IIHHI", 12346, 1, 0, 4999, 16) + b"\1" + bytes(8191),
    "runs that overlap": struct.pack("<IBHHHHHHH", 12347, 1, 0, 8, 2, 100, 5, 3, 9),
    "a run beyond its container": struct.pack("<IBHHHHH", 12347, 1, 0, 9, 1, 65530, 100),
    "cut": array_container(5, 7)[:-1],
}


@pytest.mark.parametrize("bitmap", BITMAPS)
@pytest.mark.parametrize("place", range(3))
def test_a_hello_with_a_bitmap_that_lies_is_refused(scene: StreamedScene, bitmap: str, place: int) -> None:
    empty = struct.pack("<II", 12346, 0)
    parts = [BITMAPS[bitmap] if k == place else empty for k in range(3)]
    head = struct.pack("<4sIIIII", b"GVH1", len(scene), scene.about.terms, *(len(part) for part in parts))
    hello = Hello(VIEW, bytes.fromhex(scene.about.identity), head + b"".join(parts))
    said = parse_client(hello.to_bytes())
    assert isinstance(said, Hello)
    if bitmap == "beyond" and place == 1 and scene.about.terms > 100:
        Session.from_hello(scene, said)  # there are so many terms
        return
    with pytest.raises(ValueError, match="data: expected"):
        Session.from_hello(scene, said)


class Changed(ArrayCells):
    """Cells that give other words or classes than they should."""

    def __init__(self, index: SceneIndex, cells: list[int], words: Change | None = None, classes: Change | None = None):
        members = [index.sets.classes(cell) for cell in range(len(index.grid))]
        terms = [index.active.active_ids(cell) for cell in range(len(index.grid))]
        super().__init__(members, terms)
        self._cells, self._change_words, self._change_classes = cells, words, classes

    def visible_masks(self, cell: int) -> tuple[np.ndarray, np.ndarray]:
        masks = super().visible_masks(cell)
        return self._change_words(*masks) if self._change_words and cell in self._cells else masks

    def classes(self, cell: int) -> tuple[np.ndarray, np.ndarray]:
        ids, classes = super().classes(cell)
        return ids, self._change_classes(classes) if self._change_classes and cell in self._cells else classes


HIGH = np.uint64(1) << np.uint64(63)
WORDS: dict[str, Change] = {
    "longer": lambda words, masks: (np.append(words, words[-1] + 1), np.append(masks, HIGH)),
    "far": lambda words, masks: (np.append(words, np.int32(1 << 25)), np.append(masks, HIGH)),
    "beyond": lambda words, masks: (words, np.where(words == 300 // 64, masks | HIGH, masks)),
}


@pytest.mark.parametrize("change", WORDS)
@pytest.mark.parametrize("neighbor", [False, True])
def test_cells_with_gaussians_that_the_scene_lacks_are_refused(change: str, neighbor: bool) -> None:
    index = random_index(1, 300)
    cells = index.grid.neighbors(0).tolist() if neighbor else [0]
    with pytest.raises(ValueError, match="words: expected a set of 300"):
        CandidateIndex(replace(index, sets=Changed(index, cells, words=WORDS[change]))).in_cell(0)


def test_cells_with_classes_or_terms_that_the_scene_lacks_are_refused() -> None:
    index = random_index(1, 300)
    for change in (lambda classes: classes[:-1], lambda classes: np.full_like(classes, 200)):
        with pytest.raises(ValueError, match="classes: expected"):
            CandidateIndex(replace(index, sets=Changed(index, [0], classes=change))).in_cell(0)
    for terms in ([index.num_terms], [0, 1 << 40], [-1]):
        cells = ArrayCells([], [np.array(terms)])
        with pytest.raises(ValueError, match="terms: expected values in"):
            CandidateIndex(replace(index, active=cells)).in_cell(0)


NONE = np.zeros(0, np.int64)


def message(about: SceneHeader, **ids: Any) -> bytes:
    """A BATCH whose ids are as given, and whose coded records are zeros."""
    lists = {name: np.array(ids.get(name, NONE), np.int64) for name in ("gaussians", "terms", "owners", "gone")}
    records = np.zeros(9 * len(lists["gaussians"]), np.uint8)
    term_records = np.zeros(4 * len(lists["terms"]), np.uint8)
    empty = Sections(
        1, NONE, np.zeros(0, np.uint8), lists["gaussians"], records, lists["terms"], lists["owners"], term_records,
        lists["gone"],
    )  # fmt: skip
    return empty.to_message(about)


def test_a_client_refuses_ids_beyond_its_scene(scene: StreamedScene) -> None:
    about, n, t = scene.about, len(scene), scene.about.terms
    for ids in ({"gaussians": [n]}, {"terms": [t], "owners": [0]}, {"terms": [0], "owners": [n]}, {"gone": [n]}):
        receiver = Receiver(scene.header)
        with pytest.raises(ProtocolError, match="BATCH 1: expected"):
            receiver.receive(message(about, **ids))
        assert len(receiver.shown()) == 0


def test_a_client_refuses_rows_of_chunks_that_the_protocol_does_not_have(scene: StreamedScene) -> None:
    first, none = np.zeros(1, np.int64), np.zeros(0, np.uint8)

    def receive(**values: object) -> None:
        row = scene.records.chunk_rows[:1].copy()
        for name, value in values.items():
            row[name] = value
        Receiver(scene.header).receive(
            Sections(1, first, row, NONE, none, NONE, NONE, none, NONE).to_message(scene.about)
        )

    receive()
    receive(origin=1.0, step=-1e-3)  # a logarithmic chunk
    for values, message in (
        ({"step": (1.0, -1e-3, -1e-3)}, "steps: expected all >= 0, or all < 0"),
        ({"origin": 80.0, "step": -1e-3}, "steps: expected all >= 0, or all < 0 and logarithms up to 88"),
        ({"origin": np.nan}, "origins: expected"),
        ({"bits": 0xEEF}, "bits: expected values in"),
        ({"bits": 0x1000}, "bits: expected values in"),
    ):
        with pytest.raises(ProtocolError, match=message):
            receive(**values)


def test_rules_of_batches_hold_for_ids_that_came_before(scene: StreamedScene) -> None:
    """A row of a chunk that comes again is ignored; the others are refused, and change nothing."""
    about, none = scene.about, np.zeros(0, np.uint8)

    def batch(
        sequence: int, *, chunks: np.ndarray = NONE, gone: np.ndarray = NONE, evicted: np.ndarray = NONE
    ) -> bytes:
        rows = scene.records.chunk_rows[np.searchsorted(scene.records.starts, chunks)]
        return Sections(sequence, chunks, rows, NONE, none, NONE, NONE, none, gone, evicted).to_message(about)

    first, some = scene.records.starts[:1], np.array([1], np.int64)
    receiver = Receiver(scene.header)
    receiver.receive(batch(1, chunks=first, gone=some))
    receiver.receive(batch(2, chunks=scene.records.starts[:2]))
    before = receiver.holdings.to_bytes()
    arrives = Sections.parse(message(about, gaussians=[1]), about)
    coded = scene.coding.encode_some(
        scene.records.parts, np.ones(1, np.int32), scene.records.chunks[1:2], scene.records.chunk_numbers
    )
    for data, words in (
        (batch(3, gone=some), "gone: expected each Gaussian once"),
        (replace(arrives, sequence=3, records=coded).to_message(about), "expected none that was replaced"),
        (batch(3, evicted=some), "expected none without a limit of memory"),
    ):
        with pytest.raises(ProtocolError, match=words):
            receiver.receive(data)
        assert receiver.holdings.to_bytes() == before
    receiver.receive(batch(3))
    few = Receiver(replace(about, chunks=1).to_message())
    few.receive(batch(1, chunks=first))
    with pytest.raises(ProtocolError, match="chunks: expected at most 1"):
        few.receive(batch(2, chunks=scene.records.starts[1:2]))


def test_a_welcome_that_promises_billions_is_refused(scene: StreamedScene) -> None:
    most = 1 << 28
    with pytest.raises(ProtocolError, match="WELCOME: gaussians: expected an integer"):
        Receiver(replace(scene.about, gaussians=8 * most).to_message())
    with pytest.raises(ProtocolError, match="WELCOME: terms: expected an integer"):
        Receiver(replace(scene.about, gaussians=1 << 24, terms=255 << 24).to_message())
    with pytest.raises(ProtocolError, match="WELCOME: expected a scene for 536,870,912 bytes"):
        Receiver(replace(scene.about, gaussians=most).to_message())
    with pytest.raises(ProtocolError, match="raise most_bytes"):
        Receiver(scene.header, most_bytes=100)
    Receiver(scene.header, most_bytes=100_000)
