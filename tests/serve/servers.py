"""Servers and clients of tests, and raw sockets for what no decent client does.

No test rests on a time. The clock of a server stands still: a deadline expires because the test advances it. Tests wait
for facts; `PATIENCE` ends one that hangs, and decides nothing else.
"""

from __future__ import annotations

import asyncio
import os
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from gsvis.abr.classes import FieldOfView
from gsvis.package import Package
from gsvis.serve import Address, AppConfig, ClientConfig, Limits, ManualClock, Server, StreamClient, open_scenes
from gsvis.stream import Hello, PoseAt, Receiver

VIEW = FieldOfView.from_degrees(80, 60, margin=8)
PATIENCE = float(os.environ.get("GSVIS_PATIENCE", "300"))
"""Seconds after which a test hangs."""
LIMITS = Limits(tick_s=0.02, messages_per_s=1000.0)
"""Limits of the servers of tests."""


def still(t: float) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """A viewer who does not move."""
    return (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)


@contextmanager
def serving(
    *packages: Path,
    limits: Limits = LIMITS,
    port: int = 0,
    tls: tuple[Path, Path] | None = None,
    tables: Path | None = None,
    **config: Any,
) -> Iterator[Server]:
    """A running server, with a `ManualClock`; `tls` is a chain and a key."""
    settings = AppConfig(limits=limits, **config)
    clock = ManualClock()
    with open_scenes(packages, tables=tables) as scenes:
        server = Server(scenes, settings, Address("127.0.0.1", port, *(tls or ())), clock=clock)
        with server.running():
            try:
                yield server
            finally:
                server.stop()
                threading.Thread(target=_let_end, args=(server, clock), daemon=True).start()


def _let_end(server: Server, clock: ManualClock) -> None:
    """Let a server that stops come to its end, whoever does not listen."""
    while server._socket.fileno() >= 0:
        time.sleep(0.05)
        clock.advance(0.1)


@contextmanager
def raw(server: Server, hello: bytes | None = None, name: str = "") -> Iterator[ClientConnection]:
    """A WebSocket that has said HELLO, unless `hello` is b""."""
    with connect(
        server.url + name, compression=None, proxy=None, ping_interval=None, open_timeout=PATIENCE, close_timeout=0.2
    ) as ws:
        ws.send(Hello(VIEW).to_bytes() if hello is None else hello) if hello != b"" else None
        yield ws


def pose(x: float = 0.0, ms: int = 0) -> bytes:
    return PoseAt(ms, (x, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)).to_bytes()


def heard(ws: ClientConnection) -> bytes:
    """The next message of the server."""
    data = ws.recv(timeout=PATIENCE)
    assert isinstance(data, bytes)
    return data


def close_code(ws: ClientConnection) -> int | None:
    """The code with which the server closes a connection, after all its messages."""
    with suppress(ConnectionClosed):
        while True:
            ws.recv(timeout=PATIENCE)
    return ws.close_code


def until(fact: Callable[[], bool], seconds: float = PATIENCE) -> None:
    """Wait for a fact; `seconds` end what hangs."""
    end = time.monotonic() + seconds
    while not fact():
        assert time.monotonic() < end, "it did not come to pass"
        time.sleep(0.005)


def advance(server: Server, seconds: float) -> None:
    """Let the time of a server pass."""
    assert isinstance(server.clock, ManualClock)
    server.clock.advance(seconds)


def is_due(server: Server, seconds: float) -> bool:
    """Return whether a server has set a deadline in so many seconds."""
    assert isinstance(server.clock, ManualClock)
    return any(abs(due - seconds) < 1e-6 for due in server.clock.due)


def advance_until(server: Server, fact: Callable[[], bool], step: float = 1.0) -> None:
    """Let the time of a server pass until a fact holds; only for tests in which nobody is to be spared."""

    def passes() -> bool:
        advance(server, step)
        return fact()

    until(passes)


