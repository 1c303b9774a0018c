"""Targets: the wire in both directions: what clients say to a server, and what a server says to a client."""

from __future__ import annotations

import asyncio
import atexit
import json
import struct
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import fields, replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

import numpy as np
import pyarrow as pa
from pyroaring import BitMap

from gsvis.abr.classes import FieldOfView
from gsvis.abr.config import AbrConfig
from gsvis.abr.holdings import Holdings
from gsvis.errors import ProtocolError
from gsvis.serve import Limits, Metrics
from gsvis.serve._log import EventLog
from gsvis.serve.clock import ManualClock
from gsvis.serve.connection import Connection, GoneError, Setting
from gsvis.serve.scenes import ServedScene
from gsvis.stream import Ack, Bye, Hello, PoseAt, Receiver, Session, StreamedScene, Token, drawn, parse_client
from gsvis.stream.batch import _ARROW, _BODY_AT, _DATA_AT, _ENDS, _IDS, Sections
from gsvis.stream.header import HEAD, SCHEMA, SceneHeader
from gsvis.stream.wire import ServerFault
from tests.fuzz.mutators import KINDS, change_bytes, change_json, mutate
from tests.fuzz.targets import Case, Target
from tests.stream.worlds import package_of

__all__ = ["TARGETS"]

N = 300
VIEW = FieldOfView.from_degrees(90.0, 70.0, margin=8.0)


@cache
def scenes() -> dict[str, StreamedScene]:
    """Two small packages, opened for as long as the process lives."""
    opened, found = ExitStack(), {}
    atexit.register(opened.close)
    folder = Path(opened.enter_context(TemporaryDirectory(prefix="gsvis-fuzz-")))
    for variant, stores in (("rgb", True), ("hsl", False)):
        package = opened.enter_context(package_of(folder / variant, N, variant, stores=stores))
        found[variant] = StreamedScene.open(package)
    return found


@cache
def held() -> bytes:
    """Holdings of a client of the first scene that has received some batches."""
    scene = scenes()["rgb"]
    session = Session.from_hello(scene, Hello(VIEW))
    talk(session, Receiver(session.welcome(0.0).data), 1)
    return session.holdings.to_bytes()


def eyes() -> list[tuple[float, float, float]]:
    """Where viewers walk: the centers of cells of the first scene."""
    return [(float(x), float(y), float(z)) for x, y, z in scenes()["rgb"].index.grid.centers[:6]]


def talk(session: Session, receiver: Receiver, batches: int) -> list[bytes]:
    """The batches that a session has for a viewer that walks."""
    found, places = [], eyes()
    for k in range(4 * batches):
        session.on_pose(0.1 * k, places[k % len(places)], (1.0, 0.1 * k, 0.0, 0.0))
        message = session.next_message(0.1 * k + 0.02, 1500.0)
        if message is not None and len(found) < batches:
            receiver.receive(message.data)
            found.append(message.data)
            session.on_ack(0.1 * k + 0.05, message.sequence)
    return found


def hellos() -> list[bytes]:
    about = scenes()["rgb"].about
    return [Hello(VIEW).to_bytes(), Hello(VIEW, bytes.fromhex(about.identity), held()).to_bytes()]


def said() -> list[Case]:
    pose = PoseAt(1234, (0.5, 1.0, -2.0), (1.0, 0.0, 0.0, 0.0)).to_bytes()
    others = pose, Ack(3).to_bytes(), Bye().to_bytes(), Token("s3cret").to_bytes()
    return [{"message.hello": message} for message in (*hellos(), *others)]


def in_parser(folder: Path, case: Case) -> None:
    (data,) = case.values()
    found = parse_client(data, most_hello=scenes()["rgb"].most_hello)
    assert type(found)(**{f.name: getattr(found, f.name) for f in fields(found)}).to_bytes() is not None
    if isinstance(found, Hello):
        try:
            Session.from_hello(scenes()["rgb"], found)
        except ValueError as error:
            raise ProtocolError(str(error)) from error


