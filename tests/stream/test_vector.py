"""Recorded exchanges: what other implementations can check themselves against, and what this one must go on saying.

`python tests/stream/test_vector.py --write` records them anew, after a change of the protocol and of its version.
"""

from __future__ import annotations

import json
import struct
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from gsvis.abr.batches import Batch
from gsvis.abr.classes import FieldOfView
from gsvis.abr.config import AbrConfig
from gsvis.color.evaluate import evaluate
from gsvis.package.rounding import Quality
from gsvis.stream import Ack, Bye, Hello, PoseAt, Receiver, Session, StreamedScene, parse_client
from gsvis.stream.header import SceneHeader

EYE = [0.25, -1.5, 0.5]


class Record(NamedTuple):
    """What is recorded: the scene, how its records are rounded, the memory of the client, bytes of the batches."""

    file: str
    variant: str
    lattice: bool
    quality: Quality | None
    memory: int
    budgets: tuple[float, ...]

    @property
    def path(self) -> Path:
        return Path(__file__).with_name(self.file)


RECORDS = (
    Record("vector.json", "hsl", True, None, 0, (1100.0, 1300.0, 4000.0)),
    Record("vector_memory.json", "rgb", False, Quality(), 1400, (1100.0,) * 8),
)


@contextmanager
def opened(record: Record, folder: Path) -> Iterator[StreamedScene]:
    sys.path.insert(0, str(Path(__file__).parents[2]))
    from tests.stream.worlds import package_of

    with package_of(folder / "s.gsvis", 300, record.variant, seed=4, lattice=record.lattice) as package:
        yield StreamedScene.open(package, quality=record.quality)


def drawn(receiver: Receiver) -> dict[str, Any]:
    """What a client shows at the end, by rising ids."""
    order = np.argsort(receiver.shown())
    gaussians, colors = receiver.scene()
    rgb = evaluate(colors, gaussians.means, EYE)
    arrays = {name: getattr(gaussians, name) for name in ("means", "quats", "scales", "opacities")} | {"rgb": rgb}
    return {"ids": receiver.shown()[order].tolist()} | {
        name: array[order].astype(np.float64).round(7).tolist() for name, array in arrays.items()
    }


def recorded(record: Record) -> dict[str, Any]:
    memory = record.memory
    with tempfile.TemporaryDirectory() as folder, opened(record, Path(folder)) as scene:
        view = FieldOfView(1.0, 1.0, 0.75, 0.75, 0.125, 0.0625)
        config = AbrConfig(policy="low-first", start_rate=100.0)
        receiver = Receiver(scene.header, memory=memory)
        session = Session(scene, view, config, memory=memory or None)
        steps: list[dict[str, Any]] = []

        def said(side: str, data: bytes, **facts: Any) -> None:
            steps.append({"from": side, **facts, "bytes": data.hex()})

        said("client", Hello(view, memory=memory).to_bytes())
        said("server", session.welcome(0.0).data)
        said("client", Ack(0).to_bytes())
        for k, budget in enumerate(record.budgets):
            pose = PoseAt(100 * k, (1.5 * (k % 3) - 1.5, -1.0, 0.25), (1.0, 0.0, 0.25 * k, 0.0))
            said("client", pose.to_bytes())
            session.on_pose(k / 10, pose.position, pose.quat)
            message = session.next_message(k / 10, budget)
            if message is None:  # nothing that fits into the memory is worth more than what is there
                continue
            received = receiver.receive(message.data)
            lists = {name: getattr(received, name).tolist() for name in ("gaussians", "terms", "dropped")}
            if memory:
                lists["evicted"] = np.sort(message.batch.evicted).tolist()
            held = session.holdings
            said("server", message.data, **lists, gone=sorted({int(g) for g in np.flatnonzero(bits(held.gone))}))
            said("client", Ack(received.sequence).to_bytes())
            if k == 1:  # the connection breaks
                hello = receiver.hello(view)
                session = Session.from_hello(scene, hello)  # and the link is a better one
                said("client", hello.to_bytes())
                said("server", session.welcome(0.2).data)
                receiver.resume(scene.header)
        said("client", Bye().to_bytes())
        return {"protocol": 3, "eye": EYE, "steps": steps, "drawn": drawn(receiver)}


def bits(words: np.ndarray) -> np.ndarray:
    return np.unpackbits(words.view(np.uint8), bitorder="little")


@pytest.fixture(scope="module", params=RECORDS, ids=lambda record: record.file)
def record(request: pytest.FixtureRequest) -> Record:
    return request.param


@pytest.fixture(scope="module")
def vector(record: Record) -> dict[str, Any]:
    return json.loads(record.path.read_text(encoding="utf-8"))


def test_the_records_show_what_the_page_says_of_them(record: Record, vector: dict[str, Any]) -> None:
    (welcome, *_) = (bytes.fromhex(step["bytes"]) for step in vector["steps"] if step["from"] == "server")
    assert (SceneHeader.parse(welcome).steps is not None) == (record.quality is not None)
    brought = [step for step in vector["steps"] if "gaussians" in step]
    assert any(step["gone"] for step in brought)
    assert any(step["terms"] for step in brought)
    assert any(step.get("evicted") for step in brought) == (record.memory > 0)
    both = [set(step["gaussians"]) for step in brought]
    assert (len(set.union(*both)) < sum(map(len, both))) == (record.memory > 0)  # some come again


