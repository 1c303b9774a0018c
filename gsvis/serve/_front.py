"""The first layer of the application: refuse requests by unknown host names, and log a failing request in one line."""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import suppress

from starlette.requests import HTTPConnection
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect

from gsvis.serve._addresses import is_known_host
from gsvis.serve._log import LOGGER, EventLog
from gsvis.serve.metrics import Metrics

__all__ = ["HEALTH", "Front"]

HEALTH = "/healthz"


class Front:
    """Refuse requests by unknown host names, and log a failing request in one line.

    Args:
        inner: The application.
        hosts: Known names of this server.
        place: Returns the address of a client, for the log.
        metrics: Counters of the server.
        log: Log of events.
    """

    def __init__(
        self,
        inner: ASGIApp,
        hosts: tuple[str, ...],
        place: Callable[[HTTPConnection], str],
        metrics: Metrics,
        log: EventLog,
    ) -> None:
        self._inner = inner
        self._hosts = hosts
        self._place = place
        self._metrics = metrics
        self._log = log

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._inner(scope, receive, send)
            return
        if self._is_good(scope):
            await self._pass_on(scope, receive, send)
            return
        asked = HTTPConnection(scope)
        self._metrics.refused.add(of="host")
        why = f"Host is {asked.headers.get('host')}; name it with --hosts if it is this server"
        self._log("refused", logging.WARNING, peer=self._place(asked), reason="host", why=why)
        answer = PlainTextResponse("this server is not known by this name\n", 421)
        if scope["type"] == "websocket":
            await WebSocket(scope, receive, send).send_denial_response(answer)
        else:
            await answer(scope, receive, send)

    async def _pass_on(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Let the application answer; log an error of it in one line and answer 500."""
        begun = False

        async def watched(message: Message) -> None:
            nonlocal begun
            begun = True
            await send(message)

        try:
            await self._inner(scope, receive, watched)
        except WebSocketDisconnect:
            pass  # the client has gone before its answer
        except Exception as error:
            peer = self._place(HTTPConnection(scope))
            self._log("failed", logging.ERROR, peer=peer, why=f"{type(error).__name__}: {error}")
            LOGGER.debug("request of %s", peer, exc_info=error)
            with suppress(Exception):
                if scope["type"] == "websocket":
                    await send({"type": "websocket.close", "code": 1011})
                elif not begun:
                    await PlainTextResponse("the server failed; try again later\n", 500)(scope, receive, send)

    def _is_good(self, scope: Scope) -> bool:
        """Return whether a request names a known host, or asks for the health of the server."""
        host = HTTPConnection(scope).headers.get("host")
        if host is None:  # no page sends such a request
            return True
        return scope["path"] == HEALTH or is_known_host(host, self._hosts)