def phases(server: Server) -> list[str]:
    """What the connections of a server are doing."""
    return sorted(guard.phase.value for guard in list(server._server._door.guards))


def wanted(package: Path) -> tuple[np.ndarray, np.ndarray]:
    """Ids of the highest level, and of their terms: what a patient client of a plain package shows."""
    with Package.open(package) as opened:
        contents = opened.contents
    highest = contents.last == len(contents.names) - 1
    return np.flatnonzero(highest), np.flatnonzero(np.repeat(highest, np.diff(contents.term_offsets)))


def has_all(receiver: Receiver | None, package: Path) -> bool:
    """Whether a client shows the highest level with all its terms."""
    if receiver is None:
        return False
    high, terms = wanted(package)
    held = receiver.holdings.received_terms
    return np.array_equal(np.sort(receiver.shown()), high) and bool(np.isin(terms, held).all())


def patient(
    url: str, package: Path, *, seconds: float = PATIENCE, config: ClientConfig | None = None,
    receiver: Receiver | None = None, moved: Callable[[StreamClient], None] | None = None,
) -> tuple[StreamClient, list[int]]:  # fmt: skip
    """A client that stays until it has all; also the ids of the Gaussians that came, in their order."""
    high, terms = wanted(package)
    came: list[int] = []

    async def stream() -> StreamClient:
        client = StreamClient(url, VIEW, config, receiver=receiver, clock=ManualClock())

        def look(received: object) -> None:
            came.extend(received.gaussians.tolist())  # type: ignore[attr-defined]
            if moved is not None:
                moved(client)
            held = client.receiver
            assert held is not None
            has_terms = np.isin(terms, held.holdings.received_terms).all()
            if np.array_equal(np.sort(held.shown()), high) and has_terms:
                client.stop()

        await asyncio.wait_for(client.run(still, on_batch=look), seconds)
        return client

    return asyncio.run(stream()), came


def after_one_batch(url: str, config: ClientConfig | None = None) -> StreamClient:
    """A client that leaves after its first batch."""

    async def stream() -> StreamClient:
        client = StreamClient(url, VIEW, config, clock=ManualClock())
        await asyncio.wait_for(client.run(still, on_batch=lambda _: client.stop()), PATIENCE)
        return client

    return asyncio.run(stream())


def give_up(url: str, config: ClientConfig | None = None) -> None:
    """A client whose time passes until it gives up."""

    async def stream() -> None:
        clock = ManualClock()
        running = asyncio.create_task(StreamClient(url, VIEW, config, clock=clock).run(still))
        while not running.done():
            clock.advance(1.0)
            await asyncio.sleep(0.01)
        running.result()

    asyncio.run(asyncio.wait_for(stream(), PATIENCE))


