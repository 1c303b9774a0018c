"""The addresses of a server, as an ASGI application: streams, files of packages, health, metrics.

    /                                   the scenes, as JSON
    /stream, /stream/NAME               WebSocket: the protocol of docs/streaming.md
    /packages/NAME/manifest.json        files of a package, for clients that fetch parts themselves
    /packages/NAME/parts/HASH.arrow
    /healthz, /metrics

With a token, all but `/healthz` want it: as `Authorization: Bearer TOKEN`, or `?token=TOKEN` where a browser cannot set
headers. A WebSocket that a page of another origin opens is turned away, unless that origin is allowed.
"""

from __future__ import annotations

import hmac
import itertools
import logging
import time
from collections.abc import Mapping
from concurrent.futures import Executor
from dataclasses import dataclass, field
from urllib.parse import urlsplit

from starlette.applications import Starlette
from starlette.requests import HTTPConnection, Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from gsvis.abr.scheduler import SchedulerConfig
from gsvis.errors import FormatError, ProtocolError
from gsvis.serve._log import EventLog
from gsvis.serve._protocols import ABORT
from gsvis.serve.connection import Connection, GoneError, Setting
from gsvis.serve.limits import Limits, Pace
from gsvis.serve.metrics import CONTENT_TYPE, Metrics
from gsvis.serve.parts import respond
from gsvis.serve.scenes import ServedScene
from gsvis.stream.wire import FAULTS, ServerFault

__all__ = ["AppConfig", "build_app"]

_ENDED = 1012  # what uvicorn closes with when the server stops
_LEFT = (1000, 1001)


@dataclass(frozen=True)
class AppConfig:
    """How an application serves.

    Attributes:
        token: What clients have to show; None lets everybody in.
        origins: Origins of pages that may open streams, such as "https://example.org"; "*" is every one. Pages of the
            server's own address may always.
        limits: Bounds.
        scheduler: Of every client.

    Raises:
        ValueError: If the token is empty, or not ASCII.
    """

    token: str | None = field(default=None, repr=False)
    origins: tuple[str, ...] = ()
    limits: Limits = field(default_factory=Limits)
    scheduler: SchedulerConfig = field(default_factory=SchedulerConfig)

    def __post_init__(self) -> None:
        if self.token is not None and not (self.token and self.token.isascii() and self.token.isprintable()):
            raise ValueError("token: expected printable ASCII characters, got none or others")


