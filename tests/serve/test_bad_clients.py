"""Crowds that take connections and give nothing, over real sockets: they give way, honest viewers notice nothing."""

from __future__ import annotations

import contextlib
import errno
import logging
import socket
import ssl
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
from websockets.exceptions import ConnectionClosed

from gsvis.serve import Server
from gsvis.serve._door import Door
from gsvis.serve._head import Head
from gsvis.stream import Hello
from gsvis.stream.wire import FAULTS, ServerFault
from tests.serve.certificates import certificate
from tests.serve.servers import (
    PATIENCE,
    VIEW,
    advance,
    advance_until,
    ask,
    frame,
    has_all,
    heard,
    limits_of,
    patient,
    phases,
    plain_socket,
    pose,
    raw,
    rest_of,
    serving,
    until,
    upgraded,
)  # fmt: skip

HEALTH = b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n"
UPGRADE = (
    b"GET /stream HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n"
)


def get(found: socket.socket, request: bytes = HEALTH) -> bytes:
    """The answer to a request on a connection that is kept; its body ends with a brace."""
    found.settimeout(PATIENCE)
    found.sendall(request)
    answer = b""
    while not answer.endswith(b"}"):
        piece = found.recv(1 << 16)
        assert piece, answer
        answer += piece
    return answer


def answered(server: Server, source: str = "127.0.0.1") -> socket.socket:
    """A connection that has had one answer."""
    found = socket.create_connection(("127.0.0.1", server.port), PATIENCE, source_address=(source, 0))
    assert get(found).startswith(b"HTTP/1.1 200")
    return found


@contextmanager
def crowd(count: int, one: Callable[[int], socket.socket]) -> Iterator[list[socket.socket]]:
    with ExitStack() as stack:
        yield [stack.enter_context(one(k)) for k in range(count)]


def is_over(one: socket.socket) -> bool:
    one.setblocking(False)
    try:
        return one.recv(1) == b""
    except BlockingIOError:
        return False
    except ConnectionError:
        return True


@contextmanager
def streaming(server: Server) -> Iterator[None]:
    """A viewer that streams before, and is connected afterward."""
    with raw(server) as ws:
        heard(ws)
        ws.send(pose())
        assert heard(ws)[0] == 130
        yield
        pongs = ws.ping()
        assert pongs.wait(PATIENCE)
        until(lambda: server.metrics.clients.value() == 1)  # another may still be leaving


def test_one_byte_of_the_next_request_does_not_keep_a_connection(plain: Path) -> None:
    with serving(plain, limits=limits_of(connections=40, per_address=40)) as server:

        def one(_: int) -> socket.socket:
            found = answered(server)
            found.sendall(b"G")
            return found

        with crowd(20, one) as many:
            until(lambda: phases(server) == ["idle"] * 20)
            advance(server, 14.9)
            for found in many:
                found.sendall(b"E")  # a byte now and then does not help
            assert ask(server, "/healthz")[0] == 200
            until(lambda: phases(server) == ["idle"] * 20)
            advance(server, 0.2)
            until(lambda: phases(server) == [])
            assert all(is_over(found) for found in many)


def test_an_idle_connection_is_closed_and_one_that_asks_again_is_answered(plain: Path) -> None:
    with serving(plain) as server, answered(server) as found:
        for _ in range(3):
            advance(server, 14.0)
            assert get(found).startswith(b"HTTP/1.1 200")
            until(lambda: phases(server) == ["idle"])
        advance_until(server, lambda: phases(server) == [])
        assert found.recv(1) == b""  # closed, not cut


def test_requests_that_come_together_are_answered_in_turn(plain: Path) -> None:
    with serving(plain) as server, plain_socket(server) as found:
        last = HEALTH.replace(b"\r\n\r\n", b"\r\nConnection: close\r\n\r\n")
        found.sendall(HEALTH * 200 + last)
        assert rest_of(found).count(b"HTTP/1.1 200") == 201


@pytest.mark.parametrize("kind", ["silent", "half a request", "idle", "a byte more", "before HELLO"])
def test_a_crowd_of_one_address_does_not_shut_others_out(plain: Path, kind: str) -> None:
    limits = limits_of(connections=20, per_address=30, waiting=20)
    with serving(plain, limits=limits) as server, streaming(server):

        def one(_: int) -> socket.socket:
            if kind == "before HELLO":
                return upgraded(server)
            if kind in ("idle", "a byte more"):
                found = answered(server)
                found.sendall(b"G" * (kind == "a byte more"))
                return found
            found = plain_socket(server)
            found.sendall(b"GET / HTTP/1.1\r\nHo" * (kind == "half a request"))
            return found

        with crowd(60, one):
            until(lambda: len(phases(server)) <= 21)
            assert ask(server, "/healthz")[0] == 200
            with patience_of_another(server, "127.0.0.9") as ws:  # a viewer that comes from elsewhere
                assert ws.recv(1)
            assert has_all(patient(server.url, plain)[0].receiver, plain)