class SlowLink:
    """A link between clients and a server, of a rate, that can be held up; it may stall by itself, once.

    Args:
        url: Address of the server.
        bytes_per_s: Rate.
        most_bytes: Bytes of one connection after which it stalls; what earlier ones brought may have been lost.
    """

    def __init__(self, url: str, bytes_per_s: float, most_bytes: float = float("inf")) -> None:
        parts = urlsplit(url)
        self._to, self._rate, self._most = (parts.hostname, parts.port), bytes_per_s, most_bytes
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.url = f"ws://127.0.0.1:{self._listener.getsockname()[1]}{parts.path}"
        self._open, self.is_free = threading.Event(), False
        self.go_on()
        threading.Thread(target=self._accept, daemon=True).start()

    @property
    def is_stalled(self) -> bool:
        return not self._open.is_set()

    def stall(self) -> None:
        self._open.clear()

    def carry_freely(self) -> None:
        """Go on, and faster than anybody can send."""
        self._rate, self.is_free = 1e9, True
        self.go_on()

    def go_on(self) -> None:
        self._open.set()

    def close(self) -> None:
        self.go_on()
        with suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)  # ends the wait for a client
        self._listener.close()

    def _accept(self) -> None:
        while True:
            try:
                near, _ = self._listener.accept()
            except OSError:
                return
            near.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 8192)
            far = socket.socket()
            far.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 8192)  # or all would wait in here
            try:
                far.connect(self._to)
            except OSError:  # nobody there just now
                near.settimeout(PATIENCE)
                threading.Thread(target=self._turn_away, args=(near,), daemon=True).start()
                far.close()
                continue
            for source, sink, is_down in ((near, far, False), (far, near, True)):
                source.settimeout(None)
                threading.Thread(target=self._carry, args=(source, sink, is_down), daemon=True).start()

    def _turn_away(self, near: socket.socket) -> None:
        """End a connection once its request is here: node says nothing of one that ends before."""
        with suppress(OSError), near:
            near.recv(1 << 16)

    def _carry(self, source: socket.socket, sink: socket.socket, is_down: bool) -> None:
        carried = 0
        try:
            while data := source.recv(4096):
                carried += len(data) if is_down else 0
                if carried > self._most:
                    self._most = float("inf")
                    self.stall()
                time.sleep(len(data) / self._rate)
                self._open.wait()
                sink.sendall(data)
        except OSError:
            pass
        for end in (source, sink):
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
            end.close()


@contextmanager
def slow_link(url: str, bytes_per_s: float, most_bytes: float = float("inf")) -> Iterator[SlowLink]:
    link = SlowLink(url, bytes_per_s, most_bytes)
    try:
        yield link
    finally:
        link.close()


def plain_socket(server: Server) -> socket.socket:
    """A TCP connection."""
    parts = urlsplit(server.url)
    return socket.create_connection((parts.hostname, parts.port), timeout=PATIENCE)


def upgraded(server: Server, path: str = "/stream") -> socket.socket:
    """A TCP connection that is a WebSocket now, for frames made by hand."""
    found = plain_socket(server)
    found.sendall(
        f"GET {path} HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n\r\n".encode()
    )
    answer = b""
    while b"\r\n\r\n" not in answer:
        answer += found.recv(1)
    assert b" 101 " in answer.split(b"\r\n")[0]
    return found


def frame(data: bytes, opcode: int = 2, *, fin: bool = True, claimed: int | None = None) -> bytes:
    """A frame of a client, masked with zeros."""
    length = len(data) if claimed is None else claimed
    head = bytes([(0x80 if fin else 0) | opcode])
    if length < 126:
        head += bytes([0x80 | length])
    elif length < 1 << 16:
        head += bytes([0x80 | 126]) + struct.pack(">H", length)
    else:
        head += bytes([0x80 | 127]) + struct.pack(">Q", length)
    return head + bytes(4) + data


def ask(server: Server, path: str, method: str = "GET", **headers: str) -> tuple[int, dict[str, str], bytes]:
    """Status, headers and body of a plain request; the path goes out as it is."""
    headers = {"Host": "localhost"} | headers
    with plain_socket(server) as found:
        lines = [f"{method} {path} HTTP/1.1", "Connection: close"]
        lines += [f"{name.replace('_', '-')}: {value}" for name, value in headers.items()]
        found.sendall("\r\n".join([*lines, "", ""]).encode("latin-1"))
        answer = rest_of(found)
    head, _, body = answer.partition(b"\r\n\r\n")
    first, *rest = head.decode("latin-1").split("\r\n")
    fields = dict(line.lower().split(": ", 1) for line in rest)
    return int(first.split()[1]), fields, body


def rest_of(found: socket.socket) -> bytes:
    """What comes until the server ends the connection, or cuts it."""
    found.settimeout(PATIENCE)
    answer = b""
    with suppress(ConnectionError):
        while piece := found.recv(1 << 16):
            answer += piece
    return answer


def limits_of(**changes: Any) -> Limits:
    """`LIMITS`, changed."""
    return replace(LIMITS, **changes)