def change_hello(rng: Random, data: bytes) -> bytes:
    """One change of a message; holdings in a HELLO get a right length."""
    if len(data) < 78 or rng.random() < 0.4:
        return change_bytes(rng, data)
    holdings = change_holdings(rng, data[72:])
    return data[:4] + struct.pack("<I", len(holdings)) + data[8:72] + holdings


def change_holdings(rng: Random, data: bytes) -> bytes:
    """One change of holdings: of a bitmap, its ids, or the lengths."""
    if len(data) < 24 or rng.random() < 0.2:
        return change_bytes(rng, data)
    magic, n, t, *lengths = struct.unpack_from("<4sIIIII", data)
    ends = np.cumsum([24, *lengths]).tolist()
    if ends[-1] != len(data):
        return change_bytes(rng, data)
    parts = [data[a:b] for a, b in pairwise(ends)]
    at = rng.randrange(3)
    way = rng.randrange(6)
    if way < 3:
        parts[at] = change_bytes(rng, parts[at])
    elif way == 3:
        ids = [0, n - 1, n, n + 1, t, 65535, 65536, (1 << 32) - 1, *range(rng.randrange(200))]
        bitmap = BitMap(i % (1 << 32) for i in rng.sample(ids, rng.randint(1, len(ids))))
        if rng.random() < 0.5:
            bitmap.run_optimize()
        parts[at] = bytes(bitmap.serialize())
    elif way == 4:
        parts[at] = parts[rng.randrange(3)]
    else:
        n, t = rng.choice((((n + 1) % (1 << 32), t), (n, 0), ((1 << 32) - 1, t), (n, (1 << 32) - 1)))
    return struct.pack("<4sIIIII", magic, n, t, *map(len, parts)) + b"".join(parts)


KINDS.update({"hello": change_hello, "holdings": change_holdings})


def in_holdings(folder: Path, case: Case) -> None:
    (data,) = case.values()
    about = scenes()["rgb"].about
    found = Holdings.from_bytes(data, about.gaussians, about.terms)
    assert Holdings.from_bytes(found.to_bytes(), about.gaussians, about.terms).to_bytes() == found.to_bytes()
    assert not len(found.received) or found.received[-1] < about.gaussians


def sessions() -> list[Case]:
    moves = [PoseAt(100 * k, eye, (1.0, 0.1 * k, 0, 0)).to_bytes() for k, eye in enumerate(eyes())]
    acks = [Ack(k).to_bytes() for k in range(3)]
    new, back = hellos()
    late = PoseAt((1 << 32) - 90, eyes()[0], (1.0, 0.0, 0.0, 0.0)).to_bytes()
    scripts = [
        [new, acks[0], moves[0], acks[1], moves[1], moves[2], acks[2], moves[3], Bye().to_bytes()],
        [back, acks[0], moves[4], moves[5], acks[1], moves[0]],
        [new, late, acks[0], moves[0], acks[1]],  # milliseconds start again after 2^32
        [Hello(VIEW, memory=MEMORY).to_bytes(), acks[0], moves[0], acks[1], *moves[1:], Bye().to_bytes()],
    ]
    return [{f"{k:02d}.hello": message for k, message in enumerate(script)} for script in scripts]


def change_order(rng: Random, case: Case, target: Target) -> Case:
    """Change one message, or leave one out, say one twice, or exchange two."""
    messages = [case[name] for name in sorted(case)]
    at, way = rng.randrange(len(messages)), rng.randrange(8)
    if way == 0 and len(messages) > 1:
        del messages[at]
    elif way == 1:
        messages.insert(at, rng.choice(messages))
    elif way == 2:
        other = rng.randrange(len(messages))
        messages[at], messages[other] = messages[other], messages[at]
    elif way == 4 and target.name == "client-session" and rng.random() < 0.3:
        messages.insert(at, batches(rng.choice(("rgb", "hsl")))[0])
    elif way == 3 and len(messages) < 40:
        messages[at:at] = [messages[at]] * rng.randint(2, 30)
    else:
        suffix = next(iter(sorted(case))).partition(".")[2]
        messages[at] = mutate(rng, suffix, messages[at])
    suffix = next(iter(sorted(case))).partition(".")[2]
    return {f"{k:02d}.{suffix}": message for k, message in enumerate(messages[:60])}


