"""The guard of one connection, between its socket and uvicorn's protocols, from accept to end.

A connection is always in one phase. Each phase ends by progress, by a deadline, or to make room for another connection.

    ASKING     no complete request yet; also the TLS handshake        handshake_s
    ANSWERING  a request is being answered                            as long as the answer is read
    IDLE       between requests, until the next one is complete       keep_alive_s, after the answer is sent
    GREETING   a WebSocket before its HELLO                           handshake_s, kept by `Connection`
    STREAMING  a viewer                                               kept by `Connection`
    ENDING     closed by us, or refused; the rest is being sent       stall_s

In every phase, a peer whose socket is full must read at a minimum rate. The guard reads the head of each request itself
and hands over one complete request at a time; later bytes wait in the guard. Bytes of a WebSocket go to its parser in
slices, for a short time in each turn of the event loop, so that a burst of small frames keeps no other viewer waiting.
"""

from __future__ import annotations

import asyncio
import enum
import http
import itertools
import logging
import socket
import struct
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Protocol

from gsvis.serve._addresses import owner_of
from gsvis.serve._head import MOST_BYTES, Refusal, check_head, find_end
from gsvis.serve._log import EventLog
from gsvis.serve.clock import Clock, Timer
from gsvis.serve.limits import Limits
from gsvis.serve.metrics import Metrics
from gsvis.serve.precedence import Precedence
from gsvis.serve.turns import Readings

__all__ = ["Guard", "Means", "Phase", "Wire"]

_AT_ONCE = struct.pack("ii", 1, 0)  # linger for 0 seconds
_MOST_PENDING = 1 << 20  # most bytes that wait for a viewer, with answers to pings; or four batches, if more
_PACE = 1 << 10  # least bytes that a peer must read in `stall_s`
_SLICE = 1 << 9  # most bytes of a WebSocket that are parsed in one go; 5,000 empty frames take 50 ms
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