@contextmanager
def patience_of_another(server: Server, source: str) -> Iterator[socket.socket]:
    """A viewer of another address, after its WELCOME has begun to come."""
    with socket.create_connection(("127.0.0.1", server.port), PATIENCE, source_address=(source, 0)) as found:
        found.sendall(UPGRADE + b"\r\n" + frame(Hello(VIEW).to_bytes()))
        answer = b""
        while b"\r\n\r\n" not in answer:
            answer += found.recv(1)
        assert b" 101 " in answer
        yield found


def test_an_address_has_a_share_and_who_asks_from_elsewhere_is_kept(plain: Path) -> None:
    limits = limits_of(connections=40, waiting=12, per_address=8)
    with (
        serving(plain, limits=limits) as server,
        answered(server, source="127.0.0.7") as honest,
        crowd(30, lambda _: plain_socket(server)),
    ):
        until(lambda: len(phases(server)) == 9)  # 8 of the crowd
        with crowd(30, lambda _: answered(server, source="127.0.0.2")):
            until(lambda: len(phases(server)) == 12)
            assert get(honest).startswith(b"HTTP/1.1 200")


def test_an_address_has_so_many_streams(plain: Path) -> None:
    with serving(plain, limits=limits_of(connections=5, per_address=2)) as server, ExitStack() as stack:
        for _ in range(2):
            assert heard(stack.enter_context(raw(server)))[0] == 129
        with raw(server, b"") as third:
            fault = ServerFault.parse(heard(third))
            assert fault.code == FAULTS["too-many"]
        with patience_of_another(server, "127.0.0.9") as other:
            assert other.recv(1)
            until(lambda: server.metrics.clients.value() == 3)
        assert server.metrics.refused.value("address-full") == 1


def test_a_class_behind_one_address_comes_back_after_an_outage(plain: Path) -> None:
    with serving(plain, limits=limits_of(connections=8)) as server, ExitStack() as stack:
        dead = [stack.enter_context(raw(server)) for _ in range(8)]
        for ws in dead:
            assert heard(ws)[0] == 129
        with raw(server, b"") as early:
            assert ServerFault.parse(heard(early)).code == FAULTS["too-many"]
        advance(server, 5.1)
        place, source = ("127.0.0.1", server.port), ("127.0.0.9", 0)
        with socket.create_connection(place, PATIENCE, source_address=source) as stranger:  # who takes nobody's seat
            stranger.sendall(UPGRADE + b"\r\n" + frame(Hello(VIEW).to_bytes()))
            until(lambda: server.metrics.refused.value("too-many") == 2)
        dead[0].send(pose())  # lives
        until(lambda: server.metrics.received.value("PoseAt") == 1)
        for _ in range(7):
            assert heard(stack.enter_context(raw(server)))[0] == 129
        until(lambda: server.metrics.clients.value() == 8)
        with raw(server, b"") as one_more:
            assert ServerFault.parse(heard(one_more)).code == FAULTS["too-many"]
        assert dead[0].ping().wait(PATIENCE)
        for ws in dead[1:]:
            assert ServerFault.parse(heard(ws)).code == FAULTS["late"]


def test_connections_without_hello_take_no_seat(plain: Path) -> None:
    with serving(plain, limits=limits_of(connections=3, per_address=30, waiting=30)) as server, ExitStack() as stack:
        for _ in range(20):
            stack.enter_context(upgraded(server))
        until(lambda: phases(server) == ["greeting"] * 20)
        assert server.metrics.clients.value() == 0
        assert has_all(patient(server.url, plain)[0].receiver, plain)


def test_what_trusted_proxies_say_is_the_address_and_what_others_say_is_not(plain: Path) -> None:
    limits = limits_of(connections=5, per_address=1)

    def fault(server: Server, message: str) -> int:
        with plain_socket(server) as found:
            found.sendall(UPGRADE + f"X-Forwarded-For: {message}\r\n\r\n".encode())
            head = b""
            while b"\r\n\r\n" not in head:
                head += found.recv(1)
            data = found.recv(3)
            return data[2] if len(data) == 3 else 0

    with serving(plain, limits=limits, proxies=("127.0.0.1",)) as server, patience_of_another(server, "127.0.0.1"):
        until(lambda: server.metrics.clients.value() == 1)
        with plain_socket(server) as found:
            found.sendall(UPGRADE + b"X-Forwarded-For: 9.9.9.9, 10.0.0.1\r\n\r\n")
            until(lambda: "greeting" in phases(server))
            assert server.metrics.refused.value("address-full") == 0
        assert fault(server, "nonsense") == 131  # an ERROR: still the address of the proxy
    with serving(plain, limits=limits) as server, patience_of_another(server, "127.0.0.1"):
        until(lambda: server.metrics.clients.value() == 1)
        assert fault(server, "10.0.0.1") == 131


