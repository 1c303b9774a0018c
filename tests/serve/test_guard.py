"""Guards and the door, each rule by itself: what is held, who gives way, what counts as unsent."""

from __future__ import annotations

import asyncio
import gc
import ipaddress
import itertools
import socket
import ssl
import struct
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from starlette.requests import Request
from starlette.responses import PlainTextResponse

from gsvis.serve import Limits, ManualClock, Server
from gsvis.serve._addresses import Proxies
from gsvis.serve._door import Door
from gsvis.serve._guard import Guard, Phase, Shared
from gsvis.serve._log import EventLog
from gsvis.serve.metrics import Metrics
from gsvis.serve.turns import Readings
from tests.serve.certificates import certificate
from tests.serve.servers import PATIENCE, advance, advance_until, limits_of, phases, plain_socket, serving, until

HEALTH = b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n"
LARGE = 12_000_000


class FakeTransport:
    """Sends what a test lets it send."""

    def __init__(self, unsent: int = 0) -> None:
        self.left, self.is_aborted = unsent, False

    def get_write_buffer_size(self) -> int:
        return self.left

    def abort(self) -> None:
        self.is_aborted = True

    def resume_reading(self) -> None: ...


class Silent:
    """A protocol that answers nothing."""

    def connection_made(self, transport: object) -> None: ...
    def data_received(self, data: bytes) -> None: ...


def house(limits: Limits) -> tuple[Door, Shared]:
    """A door that nobody has opened; each slice of a burst takes long, so that it has a turn of the loop for itself."""
    means = Shared(limits, ManualClock(), EventLog(), Metrics(), Readings(itertools.count().__next__))
    return Door(None, means, Silent, Proxies()), means  # type: ignore[arg-type]


def guard_of(door: Door, means: Shared, address: str, phase: Phase, unsent: int = 0) -> tuple[Guard, FakeTransport]:
    """A guard behind a door, in a phase."""
    sock = socket.socket()
    sock.close()  # its options cannot be set, which a guard bears
    guard, transport = Guard(sock, (address, 1), means, door), FakeTransport(unsent)
    guard.connection_made(transport)
    door.guards.add(guard)
    guard._enter(phase)
    return guard, transport


def run(test: Callable[[], None]) -> None:
    """Run a function where there is an event loop."""

    async def inside() -> None:
        test()

    asyncio.run(inside())


def count_guards() -> int:
    gc.collect()
    return sum(type(thing) is Guard for thing in gc.get_objects())


@pytest.fixture
def few_objects() -> None:
    """Set aside what is in memory before, for good, so that it takes no time to look for what is new."""
    gc.collect()
    gc.freeze()


@pytest.mark.usefixtures("few_objects")
@pytest.mark.parametrize("is_reset", [True, False])
def test_nothing_is_kept_of_a_connection_that_ends_after_its_answer(plain: Path, is_reset: bool) -> None:
    before = count_guards()
    with serving(plain) as server:
        for _ in range(20):
            with plain_socket(server) as found:
                found.sendall(HEALTH)
                answer = b""
                while not answer.endswith(b"}"):
                    answer += found.recv(1 << 16)
                if is_reset:
                    found.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        until(lambda: phases(server) == [])
        until(lambda: count_guards() <= before)


def test_a_newcomer_costs_few_looks_at_addresses(monkeypatch: pytest.MonkeyPatch) -> None:
    parsed: list[object] = []
    parse = ipaddress.ip_address

    def counted(text: Any) -> Any:
        parsed.append(text)
        return parse(text)

    def test() -> None:
        door, means = house(limits_of(waiting=200, per_address=200))
        for k in range(200):
            guard_of(door, means, f"2001:db8:0:{k:x}::1", Phase.IDLE)
        monkeypatch.setattr(ipaddress, "ip_address", counted)
        newcomer, _ = guard_of(door, means, "2001:db8:1::1", Phase.ASKING)
        door._enforce_limits(newcomer)
        assert sum(guard.phase.has_ended for guard in door.guards) == 1
        assert 0 < len(parsed) < 5

    run(test)


def test_an_address_said_by_a_proxy_changes_the_owner() -> None:
    def test() -> None:
        limits = limits_of()
        means = Shared(limits, ManualClock(), EventLog(), Metrics())
        door = Door(None, means, Silent, Proxies(("127.0.0.1",)))  # type: ignore[arg-type]
        guard, _ = guard_of(door, means, "127.0.0.1", Phase.ASKING)
        assert guard.client.owner == "127.0.0.1"
        guard.data_received(HEALTH[:-2] + b"X-Forwarded-For: 2001:db8::7\r\n\r\n")
        assert guard.client == ("2001:db8::7", "2001:db8::/64")

    run(test)