def test_a_client_of_the_record_draws_what_it_says(record: Record, vector: dict[str, Any]) -> None:
    receiver = None
    for step in vector["steps"]:
        data = bytes.fromhex(step["bytes"])
        if step["from"] == "client":
            assert parse_client(data).to_bytes() == data
        elif "gaussians" not in step:
            if receiver is None:
                receiver = Receiver(data, memory=record.memory)
            assert receiver.resume(data)
        else:
            assert receiver is not None
            received = receiver.receive(data)
            assert received.gaussians.tolist() == step["gaussians"]
            assert received.terms.tolist() == step["terms"]
            assert received.dropped.tolist() == step["dropped"]
            assert np.flatnonzero(bits(receiver.holdings.gone)).tolist() == step["gone"]
    assert receiver is not None
    found = drawn(receiver)
    for name, values in vector["drawn"].items():
        np.testing.assert_allclose(found[name], values, atol=1e-6, err_msg=name)


def test_a_server_of_the_record_says_the_same_bytes(record: Record, vector: dict[str, Any], tmp_path: Path) -> None:
    """Whatever order a planner finds, what is chosen becomes the same bytes."""
    with opened(record, tmp_path) as scene:
        session = None
        # The identity is of the files of the package, whose bytes are not the same with every version of pyarrow.
        welcome = next(bytes.fromhex(step["bytes"]) for step in vector["steps"] if step["from"] == "server")
        scene.about = replace(scene.about, identity=SceneHeader.parse(welcome).identity)
        scene.header = scene.about.to_message()
        chosen: list[dict[str, Any]] = []

        def next_batch(t: float, budget: float, rate: float, *, spare: float) -> Batch:
            assert session is not None
            step = chosen.pop()
            ids = [np.array(step[name], np.int64) for name in ("gaussians", "terms", "gone")]
            evicted, held = np.array(step.get("evicted", []), np.int64), session.holdings.received_terms
            session.holdings.evict(evicted, held[np.isin(scene.records.owners[held], evicted)])
            before = session.holdings.gone.copy()
            session.holdings.add(*ids)
            fresh = np.flatnonzero(bits(session.holdings.gone & ~before)).astype(np.int32)
            some, terms = ids[0][::-1].astype(np.int32), ids[1][::-1].astype(np.uint32)
            return Batch(some, terms, fresh, 1000.0, evicted=evicted[::-1].astype(np.int32), gone=fresh)

        for step in vector["steps"]:
            data = bytes.fromhex(step["bytes"])
            if step["from"] == "client":
                said = parse_client(data)
                if isinstance(said, Hello):
                    session = Session.from_hello(scene, said)
                    session.planner.next_batch = next_batch
            elif "gaussians" not in step:
                assert SceneHeader.parse(data) == SceneHeader.parse(scene.header)
            else:
                assert session is not None
                chosen.append(step)
                message = session.next_message(0.0, 2000.0)
                assert message is not None
                assert message.data == data


def test_the_page_shows_the_bytes_around_the_rows(vector: dict[str, Any]) -> None:
    page = (Path(__file__).parents[2] / "docs" / "streaming.md").read_text(encoding="utf-8")
    (data, *_) = (bytes.fromhex(step["bytes"]) for step in vector["steps"] if "gaussians" in step)
    text = page.split("```")[1].split("\n160  ")[0]
    for name, place in (("body", 48), ("rows", 136)):
        text = text.replace(f"[{name}, i64]", data[place : place + 8].hex())
    lines = [line.partition(" ")[2].replace(" ", "") for line in text.strip().splitlines()]
    assert "".join(lines) == data[8:168].hex()


def test_the_page_says_where_the_json_of_welcome_is(vector: dict[str, Any]) -> None:
    """The steps of the page, without an Arrow library."""
    (data, *_) = (bytes.fromhex(step["bytes"]) for step in vector["steps"] if step["from"] == "server")
    flat = data[16:]
    assert struct.unpack_from("<Ii", data, 8) == (0xFFFFFFFF, len(flat))

    def follow(place: int) -> int:
        return place + int(struct.unpack_from("<I", flat, place)[0])

    def field(table: int, k: int) -> int:
        fields = table - struct.unpack_from("<i", flat, table)[0]
        (size,) = struct.unpack_from("<H", flat, fields)
        apart = struct.unpack_from("<H", flat, fields + 4 + 2 * k)[0] if 4 + 2 * k < size else 0
        assert apart
        return int(table + apart)

    def text(place: int) -> bytes:
        (size,) = struct.unpack_from("<I", flat, place)
        return flat[place + 4 : place + 4 + size]

    message = follow(0)
    assert flat[field(message, 1)] == 1
    entries = follow(field(follow(field(message, 2)), 2))
    tables = [follow(entries + 4 + 4 * k) for k in range(struct.unpack_from("<I", flat, entries)[0])]
    (said,) = [text(follow(field(t, 1))) for t in tables if text(follow(field(t, 0))) == b"gsvis"]
    assert json.loads(said)["protocol"] == 3
    at = data.index(b'{"chunks":')
    assert data[at - 4 : at] == struct.pack("<I", len(said))
    assert data[at : at + len(said)] == said


if __name__ == "__main__":
    if sys.argv[1:] != ["--write"]:
        raise SystemExit("python tests/stream/test_vector.py --write")
    found = [recorded(each) for each in RECORDS]  # all of them before any is written
    for each, value in zip(RECORDS, found, strict=True):
        each.path.write_text(json.dumps(value, indent=1) + "\n", encoding="utf-8")
