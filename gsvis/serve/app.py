"""The addresses of a server, as an ASGI application: streams, files of packages, health, metrics.

    /                                   the scenes, as JSON
    /stream, /stream/NAME               WebSocket: the protocol of docs/streaming.md
    /packages/NAME/manifest.json        files of a package, for clients that fetch parts themselves
    /packages/NAME/parts/HASH.arrow
    /healthz, /metrics

With a token, all addresses but `/healthz` require it: as `Authorization: Bearer TOKEN`, or as `?token=TOKEN` if a
browser cannot set headers. The server refuses a WebSocket from a page of another origin, unless that origin is allowed.
Requests by an unknown host name get 421, except for `/healthz`: a page could have made its own name point here.
"""

from __future__ import annotations

import errno
import hmac
import itertools
import logging
from collections.abc import Mapping
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import dataclass, field
from urllib.parse import urlsplit

from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import HTTPConnection, Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect

from gsvis.abr.config import AbrConfig
from gsvis.errors import FormatError, ProtocolError
from gsvis.serve._addresses import Proxies, is_known_host, owner_of
from gsvis.serve._log import LOGGER, EventLog
from gsvis.serve._protocols import GUARD
from gsvis.serve.clock import Clock
from gsvis.serve.connection import Connection, GoneError, Setting
from gsvis.serve.limits import Limits, Pace, Seats
from gsvis.serve.metrics import CONTENT_TYPE, Metrics
from gsvis.serve.parts import respond
from gsvis.serve.scenes import ServedScene
from gsvis.stream.wire import FAULTS, ServerFault

__all__ = ["AppConfig", "build_app"]

_ENDED = 1012  # close code of uvicorn when the server stops
_LEFT = (1000, 1001)
_HEALTH = "/healthz"
_SHORT_OF = (errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.ENOBUFS, errno.EAGAIN)  # errors that pass


@dataclass(frozen=True)
class AppConfig:
    """Settings of an application.

    Attributes:
        token: Token that clients must send; None accepts every client.
        origins: Origins of pages that may open streams, such as "https://example.org"; "*" means every origin. Pages of
            the server's own address always may.
        limits: Bounds.
        abr: How streams adapt.
        hosts: Accepted names in the Host header, without port; ".example.org" means every name below example.org, "*"
            every name. Addresses and localhost are always accepted; `Server` adds the name that it listens on.
        proxies: Addresses or networks of proxies whose X-Forwarded-For is trusted, such as "127.0.0.1".

    Raises:
        ValueError: If the token is empty or not ASCII, or a proxy is neither an address nor a network.
    """

    token: str | None = field(default=None, repr=False)
    origins: tuple[str, ...] = ()
    limits: Limits = field(default_factory=Limits)
    abr: AbrConfig = field(default_factory=AbrConfig)
    hosts: tuple[str, ...] = ()
    proxies: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        Proxies(self.proxies)
        if self.token is not None and not (self.token and self.token.isascii() and self.token.isprintable()):
            raise ValueError("token: expected printable ASCII characters, got none or others")