@pytest.mark.parametrize("limits", [limits_of(waiting=3, per_address=9), limits_of(waiting=9, per_address=3)])
def test_a_newcomer_never_gives_way_to_itself(limits: Limits) -> None:
    def test() -> None:
        door, means = house(limits)
        others = [guard_of(door, means, "10.0.0.1", Phase.ANSWERING)[0] for _ in range(3)]
        newcomer, _ = guard_of(door, means, "10.0.0.1", Phase.ASKING)
        door._enforce_limits(newcomer)
        assert [guard.phase.has_ended for guard in (*others, newcomer)] == [True, False, False, False]
        assert means.metrics.cut.value("gives way to others") == 1

    run(test)


@pytest.mark.parametrize("phase", [Phase.IDLE, Phase.ENDING])
def test_an_idle_connection_gives_way_before_an_older_download(phase: Phase) -> None:
    def test() -> None:
        door, means = house(limits_of(waiting=2))
        download, _ = guard_of(door, means, "10.0.0.1", phase, unsent=1000)
        idle, _ = guard_of(door, means, "10.0.0.2", Phase.IDLE)
        newcomer, _ = guard_of(door, means, "10.0.0.3", Phase.ASKING)
        door._enforce_limits(newcomer)
        assert [guard.phase.has_ended for guard in (download, idle, newcomer)] == [False, True, False]

    run(test)


def test_what_may_wait_for_a_viewer_follows_the_size_of_batches() -> None:
    def test() -> None:
        door, means = house(limits_of(batch_bytes=1 << 20))
        guard, transport = guard_of(door, means, "10.0.0.1", Phase.STREAMING)
        guard.upgrade(Silent())
        for transport.left, is_cut in ((4 << 20, False), ((4 << 20) + 1, True)):
            guard.data_received(b"a ping")
            assert guard.phase.has_ended == is_cut
        small, transport = guard_of(*house(limits_of(batch_bytes=100)), "10.0.0.1", Phase.STREAMING)
        small.upgrade(Silent())
        transport.left = 1 << 20
        small.data_received(b"a ping")
        assert not small.phase.has_ended

    run(test)


def test_nothing_waits_once_tls_has_lost_its_transport() -> None:
    class Lost(FakeTransport):
        class _ssl_protocol:  # noqa: N801
            _transport = None

        def get_write_buffer_size(self) -> int:
            raise AttributeError

    def test() -> None:
        guard, _ = guard_of(*house(limits_of()), "10.0.0.1", Phase.IDLE)
        guard._line.transport = Lost()
        assert guard.unsent == 0

    run(test)


class Recording(Silent):
    """Keeps what it is given, and what else ran in between."""

    def __init__(self) -> None:
        self.given: list[bytes] = []
        self.turns: list[int] = []


class Flowing(FakeTransport):
    """A transport that knows whether it reads."""

    is_reading = True

    def pause_reading(self) -> None:
        self.is_reading = False

    def resume_reading(self) -> None:
        self.is_reading = True


def upgraded() -> tuple[Guard, Recording, Flowing]:
    """A guard of a WebSocket, whose protocol counts the turns of the loop."""
    door, means = house(Limits())
    guard, _ = guard_of(door, means, "10.0.0.1", Phase.STREAMING)
    inner, transport, turn = Recording(), Flowing(), [0]

    def count() -> None:
        turn[0] += 1
        asyncio.get_running_loop().call_soon(count)

    def take(data: bytes) -> None:
        inner.given.append(data)
        inner.turns.append(turn[0])

    asyncio.get_running_loop().call_soon(count)
    inner.data_received = take  # type: ignore[method-assign]
    guard.connection_made(transport)
    guard.upgrade(inner)
    return guard, inner, transport


def test_a_burst_of_frames_lets_others_run_and_arrives_in_order() -> None:
    async def inside() -> None:
        guard, inner, transport = upgraded()
        burst = bytes(range(256)) * 400
        guard.data_received(burst)
        assert not transport.is_reading
        guard.data_received(b"later")
        while not transport.is_reading:
            await asyncio.sleep(0)
        assert b"".join(inner.given) == burst + b"later"
        assert max(map(len, inner.given)) <= 512
        assert len(set(inner.turns)) == len(inner.turns) > 20  # one slice in each turn of the loop
        guard.data_received(b"few")
        assert inner.given[-1] == b"few"  # few bytes do not wait

    asyncio.run(inside())


def test_reading_resumes_when_slices_are_out_and_the_protocol_wants_more() -> None:
    async def inside() -> None:
        guard, inner, transport = upgraded()
        guard.hold_reading(True)
        guard.data_received(bytes(10_000))
        guard.hold_reading(False)
        assert not transport.is_reading  # slices are under way
        guard.hold_reading(True)
        while sum(map(len, inner.given)) < 10_000:
            await asyncio.sleep(0)
        await asyncio.sleep(0)
        assert not transport.is_reading  # the protocol wants no more yet
        guard.hold_reading(False)
        assert transport.is_reading

    asyncio.run(inside())


