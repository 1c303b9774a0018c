"""A connection over a socket that is none: nothing piles up, both loops end, whoever does not listen is cut."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import pytest

from gsvis.abr.config import AbrConfig
from gsvis.serve import Limits, ManualClock, Metrics, open_scenes
from gsvis.serve._log import EventLog
from gsvis.serve.connection import Connection, GoneError, Setting
from gsvis.stream import Ack, Hello
from tests.serve.servers import PATIENCE, VIEW, limits_of, pose


class FakePeer:
    """Says what it is given; takes what is sent, or has no room."""

    def __init__(self, *said: bytes, room: bool = True, again: Callable[[int], bytes] | None = None) -> None:
        self.said, self.room, self.again = list(said), room, again
        self.sent: list[bytes] = []
        self.closed, self.code, self.aborted, self.heard = "", 0, False, 0
        self.is_silent = asyncio.Event()

    async def receive(self) -> bytes:
        if self.said:
            return self.said.pop(0)
        if self.again is not None:
            self.heard += 1
            await asyncio.sleep(0)
            return self.again(self.heard)
        self.is_silent.set()
        await asyncio.Event().wait()
        raise GoneError("lost")

    async def send(self, data: bytes) -> None:
        if not self.room and data[0] != 129:
            await asyncio.Event().wait()
        self.sent.append(data)

    async def close(self, reason: str, code: int) -> None:
        self.closed, self.code = reason, code

    def abort(self) -> None:
        self.aborted = True


Passing = Callable[[Connection, ManualClock], Coroutine[Any, Any, None]]


def served_to(
    plain: Path, peer: FakePeer, limits: Limits, passing: Passing | None = None
) -> tuple[Connection, Metrics, ManualClock]:
    """A connection at its end; time passes as `passing` says."""
    metrics, clock = Metrics(), ManualClock()

    async def alone() -> Connection:
        setting = Setting(limits, metrics, EventLog(), AbrConfig(), clock)
        connection = Connection(peer, scenes["plain"], setting, 1)
        beside = [] if passing is None else [asyncio.create_task(passing(connection, clock))]
        await asyncio.wait_for(connection.run(), PATIENCE)
        await asyncio.gather(*beside)
        assert len(asyncio.all_tasks()) == 2  # this one and its hang guard: both loops have ended
        return connection

    async def guarded() -> Connection:
        return await asyncio.wait_for(asyncio.create_task(alone()), PATIENCE)

    with open_scenes([plain]) as scenes:
        return asyncio.run(guarded()), metrics, clock


async def past_the_farewell(connection: Connection, clock: ManualClock) -> None:
    while not connection.reason:
        await asyncio.sleep(0)
    for _ in range(20):  # until the last words are on their way
        await asyncio.sleep(0)
    clock.advance(1.0)


def test_without_room_in_the_socket_nothing_piles_up(plain: Path) -> None:
    peer = FakePeer(Hello(VIEW).to_bytes(), pose(), room=False, again=lambda k: pose(ms=k))
    limits = limits_of(messages_per_s=500.0, burst_s=2.0, poses_per_s=1e6)
    connection, _, _ = served_to(plain, peer, limits, past_the_farewell)
    assert connection.reason == "flood"
    assert len(connection._mailbox) <= 257
    assert peer.aborted  # its last words had no room either
    assert [data[0] for data in peer.sent] == [129]


def test_acknowledgements_without_room_are_a_flood(plain: Path) -> None:
    peer = FakePeer(Hello(VIEW).to_bytes(), pose(), room=False, again=lambda k: Ack(0).to_bytes())
    connection, _, _ = served_to(plain, peer, limits_of(messages_per_s=500.0, burst_s=2.0), past_the_farewell)
    assert connection.reason == "flood"
    assert len(connection._mailbox) <= 257


@pytest.mark.parametrize(
    ("said", "seconds"),
    [
        ((), 10.0),
        ((Hello(VIEW).to_bytes(),), 30.0),  # WELCOME is not acknowledged
        ((Hello(VIEW).to_bytes(), Ack(0).to_bytes()), 60.0),
    ],
)
def test_silence_ends_a_connection_at_its_deadline_and_not_before(
    plain: Path, said: tuple[bytes, ...], seconds: float
) -> None:
    peer = FakePeer(*said)

    async def passing(connection: Connection, clock: ManualClock) -> None:
        await peer.is_silent.wait()
        while connection._mailbox:  # what it has said is taken in
            await asyncio.sleep(0)
        clock.advance(seconds - 0.01)
        for _ in range(50):
            await asyncio.sleep(0)
        assert connection.reason == ""
        clock.advance(0.01)

    connection, metrics, clock = served_to(plain, peer, limits_of(handshake_s=10.0, stall_s=30.0, idle_s=60.0), passing)
    assert (connection.reason, peer.closed) == ("late", "late")
    assert clock.now() == pytest.approx(seconds)
    assert (metrics.closed if said else metrics.refused).value("late") == 1


def test_farewell(plain: Path) -> None:
    peer = FakePeer(Hello(VIEW).to_bytes(), b"\x04\0\0\0")
    connection, metrics, _ = served_to(plain, peer, limits_of())
    assert (connection.reason, peer.closed, peer.code, peer.aborted) == ("left", "left", 1000, False)
    assert metrics.closed.value("left") == 1


def test_no_batch_exceeds_its_limit_and_the_pace_is_kept(plain: Path) -> None:
    peer = FakePeer(Hello(VIEW).to_bytes(), pose())
    waiting: Callable[[], Coroutine[Any, Any, bytes]] = peer.receive
    acknowledged = -1

    async def paced() -> bytes:
        nonlocal acknowledged
        if peer.said:
            return await waiting()
        if len(peer.sent) > 12:
            return b"\x04\0\0\0"
        while len(peer.sent) - 1 == acknowledged:
            await asyncio.sleep(0)
        acknowledged = len(peer.sent) - 1
        return Ack(acknowledged).to_bytes()

    peer.receive = paced  # type: ignore[method-assign]
    connection, metrics, _ = served_to(plain, peer, limits_of(batch_bytes=5000, messages_per_s=1e4))
    assert connection.reason == "left"
    assert max(len(data) for data in peer.sent[1:]) <= 1.1 * 5000
    assert metrics.sent.batches.value() == len(peer.sent) - 1


@pytest.mark.parametrize("room", [True, False])
def test_one_that_gives_way_ends_whether_or_not_its_socket_has_room(plain: Path, room: bool) -> None:
    peer = FakePeer(Hello(VIEW).to_bytes(), pose(), room=room)

    async def passing(connection: Connection, clock: ManualClock) -> None:
        await peer.is_silent.wait()
        clock.advance(7.0)
        assert connection.silent_s == 7.0
        connection.give_way()
        if not room:
            await past_the_farewell(connection, clock)

    connection, metrics, _ = served_to(plain, peer, limits_of(), passing)
    assert (connection.reason, metrics.closed.value("late")) == ("late", 1)
    assert (peer.closed, peer.aborted) == (("late", False) if room else ("", True))
