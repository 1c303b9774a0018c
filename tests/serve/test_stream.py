"""Over real sockets: all arrives, once, at as many clients as there are; what was held is not sent again."""

from __future__ import annotations

import asyncio
import logging
import socket
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from websockets.asyncio.server import ServerConnection
from websockets.asyncio.server import serve as websocket_server
from websockets.exceptions import ConnectionClosed
from websockets.protocol import State
from websockets.sync.client import connect
from websockets.typing import Origin

from gsvis.abr.holdings import Holdings
from gsvis.errors import ProtocolError
from gsvis.serve import Address, ClientConfig, ManualClock, Server, StreamClient, fetch, open_scenes
from gsvis.serve.limits import Pace
from gsvis.serve.mailbox import PoseClock
from gsvis.stream import Ack, Bye, Hello, Receiver, Session, StreamedScene, Token
from gsvis.stream.wire import ServerFault
from tests.serve.servers import (
    LIMITS,
    PATIENCE,
    VIEW,
    advance,
    advance_until,
    after_one_batch,
    ask,
    close_code,
    give_up,
    has_all,
    heard,
    is_due,
    limits_of,
    patient,
    phases,
    pose,
    raw,
    serving,
    slow_link,
    still,
    until,
)  # fmt: skip
from tests.stream.worlds import package_of


def test_all_arrives_and_nothing_twice(plain: Path) -> None:
    with serving(plain) as server:
        client, came = patient(server.url, plain)
        assert has_all(client.receiver, plain)
        assert len(came) == len(set(came))
        assert server.metrics.sent.gaussians.value() == len(came)
        assert server.metrics.sent.bytes.value() == client.nbytes
        gaussians, colors = client.receiver.scene()
        assert len(gaussians) == len(colors) == len(client.receiver.shown())
        until(lambda: server.metrics.closed.value("left") == 1)
        assert "gsvis_batches_total" in ask(server, "/metrics")[2].decode()


def test_planning_in_threads_brings_the_same(plain: Path) -> None:
    with open_scenes([plain]) as scenes, Server(scenes, None, Address(port=0), planners=2).running() as url:
        client, came = patient(url, plain)
        assert has_all(client.receiver, plain)
        assert len(came) == len(set(came))


def test_clients_do_not_disturb_each_other(plain: Path, celled: Path) -> None:
    async def all_of_them(url: str) -> list[StreamClient]:
        names = ["", "/plain", "/celled", "/celled"]
        clients = [StreamClient(url + name, VIEW, clock=ManualClock()) for name in names]

        def stops(client: StreamClient) -> Callable[[object], None]:
            return lambda _: client.stop() if len(client.receiver.shown()) else None

        runs = [client.run(still, on_batch=stops(client)) for client in clients]
        await asyncio.wait_for(asyncio.gather(*runs), PATIENCE)
        return clients

    with serving(plain, celled) as server:
        clients = asyncio.run(all_of_them(server.url))
        sizes = [client.receiver.about.gaussians for client in clients]
        assert sizes == [6000, 6000, 1500, 1500]
        assert all(len(client.receiver.shown()) for client in clients)
        assert server.metrics.opened.value("celled") == 2


def after_a_plan(server: Server, receiver: Receiver) -> StreamClient:
    """A client that comes back and leaves once the server has planned for it."""

    async def stream() -> StreamClient:
        client = StreamClient(server.url, VIEW, receiver=receiver, clock=ManualClock())
        before = server.metrics.planning.count
        running = asyncio.create_task(client.run(still))
        while server.metrics.planning.count == before:
            await asyncio.sleep(0.01)
        client.stop()
        await running
        return client

    return asyncio.run(asyncio.wait_for(stream(), PATIENCE))


def test_a_client_that_comes_back_is_sent_what_is_missing(plain: Path) -> None:
    with serving(plain) as server, slow_link(server.url, 60e3) as link:
        whole, _ = patient(server.url, plain)
        first = after_one_batch(link.url)
        held = set(first.receiver.holdings.received.tolist())
        assert held
        assert not has_all(first.receiver, plain)
        second, came = patient(server.url, plain, receiver=first.receiver)
        assert has_all(second.receiver, plain)
        assert not held & set(came)
        assert second.receiver is first.receiver
        assert after_a_plan(server, second.receiver).nbytes == 0
        assert whole.restarts == second.restarts == 0


