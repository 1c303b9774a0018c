"""uvicorn's protocols, which turn complete requests and frames into calls of the application, behind guards.

The application finds the guard of its connection as `scope["extensions"]["gsvis.guard"]`.

Here, and in `server`, members of uvicorn and websockets are overridden or read that these do not document, because no
option of theirs does the same:

    when an answer has ended          on_response_complete, _unset_keepalive_if_required, cycle
    most pieces of a message          handle_cont, frames
    a burst of small messages         send_receive_event_to_app, read_paused, queue
    a refused handshake is answered   handshake_complete, close_sent, conn.handshake_exc
    nothing is kept of a connection   conn.parser, conn.parser_exc
    one deadline, the guard's         close_timeout
    our own sockets, a bounded end    uvicorn.Server.startup and shutdown

So pyproject.toml bounds both from above. Raise a bound when tests/serve pass with the new version.
"""

from __future__ import annotations

import logging
from typing import Any

from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.frames import Frame

from gsvis.serve._guard import Guard

__all__ = ["GUARD", "Plain", "Socket"]

GUARD = "gsvis.guard"

_MOST_PIECES = 1024  # most frames of one message
# messages that may wait for the application while more are read, and their bytes
_MOST_WAITING = 16
_SMALL = 256
_NEVER = 1e6  # seconds; the guard has its own deadline


class Plain(H11Protocol):
    """The protocol of plain requests."""

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self.cycle = None  # type: ignore[assignment]  # it refers to this object

    def on_response_complete(self) -> None:
        super().on_response_complete()
        self._unset_keepalive_if_required()  # the guard has its own; this timer outlives a reset
        guard: Guard = self.transport.guard  # type: ignore[attr-defined]
        guard.answered()


class Socket(WebSocketsSansIOProtocol):
    """The protocol of WebSockets."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.close_timeout = _NEVER

    @property
    def _guard(self) -> Guard:
        return self.transport.guard  # type: ignore[attr-defined, no-any-return]

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        if getattr(self.conn, "handshake_exc", None) is not None and not self.handshake_complete:
            self._refuse_handshake()

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self.conn.parser.close()  # a generator that keeps its parser and its input alive
        for name in ("parser_exc", "handshake_exc"):  # the latter in newer versions only
            if (error := getattr(self.conn, name, None)) is not None:
                error.__traceback__ = None  # its frames keep them alive too

    def _refuse_handshake(self) -> None:
        """Answer a request that the WebSocket parser rejects; the guard should have done so before."""
        self.handshake_complete = self.close_sent = True
        answer = b"".join(self.conn.data_to_send())
        self.transport.write(answer or b"HTTP/1.1 400 Bad Request\r\ncontent-length: 0\r\nconnection: close\r\n\r\n")
        self.transport.close()

    def handle_cont(self, event: Frame) -> None:
        super().handle_cont(event)
        if len(self.frames) > _MOST_PIECES:
            self.frames = []
            self._guard.cut("a message in too many pieces", logging.WARNING)

    def send_receive_event_to_app(self) -> None:
        """Hand a message to the application; read on while few small ones wait: a pause takes two system calls."""
        is_small = sum(map(len, self.frames)) <= _SMALL and self.queue.qsize() < _MOST_WAITING
        if self.read_paused or not is_small:
            super().send_receive_event_to_app()
            return
        self.read_paused = True  # so that the protocol does not pause
        try:
            super().send_receive_event_to_app()
        finally:
            self.read_paused = False

    async def send(self, message: Any) -> None:
        await super().send(message)
        if message["type"] == "websocket.http.response.body" and not message.get("more_body", False):
            self.handshake_complete = True  # a refusal is an answer too
        if message["type"] == "websocket.close":
            self._guard.finish()

    async def run_asgi(self) -> None:
        scope: Any = self.scope
        scope["extensions"][GUARD] = self._guard
        await super().run_asgi()
