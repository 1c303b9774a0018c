"""Clients that mean harm, each kind a coroutine that makes one attempt: what `server_soak.py` sets upon a server.

All on loopback, from addresses of their own, bounded in number and in time, on other cores than the server's.
"""

from __future__ import annotations

import asyncio
import logging
import os
import socket
import ssl
import struct
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from gsvis.abr.classes import FieldOfView
from gsvis.errors import ProtocolError
from gsvis.stream import Hello, PoseAt
from gsvis.stream.header import SceneHeader

__all__ = ["CROWD", "Target", "attack", "unverified"]

VIEW = FieldOfView.from_degrees(90, 70, margin=8)
NICE = 15  # attackers yield to viewers on the same core: what is measured is the server, not who gets that core
HOLD_S = 90.0  # a connection that the server does not end is given up after so long
HEALTH = b"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1\r\n"
OUTSIDE = (
    "/packages/{name}/parts/../manifest.json", "/packages/{name}/../../../../../../etc/passwd",
    "/packages/{name}/parts/..%2f..%2f..%2f..%2f..%2fetc%2fpasswd", "/packages/{name}/parts/%00",
    "/packages/{name}/parts//etc/passwd", "/packages/..%2f..%2fetc%2fpasswd/manifest.json", "//etc/passwd",
    "/../../../../../../etc/passwd", "/packages/{name}/parts/" + "0" * 64 + ".arrow%0a",
)  # fmt: skip


@dataclass(frozen=True)
class Target:
    """What is attacked, and from where.

    Attributes:
        host: Address of the server.
        port: Of the server.
        tls: Whether it wants TLS.
        name: Of a scene.
        address: Of the attacker.
    """

    host: str
    port: int
    tls: bool
    name: str
    address: str = "127.0.0.1"


EXPECTED = (OSError, EOFError, asyncio.TimeoutError, asyncio.LimitOverrunError, ProtocolError)


class LeakError(Exception):
    """The server gave away what it must not."""


@cache
def unverified() -> ssl.SSLContext:
    """Return a context that takes any certificate: this is loopback. One for all: it has a megabyte of authorities."""
    context = ssl.create_default_context()
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    return context


