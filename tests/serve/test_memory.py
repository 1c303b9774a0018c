"""A connection that has ended leaves nothing: what it held is free at once, not when the garbage collector comes by."""

from __future__ import annotations

import gc
import socket
import ssl
import struct
import subprocess
import sys
from asyncio.sslproto import SSLProtocol
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from gsvis.serve import Server
from gsvis.serve._guard import Guard
from gsvis.serve._protocols import Plain, Socket
from gsvis.serve.connection import Connection
from gsvis.stream import Bye, Hello, Session
from tests.serve.certificates import certificate
from tests.serve.servers import (
    PATIENCE,
    VIEW,
    advance_until,
    ask,
    frame,
    heard,
    phases,
    plain_socket,
    pose,
    raw,
    rest_of,
    serving,
    until,
    upgraded,
)  # fmt: skip

KINDS = Connection, Guard, Plain, Session, Socket, SSLProtocol


def kept() -> list[str]:
    """What is in memory of connections."""
    return sorted(type(entry).__name__ for entry in gc.get_objects() if type(entry) in KINDS)


@pytest.fixture
def uncollected() -> Iterator[None]:
    """Cycles stay. What was there before is set aside for good: to look through it each time takes most of a test."""
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


def leave(server: Server) -> None:
    """Stream, and say BYE."""
    with raw(server) as ws:
        heard(ws)
        ws.send(pose())
        heard(ws)
        ws.send(Bye().to_bytes())
        until(lambda: "streaming" not in phases(server))


def break_off(server: Server) -> None:
    """Stream, and reset the connection."""
    found = upgraded(server)
    found.sendall(frame(Hello(VIEW).to_bytes()) + frame(pose()))
    until(lambda: phases(server) == ["streaming"])
    found.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    found.close()


def say_nothing(server: Server) -> None:
    """Be a WebSocket without HELLO until the server has had enough."""
    with upgraded(server):
        advance_until(server, lambda: phases(server) == [])


def say_nonsense(server: Server) -> None:
    """Send frames that are none."""
    with upgraded(server) as found:
        found.sendall(b"\xff" * 100)
        rest_of(found)


def send_a_wrong_message(server: Server) -> None:
    """Send a message that is none."""
    with upgraded(server) as found:
        found.sendall(frame(b"nonsense"))
        advance_until(server, lambda: phases(server) == [])


def request(server: Server) -> None:
    """Ask for something plain."""
    assert ask(server, "/healthz")[0] == 200


def stay_idle(server: Server) -> None:
    """Ask once, and keep the connection until it is closed."""
    with plain_socket(server) as found:
        found.sendall(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n")
        until(lambda: phases(server) == ["idle"])
        advance_until(server, lambda: phases(server) == [])


@pytest.mark.usefixtures("uncollected")
@pytest.mark.parametrize(
    "visit", [leave, break_off, say_nothing, say_nonsense, send_a_wrong_message, request, stay_idle]
)
def test_a_connection_that_has_ended_is_not_kept(plain: Path, visit: Callable[[Server], None]) -> None:
    with serving(plain) as server:
        before = kept()
        visit(server)
        until(lambda: kept() == before)


@pytest.mark.usefixtures("uncollected")
@pytest.mark.parametrize("shakes_hands", [True, False])
def test_a_connection_with_tls_is_not_kept(plain: Path, tmp_path: Path, *, shakes_hands: bool) -> None:
    context = ssl.create_default_context()
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    with serving(plain, tls=certificate(tmp_path)) as server:
        before = kept()
        with socket.create_connection(("127.0.0.1", server.port), PATIENCE) as found:
            if shakes_hands:
                with context.wrap_socket(found) as inside:
                    inside.sendall(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
                    assert rest_of(inside).startswith(b"HTTP/1.1 200")
            else:
                found.sendall(b"GET / HTTP/1.1\r\n\r\n")
                rest_of(found)
        until(lambda: kept() == before)


def test_a_server_needs_no_torch() -> None:
    code = "import sys, gsvis.serve, gsvis.cli.serve; assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=PATIENCE)
