"""The guard of one connection, between its socket and uvicorn's protocols, from accept to end.

A connection is always in one phase. Each phase ends by progress, by a deadline, or to make room for another connection.

    ASKING     no complete request yet; also the TLS handshake        handshake_s
    ANSWERING  a request is being answered                            as long as the answer is read
    IDLE       between requests, until the next one is complete       keep_alive_s, after the answer is sent
    GREETING   a WebSocket before its HELLO                           handshake_s, kept by `Connection`
    STREAMING  a viewer                                               kept by `Connection`
    ENDING     closed by us, or refused; the rest is being sent       stall_s
    CUT        aborted; the transport reports its end in a moment
    OVER       nothing is left of it

In every phase, a peer whose socket is full must read at a minimum rate. The guard reads the head of each request itself
and hands over one complete request at a time; later bytes wait in the guard.
"""

from __future__ import annotations

import asyncio
import enum
import http
import itertools
import logging
import socket
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Protocol

from gsvis.serve._addresses import Client
from gsvis.serve._head import MOST_BYTES, Head, Refusal, RequestBuffer
from gsvis.serve._line import Line
from gsvis.serve._log import EventLog
from gsvis.serve._slices import Slices
from gsvis.serve.clock import Clock, Timer
from gsvis.serve.limits import Limits
from gsvis.serve.metrics import Metrics
from gsvis.serve.precedence import Precedence
from gsvis.serve.turns import Readings

__all__ = ["Guard", "GuardOwner", "Phase", "Shared", "Wire"]

_MOST_PENDING = 1 << 20  # most bytes that wait for a viewer, with answers to pings; or four batches, if more
_PACE = 1 << 10  # least bytes that a peer must read in `stall_s`
_LOOK_S = 1.0  # seconds between checks whether an answer has been sent

_numbers = itertools.count()


class Phase(enum.Enum):
    """The phase of a connection."""

    ASKING = "asking"
    ANSWERING = "answering"
    IDLE = "idle"
    GREETING = "greeting"
    STREAMING = "streaming"
    ENDING = "ending"
    CUT = "cut"
    OVER = "over"

    @property
    def has_ended(self) -> bool:
        """Whether nothing more is read or answered."""
        return self in (Phase.CUT, Phase.OVER)


@dataclass(frozen=True)
class Shared:
    """What all guards of a server share.

    Attributes:
        limits: Bounds.
        clock: Clock of the deadlines.
        log: Log of events.
        metrics: Counters of events.
        readings: Turns in which bursts are parsed.
        precedence: Which sockets the event loop looks at first.
    """

    limits: Limits
    clock: Clock
    log: EventLog
    metrics: Metrics
    readings: Readings = field(default_factory=Readings)
    precedence: Precedence = field(default_factory=Precedence)


class GuardOwner(Protocol):
    """What a guard asks of the door that it belongs to."""

    def make_protocol(self) -> Any:
        """Return the protocol that answers the requests of a connection."""
        ...

    def client_of(self, peer: str, forwarded: list[str]) -> str:
        """Return the address of a client, from the address of its socket and its forwarded headers."""
        ...

    def forget(self, guard: Guard) -> None:
        """Forget a connection, which has ended; called once."""
        ...


class _Inner(Protocol):
    """Interface of a protocol of uvicorn."""

    def connection_made(self, transport: Any) -> None: ...
    def connection_lost(self, exc: Exception | None) -> None: ...
    def data_received(self, data: bytes) -> None: ...
    def pause_writing(self) -> None: ...
    def resume_writing(self) -> None: ...
    def shutdown(self) -> None: ...