STRANGE = {
    "a control character": (b"X-A: a\x01b\r\n", b" 400 "),
    "a header of 20 kB": (b"X-A: " + b"a" * 20_000 + b"\r\n", b" 431 "),
    "a header of 40 kB": (b"X-A: " + b"a" * 40_000 + b"\r\n", b" 431 "),
    "130 headers": (b"".join(b"X-%d: a\r\n" % k for k in range(130)), b" 431 "),
    "a folded header": (b"X-A: a\r\n b\r\n", b" 400 "),
    "a bare line feed": (b"X-A: a\nX-B: b\r\n", b" 400 "),
    "a length and a coding": (b"Content-Length: 3\r\nTransfer-Encoding: chunked\r\n", b" 400 "),
    "two hosts": (b"Host: evil.example\r\n", b" 400 "),
    "a body": (b"Content-Length: 1000000\r\n", b" 413 "),
    "a body in chunks": (b"Transfer-Encoding: chunked\r\n", b" 413 "),
}


@pytest.mark.parametrize("start", [UPGRADE, HEALTH[:-2]], ids=["upgrade", "plain"])
@pytest.mark.parametrize("name", STRANGE)
def test_strange_requests_are_answered_and_closed(plain: Path, start: bytes, name: str) -> None:
    header, status = STRANGE[name]
    with serving(plain) as server, plain_socket(server) as found:
        found.sendall(start + header + b"\r\n")
        answer = rest_of(found)
        assert status in answer.split(b"\r\n")[0]
        assert b"connection: close" in answer
        found.close()
        until(lambda: phases(server) == [])
        assert server.metrics.refused.value(status.strip().decode()) == 1


@pytest.mark.parametrize("name", STRANGE)
def test_with_strange_requests_standing_a_server_ends_well(plain: Path, name: str) -> None:
    codes: list[int] = []
    with ExitStack() as stack:
        server = stack.enter_context(serving(plain))
        viewers = [stack.enter_context(raw(server)) for _ in range(5)]
        for ws in viewers:
            heard(ws)
        standing = stack.enter_context(plain_socket(server))
        standing.sendall(UPGRADE + STRANGE[name][0] + b"\r\n")
        until(lambda: "ending" in phases(server))
        server.stop()
        for ws in viewers:
            with contextlib.suppress(ConnectionClosed):
                while True:
                    ws.recv(timeout=PATIENCE)
            assert ws.protocol.close_rcvd is not None
            codes.append(ws.protocol.close_rcvd.code)
    assert codes == [1012] * 5