class Line:
    """One TCP connection, inside of TLS if the server wants it."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader, self._writer = reader, writer

    @classmethod
    async def open(cls, target: Target, *, tls: bool | None = None, limit: int = 1 << 16) -> Line:
        context = unverified() if (target.tls if tls is None else tls) else None
        opening = asyncio.open_connection(
            target.host, target.port, ssl=context, local_addr=(target.address, 0), limit=limit
        )
        return cls(*await asyncio.wait_for(opening, 20.0))

    async def say(self, data: bytes) -> None:
        self._writer.write(data)
        await asyncio.wait_for(self._writer.drain(), HOLD_S)

    async def hold(self, seconds: float = HOLD_S) -> None:
        """Read until the server ends the connection, or for so long."""

        async def drain() -> None:
            while await self.reader.read(1 << 16):
                pass

        with suppress(asyncio.TimeoutError):
            await asyncio.wait_for(drain(), seconds)

    async def upgrade(self, target: Target, *more: bytes) -> None:
        lines = [
            b"GET /stream HTTP/1.1", f"Host: {target.host}:{target.port}".encode(), b"Upgrade: websocket",
            b"Connection: Upgrade", b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==", b"Sec-WebSocket-Version: 13", *more,
        ]  # fmt: skip
        await self.say(b"\r\n".join([*lines, b"", b""]))

    async def streaming(self, target: Target) -> None:
        """Be a WebSocket."""
        await self.upgrade(target)
        await asyncio.wait_for(self.reader.readuntil(b"\r\n\r\n"), HOLD_S)

    async def message(self) -> bytes:
        """Read a whole frame of the server."""
        head = await asyncio.wait_for(self.reader.readexactly(2), HOLD_S)
        length = head[1] & 127
        if length >= 126:
            length = int.from_bytes(await self.reader.readexactly(2 if length == 126 else 8), "big")
        return await self.reader.readexactly(length)

    def end(self) -> None:
        """Say that nothing more will be said, where that can be said."""
        if self._writer.can_write_eof():
            self._writer.write_eof()

    def close(self, *, reset: bool = False) -> None:
        found = self._writer.get_extra_info("socket")
        if reset and found is not None:
            with suppress(OSError):
                found.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self._writer.transport.abort()


def frame(data: bytes, opcode: int = 2, *, fin: bool = True, claimed: int | None = None) -> bytes:
    """Return a frame of a client, masked with zeros."""
    length = len(data) if claimed is None else claimed
    head = bytes([(0x80 if fin else 0) | opcode])
    if length < 126:
        head += bytes([0x80 | length])
    elif length < 1 << 16:
        head += bytes([0x80 | 126]) + struct.pack(">H", length)
    else:
        head += bytes([0x80 | 127]) + struct.pack(">Q", length)
    return head + bytes(4) + data


def pose(rng: np.random.Generator) -> bytes:
    """Return a frame with a POSE somewhere."""
    x, y, z = rng.normal(scale=10.0 ** rng.integers(0, 6), size=3).tolist()
    return frame(PoseAt(int(rng.integers(1 << 32)), (x, y, z), (1.0, 0.0, 0.0, 0.0)).to_bytes())


async def idle_keep_alive(line: Line, target: Target, rng: np.random.Generator) -> None:
    await line.say(HEALTH + b"\r\n")
    await line.reader.readuntil(b"\r\n\r\n")
    await line.say(b"G")
    await line.hold()


async def slow_headers(line: Line, target: Target, rng: np.random.Generator) -> None:
    await line.say(HEALTH + b"X-Slow: ")
    for _ in range(int(2 * HOLD_S)):
        await line.say(b"a")
        await line.hold(0.5)
        if line.reader.at_eof():
            return


async def slow_body(line: Line, target: Target, rng: np.random.Generator) -> None:
    await line.say(HEALTH.replace(b"GET", b"POST") + b"Content-Length: 100000\r\n\r\n")
    for _ in range(int(2 * HOLD_S)):
        await line.say(b"a")
        await line.hold(0.5)
        if line.reader.at_eof():
            return


async def unread_answers(line: Line, target: Target, rng: np.random.Generator) -> None:
    asked = f"GET /packages/{target.name}/manifest.json HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n".encode()
    for _ in range(400):
        await line.say(asked)
    await asyncio.sleep(HOLD_S)


async def refused_upgrade(line: Line, target: Target, rng: np.random.Generator) -> None:
    bad = ([b"X-A: a\x01b"], [b"X-A: " + b"a" * 20_000], [b"X-%d: a" % k for k in range(130)])
    await line.upgrade(target, *bad[int(rng.integers(3))])
    await line.hold()


async def garbage(line: Line, target: Target, rng: np.random.Generator) -> None:
    await line.say(rng.bytes(int(rng.integers(1, 5000))))
    await line.hold(20.0)


async def garbage_frames(line: Line, target: Target, rng: np.random.Generator) -> None:
    await line.streaming(target)
    await line.say(rng.bytes(int(rng.integers(1, 5000))))
    await line.hold(20.0)


async def garbage_messages(line: Line, target: Target, rng: np.random.Generator) -> None:
    await line.streaming(target)
    said = [Hello(VIEW).to_bytes(), pose(rng)[6:], rng.bytes(40)]
    for _ in range(10):
        data = bytearray(said[int(rng.integers(3))])
        data[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
        await line.say(frame(bytes(data)))
    await line.hold(20.0)


async def bad_holdings(line: Line, target: Target, rng: np.random.Generator) -> None:
    await line.streaming(target)
    await line.say(frame(Hello(VIEW).to_bytes()))
    about = SceneHeader.parse(await line.message())
    held = struct.pack("<4sIIIII", b"GVH1", about.gaussians, about.terms, 40, 40, 40) + rng.bytes(120)
    again = await Line.open(target)
    try:
        await again.streaming(target)
        await again.say(frame(Hello(VIEW, bytes.fromhex(about.identity), held).to_bytes()))
        await again.hold(20.0)
    finally:
        again.close()


async def flood(line: Line, target: Target, rng: np.random.Generator) -> None:
    await line.streaming(target)
    await line.say(frame(Hello(VIEW).to_bytes()))
    burst = b"".join(pose(rng) for _ in range(500))
    for _ in range(20):
        await line.say(burst)
    await line.hold(20.0)


async def huge_frame(line: Line, target: Target, rng: np.random.Generator) -> None:
    await line.streaming(target)
    await line.say(frame(b"", claimed=1 << int(rng.integers(24, 62))))
    for _ in range(256):
        await line.say(bytes(1 << 16))
    await line.hold(20.0)


async def fragments(line: Line, target: Target, rng: np.random.Generator) -> None:
    await line.streaming(target)
    await line.say(frame(b"\x01", fin=False) + frame(b"", 0, fin=False) * 5000)
    await line.hold(20.0)


async def unread_pings(line: Line, target: Target, rng: np.random.Generator) -> None:
    await line.streaming(target)
    await line.say(frame(Hello(VIEW).to_bytes()))
    for _ in range(400):
        await line.say(frame(bytes(100), 9) * 50)
    await asyncio.sleep(5.0)


async def traversal(line: Line, target: Target, rng: np.random.Generator) -> None:
    path = OUTSIDE[int(rng.integers(len(OUTSIDE)))].format(name=target.name)
    await line.say(f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: close\r\n\r\n".encode())
    answer = await asyncio.wait_for(line.reader.read(1 << 20), HOLD_S)
    if b"root:" in answer or answer.startswith(b"HTTP/1.1 200"):
        raise LeakError(path)


async def never_acks(line: Line, target: Target, rng: np.random.Generator) -> None:
    await line.streaming(target)
    await line.say(frame(Hello(VIEW).to_bytes()))
    for _ in range(int(5 * HOLD_S)):
        await line.say(pose(rng))
        await line.hold(0.2)
        if line.reader.at_eof():
            return


async def never_reads(line: Line, target: Target, rng: np.random.Generator) -> None:
    await line.streaming(target)
    await line.say(frame(Hello(VIEW).to_bytes()))
    for _ in range(int(5 * HOLD_S)):
        await line.say(pose(rng))
        await asyncio.sleep(0.2)


async def reconnect_storm(line: Line, target: Target, rng: np.random.Generator) -> None:
    await line.streaming(target)
    await line.say(frame(Hello(VIEW).to_bytes()))
    await line.message()
    line.close(reset=True)


async def reset_when_answered(line: Line, target: Target, rng: np.random.Generator) -> None:
    await line.say(HEALTH + b"\r\n")
    await line.reader.readuntil(b"\r\n\r\n")
    await line.reader.readuntil(b"}")
    line.close(reset=True)


async def silent(line: Line, target: Target, rng: np.random.Generator) -> None:
    await line.hold()


async def silent_socket(line: Line, target: Target, rng: np.random.Generator) -> None:
    await line.streaming(target)
    await line.hold()


async def smuggled(line: Line, target: Target, rng: np.random.Generator) -> None:
    body = b"Content-Length: 5\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n" + HEALTH + b"\r\n"
    bare = (HEALTH + b"\r\n").replace(b"\r\n", b"\n")
    await line.say(HEALTH.replace(b"GET", b"POST") + body if rng.integers(2) else bare)
    await line.hold(20.0)


async def half_closed(line: Line, target: Target, rng: np.random.Generator) -> None:
    await line.say(HEALTH + b"\r\n")
    line.end()
    await line.hold()


Kind = Callable[[Line, Target, np.random.Generator], Awaitable[None]]

CROWD: dict[Kind, tuple[int, float]] = {
    idle_keep_alive: (40, 0.5), slow_headers: (24, 0.5), slow_body: (8, 0.5), unread_answers: (8, 1.0),
    refused_upgrade: (16, 0.5), garbage: (8, 0.5), garbage_frames: (8, 0.5), garbage_messages: (8, 0.5),
    bad_holdings: (4, 0.5), flood: (2, 2.0), huge_frame: (4, 1.0), fragments: (2, 1.0), unread_pings: (2, 2.0),
    traversal: (4, 0.2), never_acks: (6, 1.0), never_reads: (4, 1.0), reconnect_storm: (4, 0.2), silent: (40, 0.5),
    silent_socket: (16, 0.5), smuggled: (4, 0.5), half_closed: (8, 0.5),
    reset_when_answered: (4, 0.2),
}  # fmt: skip
"""How many of each kind at once, and the seconds between two attempts of one."""

PLAIN = (silent,)  # kinds that do not even begin with TLS


async def _attempt(kind: Kind, target: Target, rng: np.random.Generator) -> None:
    line = await Line.open(target, tls=False if kind in PLAIN else None)
    try:
        await kind(line, target, rng)
    finally:
        line.close()


async def _keep_on(kind: Kind, target: Target, pause: float, until: float, seed: int, counts: Counter[str]) -> None:
    rng, name = np.random.default_rng(seed), kind.__name__
    while (left := until - time.monotonic()) > 0:
        counts[f"{name}: attempts"] += 1
        try:
            await asyncio.wait_for(_attempt(kind, target, rng), left)
        except LeakError as leak:
            counts[f"leak: {leak}"] += 1
        except EXPECTED as error:
            counts[f"{name}: {type(error).__name__}"] += 1
        await asyncio.sleep(pause * float(rng.uniform(0.5, 1.5)))


def attack(target: Target, names: Sequence[str], seconds: float, cores: Sequence[int], seed: int, results: Any) -> None:
    """Run some kinds for so long, and put the counts of what happened into a queue; the body of a process.

    Args:
        target: What is attacked.
        names: Of kinds in `CROWD`.
        seconds: How long.
        cores: Where this process may run.
        seed: Of everything random.
        results: A queue.
    """
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, cores)
    os.nice(NICE)
    logging.getLogger("asyncio").setLevel(logging.ERROR)  # it warns of each connection that the server has cut
    counts: Counter[str] = Counter()

    async def run() -> None:
        until, tasks = time.monotonic() + seconds, []
        for place, (kind, (count, pause)) in enumerate(CROWD.items()):
            if kind.__name__ not in names:
                continue
            for k in range(count):
                # Half of a kind share an address, the others have one each.
                at = f"127.{1 + seed % 100}.{1 + place}.{1 if k % 2 else 2 + k}"
                mine = Target(target.host, target.port, target.tls, target.name, at)
                tasks.append(_keep_on(kind, mine, pause, until, seed * 10_000 + place * 100 + k, counts))
        await asyncio.gather(*tasks)

    asyncio.run(run())
    results.put(dict(counts))