class Wire:
    """The transport that uvicorn's protocols use; it keeps the guard between them and the socket.

    Attributes:
        guard: The guard of this connection.
    """

    def __init__(self, transport: Any, guard: Guard) -> None:
        self._transport = transport
        self.guard = guard

    def __getattr__(self, name: str) -> Any:
        return getattr(self._transport, name)

    def set_protocol(self, protocol: Any) -> None:
        """Switch the connection to another protocol, behind the guard."""
        self.guard.upgrade(protocol)

    def pause_reading(self) -> None:
        """Pause reading until the protocol resumes it."""
        self.guard.hold_reading(True)

    def resume_reading(self) -> None:
        """Resume reading, once everything read has been handed over."""
        self.guard.hold_reading(False)

    def close(self) -> None:
        """Close after everything is sent, or when the guard's deadline expires."""
        self.guard.close()


class Guard(asyncio.Protocol):
    """Watch one connection.

    Args:
        sock: The accepted socket.
        peer: Address of the other end.
        shared: What all guards share.
        door: The door that accepted the connection.

    Attributes:
        peer: Address of the other end of the socket.
        client: The client; behind a proxy, the address that the proxy names.
        phase: Phase of the connection.
        since: Increases with each change of phase; the smallest has waited longest.
    """

    def __init__(self, sock: socket.socket, peer: tuple[str, int], shared: Shared, door: GuardOwner) -> None:
        self.peer = peer
        self.client = Client.at(peer[0])
        self._shared = shared
        self._door = door
        self._line = Line(sock)
        self._inner: _Inner | None = None
        self._requests = RequestBuffer()
        self._frames: Slices | None = None  # None before the connection is a WebSocket
        self._deadline: Timer | None = None
        self._room: Timer | None = None
        self._unsent_before = 0  # bytes that waited to be sent at the last check, while ending
        self.phase = Phase.ASKING
        self._enter(Phase.ASKING, shared.limits.handshake_s)

    def __str__(self) -> str:
        return f"{self.peer[0]}:{self.peer[1]}"

    @property
    def is_full(self) -> bool:
        """Whether the buffer of the socket is full."""
        return self._room is not None

    @property
    def unsent(self) -> int:
        """Bytes that wait for room in the socket."""
        return self._line.unsent

    # from the transport

    def connection_made(self, transport: Any) -> None:
        """Handle a new connection; with TLS, after the handshake."""
        self._line.transport = transport
        if self.phase.has_ended:
            transport.abort()
            return
        self._inner = self._door.make_protocol()
        self._inner.connection_made(Wire(transport, self))

    def data_received(self, data: bytes) -> None:
        """Handle bytes of the peer."""
        if self.phase.has_ended:
            return
        if self._frames is not None:
            self._frames.add(data)
            return
        if self.phase is Phase.ENDING:
            return
        self._requests.add(data)
        if self.phase in (Phase.ASKING, Phase.IDLE):
            self._take_request()
        elif len(self._requests) > MOST_BYTES:
            self._line.transport.pause_reading()  # until the answer is out

    def eof_received(self) -> bool | None:
        """Return None, so that the transport closes: the peer sends nothing more."""
        return None

    def pause_writing(self) -> None:
        """Stop writing: the socket buffer is full."""
        if self._inner is not None:
            self._inner.pause_writing()
        if self._room is None:
            self._watch_room()

    def resume_writing(self) -> None:
        """Resume writing: the socket buffer has room again."""
        if self._room is not None:
            self._room.cancel()
            self._room = None
        if self._inner is not None:
            self._inner.resume_writing()

    def connection_lost(self, exc: Exception | None) -> None:
        """Handle the end of the connection."""
        self.end()
        # break the cycles, which keep 256 kB of TLS
        inner = self._inner
        self._inner = None
        self._frames = None
        self._line.transport = None
        if inner is not None:
            inner.connection_lost(exc)

    # from the server

    def answered(self) -> None:
        """Handle an answer that has been sent or is in the socket buffer."""
        if self.phase is not Phase.ANSWERING:
            return
        self._enter(Phase.IDLE)
        self._start_keep_alive()
        self._line.transport.resume_reading()
        if self._requests:
            self._shared.readings.add(self._take_next_request)

    def _take_next_request(self) -> bool:
        """Take the next of several requests that came together; return False: one a turn is enough."""
        if self.phase is Phase.IDLE:
            self._take_request()
        return False

    def upgrade(self, protocol: Any) -> None:
        """Switch the connection to a WebSocket."""
        self._inner = protocol
        self._frames = Slices(self._line, self._shared.readings, self._hand_over)
        if self.phase is Phase.ANSWERING:
            self._enter(Phase.GREETING)

    def hold_reading(self, is_held: bool) -> None:
        """Pause or resume reading for the protocol."""
        transport = self._line.transport
        if transport is None:
            return
        if self._frames is not None:
            self._frames.hold(is_held)
        elif is_held:
            transport.pause_reading()
        else:
            transport.resume_reading()

    def stream(self) -> None:
        """Mark the connection as a viewer, which does not make room for others."""
        if self.phase is Phase.GREETING:
            self._enter(Phase.STREAMING)

    def close(self) -> None:
        """End the connection when everything is sent, at most `stall_s` later."""
        self.finish()
        self._line.close()

    def finish(self) -> None:
        """Enter the phase ENDING: the peer has `stall_s` to read the rest and to close."""
        if self.phase is not Phase.ENDING and not self.phase.has_ended:
            self._unsent_before = self.unsent
            self._enter(Phase.ENDING, self._shared.limits.stall_s)

    def cut(self, reason: str = "", level: int = logging.WARNING) -> None:
        """Abort the connection now and discard unsent bytes, in the kernel too.

        Args:
            reason: For the log and the metrics; "" logs and counts nothing.
            level: Level of the log line.
        """
        if self.phase.has_ended:
            return
        if reason:
            self._shared.metrics.cut.add(of=reason)
            self._shared.log("cut", level, reason=reason, peer=str(self), phase=self.phase.value)
        self.phase = Phase.CUT
        self._stop_timers()
        self._line.abort()

    def shut_down(self) -> None:
        """Announce the shutdown; never raise, so that the next connection gets the message too."""
        if self._inner is None:
            self.cut()
        elif self.phase is not Phase.ENDING and not self.phase.has_ended:
            try:
                self._inner.shutdown()
            except Exception as error:
                why = f"shutdown: {type(error).__name__}: {error}"
                self._shared.log("failed", logging.ERROR, peer=str(self), why=why)
                self.cut()

    def end(self) -> None:
        """Stop watching."""
        if self.phase is Phase.OVER:
            return
        self.phase = Phase.OVER
        self._stop_timers()
        self._requests.clear()
        if self._frames is not None:
            self._frames.clear()
        self._shared.precedence.forget(self._line.fd, self)
        self._door.forget(self)

    # inside

    def _enter(self, phase: Phase, seconds: float | None = None) -> None:
        """Enter a phase, which ends after some seconds at the latest; None sets no deadline."""
        if self._deadline is not None:
            self._deadline.cancel()
        self._deadline = None if seconds is None else self._shared.clock.call_later(seconds, self._too_late)
        self._shared.precedence.put(self._line.fd, self, is_first=phase is Phase.STREAMING)
        # last, so that another thread that reads the phase finds the deadline set
        self.phase = phase
        self.since = next(_numbers)

    def _stop_timers(self) -> None:
        """Cancel all deadlines."""
        for timer in (self._deadline, self._room):
            if timer is not None:
                timer.cancel()

    def _start_keep_alive(self) -> None:
        """Start the deadline of the next request after the answer is sent; until then check that the peer reads."""
        left = self.unsent
        limits = self._shared.limits
        if left:
            self._check_later(left, self._shared.clock.now() + limits.stall_s)
        else:
            self._enter(Phase.IDLE, limits.keep_alive_s)

    def _check_later(self, left: int, end: float) -> None:
        """Check in a moment that the peer reads; see `_check_reading`."""
        wait = min(_LOOK_S, self._shared.limits.stall_s)
        self._deadline = self._shared.clock.call_later(wait, partial(self._check_reading, left, end))

    def _check_reading(self, left: int, end: float) -> None:
        """Check that the answer has been sent, or that the peer reads it.

        Args:
            left: Bytes that were unsent at the start.
            end: When the peer must have read some of them, seconds of the clock.
        """
        unsent = self.unsent
        if unsent > 0 and self._shared.clock.now() < end:
            self._check_later(left, end)
        elif unsent > 0 and left - unsent < _PACE:
            self.cut("does not read")
        else:
            self._start_keep_alive()

    def _too_late(self) -> None:
        """End the connection at the deadline of its phase, or give it more time while it reads."""
        if self.phase is Phase.IDLE and not self._requests:
            self.close()  # no error: the peer has no further request
            return
        if self.phase is Phase.ENDING:
            left = self._unsent_before
            self._unsent_before = self.unsent
            if left - self._unsent_before >= _PACE:  # the peer still reads
                self._enter(Phase.ENDING, self._shared.limits.stall_s)
                return
            self.cut("does not read" if self._unsent_before else "does not end", logging.INFO)
            return
        self.cut("no request in time", logging.INFO)

    def _take_request(self) -> None:
        """Hand over the next request if it is complete; refuse it if it is malformed."""
        found = self._requests.take_request()
        if found is None:
            return
        if isinstance(found, Refusal):
            self._refuse(found)
            return
        raw, head = found
        self._find_client(head)
        self._enter(Phase.ANSWERING)
        self._hand_over(raw)
        if self._frames is not None and self._requests:
            self._frames.add(self._requests.take_rest())

    def _find_client(self, head: Head) -> None:
        """Take the address of the client from a request, which a proxy may have forwarded."""
        forwarded = [value for name, value in head.headers if name == "x-forwarded-for"]
        address = self._door.client_of(self.peer[0], forwarded)
        if address != self.client.address:
            self.client = Client.at(address)

    def _hand_over(self, data: bytes) -> bool:
        """Give bytes to uvicorn's protocol; return whether the connection goes on."""
        if self.phase.has_ended:
            return False
        assert self._inner is not None
        try:
            self._inner.data_received(data)
        except Exception as error:  # a failing parser ends only its own connection
            self._shared.metrics.cut.add(of="failed")
            self._shared.log("failed", logging.ERROR, peer=str(self), why=f"{type(error).__name__}: {error}")
            self.cut()
            return False
        most = max(_MOST_PENDING, 4 * self._shared.limits.batch_bytes)
        if self._frames is not None and self.unsent > most:
            self.cut("pings and does not read")
        return not self.phase.has_ended

    def _refuse(self, refusal: Refusal) -> None:
        """Write the refusal directly, without uvicorn, and end the connection."""
        self._shared.metrics.refused.add(of=str(refusal.status))
        self._shared.log("refused", logging.WARNING, peer=str(self), reason=str(refusal.status), why=refusal.line)
        self._requests.clear()
        self._line.transport.write(_answer(refusal))
        self.finish()
        self._line.end_writing()

    def _watch_room(self) -> None:
        """Cut the connection unless the peer reads `_PACE` bytes, or all, in each `stall_s`."""
        waiting = self.unsent

        def look() -> None:
            now = self.unsent
            if now > 0 and waiting - now < _PACE:
                self.cut("does not read")
            else:
                self._watch_room()

        self._room = self._shared.clock.call_later(self._shared.limits.stall_s, look)


def _answer(refusal: Refusal) -> bytes:
    """Return a refusal as an answer of HTTP."""
    body = f"{refusal.line}\n".encode()
    phrase = http.HTTPStatus(refusal.status).phrase
    head = (
        f"HTTP/1.1 {refusal.status} {phrase}\r\ncontent-type: text/plain; charset=utf-8\r\n"
        f"content-length: {len(body)}\r\nconnection: close\r\n\r\n"
    )
    return head.encode() + body