def test_whatever_is_held_of_a_small_scene_its_client_may_come_back(tmp_path: Path) -> None:
    with package_of(tmp_path / "small.gsvis", 5000, stores=False) as package:
        header = StreamedScene.open(package).header
    known = Receiver(header).about
    held = Holdings(known.gaussians, known.terms)
    gaussians, terms = np.arange(held.gaussians), np.arange(held.terms)
    held.add(gaussians[gaussians % 3 > 0], terms[terms % 3 > 0], gaussians[:0])  # neither runs nor a few
    hello = Hello(VIEW, bytes.fromhex(known.identity), held.to_bytes())
    with serving(tmp_path / "small.gsvis") as server:
        answer, code = first_answer(server, hello.to_bytes())
    assert (answer[0], code) == (129, None), answer


def test_what_is_held_of_another_scene_is_worth_nothing(plain: Path, celled: Path) -> None:
    with serving(celled, plain) as server:
        other = after_one_batch(server.url)
        client, _ = patient(server.url + "/plain", plain, receiver=other.receiver)
        assert client.restarts == 1
        assert has_all(client.receiver, plain)


def test_a_token_opens_the_stream(plain: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.DEBUG), serving(plain, token="s3cret-word") as server:
        for wrong in (None, "s3cret"):
            with pytest.raises(ProtocolError, match="a token is needed"):
                after_one_batch(server.url, ClientConfig(token=wrong))
        right = after_one_batch(server.url, ClientConfig(token="s3cret-word"))
        in_query = after_one_batch(server.url + "?token=s3cret-word")
        assert right.connections == in_query.connections == 1
        said = [record for record in caplog.records if record.name.startswith(("gsvis", "uvicorn"))]
        assert not any("s3cret-word" in record.getMessage() for record in said)
        assert server.metrics.refused.value("token") == 2
    assert "s3cret-word" not in repr(server.config)


def first_answer(server: Server, *messages: bytes, name: str = "", **headers: str) -> tuple[bytes, int | None]:
    """The first message of the server, and how it closes where it is an ERROR."""
    with connect(server.url + name, additional_headers=headers, proxy=None, ping_interval=None) as ws:
        with suppress(ConnectionClosed):  # who is refused may be closed already
            for message in messages:
                ws.send(message)
        data = heard(ws)
        return data, close_code(ws) if data[0] == 131 else None


def test_a_page_shows_its_token_as_the_first_message(plain: Path, caplog: pytest.LogCaptureFixture) -> None:
    hello, right = Hello(VIEW).to_bytes(), Token("s3cret-word").to_bytes()
    refused = ServerFault(4, "a token is needed").to_bytes(), 1008
    with caplog.at_level(logging.DEBUG), serving(plain, token="s3cret-word") as server:
        assert first_answer(server, right, hello)[0][0] == 129
        assert first_answer(server, hello) == refused
        assert first_answer(server, Token("s3cret-wore").to_bytes(), hello) == refused
        assert first_answer(server, b"\x05\x00\x01", hello) == refused
        wrong = {"Authorization": "Bearer wrong"}
        assert first_answer(server, right, hello, **wrong) == refused  # what is shown first counts
        assert first_answer(server, hello, name="/none") == refused  # nothing is said of scenes without the token
        assert first_answer(server, right, hello, name="/none") == (ServerFault(4, "no such scene").to_bytes(), 1008)
        assert server.metrics.refused.value("token") == 5
    said = [record.getMessage() for record in caplog.records if record.name.startswith(("gsvis", "uvicorn"))]
    assert not any("s3cret" in line for line in said)
    assert "s3cret" not in repr(Token("s3cret-word"))


def test_a_token_that_nobody_needs_is_ignored_once(plain: Path) -> None:
    hello, token = Hello(VIEW).to_bytes(), Token("whatever").to_bytes()
    with serving(plain) as server:
        assert first_answer(server, token, hello)[0][0] == 129
        for messages in ((token, token, hello), (token, pose())):
            data, code = first_answer(server, *messages)
            assert (ServerFault.parse(data).code, code) == (1, 1008)
        with raw(server) as ws:
            assert heard(ws)[0] == 129
            ws.send(token)
            assert b"TOKEN: expected it at the start" in heard(ws)
            assert close_code(ws) == 1008