LIMITS = Limits(batch_bytes=1500, messages_per_s=20.0, burst_s=1.0, poses_per_s=8.0, stall_s=0.4)
"""Tight, so that sixty messages can go over them."""

WIDE = Limits(batch_bytes=1500, messages_per_s=1e6, burst_s=1.0, poses_per_s=1e6)
"""For a client that says hundreds of things while its socket takes nothing."""

SLOW = 200
"""Messages from which on a client's socket takes nothing until it has said all."""

BRIEF = AbrConfig(begin=9000.0)
"""A session whose messages are small for a short while only: WELCOME has 6 kB."""

SILENCE = b"silence"
"""In place of a message: the client says nothing for longer than the limit."""


class Script:
    """A socket whose client says what is written, then goes; an acknowledgement waits for its message a while."""

    def __init__(self, messages: list[bytes], clock: ManualClock) -> None:
        self.messages, self.clock, self.sent = list(messages), clock, 0
        self.slow, self.deaf = len(messages) >= SLOW, len(messages) % 2 == 1  # who is deaf is gone before the farewell

    async def receive(self) -> bytes:
        self.clock.advance(0.02)
        await asyncio.sleep(0)
        if not self.messages:
            raise GoneError("lost")
        message = self.messages.pop(0)
        if message == SILENCE:
            self.clock.advance(LIMITS.idle_s)
            await asyncio.sleep(0.01)  # the server closes; it has a bell of its own
        wanted = struct.unpack_from("<I", message, 4)[0] if message[:1] == b"\3" and len(message) == 8 else 0
        for _ in range(0 if self.slow else 60):
            if self.sent > wanted:
                break
            await asyncio.sleep(0)
        return message

    async def send(self, data: bytes) -> None:
        for _ in range(5 * SLOW if self.slow and self.sent else 0):
            if not self.messages:
                break
            await asyncio.sleep(0)
        self.sent += 1

    async def close(self, reason: str, code: int) -> None:
        if self.deaf:
            raise GoneError("lost")

    def abort(self) -> None:
        pass


class Heard(EventLog):
    """A log that remembers what went wrong."""

    def __init__(self) -> None:
        super().__init__()
        self.faults: list[str] = []

    def __call__(self, event: str, level: int = 20, /, **facts: object) -> None:
        if event in ("failed", "damaged"):
            self.faults.append(str(facts.get("why")))


def in_connection(folder: Path, case: Case) -> None:
    clock = ManualClock()
    log, served = Heard(), ServedScene("rgb", folder, scenes()["rgb"])
    peer = Script([case[name] for name in sorted(case)], clock)
    planners = ThreadPoolExecutor(1) if len(case) % 5 == 0 else None
    setting = Setting(WIDE if peer.slow else LIMITS, Metrics(), log, BRIEF, clock, planners=planners)
    if peer.deaf:  # and finds the scene closed
        served.opened, served.reopen = None, lambda: (scenes()["rgb"], None)
    full = "all are taken" if len(case) == 1 else ""  # who says one thing alone finds no seat

    async def run() -> str:
        connection = Connection(peer, served, setting, 1, lambda: full)
        await connection.run()
        return connection.reason

    reason = asyncio.run(run())
    if planners is not None:
        planners.shutdown()
    if log.faults or reason in ("", "internal", "damaged"):
        raise AssertionError(f"{reason}: {log.faults[:1]}")
    assert served.fault == ""
    if reason not in ("left", "lost"):
        raise ProtocolError(reason)


@cache
def batches(variant: str) -> list[bytes]:
    session = Session.from_hello(scenes()[variant], Hello(VIEW))
    welcome = session.welcome(0.0).data
    return [welcome, *talk(session, Receiver(welcome), 4)]


MEMORY = 1500
"""Bytes of records that a small client holds: less than the first scene has, so that it forgets some."""


