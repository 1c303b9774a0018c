"""uvicorn's protocols with what it leaves open: bounds for a peer that says nothing, reads nothing, or only pings.

Both keep an eye on their socket. A peer that leaves no room in its buffer is cut off, since a farewell would wait
behind all the rest. The application finds `scope["extensions"]["gsvis.abort"]`, which cuts the connection at once.
"""

from __future__ import annotations

import asyncio
import logging
import socket
import struct
from contextlib import suppress
from functools import partial
from typing import Any

from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.frames import Frame

from gsvis.serve._log import EventLog
from gsvis.serve.limits import Limits

__all__ = ["ABORT", "protocols"]

ABORT = "gsvis.abort"

_MOST_PIECES = 1024  # frames of one message
_AT_ONCE = struct.pack("ii", 1, 0)  # linger for 0 seconds
_MOST_PENDING = 1 << 20  # bytes of answers to pings that nobody reads


class _Watch:
    """Cuts a connection that has had no room for too long, or whose end takes too long."""

    def __init__(self, loop: asyncio.AbstractEventLoop, transport: Any, stall_s: float, log: EventLog) -> None:
        self._loop, self._transport, self._stall_s, self._log = loop, transport, stall_s, log
        self._full: float | None = None  # since when it has been full, or ending
        self._timer = loop.call_later(stall_s / 4, self._look)

    def full(self, is_full: bool) -> None:
        """The buffer of the socket is full, or has room again."""
        self._full = self._loop.time() if is_full else None

    def end(self) -> None:
        """Look no more."""
        self._timer.cancel()

    def _look(self) -> None:
        now = self._loop.time()
        if self._full is None and self._transport.is_closing():
            self._full = now
        if self._full is not None and now - self._full >= self._stall_s:
            waiting = self._transport.get_write_buffer_size()
            self._log("cut", logging.WARNING, reason="does not read", peer=_peer(self._transport), waiting=waiting)
            _cut(self._transport)
            return
        self._timer = self._loop.call_later(self._stall_s / 4, self._look)


def _cut(transport: Any) -> None:
    """End a connection and forget what waits to be sent, in the kernel, too."""
    found = transport.get_extra_info("socket")
    if found is not None:
        with suppress(OSError):
            found.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _AT_ONCE)
    transport.abort()


def _peer(transport: Any) -> str:
    peer = transport.get_extra_info("peername")
    return f"{peer[0]}:{peer[1]}" if isinstance(peer, tuple) and len(peer) >= 2 else str(peer)


def protocols(limits: Limits, log: EventLog) -> tuple[type[asyncio.Protocol], type[asyncio.Protocol]]:
    """The protocol classes for plain requests and for WebSockets, bound to limits."""

    class Plain(H11Protocol):
        """Plain requests: one has to come in time, and its answer has to be read."""

        _watch: _Watch | None = None
        _first: asyncio.TimerHandle | None = None

        def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
            super().connection_made(transport)
            peer = _peer(transport)
            if len(self.connections) > 2 * limits.connections:
                log("cut", logging.WARNING, reason="too many connections", peer=peer)
                _cut(transport)
                return
            self._watch = _Watch(self.loop, transport, limits.stall_s, log)
            self._first = self.loop.call_later(limits.handshake_s, self._too_late, peer)

        def _too_late(self, peer: str) -> None:
            cycle: Any = self.cycle
            if cycle is None:
                log("cut", logging.INFO, reason="no request in time", peer=peer)
                _cut(self.transport)

        def connection_lost(self, exc: Exception | None) -> None:
            self._end()
            super().connection_lost(exc)

        def pause_writing(self) -> None:
            super().pause_writing()
            if self._watch is not None:
                self._watch.full(True)

        def resume_writing(self) -> None:
            super().resume_writing()
            if self._watch is not None:
                self._watch.full(False)

        def handle_websocket_upgrade(self, event: Any) -> None:
            self._end()  # the other protocol takes over the transport
            super().handle_websocket_upgrade(event)

        def _end(self) -> None:
            if self._watch is not None:
                self._watch.end()
            if self._first is not None:
                self._first.cancel()

    class Socket(WebSocketsSansIOProtocol):
        """WebSockets: pieces of messages are counted, and so is what is written without being asked for."""

        _watch: _Watch | None = None

        def connection_made(self, transport: Any) -> None:
            super().connection_made(transport)
            self._watch = _Watch(self.loop, transport, limits.stall_s, log)
            self._peer = _peer(transport)

        def connection_lost(self, exc: Exception | None) -> None:
            if self._watch is not None:
                self._watch.end()
            super().connection_lost(exc)

        def pause_writing(self) -> None:
            super().pause_writing()
            if self._watch is not None:
                self._watch.full(True)

        def resume_writing(self) -> None:
            super().resume_writing()
            if self._watch is not None:
                self._watch.full(False)

        def handle_ping(self) -> None:
            super().handle_ping()
            if self.transport.get_write_buffer_size() > _MOST_PENDING:
                log("cut", logging.WARNING, reason="pings and does not read", peer=self._peer)
                _cut(self.transport)

        def handle_cont(self, event: Frame) -> None:
            super().handle_cont(event)
            if len(self.frames) > _MOST_PIECES:
                log("cut", logging.WARNING, reason="a message in too many pieces", peer=self._peer)
                self.frames = []
                _cut(self.transport)

        async def send(self, message: Any) -> None:
            await super().send(message)
            if message["type"] == "websocket.http.response.body" and not message.get("more_body", False):
                self.handshake_complete = True  # a refusal is an answer, too

        async def run_asgi(self) -> None:
            scope: Any = self.scope
            scope["extensions"][ABORT] = partial(_cut, self.transport)
            await super().run_asgi()

    return Plain, Socket