def test_a_client_that_shows_no_token_in_time_is_turned_away(plain: Path) -> None:
    with serving(plain, token="s3cret-word") as server, connect(server.url, proxy=None, ping_interval=None) as ws:
        until(lambda: phases(server) == ["greeting"])
        until(lambda: is_due(server, LIMITS.handshake_s))
        advance(server, LIMITS.handshake_s + 1.0)
        assert ServerFault.parse(heard(ws)).code == 4
        assert close_code(ws) == 1008


def test_bye_ends_with_the_code_for_it(plain: Path) -> None:
    with serving(plain) as server:
        with raw(server) as ws:
            assert heard(ws)[0] == 129
            ws.send(Ack(0).to_bytes())
            ws.send(Bye().to_bytes())
            assert close_code(ws) == 1000
        until(lambda: server.metrics.closed.value("left") == 1)


def test_pages_of_other_origins_are_turned_away(plain: Path) -> None:
    upgrade = {"Upgrade": "websocket", "Sec-WebSocket-Key": "A" * 22 + "==", "Sec-WebSocket-Version": "13"}
    with serving(plain, origins=("https://friend.example",)) as server:

        def answer(origin: str) -> int:
            """Kind of the first message; a page reads no other answer."""
            with connect(server.url, origin=Origin(origin), proxy=None) as ws:
                with suppress(ConnectionClosed):  # who is refused may be closed already
                    ws.send(Hello(VIEW).to_bytes())
                data = heard(ws)
                if data[0] == 131:
                    assert ServerFault.parse(data) == ServerFault(4, "pages of this origin may not stream from here")
                    assert close_code(ws) == 1008
                return data[0]

        assert answer("https://evil.example") == 131
        assert answer("null") == 131
        assert answer("https://friend.example") == 129
        assert answer(f"http://127.0.0.1:{server.port}") == 129
        assert server.metrics.refused.value("origin") == 2
        assert ask(server, "/nothing", **upgrade)[0] in (403, 404)


def test_a_scene_that_is_not_there(plain: Path) -> None:
    with serving(plain) as server, pytest.raises(ProtocolError, match="no such scene"):
        fetch(server.url + "/other", VIEW, still, PATIENCE)


def test_no_server_for_too_long_is_an_error() -> None:
    with socket.socket() as taken:  # bound, but nobody listens
        taken.bind(("127.0.0.1", 0))
        url = f"ws://127.0.0.1:{taken.getsockname()[1]}/stream"
        with pytest.raises(ConnectionError, match="no stream for"):
            give_up(url)


def test_an_address_that_is_taken_is_an_error(plain: Path) -> None:
    with open_scenes([plain]) as scenes, socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(OSError, match=f"127.0.0.1:{port}"):
            Server(scenes, address=Address(port=port))
    assert Address().host == "127.0.0.1"


