"""What no decent client does, while a decent one is served: it is sent away, the log says why, the other gets all."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import logging
import socket
import struct
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from websockets.exceptions import ConnectionClosed

from gsvis.errors import FormatError, ProtocolError
from gsvis.serve import ClientConfig, ManualClock, Server, StreamClient, open_scenes
from gsvis.stream import Ack, Hello, PoseAt, Session
from gsvis.stream.wire import FAULTS, ServerFault
from tests.serve.servers import (
    PATIENCE,
    VIEW,
    advance,
    advance_until,
    after_one_batch,
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
    slow_link,
    still,
    until,
    upgraded,
)  # fmt: skip

SLOW = ClientConfig(poses_per_s=2.0)  # no flood, however long a test takes
NAN = struct.pack("<B3xI3f4f", 2, 0, float("nan"), 0, 0, 1, 0, 0, 0)
NO_TURN = struct.pack("<B3xI3f4f", 2, 0, 0, 0, 0, 0, 0, 0, 0)


@contextmanager
def beside_a_decent_client(server: Server, package: Path) -> Iterator[None]:
    """Whatever happens meanwhile, this one gets everything, over one connection: half before, the rest after."""
    found: list[StreamClient] = []
    with slow_link(server.url, 300e3) as link:

        def moved(client: StreamClient) -> None:
            if not link.is_free:
                link.stall()

        thread = threading.Thread(
            target=lambda: found.append(patient(link.url, package, config=SLOW, moved=moved)[0]), daemon=True
        )
        thread.start()
        until(lambda: link.is_stalled)
        yield
        assert thread.is_alive()
        link.carry_freely()
        thread.join(PATIENCE)
    (client,) = found
    assert client.connections == 1
    assert has_all(client.receiver, package)


@contextmanager
def beside_one_that_has_all(server: Server, package: Path) -> Iterator[None]:
    """Time may pass: this one has acknowledged all, goes on to say where it is, and keeps its connection."""
    clients: list[StreamClient] = []
    loops: list[asyncio.AbstractEventLoop] = []

    async def stay() -> None:
        client = StreamClient(server.url, VIEW, SLOW, clock=ManualClock())
        loops.append(asyncio.get_running_loop())
        clients.append(client)
        await client.run(still)

    thread = threading.Thread(target=lambda: asyncio.run(stay()), daemon=True)
    thread.start()
    until(lambda: bool(clients) and has_all(clients[0].receiver, package))
    until(lambda: server.metrics.received.value("Ack") == server.metrics.sent.batches.value() + 1)  # and WELCOME
    before = server.metrics.received.value("PoseAt")
    yield
    until(lambda: server.metrics.received.value("PoseAt") > before)
    assert clients[0].connections == 1
    loops[0].call_soon_threadsafe(clients[0].stop)
    thread.join(PATIENCE)
    until(lambda: server.metrics.closed.value("left") == 1)


def fault_of(ws: object) -> ServerFault:
    """The last words of the server."""
    fault = None
    with contextlib.suppress(ConnectionClosed):
        while True:
            data = ws.recv(timeout=PATIENCE)  # type: ignore[attr-defined]
            if data[0] == 131:
                fault = ServerFault.parse(data)
    assert fault is not None
    return fault


@pytest.mark.parametrize(
    ("said", "reason", "line"),
    [
        (b"\x99garbage", "malformed", "expected one of HELLO"),
        (b"", "malformed", "nothing"),
        (bytes(range(64)), "malformed", "expected one of HELLO"),
        (NAN, "malformed", "finite"),
        (NO_TURN, "malformed", "rotation"),
        (pose() + b"!", "malformed", "POSE"),
        (Hello(VIEW).to_bytes(), "malformed", "HELLO"),
        (Ack(7).to_bytes(), "malformed", "sequence"),
        (Ack(0xFFFFFFFF).to_bytes(), "malformed", "sequence"),
        ("text", "malformed", "expected bytes"),
    ],
)
def test_garbage(
    plain: Path, caplog: pytest.LogCaptureFixture, said: bytes | str, reason: str, line: str
) -> None:  # fmt: skip
    with caplog.at_level(logging.INFO, "gsvis.serve"), serving(plain) as server:
        with raw(server) as ws:
            heard(ws)
            ws.send(pose())
            ws.send(said)
            fault = fault_of(ws)
        assert (fault.code, line in fault.line) == (FAULTS[reason], True), fault
        until(lambda: server.metrics.closed.value(reason) == 1)
        until(lambda: server.metrics.clients.value() == 0)  # the seat goes after the last words
        assert any("refused" in record.getMessage() and reason in record.getMessage() for record in caplog.records)
        assert after_one_batch(server.url).connections == 1


@pytest.mark.parametrize(
    ("first", "reason"),
    [
        (b"\x01", "version"),
        (b"\x01\x07" + bytes(200), "version"),
        (Hello(VIEW).to_bytes()[:-1], "malformed"),
        (Hello(VIEW, bytes(32), b"nonsense").to_bytes()[:-1], "malformed"),
        (pose(), "malformed"),
    ],
)
def test_a_first_message_that_is_no_hello(plain: Path, first: bytes, reason: str) -> None:
    with serving(plain) as server:
        with raw(server, first) as ws:
            assert fault_of(ws).code == FAULTS[reason]
        until(lambda: server.metrics.refused.value(reason) == 1)


def test_holdings_that_cannot_be(plain: Path) -> None:
    with serving(plain) as server:
        client = after_one_batch(server.url)
        identity = bytes.fromhex(client.receiver.about.identity)
        with raw(server, Hello(VIEW, identity, b"GVH1 and nonsense").to_bytes()) as ws:
            assert "HELLO" in fault_of(ws).line
        until(lambda: server.metrics.refused.value("malformed") == 1)


def test_a_huge_frame_is_refused_before_it_is_held(plain: Path) -> None:
    with serving(plain) as server, beside_a_decent_client(server, plain):
        for claimed in (1 << 40, 1 << 62, 1 << 26):
            with upgraded(server) as ws:
                ws.sendall(frame(b"x" * 1000, claimed=claimed))
                rest_of(ws)
        with upgraded(server) as ws:  # the same in pieces
            with contextlib.suppress(OSError):
                ws.sendall(frame(b"x" * 60_000, fin=False))
                for _ in range(100):
                    ws.sendall(frame(b"x" * 60_000, 0, fin=False))
            rest_of(ws)
        until(lambda: server.metrics.clients.value() <= 1)


def test_a_message_in_too_many_pieces(plain: Path) -> None:
    with serving(plain) as server, upgraded(server) as ws:
        with contextlib.suppress(OSError):
            ws.sendall(frame(b"", fin=False))
            for _ in range(50):
                ws.sendall(frame(b"", 0, fin=False) * 100)
        rest_of(ws)


def test_pings_that_nobody_reads_the_answers_of(plain: Path) -> None:
    with serving(plain, limits=limits_of()) as server, upgraded(server) as ws:
        many = frame(b"x" * 120, 9) * 200
        with pytest.raises(OSError, match=r"reset|[Bb]roken|timed out") as cut:
            for _ in range(4000):  # 100 MB of pings
                ws.sendall(many)
        assert not isinstance(cut.value, TimeoutError)


def test_a_pose_far_outside_is_served_as_from_the_nearest_cell(celled: Path) -> None:
    with serving(celled) as server, raw(server) as ws:

        def is_planned() -> bool:  # what comes is acknowledged, so that there is room for the next
            with contextlib.suppress(TimeoutError):
                while True:
                    data = ws.recv(timeout=0.02)
                    seen.append(data[0])
                    ws.send(Ack(max(seen.count(130), 0)).to_bytes())
            return server.metrics.planning.count > before

        seen: list[int] = []
        for k, far in enumerate((1e4, -1e20, 3e38)):
            before = server.metrics.planning.count
            ws.send(PoseAt(50 * k, (far, -far, far), (1e5, 0, 0, 1e5)).to_bytes())
            until(is_planned)
        before = server.metrics.planning.count
        ws.send(PoseAt(500, (0, 0, 0), (1, 0, 0, 0)).to_bytes())
        until(lambda: is_planned() and 130 in seen)
        assert server.metrics.clients.value() == 1


def test_a_flood_is_cut_and_the_others_are_served(plain: Path) -> None:
    with (
        serving(plain, limits=limits_of(messages_per_s=500.0, burst_s=4.0)) as server,
        beside_a_decent_client(server, plain),
    ):
        with raw(server) as ws:
            with contextlib.suppress(ConnectionClosed):
                for k in range(5000):
                    ws.send(pose(ms=k))
            with contextlib.suppress(AssertionError):  # its last words may drown
                assert fault_of(ws).code == FAULTS["flood"]
        until(lambda: server.metrics.closed.value("flood") == 1)


def test_more_poses_than_are_looked_at_are_passed_over(plain: Path) -> None:
    with serving(plain, limits=limits_of(poses_per_s=10.0)) as server, raw(server) as ws:
        for k in range(60):
            ws.send(pose(ms=k))
        until(lambda: server.metrics.received.value("PoseAt") == 60)
        until(lambda: server.metrics.skipped.value() == 50)  # no time has passed: a second's worth is looked at
        assert server.metrics.clients.value() == 1
        advance(server, 1.0)
        for k in range(12):
            ws.send(pose(ms=60 + k))
        until(lambda: server.metrics.skipped.value() == 52)


def test_one_that_never_reads_is_cut(plain: Path) -> None:
    limits = limits_of(stall_s=30.0, idle_s=60.0)
    with serving(plain, limits=limits) as server, beside_one_that_has_all(server, plain), raw(server) as ws:
        batches = server.metrics.sent.batches.value()
        ws.send(pose())  # and not one acknowledgement
        until(lambda: server.metrics.sent.batches.value() > batches)
        advance(server, 30.0)
        until(lambda: server.metrics.closed.value("late") == 1)
        until(lambda: server.metrics.clients.value() == 1)  # the seat goes after the last words


def test_one_that_asks_for_files_and_never_reads_is_cut(plain: Path) -> None:
    part = max((plain / "parts").iterdir(), key=lambda path: path.stat().st_size)
    asked = f"GET /packages/plain/parts/{part.name} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode()
    with serving(plain, limits=limits_of(idle_s=1e6)) as server, beside_one_that_has_all(server, plain):
        with socket.socket() as found:
            found.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            found.connect(("127.0.0.1", server.port))
            found.sendall(asked * 200)
            until(lambda: any(guard.is_full for guard in list(server._server._door.guards)))
            advance_until(server, lambda: _is_reset(found), 10.0)
        assert server.metrics.parts.value("200") < 200
        assert server.metrics.cut.value("does not read") == 1


def _is_reset(one: socket.socket) -> bool:
    return one.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR) != 0


def test_one_that_says_nothing_is_cut(plain: Path) -> None:
    with serving(plain) as server:
        with plain_socket(server) as silent, plain_socket(server) as slow:
            slow.sendall(b"GET / HTTP/1.1\r\nHo")  # and never the rest
            until(lambda: phases(server) == ["asking", "asking"])
            advance_until(server, lambda: phases(server) == [])
            assert rest_of(silent) == rest_of(slow) == b""
            assert server.metrics.cut.value("no request in time") == 2
        with raw(server, b"") as ws:
            advance_until(server, lambda: server.metrics.refused.value("late") == 1)
            assert fault_of(ws).code == FAULTS["late"]
        with raw(server) as ws:
            heard(ws)
            advance_until(server, lambda: server.metrics.closed.value("late") == 1)
            assert fault_of(ws).code == FAULTS["late"]


def test_one_that_goes_in_mid_batch(plain: Path) -> None:
    with serving(plain) as server, beside_a_decent_client(server, plain):
        for _ in range(5):
            with upgraded(server) as ws:
                ws.sendall(frame(Hello(VIEW).to_bytes()) + frame(pose()))
                ws.recv(500)
                ws.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # a reset, no farewell
        until(lambda: server.metrics.clients.value() <= 1)
        assert server.metrics.closed.value("internal") == 0


def test_no_more_clients_than_the_limit(plain: Path) -> None:
    with serving(plain, limits=limits_of(connections=2)) as server:
        with raw(server) as first, raw(server) as second:
            assert heard(first)[0] == heard(second)[0] == 129
            with raw(server, b"") as third:
                assert fault_of(third).code == FAULTS["too-many"]
        until(lambda: server.metrics.clients.value() == 0)
        with raw(server) as fourth:
            assert heard(fourth)[0] == 129
        crowd = [plain_socket(server) for _ in range(12)]  # and of those that do not even ask
        until(lambda: any(_is_over(one) for one in crowd))
        for one in crowd:
            one.close()


def _is_over(one: socket.socket) -> bool:
    one.setblocking(False)
    try:
        return one.recv(1) == b""
    except BlockingIOError:
        return False
    except ConnectionError:
        return True


def test_a_scene_found_damaged_while_it_is_served_is_refused(
    plain: Path, celled: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:  # fmt: skip
    with serving(plain, celled) as server, beside_a_decent_client(server, plain):

        def damaged(self: object, *_: object) -> None:
            raise FormatError("sets.pvs", "cell 3", "a set that fits its hash", "another")

        monkeypatch.setattr("gsvis.pvs.store.VisibilityStore.classes", damaged)
        with raw(server, name="/celled") as ws:
            heard(ws)
            ws.send(pose())
            fault = fault_of(ws)
        assert "damaged" in fault.line
        assert "sets.pvs" not in fault.line
        with raw(server, b"", name="/celled") as ws:
            assert fault_of(ws).code == FAULTS["refused"]
        with pytest.raises(ProtocolError, match="damaged"):
            after_one_batch(server.url + "/celled")
        assert server.metrics.scenes.faults.value("celled") == 1
        assert any("sets.pvs: cell 3" in record.getMessage() for record in caplog.records)


def test_a_fault_of_the_server_appears_only_in_the_log(
    plain: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:  # fmt: skip
    def broken(*_: object) -> None:
        raise ZeroDivisionError("the inside of it")

    with serving(plain) as server:
        with monkeypatch.context() as patch:
            patch.setattr("gsvis.stream.session.Session.on_pose", broken)
            with raw(server) as ws:
                heard(ws)
                ws.send(pose())
                fault = fault_of(ws)
        assert (fault.code, "inside" in fault.line) == (FAULTS["internal"], False)
        assert any("ZeroDivisionError: the inside of it" in record.getMessage() for record in caplog.records)
        assert after_one_batch(server.url).connections == 1


def test_memory_does_not_grow_with_clients_that_come_and_go(plain: Path) -> None:
    with serving(plain) as server:
        for _ in range(10):
            with raw(server) as ws:
                heard(ws)
                ws.send(pose())
                heard(ws)
        until(lambda: server.metrics.clients.value() == 0)
        until(lambda: gc.collect() >= 0 and sum(type(thing) is Session for thing in gc.get_objects()) <= 1)


def test_a_scene_that_cannot_be_made_ready_is_refused_at_once(
    plain: Path, celled: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def damaged(self: object, *_: object) -> None:
        raise FormatError("sets.pvs", "cell 3", "a set that fits its hash", "another")

    with open_scenes([celled], warm=True) as scenes:
        (served,) = scenes.values()
        assert served.scene.candidates.cache.nbytes > 0
    monkeypatch.setattr("gsvis.pvs.store.VisibilityStore.classes", damaged)
    with open_scenes([plain, celled], warm=True) as scenes:
        assert [served.fault != "" for served in scenes.values()] == [False, True]