class _App:
    def __init__(
        self,
        scenes: Mapping[str, ServedScene],
        config: AppConfig,
        metrics: Metrics,
        log: EventLog,
        setting: Setting,
    ) -> None:
        self.scenes, self.config, self.metrics, self.log, self.setting = scenes, config, metrics, log, setting
        self.numbers = itertools.count(1)
        self.seats, self.proxies = Seats(config.limits), Proxies(config.proxies)

    async def stream(self, socket: WebSocket) -> None:
        """Serve one client, from its request to its end."""
        number, peer = next(self.numbers), self.place(socket)
        name = socket.path_params.get("name") or next(iter(self.scenes))
        if not self.admits(socket):
            return await self.deny(socket, number, "token", "a token is needed\n", 401)
        if not _same_origin(socket, self.config.origins):
            line = "pages of this origin may not stream from here\n"
            return await self.deny(socket, number, "origin", line, 403, _why_not_origin(socket))
        if name not in self.scenes:
            return await self.deny(socket, number, "unknown", "no such scene\n", 404)
        await socket.accept()
        served, owner = self.scenes[name], owner_of(self.address(socket))
        if served.fault:
            return await self.turn_away(socket, number, "damaged", "the scene is damaged on the server", "refused")
        if why := self.seats.why_not(owner):
            return await self.turn_away(socket, number, why, "too many clients; try again later", "too-many")
        self.log("accepted", client=number, peer=peer, scene=name, clients=self.seats.taken)
        await self.serve(socket, served, number, owner)
        return None

    async def serve(self, socket: WebSocket, served: ServedScene, number: int, owner: str) -> None:
        """Serve a client that is accepted; it takes a seat after its HELLO."""
        guard = socket.scope.get("extensions", {}).get(GUARD)

        def seat() -> str:
            why = self.seats.take(owner, connection)
            if not why:
                self.metrics.clients.set(self.seats.taken)
                if guard is not None:
                    guard.stream()
            return why

        connection = Connection(_Peer(socket), served, self.setting, number, seat)
        try:
            await connection.run()
        finally:
            self.seats.leave(owner, connection)
            self.metrics.clients.set(self.seats.taken)

    async def deny(
        self, socket: WebSocket, number: int, reason: str, line: str, status: int, why: str | None = None
    ) -> None:
        """Refuse a stream with an HTTP answer."""
        self.metrics.refused.add(of=reason)
        self.log("refused", logging.WARNING, client=number, peer=self.place(socket), reason=reason, why=why)
        await socket.send_denial_response(PlainTextResponse(line, status))

    async def turn_away(self, socket: WebSocket, number: int, reason: str, line: str, fault: str) -> None:
        """Refuse a stream with an error of the protocol."""
        self.metrics.refused.add(of=reason)
        self.log("refused", logging.WARNING, client=number, peer=self.place(socket), reason=reason)
        try:
            await socket.send_bytes(ServerFault(FAULTS[fault], line).to_bytes())
            await socket.close(1013, reason)
        except (WebSocketDisconnect, RuntimeError):
            pass  # the client has gone already

    async def index(self, request: Request) -> Response:
        """Return the scenes as JSON; addresses are relative, since a proxy may serve them under a prefix."""
        if not self.admits(request):
            return self.unauthorized(request)
        rows = [
            {
                "name": served.name,
                "state": "refused" if served.fault else "ready",
                "gaussians": served.opened.about.gaussians if served.opened else None,
                "stream": f"stream/{served.name}",
                "manifest": f"packages/{served.name}/manifest.json",
            }
            for served in self.scenes.values()
        ]
        return JSONResponse({"format": "gsvis-server", "version": 1, "scenes": rows})

    async def health(self, request: Request) -> Response:
        """Answer 200 while a scene is served."""
        ready = sum(not served.fault for served in self.scenes.values())
        status = {"status": "ok" if ready else "no scene", "scenes": ready, "refused": len(self.scenes) - ready}
        return JSONResponse(status, 200 if ready else 503, {"cache-control": "no-store"})

    async def counts(self, request: Request) -> Response:
        """Answer with metrics for Prometheus."""
        if not self.admits(request):
            return self.unauthorized(request)
        return Response(self.metrics.text(), media_type=CONTENT_TYPE)

    async def file(self, request: Request) -> Response:
        """Return a file of a package."""
        if not self.admits(request):
            return self.unauthorized(request)
        served = self.scenes.get(request.path_params["name"])
        name = request.path_params.get("part") or "manifest.json"
        if served is None:
            response: Response = PlainTextResponse("no such scene\n", 404)
        else:
            try:
                response = await respond(request, served.path, name, private=self.config.token is not None)
            except FormatError as error:
                self.metrics.faults.add(of=served.name)
                self.log("damaged", logging.ERROR, scene=served.name, why=str(error))
                response = PlainTextResponse("this part is damaged on the server\n", 500)
            except OSError as error:
                response = self.unread(served, error)
        self.metrics.parts.add(of=str(response.status_code))
        self.metrics.parts_bytes.add(len(response.body))
        return response

    def unread(self, served: ServedScene, error: OSError) -> Response:
        """Answer 503 if the server is short of a resource for a moment, 500 if a file cannot be read."""
        self.log("failed", logging.ERROR, scene=served.name, why=f"{type(error).__name__}: {error}")
        if error.errno in _SHORT_OF:
            return PlainTextResponse("the server is busy; try again later\n", 503, {"retry-after": "1"})
        self.metrics.faults.add(of=served.name)
        return PlainTextResponse("this file cannot be read on the server\n", 500)

    def admits(self, asked: HTTPConnection) -> bool:
        """Return whether the request has the token; true if none is required."""
        token = self.config.token
        if token is None:
            return True
        kind, _, shown = asked.headers.get("authorization", "").partition(" ")
        if kind.lower() != "bearer":
            shown = asked.query_params.get("token", "")
        return hmac.compare_digest(shown.strip().encode("utf-8", "replace"), token.encode())

    def address(self, asked: HTTPConnection) -> str:
        """Return the address of a client: that of its socket, or the one that trusted proxies report."""
        forwarded = asked.headers.getlist("x-forwarded-for")
        return self.proxies.client_of(asked.client.host if asked.client else "-", forwarded)

    def place(self, asked: HTTPConnection) -> str:
        """Return the address of a client, for the log."""
        address = self.address(asked)
        return f"{address}:{asked.client.port}" if asked.client and asked.client.host == address else address

    def unauthorized(self, request: Request) -> Response:
        """Answer 401: the token is missing or wrong."""
        self.metrics.refused.add(of="token")
        self.log("refused", logging.WARNING, peer=self.place(request), reason="token")
        return PlainTextResponse("a token is needed\n", 401, {"www-authenticate": "Bearer"})