@cache
def small_batches() -> list[bytes]:
    """What a client of little memory gets while it walks: some of it is forgotten again."""
    session = Session.from_hello(scenes()["rgb"], Hello(VIEW, memory=MEMORY))
    welcome = session.welcome(0.0).data
    return [welcome, *talk(session, Receiver(welcome, memory=MEMORY), 8)]


def downstream() -> list[Case]:
    fault = ServerFault(3, "too large").to_bytes()
    made = [{f"{k:02d}.down": data for k, data in enumerate([*batches(variant)])} for variant in ("rgb", "hsl")]
    small = {f"{k:02d}.small": data for k, data in enumerate(small_batches())}
    return [*made, {"00.down": batches("rgb")[0], "01.down": fault}, small]


def change_down(rng: Random, data: bytes) -> bytes:
    """One change of a message of the server: of the JSON in WELCOME, of a section of a BATCH, or of its bytes."""
    if not data or rng.random() < 0.25:
        return change_bytes(rng, data)
    try:
        if data[0] == 129:
            return _change_welcome(rng, data)
        if data[0] == 130:
            return _change_batch(rng, data)
    except (
        ProtocolError,
        ValueError,
        TypeError,
        IndexError,
        OverflowError,
        struct.error,
        pa.ArrowException,
        OSError,
        KeyError,
    ):
        pass
    return change_bytes(rng, data)


def _change_welcome(rng: Random, data: bytes) -> bytes:
    schema = pa.ipc.read_schema(pa.py_buffer(data[HEAD.size :]))
    text = json.dumps(change_json(rng, json.loads(schema.metadata[b"gsvis"]))).encode()
    base = SCHEMA if rng.random() < 0.97 else pa.schema([pa.field("sections", pa.binary())])
    return data[: HEAD.size] + bytes(base.with_metadata({b"gsvis": text}).serialize())


def rows_of(data: bytes) -> list[bytes]:
    """The four rows of a BATCH."""
    at = HEAD.size + len(_ARROW)
    ends, start = _ENDS.unpack_from(data, at), at + _ENDS.size
    return [data[start + a : start + b] for a, b in pairwise(ends)]


def framed(data: bytes, rows: list[bytes]) -> bytes:
    """A BATCH of other rows, with ends and lengths that fit."""
    ends = [0, *np.cumsum([len(row) for row in rows]).tolist()]
    filled = -ends[-1] % 8
    head = bytearray(data[: HEAD.size + len(_ARROW)] + _ENDS.pack(*ends))
    struct.pack_into("<q", head, HEAD.size + _BODY_AT, _ENDS.size + ends[-1] + filled)
    struct.pack_into("<q", head, HEAD.size + _DATA_AT, ends[-1])
    return bytes(head) + b"".join(rows) + bytes(filled)


def _change_frame(rng: Random, data: bytes) -> bytes:
    """One row of a BATCH longer, shorter or other, with ends and lengths that fit."""
    rows = rows_of(data)
    k = rng.randrange(5)
    rows[k] = rng.choice((change_bytes(rng, rows[k]), rows[k][:-1], rows[k] + b"\0", b"", rows[k] * 2))
    if k == 0 and len(rows[0]) >= _IDS.size and rng.random() < 0.5:
        numbers = list(_IDS.unpack_from(rows[0]))
        which = rng.randrange(10)
        numbers[which] = rng.choice((0, 1, 255, numbers[which] + 1, (1 << 32) - 1)) % (1 << 32 if which < 4 else 256)
        rows[0] = _IDS.pack(*numbers) + rows[0][_IDS.size :]
    return framed(data, rows)