class _App:
    def __init__(
        self,
        scenes: Mapping[str, ServedScene],
        config: AppConfig,
        metrics: Metrics,
        log: EventLog,
        planners: Executor | None,
        pace: Pace,
    ) -> None:
        self.scenes, self.config, self.metrics, self.log = scenes, config, metrics, log
        self.setting = Setting(config.limits, metrics, log, config.scheduler, time.monotonic, planners, pace)
        self.numbers = itertools.count(1)
        self.clients = 0

    async def stream(self, socket: WebSocket) -> None:
        """One client, from its request to its end."""
        number, peer = next(self.numbers), _place(socket)
        name = socket.path_params.get("name") or next(iter(self.scenes))
        if not self.admits(socket):
            return await self.deny(socket, number, "token", "a token is needed\n", 401)
        if not _same_origin(socket, self.config.origins):
            return await self.deny(socket, number, "origin", "pages of this origin may not stream from here\n", 403)
        if name not in self.scenes:
            return await self.deny(socket, number, "unknown", "no such scene\n", 404)
        await socket.accept()
        served, most = self.scenes[name], self.config.limits.connections
        if served.fault:
            return await self.turn_away(socket, number, "damaged", "the scene is damaged on the server", "refused")
        if self.clients >= most:
            return await self.turn_away(socket, number, "too-many", "too many clients; try again later", "too-many")
        self.clients += 1
        self.metrics.clients.set(self.clients)
        self.log("accepted", client=number, peer=peer, scene=name, clients=self.clients)
        try:
            await Connection(_Peer(socket), served, self.setting, number).run()
        finally:
            self.clients -= 1
            self.metrics.clients.set(self.clients)
        return None

    async def deny(self, socket: WebSocket, number: int, reason: str, line: str, status: int) -> None:
        """No stream: an answer of HTTP."""
        self.metrics.refused.add(of=reason)
        self.log("refused", logging.WARNING, client=number, peer=_place(socket), reason=reason)
        await socket.send_denial_response(PlainTextResponse(line, status))

    async def turn_away(self, socket: WebSocket, number: int, reason: str, line: str, fault: str) -> None:
        """No stream: a word of the protocol."""
        self.metrics.refused.add(of=reason)
        self.log("refused", logging.WARNING, client=number, peer=_place(socket), reason=reason)
        try:
            await socket.send_bytes(ServerFault(FAULTS[fault], line).to_bytes())
            await socket.close(1013, reason)
        except (WebSocketDisconnect, RuntimeError):
            pass  # it has gone already

    async def index(self, request: Request) -> Response:
        """The scenes; addresses are relative, since a proxy may serve them under a prefix."""
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
        """200 while a scene is served."""
        ready = sum(not served.fault for served in self.scenes.values())
        status = {"status": "ok" if ready else "no scene", "scenes": ready, "refused": len(self.scenes) - ready}
        return JSONResponse(status, 200 if ready else 503, {"cache-control": "no-store"})

    async def counts(self, request: Request) -> Response:
        """For Prometheus."""
        if not self.admits(request):
            return self.unauthorized(request)
        return Response(self.metrics.text(), media_type=CONTENT_TYPE)

    async def file(self, request: Request) -> Response:
        """A file of a package."""
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
        self.metrics.parts.add(of=str(response.status_code))
        self.metrics.parts_bytes.add(len(response.body))
        return response

    def admits(self, asked: HTTPConnection) -> bool:
        """Whether the request shows the token."""
        token = self.config.token
        if token is None:
            return True
        kind, _, shown = asked.headers.get("authorization", "").partition(" ")
        if kind.lower() != "bearer":
            shown = asked.query_params.get("token", "")
        return hmac.compare_digest(shown.strip().encode("utf-8", "replace"), token.encode())

    def unauthorized(self, request: Request) -> Response:
        """401."""
        self.metrics.refused.add(of="token")
        self.log("refused", logging.WARNING, peer=_place(request), reason="token")
        return PlainTextResponse("a token is needed\n", 401, {"www-authenticate": "Bearer"})


class _Peer:
    """A WebSocket of Starlette as a connection needs it."""

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
        abort = self._socket.scope.get("extensions", {}).get(ABORT)
        if abort is not None:
            abort()


def _place(asked: HTTPConnection) -> str:
    return f"{asked.client.host}:{asked.client.port}" if asked.client else "-"


def _same_origin(socket: WebSocket, allowed: tuple[str, ...]) -> bool:
    """Whether a page may open this: programs send no Origin, a page sends that of its own address."""
    origin = socket.headers.get("origin")
    if origin is None or "*" in allowed or origin in allowed:
        return True
    return urlsplit(origin).netloc.lower() == socket.headers.get("host", "").lower() != ""


def build_app(
    scenes: Mapping[str, ServedScene],
    config: AppConfig | None = None,
    *,
    metrics: Metrics | None = None,
    log: EventLog | None = None,
    planners: Executor | None = None,
    pace: Pace | None = None,
) -> Starlette:
    """The application.

    Args:
        scenes: As `open_scenes` gives them; `/stream` without a name is the first.
        config: None means `AppConfig()`.
        metrics: Where to count; None counts apart.
        log: Where to say what happened.
        planners: Where batches are planned; None plans in the thread of the event loop.
        pace: How far behind the server is, kept by whoever runs it; None takes it to be on time.
    """
    app = _App(scenes, config or AppConfig(), metrics or Metrics(), log or EventLog(), planners, pace or Pace())
    return Starlette(
        routes=[
            Route("/", app.index, methods=["GET"]),
            Route("/healthz", app.health, methods=["GET"]),
            Route("/metrics", app.counts, methods=["GET"]),
            Route("/packages/{name}/manifest.json", app.file, methods=["GET"]),
            Route("/packages/{name}/parts/{part}", app.file, methods=["GET"]),
            WebSocketRoute("/stream", app.stream),
            WebSocketRoute("/stream/{name}", app.stream),
        ]
    )