class _Peer:
    """A WebSocket of Starlette, with the interface that a connection needs."""

    def __init__(self, socket: WebSocket) -> None:
        self._socket = socket

    async def receive(self) -> bytes:
        message = await self._socket.receive()
        if message["type"] == "websocket.disconnect":
            code = message.get("code", 1005)
            raise GoneError(
                "ending" if code == _ENDED else "too-large" if code == 1009 else "left" if code in _LEFT else "lost"
            )
        data = message.get("bytes")
        if data is None:
            raise ProtocolError("message: expected bytes, got text")
        return bytes(data)

    async def send(self, data: bytes) -> None:
        try:
            await self._socket.send_bytes(data)
        except (WebSocketDisconnect, RuntimeError) as error:
            raise GoneError("lost") from error

    async def close(self, reason: str) -> None:
        try:
            await self._socket.close(1008, reason)
        except (WebSocketDisconnect, RuntimeError) as error:
            raise GoneError("lost") from error

    def abort(self) -> None:
        guard = self._socket.scope.get("extensions", {}).get(GUARD)
        if guard is not None:
            guard.cut()


def _same_origin(socket: WebSocket, allowed: tuple[str, ...]) -> bool:
    """Return whether the origin of a request is allowed. Programs send no Origin; a page sends its own."""
    origin = socket.headers.get("origin")
    if origin is None or "*" in allowed or origin in allowed:
        return True
    try:
        return urlsplit(origin).netloc.lower() == socket.headers.get("host", "").lower() != ""
    except ValueError:  # such as "http://["
        return False


def _why_not_origin(socket: WebSocket) -> str:
    origin, host = socket.headers.get("origin"), socket.headers.get("host")
    return (
        f"Origin is {origin}, Host is {host}; a proxy in front has to pass Host on, or name the origin with --origins"
    )


class _Front:
    """Refuse requests by unknown host names, and log a failing request in one line."""

    def __init__(self, inner: ASGIApp, app: _App) -> None:
        self._inner, self._app = inner, app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._inner(scope, receive, send)
            return
        if self._is_good(scope):
            await self._pass_on(scope, receive, send)
            return
        app, asked = self._app, HTTPConnection(scope)
        app.metrics.refused.add(of="host")
        why = f"Host is {asked.headers.get('host')}; name it with --hosts if it is this server"
        app.log("refused", logging.WARNING, peer=app.place(asked), reason="host", why=why)
        answer = PlainTextResponse("this server is not known by this name\n", 421)
        if scope["type"] == "websocket":
            await WebSocket(scope, receive, send).send_denial_response(answer)
        else:
            await answer(scope, receive, send)

    async def _pass_on(self, scope: Scope, receive: Receive, send: Send) -> None:
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
            peer = self._app.place(HTTPConnection(scope))
            self._app.log("failed", logging.ERROR, peer=peer, why=f"{type(error).__name__}: {error}")
            LOGGER.debug("request of %s", peer, exc_info=error)
            with suppress(Exception):
                if scope["type"] == "websocket":
                    await send({"type": "websocket.close", "code": 1011})
                elif not begun:
                    await PlainTextResponse("the server failed; try again later\n", 500)(scope, receive, send)

    def _is_good(self, scope: Scope) -> bool:
        host = HTTPConnection(scope).headers.get("host")
        if host is None:  # no page sends such a request
            return True
        return scope["path"] == _HEALTH or is_known_host(host, self._app.config.hosts)


def build_app(
    scenes: Mapping[str, ServedScene],
    config: AppConfig | None = None,
    *,
    metrics: Metrics | None = None,
    log: EventLog | None = None,
    planners: Executor | None = None,
    pace: Pace | None = None,
    clock: Clock | None = None,
) -> Starlette:
    """Return the application.

    Args:
        scenes: Scenes by name, from `open_scenes`; `/stream` without a name serves the first.
        config: Settings; None means `AppConfig()`.
        metrics: Metrics to update; None means new ones.
        log: Log of events; None means a new one.
        planners: Executor that plans batches; None plans in the thread of the event loop.
        pace: How late the server runs, updated by the caller; None means that it is on time.
        clock: Clock of the deadlines; None means `Clock()`.
    """
    config, metrics, log = config or AppConfig(), metrics or Metrics(), log or EventLog()
    setting = Setting(config.limits, metrics, log, config.abr, clock or Clock(), planners=planners, pace=pace or Pace())
    app = _App(scenes, config, metrics, log, setting)
    found = Starlette(
        routes=[
            Route("/", app.index, methods=["GET"]),
            Route(_HEALTH, app.health, methods=["GET"]),
            Route("/metrics", app.counts, methods=["GET"]),
            Route("/packages/{name}/manifest.json", app.file, methods=["GET"]),
            Route("/packages/{name}/parts/{part}", app.file, methods=["GET"]),
            WebSocketRoute("/stream", app.stream),
            WebSocketRoute("/stream/{name}", app.stream),
        ],
        middleware=[Middleware(_Front, app)],
    )
    found.router.redirect_slashes = False  # a redirect would lack the prefix of a proxy
    return found