@dataclass(frozen=True)
class Means:
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
        means: What all guards share.
        inner: Makes the protocol that answers requests.
        seen: Called with the peer and the forwarded headers of each request; returns the address of the client.
        gone: Called once, when the connection has ended.

    Attributes:
        phase: Phase of the connection.
        since: Increases with each change of phase; the smallest has waited longest.
        address: Address of the client.
        owner: Address or network of the client, for limits per address.
        is_cut: Whether the connection has been cut; the transport reports its end a little later.
    """

    def __init__(
        self,
        sock: socket.socket,
        peer: tuple[str, int],
        means: Means,
        inner: Callable[[], Any],
        seen: Callable[[str, list[str]], str],
        gone: Callable[[Guard], object],
    ) -> None:
        self._sock = sock
        self.peer = peer
        self._limits = means.limits
        self._clock = means.clock
        self._log = means.log
        self._metrics = means.metrics
        self._readings = means.readings
        self._precedence = means.precedence
        self._fd = sock.fileno()
        self._make = inner
        self._seen = seen
        self._gone = gone
        self.address = peer[0]
        self.owner = owner_of(peer[0])
        self.is_cut = False
        self._transport: Any = None
        self._inner: _Inner | None = None
        self._buffer = bytearray()
        self._seen_bytes = 0
        self._deadline: Timer | None = None
        self._room: Timer | None = None
        self._is_over = self._is_upgraded = self._is_feeding = self._is_held = False
        self._left = 0  # bytes that waited to be sent at the last check, while ending
        self._enter(Phase.ASKING, self._limits.handshake_s)

    def __str__(self) -> str:
        return f"{self.peer[0]}:{self.peer[1]}"

    @property
    def is_full(self) -> bool:
        """Whether the buffer of the socket is full."""
        return self._room is not None

    @property
    def unsent(self) -> int:
        """Bytes that wait for room in the socket."""
        if self._transport is None:
            return 0
        tls = getattr(self._transport, "_ssl_protocol", None)
        below = getattr(tls, "_transport", None)
        if tls is not None and below is None:  # the transport is about to report its end
            return 0
        waiting = int(self._transport.get_write_buffer_size())
        if below is not None and sys.version_info >= (3, 11):  # TLS counts only bytes that it still holds
            waiting += int(below.get_write_buffer_size())
        return waiting

    # from the transport

    def connection_made(self, transport: Any) -> None:
        """Handle a new connection; with TLS, after the handshake."""
        self._transport = transport
        if self.is_cut:
            transport.abort()
            return
        self._inner = self._make()
        self._inner.connection_made(Wire(transport, self))

    def data_received(self, data: bytes) -> None:
        """Handle bytes of the peer."""
        if self.is_cut or (self.phase is Phase.ENDING and not self._is_upgraded):
            return
        if self._is_upgraded:
            self._feed(data)
            return
        self._buffer += data
        if self.phase in (Phase.ASKING, Phase.IDLE):
            self._take_request()
        elif len(self._buffer) > MOST_BYTES:
            self._transport.pause_reading()  # until the answer is out

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
        # break the cycle, which keeps 256 kB of TLS
        inner = self._inner
        self._inner = None
        self._transport = None
        if inner is not None:
            inner.connection_lost(exc)

    # from the server

    def answered(self) -> None:
        """Handle an answer that has been sent or is in the socket buffer."""
        if self._is_over or self.phase is not Phase.ANSWERING:
            return
        self._enter(Phase.IDLE)
        self._rest()
        self._transport.resume_reading()
        if self._buffer:
            self._readings.add(self._go_on)

    def _go_on(self) -> bool:
        """Take the next request of those that came at once; return False, as one is enough for a turn."""
        if self.phase is Phase.IDLE and not self._has_ended():
            self._take_request()
        return False

    def upgrade(self, protocol: Any) -> None:
        """Switch the connection to a WebSocket."""
        self._inner = protocol
        self._is_upgraded = True
        if self.phase is Phase.ANSWERING:
            self._enter(Phase.GREETING)

    def hold_reading(self, is_held: bool) -> None:
        """Pause or resume reading for the protocol; slices that are on their way to it still arrive."""
        self._is_held = is_held
        if self._transport is None:
            return
        if is_held:
            self._transport.pause_reading()
        elif not self._is_feeding:
            self._transport.resume_reading()

    def stream(self) -> None:
        """Mark the connection as a viewer, which does not make room for others."""
        if self.phase is Phase.GREETING:
            self._enter(Phase.STREAMING)

    def close(self) -> None:
        """End the connection when everything is sent, at most `stall_s` later."""
        self.finish()
        if self._transport is not None and not self._transport.is_closing():  # a second close of TLS cannot be aborted
            self._transport.close()

    def finish(self) -> None:
        """Enter the phase ENDING: the peer has `stall_s` to read the rest and to close."""
        if not self._is_over and self.phase is not Phase.ENDING:
            self._left = self.unsent
            self._enter(Phase.ENDING, self._limits.stall_s)

    def cut(self, reason: str = "", level: int = logging.WARNING) -> None:
        """Abort the connection now and discard unsent bytes, in the kernel too.

        Args:
            reason: For the log and the metrics; "" logs and counts nothing.
            level: Level of the log line.
        """
        if self._is_over or self.is_cut:
            return
        self.is_cut = True
        if reason:
            self._metrics.cut.add(of=reason)
            self._log("cut", level, reason=reason, peer=str(self), phase=self.phase.value)
        with suppress(OSError):
            self._sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _AT_ONCE)
        if self._transport is not None:
            self._transport.abort()
        else:  # in the handshake, which ends when it reads the end
            with suppress(OSError):
                self._sock.shutdown(socket.SHUT_RDWR)

    def shut_down(self) -> None:
        """Announce the shutdown; never raise, so that the next connection gets the message too."""
        if self._inner is None or self.phase is Phase.ENDING:
            if self._inner is None:
                self.cut()
            return
        try:
            self._inner.shutdown()
        except Exception as error:
            self._log("failed", logging.ERROR, peer=str(self), why=f"shutdown: {type(error).__name__}: {error}")
            self.cut()

    def end(self) -> None:
        """Stop watching."""
        if self._is_over:
            return
        self._is_over = True
        for timer in (self._deadline, self._room):
            if timer is not None:
                timer.cancel()
        self._buffer.clear()
        self._precedence.forget(self._fd, self)
        self._gone(self)

    # inside

    def _enter(self, phase: Phase, seconds: float | None = None) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
        self._deadline = None if seconds is None else self._clock.call_later(seconds, self._too_late)
        self._precedence.put(self._fd, self, is_first=phase is Phase.STREAMING)
        # last: who reads it from another thread finds the deadline set
        self.phase = phase
        self.since = next(_numbers)

    def _rest(self) -> None:
        """Start the deadline of the next request after the answer is sent; until then check that the peer reads."""
        left = self.unsent
        if left:
            self._look_in_a_moment(left, self._clock.now() + self._limits.stall_s)
        else:
            self._enter(Phase.IDLE, self._limits.keep_alive_s)

    def _look_in_a_moment(self, left: int, end: float) -> None:
        wait = min(_LOOK_S, self._limits.stall_s)
        self._deadline = self._clock.call_later(wait, partial(self._look, left, end))

    def _look(self, left: int, end: float) -> None:
        """Check that the answer has been sent, or that the peer reads it: `left` bytes were unsent at the start."""
        unsent = self.unsent
        if unsent > 0 and self._clock.now() < end:
            self._look_in_a_moment(left, end)
        elif unsent > 0 and left - unsent < _PACE:
            self.cut("does not read")
        else:
            self._rest()

    def _too_late(self) -> None:
        if self.phase is Phase.IDLE and not self._buffer:
            self.close()  # no error: the peer has no further request
            return
        if self.phase is Phase.ENDING:
            left = self._left
            self._left = self.unsent
            if left - self._left >= _PACE:  # the peer still reads
                self._enter(Phase.ENDING, self._limits.stall_s)
                return
            self.cut("does not read" if self._left else "does not end", logging.INFO)
            return
        self.cut("no request in time", logging.INFO)

    def _take_request(self) -> None:
        while self._buffer.startswith(b"\r\n"):  # allowed between requests
            del self._buffer[:2]
            self._seen_bytes = 0
        end = find_end(self._buffer, self._seen_bytes)
        self._seen_bytes = len(self._buffer) if end is None else 0
        if end is None:
            return
        if isinstance(end, Refusal):
            self._refuse(end)
            return
        raw = bytes(self._buffer[:end])
        head = check_head(raw)
        if isinstance(head, Refusal):
            self._refuse(head)
            return
        del self._buffer[:end]
        address = self._seen(self.peer[0], [value for name, value in head.headers if name == "x-forwarded-for"])
        if address != self.address:
            self.address = address
            self.owner = owner_of(address)
        self._enter(Phase.ANSWERING)
        self._hand_over(raw)
        if self._is_upgraded and self._buffer:
            data = bytes(self._buffer)
            self._buffer.clear()
            self._feed(data)

    def _feed(self, data: bytes) -> None:
        """Hand over bytes of a WebSocket: at once if they are few, else in slices, while reading pauses."""
        if not self._is_feeding and len(data) <= _SLICE:
            self._hand_over(data)
            return
        self._buffer += data
        if not self._is_feeding:
            self._is_feeding = True
            self._transport.pause_reading()
            self._readings.add(self._feed_slice)

    def _feed_slice(self) -> bool:
        """Hand over a slice; return whether there is more."""
        if self._has_ended():
            return False
        data = bytes(self._buffer[:_SLICE])
        del self._buffer[:_SLICE]
        self._hand_over(data)
        if self._has_ended():
            return False
        if self._buffer:
            return True
        self._is_feeding = False
        if not self._is_held:
            self._transport.resume_reading()
        return False

    def _has_ended(self) -> bool:
        return self._is_over or self.is_cut

    def _hand_over(self, data: bytes) -> None:
        inner = self._inner
        assert inner is not None
        try:
            inner.data_received(data)
        except Exception as error:  # a failing parser ends only its own connection
            self._metrics.cut.add(of="failed")
            self._log("failed", logging.ERROR, peer=str(self), why=f"{type(error).__name__}: {error}")
            self.cut()
            return
        if self._is_upgraded and self.unsent > max(_MOST_PENDING, 4 * self._limits.batch_bytes):
            self.cut("pings and does not read")

    def _refuse(self, refusal: Refusal) -> None:
        """Write the refusal directly, without uvicorn, and end the connection."""
        self._metrics.refused.add(of=str(refusal.status))
        self._log("refused", logging.WARNING, peer=str(self), reason=str(refusal.status), why=refusal.line)
        body = f"{refusal.line}\n".encode()
        phrase = http.HTTPStatus(refusal.status).phrase
        self._buffer.clear()
        self._transport.write(
            f"HTTP/1.1 {refusal.status} {phrase}\r\ncontent-type: text/plain; charset=utf-8\r\n"
            f"content-length: {len(body)}\r\nconnection: close\r\n\r\n".encode()
            + body
        )
        self.finish()
        if self._transport.can_write_eof():
            self._transport.write_eof()  # a close with unread bytes would discard the answer
        else:
            self._transport.close()

    def _watch_room(self) -> None:
        """Cut the connection unless the peer reads `_PACE` bytes, or all, in each `stall_s`."""
        waiting = self.unsent

        def look() -> None:
            now = self.unsent
            if now > 0 and waiting - now < _PACE:
                self.cut("does not read")
            else:
                self._watch_room()

        self._room = self._clock.call_later(self._limits.stall_s, look)