def test_a_parser_that_refuses_what_the_guard_let_through_still_answers(
    plain: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gsvis.serve._head.check_head", lambda head: Head("GET", "/stream", []))
    with serving(plain) as server:
        for name in ("a header of 20 kB", "130 headers"):
            with plain_socket(server) as found:
                found.sendall(UPGRADE + STRANGE[name][0] + b"\r\n")
                assert rest_of(found).startswith(b"HTTP/1.1 4")
        until(lambda: phases(server) == [])


@pytest.mark.parametrize(
    ("host", "status"),
    [
        ("evil.example", 421), ("evil.example:80", 421), ("127.0.0.1.evil.example", 421), ("", 421),
        ("a@localhost", 421),
        ("localhost", 200), ("LOCALHOST:8765", 200), ("127.0.0.1", 200), ("[::1]:80", 200), ("me.example", 200),
        ("ME.example.:443", 200), ("a.b.example", 200), ("b.example", 421), ("xme.example", 421),
    ],
)  # fmt: skip
def test_a_name_that_is_not_the_servers_is_refused(plain: Path, host: str, status: int) -> None:
    with serving(plain, hosts=("me.example", ".b.example")) as server:
        assert ask(server, "/", Host=host)[0] == status
        assert ask(server, "/healthz", Host=host)[0] == 200
        with plain_socket(server) as found:
            upgrade = UPGRADE.replace(b"localhost", host.encode()) + f"Origin: http://{host}\r\n\r\n".encode()
            found.sendall(upgrade)
            found.settimeout(PATIENCE)
            assert found.recv(12) == (b"HTTP/1.1 421" if status == 421 else b"HTTP/1.1 101")
        assert server.metrics.refused.value("host") == (2 if status == 421 else 0)


def test_every_name_is_good_if_so_wished(plain: Path) -> None:
    with serving(plain, hosts=("*",)) as server:
        assert ask(server, "/", Host="evil.example")[0] == 200


def test_the_log_says_what_to_do_behind_a_proxy(plain: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO, "gsvis.serve"), serving(plain) as server, plain_socket(server) as found:
        found.sendall(UPGRADE + b"Origin: https://public.example\r\n\r\n")
        found.settimeout(PATIENCE)
        answer = b""
        while b"may not stream from here" not in answer:
            answer += found.recv(1 << 16)
        assert answer.startswith(b"HTTP/1.1 101")
        assert ask(server, "/", Host="public.example")[0] == 421
    said = [record.getMessage() for record in caplog.records]
    assert any("reason=origin" in line and "pass Host on" in line for line in said)
    assert any("reason=host" in line and "--hosts" in line for line in said)


@pytest.fixture(scope="module")
def secured(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    return certificate(tmp_path_factory.mktemp("tls"))


def test_connections_without_a_handshake_are_counted_and_cut(plain: Path, secured: tuple[Path, Path]) -> None:
    with serving(plain, tls=secured, limits=limits_of(waiting=20, per_address=15)) as server:
        trusting = ssl.create_default_context(cafile=str(secured[0]))
        with crowd(60, lambda _: plain_socket(server)) as many:
            until(lambda: sum(map(is_over, many)) >= 45)
            until(lambda: len(phases(server)) <= 15)
            with plain_socket(server) as found, trusting.wrap_socket(found, server_hostname="127.0.0.1") as safe:
                assert get(safe).startswith(b"HTTP/1.1 200")
            assert sum(map(is_over, many)) < 60
            advance_until(server, lambda: phases(server) == [])
            until(lambda: all(map(is_over, many)))


def test_nonsense_instead_of_a_handshake_is_cut(plain: Path, secured: tuple[Path, Path]) -> None:
    with serving(plain, tls=secured) as server:
        for nonsense in (b"GET / HTTP/1.1\r\n\r\n", bytes(200), b"\x16\x03\x01\xff\xff" + b"x" * 500):
            with plain_socket(server) as found:
                found.sendall(nonsense)
                found.shutdown(socket.SHUT_WR)
                rest_of(found)
        until(lambda: phases(server) == [])


def test_without_descriptors_it_says_so_once_makes_room_and_goes_on(
    plain: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    left = [40]
    waiting: list[int] = []
    accept = Door._accept_one

    def failing(door: Door) -> object:
        if waiting and left[0] > 0:
            left[0] -= 1
            raise OSError(errno.EMFILE, "Too many open files")
        return accept(door)

    monkeypatch.setattr(Door, "_accept_one", failing)
    monkeypatch.setattr("gsvis.serve._door._LONGEST_PAUSE_S", 0.06)
    with caplog.at_level(logging.INFO), serving(plain) as server, crowd(3, lambda _: plain_socket(server)) as many:
        until(lambda: len(phases(server)) == 3)
        waiting.append(1)
        with plain_socket(server):  # wakes the wait for a connection
            until(lambda: left[0] == 0)
            until(lambda: any(map(is_over, many)))
        assert ask(server, "/healthz")[0] == 200
        assert server.metrics.accept_failures.value("EMFILE") == 40
        assert server.metrics.cut.value("gives way to others") >= 1
    said = [record.getMessage() for record in caplog.records if "accept-failed" in record.getMessage()]
    assert len(said) == 1
    assert "Too many open files" in said[0]
    assert not [record for record in caplog.records if record.name == "asyncio"]


def test_the_log_of_all_loggers_is_bounded(plain: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO), serving(plain, limits=limits_of(per_address=200)) as server:
        for _ in range(300):
            with plain_socket(server) as found:
                found.sendall(b"nonsense\r\n\r\n")
                rest_of(found)
        for name in ("asyncio", "uvicorn.error"):
            for _ in range(1000):
                logging.getLogger(name).warning("again and again")
        advance(server, 1.0)
        for name in ("asyncio", "uvicorn.error"):
            for _ in range(1000):
                logging.getLogger(name).warning("a second later")
    said = [record.getMessage() for record in caplog.records]
    assert sum(line.startswith("refused") for line in said) == 200  # the clock stands still: a burst, and no more
    assert sum(line == "again and again" for line in said) == 2 * 200
    assert sum(line == "a second later" for line in said) == 2 * 20


def test_an_end_waits_for_nobody_for_ever(plain: Path) -> None:
    with serving(plain) as server, raw(server) as ws:
        heard(ws)
        with plain_socket(server) as found:
            found.sendall(b"GET / HT")
            until(lambda: phases(server) == ["asking", "streaming"])
            server.stop()
            assert rest_of(found) == b""
        threads = [thread for thread in threading.enumerate() if thread.name == "gsvis-serve"]
    for thread in threads:
        thread.join(PATIENCE)
        assert not thread.is_alive()