def test_nothing_arrives_after_a_cut() -> None:
    async def inside() -> None:
        guard, inner, _ = upgraded()
        guard.data_received(bytes(100_000))
        while len(inner.given) < 3:
            await asyncio.sleep(0)
        guard.cut("gives way to others")
        await asyncio.sleep(0.01)
        assert len(inner.given) == 3

    asyncio.run(inside())


def test_the_deadline_of_the_next_request_starts_when_the_answer_is_out() -> None:
    async def test() -> None:
        door, means = house(limits_of(keep_alive_s=5.0, stall_s=10.0))
        clock: Any = means.clock
        guard, transport = guard_of(door, means, "10.0.0.1", Phase.ANSWERING, unsent=100_000)
        guard.answered()

        async def advance(seconds: float) -> None:
            for _ in range(round(seconds / 0.5)):
                clock.advance(0.5)
                await asyncio.sleep(0)

        for _ in range(5):
            await advance(9.0)
            transport.left -= 2000
            assert (guard.phase, transport.is_aborted) == (Phase.IDLE, False)
        transport.left = 0
        await advance(5.0)
        assert guard.phase is Phase.IDLE  # it is seen within a second, and then has 5
        guard.data_received(b"G")
        await advance(2.0)
        assert transport.is_aborted
        assert means.metrics.cut.value("no request in time") == 1

    asyncio.run(test())


def test_an_answer_that_nobody_reads_is_cut_though_it_is_complete() -> None:
    async def test() -> None:
        door, means = house(limits_of(keep_alive_s=500.0, stall_s=10.0))
        clock: Any = means.clock
        guard, transport = guard_of(door, means, "10.0.0.1", Phase.ANSWERING, unsent=5000)
        guard.answered()
        for _ in range(12):
            assert not transport.is_aborted or clock.now() >= 10.0
            clock.advance(1.0)
            await asyncio.sleep(0)
        assert transport.is_aborted
        assert means.metrics.cut.value("does not read") == 1

    asyncio.run(test())


@pytest.fixture(scope="module")
def secured(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    return certificate(tmp_path_factory.mktemp("tls"))


@contextmanager
def large_answer(server: Server, chain: Path | None, header: bytes = b"") -> Iterator[tuple[socket.socket, Guard]]:
    """A connection whose large answer is complete for the application, and waits to be read."""
    server._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 16)  # that of the connection, too
    with socket.socket() as found:
        found.settimeout(PATIENCE)
        found.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 16)
        found.connect(("127.0.0.1", server.port))
        if chain is not None:
            context = ssl.create_default_context(cafile=str(chain))
            found = context.wrap_socket(found, server_hostname="127.0.0.1")
        with found:
            found.sendall(HEALTH[:-2] + header + b"\r\n")
            until(lambda: phases(server) in (["idle"], ["ending"]))
            (guard,) = server._server._door.guards
            yield found, guard


async def large(self: object, request: Request) -> PlainTextResponse:
    return PlainTextResponse(b"x" * (LARGE - 1) + b"}")


@pytest.mark.parametrize("header", [b"", b"Connection: close\r\n"])
@pytest.mark.parametrize("is_safe", [True, False])
def test_who_reads_a_large_answer_steadily_gets_all(
    plain: Path, secured: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch, header: bytes, is_safe: bool
) -> None:
    monkeypatch.setattr("gsvis.serve.app._App.health", large)
    limits = limits_of(keep_alive_s=0.5, stall_s=1.0)
    with serving(plain, limits=limits, tls=secured if is_safe else None) as server:
        with large_answer(server, secured[0] if is_safe else None, header) as (found, guard):
            if is_safe and sys.version_info >= (3, 11):  # the guard's deadlines are the only ones
                assert guard._line.transport._ssl_protocol._ssl_shutdown_timeout >= 1e6
            came, passed = b"", 0.0
            while not came.endswith(b"}"):  # the guard may count for a moment what is already here
                before = guard.unsent
                while not came.endswith(b"}") and (guard.unsent > before - 50_000 or not guard.unsent):
                    piece = found.recv(1 << 16)
                    assert piece, len(came)
                    came += piece
                if not came.endswith(b"}"):
                    advance(server, 0.4)
                    passed += 0.4
            assert passed > 2 * (limits.keep_alive_s + limits.stall_s)
            assert len(came.partition(b"\r\n\r\n")[2]) == LARGE
        until(lambda: phases(server) == [])  # the end of the peer; time would cut a guard that has not seen it yet
        assert server.metrics.cut.value("does not read") == server.metrics.cut.value("does not end") == 0


@pytest.mark.parametrize("header", [b"", b"Connection: close\r\n"])
def test_who_does_not_read_a_large_answer_is_cut_under_tls(
    plain: Path, secured: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch, header: bytes
) -> None:
    monkeypatch.setattr("gsvis.serve.app._App.health", large)
    with serving(plain, tls=secured) as server, large_answer(server, secured[0], header):
        advance_until(server, lambda: phases(server) == [])
        assert server.metrics.cut.value("does not read") == 1