def _change_batch(rng: Random, data: bytes) -> bytes:
    if rng.random() < 0.35:
        return _change_frame(rng, data)
    about = next((scene.about for scene in scenes().values() if _fits(data, scene)), None)
    if about is None:
        return change_bytes(rng, data)
    found = Sections.parse(data, about)
    name = rng.choice([f.name for f in fields(found)])
    if name == "rows" and len(found.rows):
        rows = found.rows.copy()
        rows[rng.choice(rows.dtype.names)][rng.randrange(len(rows))] = rng.choice((0, 1, 2, 3, 200))
        return replace(found, rows=rows).to_message(about)
    value: Any = getattr(found, name)
    if name == "sequence":
        return replace(found, sequence=rng.choice((0, 1, 2, value + 1, (1 << 32) - 1))).to_message(about)
    way = rng.randrange(5)
    if way == 0 and len(value):
        value = np.delete(value, rng.randrange(len(value)), axis=0)
    elif way == 1 and len(value):
        value = np.concatenate([value, value[-1:]])
    elif way == 2 and value.dtype == np.int64:
        value = np.append(value, rng.randrange(about.terms if name == "terms" else about.gaussians))
    elif way == 3 and value.dtype == np.int64:
        value = value + rng.choice((-1, 1))
    else:
        raw = np.ascontiguousarray(value)
        changed = change_bytes(rng, raw.tobytes())[: raw.nbytes].ljust(raw.nbytes, b"\0")
        value = np.frombuffer(changed, raw.dtype).reshape(raw.shape)
    return _sound(replace(found, **{name: value}), about).to_message(about)


def _sound(s: Sections, about: SceneHeader) -> Sections:
    """The same with ids that the writer can write: rising ones of the scene, and an owner for each term."""
    n = about.gaussians
    limits = {"chunks": n, "gaussians": n, "terms": about.terms, "gone": n, "evicted": n}
    lists = {name: np.unique(np.clip(getattr(s, name), 0, limit - 1)) for name, limit in limits.items()}
    count = len(lists["terms"])
    owners = np.sort(np.clip(s.owners, 0, n - 1))[:count]
    last = owners[-1] if len(owners) else 0
    return replace(s, **lists, owners=np.append(owners, np.full(count - len(owners), last)).astype(np.int64))


def _fits(data: bytes, scene: StreamedScene) -> bool:
    try:
        Sections.parse(data, scene.about)
    except ProtocolError:
        return False
    return True


KINDS.update({"down": change_down, "small": change_down, "name": KINDS["text"]})


def in_receiver(folder: Path, case: Case) -> None:
    """Receive all, as a client with a limit of memory or without; what is no batch is tried as one, too."""
    first, *rest = (case[name] for name in sorted(case))
    small = min(case).endswith(".small")
    with patch.object(drawn, "_ROOM", 8 if small else drawn._ROOM):  # rows that have to grow
        receiver = Receiver(first, memory=MEMORY if small else 0)
    refused = None
    for data in rest:
        if data[:1] == b"\x83":
            ServerFault.parse(data)
            continue
        if data[:1] == b"\x81":
            receiver.resume(data)
            continue
        before = receiver.shown(), receiver.holdings.to_bytes()
        try:
            receiver.receive(data)
        except ProtocolError as error:
            refused = error
            assert np.array_equal(receiver.shown(), before[0])
            assert receiver.holdings.to_bytes() == before[1]
        g, colors = receiver.scene()
        assert len(g) == len(colors) == len(receiver.shown())
    receiver.hello(VIEW)
    if refused is not None:
        raise refused


S = "gsvis.stream."

TARGETS = [
    Target(
        "client-message",
        said,
        in_parser,
        (ProtocolError,),
        {"message.hello": "hello"},
        modules=(S + "wire", "gsvis.abr.holdings"),
    ),
    Target(
        "holdings",
        lambda: [{"a.holdings": held()}],
        in_holdings,
        (ValueError,),
        {"a.holdings": "holdings"},
        modules=("gsvis.abr.holdings",),
    ),
    Target(
        "server-session",
        sessions,
        in_connection,
        (ProtocolError,),
        change=change_order,
        modules=("gsvis.serve.connection", S + "session", S + "meter"),
    ),
    Target(
        "client-session",
        downstream,
        in_receiver,
        (ProtocolError,),
        change=change_order,
        modules=tuple(S + name for name in ("header", "batch", "coding", "tables", "receiver", "drawn")),
        weight=1.5,
    ),
]