def test_what_is_under_way_never_exceeds_the_window(plain: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rooms: list[float] = []
    room = Session.room

    def noted(self: Session, *arguments: float) -> float:
        rooms.append(room(self, *arguments))
        return rooms[-1]

    monkeypatch.setattr(Session, "room", noted)
    monkeypatch.setattr(Pace, "observe", lambda self, late: None)  # a late server may have two longer messages
    with serving(plain) as server, raw(server) as ws:
        heard(ws)
        ws.send(pose())
        until(lambda: bool(rooms) and rooms[-1] == 0.0)  # nothing is acknowledged, so nothing else may go
        assert 0 < server.metrics.sent.bytes.value() <= 0.3 * 250e3 * 1.05


def test_a_link_that_stalls_for_less_than_the_limit_loses_nothing(plain: Path) -> None:
    with serving(plain, limits=limits_of(stall_s=30.0)) as server, slow_link(server.url, 200e3) as link:
        stalled = []

        def moved(client: StreamClient) -> None:
            if not stalled and client.nbytes > 10_000:
                stalled.append(client.nbytes)
                link.stall()
                advance(server, 29.9)
                link.go_on()

        client, came = patient(link.url, plain, moved=moved)
        assert stalled
        assert client.connections == 1
        assert has_all(client.receiver, plain)
        assert len(came) == len(set(came))


def test_a_client_that_is_cut_off_comes_back_by_itself(plain: Path) -> None:
    with serving(plain, limits=LIMITS) as server, slow_link(server.url, 200e3) as link:
        cuts: list[threading.Thread] = []

        def hold() -> None:  # beyond what the server waits for
            closed = server.metrics.closed
            advance_until(server, lambda: closed.value("late") + closed.value("lost") >= 1)
            link.go_on()

        def moved(client: StreamClient) -> None:
            if not cuts and client.nbytes > 10_000:
                link.stall()
                cuts.append(threading.Thread(target=hold, daemon=True))
                cuts[0].start()

        client, came = patient(link.url, plain, moved=moved, config=ClientConfig(first_wait_s=0.05))
        assert client.connections >= 2
        assert has_all(client.receiver, plain)
        assert len(came) == len(set(came))


def test_poses_that_arrive_at_once_keep_their_times() -> None:
    clock = PoseClock()
    made = np.arange(0.0, 3.0, 0.1)
    arrived = np.where(made < 1.0, made, np.maximum(made, 2.5)) + 100.02  # held up from 1.0 to 2.5
    times = np.array([clock.at(a, round(1e3 * float(m))) for a, m in zip(arrived, made, strict=True)])
    np.testing.assert_allclose(times, made + 100.02, atol=5e-3)
    assert (times <= arrived + 1e-9).all()


def test_the_clock_of_a_client_may_turn_over() -> None:
    clock = PoseClock()
    start = (1 << 32) - 500
    times = [clock.at(50.0 + k / 10, (start + 100 * k) % (1 << 32)) for k in range(20)]
    np.testing.assert_allclose(np.diff(times), 0.1, atol=1e-3)


def test_a_server_that_says_nothing_is_left(plain: Path) -> None:
    async def both() -> None:
        clock, again = ManualClock(), asyncio.Event()

        async def silent(ws: ServerConnection) -> None:
            await ws.recv()  # HELLO
            while ws.state is State.OPEN and not again.is_set():
                clock.advance(1.0)
                await asyncio.sleep(0.01)
            again.set()

        async with websocket_server(silent, "127.0.0.1", 0) as server:
            port = next(iter(server.sockets)).getsockname()[1]
            client = StreamClient(f"ws://127.0.0.1:{port}", VIEW, ClientConfig(give_up_s=1e9), clock=clock)
            running = asyncio.create_task(client.run(still))
            await asyncio.wait({running, asyncio.create_task(again.wait())}, return_when=asyncio.FIRST_COMPLETED)
            assert not running.done()
            client.stop()
            await running

    asyncio.run(asyncio.wait_for(both(), PATIENCE))


def test_a_client_waits_for_a_seat_for_longer_than_dead_seats_are_kept(plain: Path) -> None:
    limits = limits_of(connections=1)

    async def wait_for_it(server: Server, leave: Callable[[], object]) -> None:
        async def refused(count: int) -> None:
            while server.metrics.refused.value("too-many") < count and not running.done():
                await asyncio.sleep(0.01)

        clock = ManualClock()
        client = StreamClient(server.url, VIEW, ClientConfig(longest_wait_s=0.02), clock=clock)
        running = asyncio.create_task(client.run(still))
        await refused(2)
        clock.advance(limits.idle_s + 10.0)
        await refused(6)
        assert not running.done()
        leave()
        while not client.connections and not running.done():
            await asyncio.sleep(0.01)
        client.stop()
        await running
        assert client.connections == 1

    with serving(plain, limits=limits) as server, raw(server) as other:
        assert heard(other)[0] == 129
        asyncio.run(asyncio.wait_for(wait_for_it(server, other.close), PATIENCE))


def test_a_scene_too_large_for_the_client_names_what_to_raise(plain: Path) -> None:
    with serving(plain) as server:
        with pytest.raises(ProtocolError, match=r"raise scene_bytes of ClientConfig"):
            after_one_batch(server.url, ClientConfig(scene_bytes=100))
        assert after_one_batch(server.url, ClientConfig(scene_bytes=1_000_000)).connections == 1
    with pytest.raises(ValueError, match="scene_bytes"):
        ClientConfig(scene_bytes=0)


def test_an_origin_that_is_none_is_turned_away_without_a_traceback(
    plain: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.INFO), serving(plain) as server:
        with connect(server.url, origin=Origin("http://["), proxy=None) as ws:
            assert heard(ws)[0] == 131
        assert server.metrics.refused.value("origin") == 1
        assert not any(record.exc_info or "Traceback" in record.getMessage() for record in caplog.records)
