"""A connection over a socket that is none: nothing piles up, both loops end, whoever does not listen is cut."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import pytest

from gsvis.abr.scheduler import SchedulerConfig
from gsvis.serve import Limits, Metrics, open_scenes
from gsvis.serve._log import EventLog
from gsvis.serve.connection import Connection, GoneError, Setting
from gsvis.stream import Ack, Hello
from tests.serve.servers import VIEW, pose, quick


class FakePeer:
    """Says what it is given; takes what is sent, or has no room."""

    def __init__(self, *said: bytes, room: bool = True, again: Callable[[int], bytes] | None = None) -> None:
        self.said, self.room, self.again = list(said), room, again
        self.sent: list[bytes] = []
        self.closed, self.aborted, self.heard = "", False, 0

    async def receive(self) -> bytes:
        if self.said:
            return self.said.pop(0)
        if self.again is not None:
            self.heard += 1
            await asyncio.sleep(0)
            return self.again(self.heard)
        await asyncio.sleep(3600)
        raise GoneError("lost")

    async def send(self, data: bytes) -> None:
        if not self.room and data[0] != 129:
            await asyncio.sleep(3600)
        self.sent.append(data)

    async def close(self, reason: str) -> None:
        self.closed = reason

    def abort(self) -> None:
        self.aborted = True


def served_to(plain: Path, peer: FakePeer, limits: Limits) -> tuple[Connection, Metrics]:
    metrics = Metrics()

    async def alone() -> Connection:
        setting = Setting(limits, metrics, EventLog(), SchedulerConfig(), time.monotonic)
        connection = Connection(peer, scenes["plain"], setting, 1)
        await connection.run()
        assert len(asyncio.all_tasks()) == 1  # both loops have ended
        return connection

    with open_scenes([plain]) as scenes:
        return asyncio.run(alone()), metrics


def test_without_room_in_the_socket_nothing_piles_up(plain: Path) -> None:
    peer = FakePeer(Hello(VIEW).to_bytes(), pose(), room=False, again=lambda k: pose(ms=k))
    connection, _ = served_to(plain, peer, quick(messages_per_s=500.0, burst_s=2.0, poses_per_s=1e6, stall_s=60.0))
    assert connection.reason == "flood"
    assert len(connection._heard) <= 257
    assert peer.aborted  # its last words had no room either
    assert [data[0] for data in peer.sent] == [129]


def test_acknowledgements_without_room_are_a_flood(plain: Path) -> None:
    peer = FakePeer(Hello(VIEW).to_bytes(), pose(), room=False, again=lambda k: Ack(0).to_bytes())
    connection, _ = served_to(plain, peer, quick(messages_per_s=500.0, burst_s=2.0, stall_s=60.0))
    assert connection.reason == "flood"
    assert len(connection._heard) <= 257


@pytest.mark.parametrize(
    ("said", "reason"),
    [((), "late"), ((Hello(VIEW).to_bytes(),), "late"), ((Hello(VIEW).to_bytes(), b"\x04\0\0\0"), "left")],
)
def test_silence_and_farewell(plain: Path, said: tuple[bytes, ...], reason: str) -> None:
    peer = FakePeer(*said)
    connection, metrics = served_to(plain, peer, quick(handshake_s=0.05, idle_s=0.1))
    assert connection.reason == reason
    assert (metrics.closed if said else metrics.refused).value(reason) == 1
    assert peer.closed == ("" if reason == "left" else "late")


def test_no_batch_exceeds_its_limit_and_the_pace_is_kept(plain: Path) -> None:
    def acknowledge(k: int) -> bytes:
        return Ack(len(peer.sent) - 1).to_bytes()

    peer = FakePeer(Hello(VIEW).to_bytes(), pose())
    waiting: Callable[[], Coroutine[Any, Any, bytes]] = peer.receive

    async def paced() -> bytes:
        if peer.said:
            return await waiting()
        if len(peer.sent) > 12:
            return b"\x04\0\0\0"
        await asyncio.sleep(0.01)
        return acknowledge(0)

    peer.receive = paced  # type: ignore[method-assign]
    connection, metrics = served_to(plain, peer, quick(batch_bytes=5000, messages_per_s=1e4))
    assert connection.reason == "left"
    assert max(len(data) for data in peer.sent[1:]) <= 1.1 * 5000
    assert metrics.batches.value() == len(peer.sent) - 1
