"""The addresses of a server, as an ASGI application: pages, streams, files of packages, facts, health, metrics.

    /                                   the scenes: a page for browsers, JSON for everybody else
    /view/NAME, /viewer/FILE            the viewer's page and its files
    /stream, /stream/NAME               WebSocket: the protocol of docs/streaming.md
    /packages/NAME/manifest.json        files of a package, for clients that fetch parts themselves
    /packages/NAME/parts/HASH.arrow     and HASH.bin
    /scenes/NAME/why/ID                 facts for a viewer, as JSON; also /scenes/NAME/cells, floor, seen, walk
    /scenes/NAME/FILE                   files of a static scene
    /healthz, /metrics

With a token, all addresses but `/healthz` require it: as `Authorization: Bearer TOKEN`, as a cookie that the server
sets for a page opened with `?token=TOKEN`, or over a WebSocket as its first message. The server refuses pages of other
origins, unless they are allowed. Over a WebSocket it accepts first, because a page cannot read why a handshake fails.
Requests by an unknown host name get 421, except for `/healthz`: a page could have made its own name point here.
"""

from __future__ import annotations

import errno
import itertools
import logging
import re
from collections.abc import Awaitable, Callable, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import quote, urlencode

from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import HTTPConnection, Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from gsvis.abr.config import AbrConfig
from gsvis.errors import FormatError, ProtocolError
from gsvis.files.origins import parse_origins
from gsvis.serve._addresses import Proxies, owner_of
from gsvis.serve._entry import Cors, Entry
from gsvis.serve._front import HEALTH, Front
from gsvis.serve._log import EventLog
from gsvis.serve._peer import SocketPeer
from gsvis.serve._protocols import GUARD
from gsvis.serve._questions import FACTS, Questions
from gsvis.serve.clock import Clock
from gsvis.serve.connection import Connection, GoneError, Setting
from gsvis.serve.limits import Limits, Pace, Seats
from gsvis.serve.metrics import CONTENT_TYPE, Metrics
from gsvis.serve.pages import Pages, wants_page
from gsvis.serve.parts import node_folder, respond
from gsvis.serve.scenes import ServedScene
from gsvis.serve.siblings import Siblings
from gsvis.serve.sites import SCENE
from gsvis.stream import Token, parse_client
from gsvis.stream.wire import CLOSE_CODES, FAULTS, POLICY, ServerFault

__all__ = ["AppConfig", "build_app"]

_SHORT_OF = (errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.ENOBUFS, errno.EAGAIN)  # errors that pass
_LIST = "list.html"
_ID = re.compile(r"[0-9]{1,10}")


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
        opens: Other origins that the viewer's pages may read scenes from, such as "https://cdn.example.org"; the token
            is never sent there.

    Raises:
        ValueError: If the token is empty or not ASCII, one of `opens` is no origin, or a proxy is
            neither an address nor a network.
    """

    token: str | None = field(default=None, repr=False)
    origins: tuple[str, ...] = ()
    limits: Limits = field(default_factory=Limits)
    abr: AbrConfig = field(default_factory=AbrConfig)
    hosts: tuple[str, ...] = ()
    proxies: tuple[str, ...] = ()
    opens: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        Proxies(self.proxies)
        parse_origins("opens", self.opens)
        if self.token is not None and not (self.token and self.token.isascii() and self.token.isprintable()):
            got = "an empty text" if not self.token else "a character that is none"  # never the token itself
            raise ValueError(f"token: expected printable ASCII characters, got {got}")


class _App:
    """The answers of the application, by route."""

    def __init__(
        self,
        scenes: Mapping[str, ServedScene],
        config: AppConfig,
        metrics: Metrics,
        log: EventLog,
        setting: Setting,
        siblings: Siblings | None,
    ) -> None:
        self.siblings = siblings
        others = {} if siblings is None else {"others": siblings.seats_of}
        self.scenes = scenes
        self.config = config
        self.metrics = metrics
        self.log = log
        self.setting = setting
        self.numbers = itertools.count(1)
        self.questions = Questions(setting.clock.now)
        self.seats = Seats(config.limits, **others)
        self.proxies = Proxies(config.proxies)
        self.entry = Entry(config.token, config.origins)
        self.pages = Pages(origins=config.origins, opens=config.opens)

    async def stream(self, socket: WebSocket) -> None:
        """Serve one client, from its request to its end."""
        number = next(self.numbers)
        clock = self.setting.clock
        name = socket.path_params.get("name") or next(iter(self.scenes))
        began = clock.now()
        await socket.accept()
        if not self.entry.allows(socket):
            line = "pages of this origin may not stream from here"
            return await self.turn_away(socket, number, "origin", line, why=_why_not_origin(socket))
        if not self.entry.admits(socket) and not await self.is_token_sent(socket, number):
            return None
        served = self.scenes.get(name)
        owner = owner_of(self.address(socket))
        if served is None:
            return await self.turn_away(socket, number, "unknown", "no such scene")
        if served.fault:
            return await self.turn_away(socket, number, "damaged", "the scene is damaged on the server")
        if not served.is_streamed:
            line = f"not streamed; read {_row(served)['static']}"
            return await self.turn_away(socket, number, "static", line)
        if why := self.seats.why_not(owner):
            return await self.turn_away(socket, number, why, "too many clients; try again later", "too-many")
        self.log("accepted", client=number, peer=self.place(socket), scene=name, clients=self.seats.taken)
        await self.serve(socket, served, number, owner, self.config.limits.handshake_s - (clock.now() - began))
        return None

    async def is_token_sent(self, socket: WebSocket, number: int) -> bool:
        """Return whether the first message is the right TOKEN; turn the client away otherwise."""
        said: object = None
        if self.entry.token_in(socket) is None:
            receiving = SocketPeer(socket).receive()
            try:
                said = parse_client(await self.setting.clock.within(self.config.limits.handshake_s, receiving))
            except (TimeoutError, ProtocolError):
                pass
            except GoneError:
                self.metrics.refused.add(of="lost")
                return False
        if isinstance(said, Token) and self.entry.is_right(said.text):
            return True
        await self.turn_away(socket, number, "token", "a token is needed")
        return False

    async def serve(self, socket: WebSocket, served: ServedScene, number: int, owner: str, greet_s: float) -> None:
        """Serve a client that is accepted; it takes a seat after its HELLO."""
        guard = socket.scope.get("extensions", {}).get(GUARD)

        def seat() -> str:
            """Take a seat; return why there is none, or ""."""
            why = self.seats.take(owner, connection)
            if not why:
                self.metrics.clients.set(self.seats.taken)
                if guard is not None:
                    guard.stream()
            return why

        connection = Connection(SocketPeer(socket), served, self.setting, number, seat, greet_s=max(greet_s, 0.0))
        try:
            await connection.run()
        finally:
            self.seats.leave(owner, connection)
            self.metrics.clients.set(self.seats.taken)

    async def turn_away(
        self, socket: WebSocket, number: int, reason: str, line: str, fault: str = "refused", *, why: str | None = None
    ) -> None:
        """Refuse an accepted stream with an error of the protocol, the only answer that a page can read."""
        self.metrics.refused.add(of=reason)
        self.log("refused", logging.WARNING, client=number, peer=self.place(socket), reason=reason, why=why)
        code = FAULTS[fault]
        try:
            await socket.send_bytes(ServerFault(code, line).to_bytes())
            await socket.close(CLOSE_CODES.get(code, POLICY), reason)
        except (WebSocketDisconnect, RuntimeError):
            pass  # the client has gone already

    async def index(self, request: Request) -> Response:
        """Return the scenes; addresses are relative, since a proxy may serve them under a prefix."""
        if not self.entry.admits(request):
            return self.unauthorized(request)
        if wants_page(request):
            return self.enter(request) if "token" in request.query_params else self.pages.page(request, _LIST)
        rows = [_row(served) for served in self.scenes.values()]
        answer = {"format": "gsvis-server", "version": 1, "scenes": rows}
        return JSONResponse(answer, headers={"vary": "Accept", "cache-control": "no-cache"})

    def enter(self, request: Request) -> Response:
        """Answer a browser that shows the token: keep it as a cookie, and go on without it in the address."""
        fields = [(key, value) for key, value in request.query_params.multi_items() if key != "token"]
        name = next((value for key, value in fields if key == "scene"), "")
        query = urlencode([(key, value) for key, value in fields if key != "scene"])
        to = f"view/{quote(name, safe='')}" if name in self.scenes else "./"
        response = self.pages.enter(f"{to}?{query}" if query else to)
        is_proxied = request.client is not None and request.client.host in self.proxies
        is_secure = is_proxied and request.headers.get("x-forwarded-proto") == "https"
        if self.config.token is not None:
            self.entry.set_cookie(response, is_secure=is_secure or request.url.scheme == "https")
        return response

    async def view(self, request: Request) -> Response:
        """Return the viewer's page of a scene."""
        name = request.path_params["name"]
        shown = request.query_params
        if not self.entry.admits(request):
            return self.unauthorized(request)
        if "token" in shown:  # the cookie has to come from the first folder, or it would not count there
            fields = [(key, value) for key, value in shown.multi_items() if key != "scene"]
            to = "../?" + urlencode([*fields, ("scene", name)])
            return Response(status_code=303, headers={"location": to, "referrer-policy": "no-referrer"})
        if name not in self.scenes:
            return self.pages.say("No such scene", f"This server has no scene {name[:100]!r}.", 404)
        return self.pages.view(request, self.scenes[name].is_streamed)

    async def viewer_file(self, request: Request) -> Response:
        """Return a file of the viewer."""
        if not self.entry.admits(request):
            return self.unauthorized(request)
        return self.pages.file(request, request.path_params["file"])

    def publish(self) -> None:
        """Tell the other processes of the server about this one."""
        if self.siblings is not None:
            self.siblings.publish(self.metrics, self.seats.by_owner, self.ready())

    def ready(self) -> tuple[int, int]:
        """Return how many scenes are served, and how many refused."""
        ready = sum(not served.fault for served in self.scenes.values())
        return ready, len(self.scenes) - ready

    async def health(self, request: Request) -> Response:
        """Answer 200 while a scene is served."""
        ready, refused = self.ready()
        status: dict[str, object] = {"status": "ok" if ready else "no scene", "scenes": ready, "refused": refused}
        if self.siblings is not None:
            status["processes"] = self.siblings.alive
        return JSONResponse(status, 200 if ready else 503, {"cache-control": "no-store"})

    async def counts(self, request: Request) -> Response:
        """Answer with metrics for Prometheus."""
        if not self.entry.admits(request):
            return self.unauthorized(request)
        text = self.metrics.text() if self.siblings is None else self.siblings.text(self.metrics)
        return Response(text, media_type=CONTENT_TYPE)

    async def file(self, request: Request) -> Response:
        """Return a file of a package, or of a world and its packages."""

        async def read(served: ServedScene) -> Response:
            given = request.path_params
            folder = served.path
            if "node" in given:
                try:
                    folder = node_folder(folder, given["node"])
                except FileNotFoundError:
                    return PlainTextResponse("no such file\n", 404)
            name = given.get("part") or given.get("table") or request.url.path.rpartition("/")[2]
            return await respond(request, folder, name, private=self.config.token is not None)

        return await self.answer(request, read)

    async def site_file(self, request: Request) -> Response:
        """Return a file of a static scene."""

        async def read(served: ServedScene) -> Response:
            if served.site is None:
                return PlainTextResponse("no such file\n", 404)
            name = request.path_params["file"]
            return await served.site.respond(request, name, private=self.config.token is not None)

        return await self.answer(request, read)

    async def fact(self, request: Request) -> Response:
        """Return facts about a scene as JSON: why a Gaussian is there, or the last part of the address."""

        async def find(served: ServedScene) -> Response:
            about_cells = request.url.path.endswith("/cells")  # those of a world are of many grids
            if not served.is_streamed or (served.is_world and about_cells) or served.fault:
                return PlainTextResponse("nothing is known of this scene\n", 404)
            given = request.path_params.get("id")
            if given is None:
                return await self.questions.answer(served, request.url.path.rpartition("/")[2])
            if not _ID.fullmatch(given):
                return PlainTextResponse("no such Gaussian\n", 404)
            return await self.questions.answer(served, "why", int(given))

        return await self.answer(request, find)

    async def answer(self, request: Request, read: Callable[[ServedScene], Awaitable[Response]]) -> Response:
        """Answer a request about a scene; count it, and log a fault of the scene."""
        if not self.entry.admits(request):
            return self.unauthorized(request)
        served = self.scenes.get(request.path_params["name"])
        if served is None:
            response: Response = PlainTextResponse("no such scene\n", 404)
        else:
            try:
                response = await read(served)
            except FormatError as error:
                self.metrics.scenes.faults.add(of=served.name)
                self.log("damaged", logging.ERROR, scene=served.name, why=str(error))
                response = PlainTextResponse("this part is damaged on the server\n", 500)
            except OSError as error:
                response = self.unread(served, error)
        self.metrics.parts.add(of=str(response.status_code))
        if request.method == "GET":
            self.metrics.parts_bytes.add(int(response.headers.get("content-length", 0)))
        return response

    def unread(self, served: ServedScene, error: OSError) -> Response:
        """Answer 503 if the server is short of a resource for a moment, 500 if a file cannot be read."""
        self.log("failed", logging.ERROR, scene=served.name, why=f"{type(error).__name__}: {error}")
        if error.errno in _SHORT_OF:
            return PlainTextResponse("the server is busy; try again later\n", 503, {"retry-after": "1"})
        self.metrics.scenes.faults.add(of=served.name)
        return PlainTextResponse("this file cannot be read on the server\n", 500)

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
        if wants_page(request):
            return self.pages.ask_token(request.query_params.multi_items())
        return PlainTextResponse("a token is needed\n", 401, {"www-authenticate": "Bearer"})


def _row(served: ServedScene) -> dict[str, Any]:
    """Return what `/` says of a scene; its addresses are relative to `/` and percent-encoded."""
    name = quote(served.name, safe="")
    streamed = not served.site
    return {
        "name": served.name,
        "state": "refused" if served.fault else "ready",
        "gaussians": served.gaussians,
        "view": f"view/{name}",
        "stream": f"stream/{name}" if streamed else None,
        "manifest": f"packages/{name}/manifest.json" if streamed and not served.is_world else None,
        "static": None if streamed else f"scenes/{name}/{SCENE}",
        "preparing": served.preparing,
    }


def _why_not_origin(socket: WebSocket) -> str:
    """Return why the origin of a page is refused, for the log."""
    origin = socket.headers.get("origin")
    host = socket.headers.get("host")
    return (
        f"Origin is {origin}, Host is {host}; a proxy in front has to pass Host on, or name the origin with --origins"
    )


def build_app(
    scenes: Mapping[str, ServedScene],
    config: AppConfig | None = None,
    *,
    metrics: Metrics | None = None,
    log: EventLog | None = None,
    planners: Executor | None = None,
    pace: Pace | None = None,
    clock: Clock | None = None,
    siblings: Siblings | None = None,
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
        siblings: Other processes of the server; None if there are none. `state.publish` of the result tells them of
            this one.
    """
    config = config or AppConfig()
    metrics = metrics or Metrics()
    log = log or EventLog()
    setting = Setting(config.limits, metrics, log, config.abr, clock or Clock(), planners=planners, pace=pace or Pace())
    app = _App(scenes, config, metrics, log, setting, siblings)
    found = Starlette(
        routes=[
            Route("/", app.index, methods=["GET"]),
            Route(HEALTH, app.health, methods=["GET"]),
            Route("/metrics", app.counts, methods=["GET"]),
            Route("/packages/{name}/manifest.json", app.file, methods=["GET"]),
            Route("/packages/{name}/parts/{part}", app.file, methods=["GET"]),
            Route("/packages/{name}/packages/{node}/manifest.json", app.file, methods=["GET"]),
            Route("/packages/{name}/packages/{node}/parts/{part}", app.file, methods=["GET"]),
            Route("/packages/{name}/beyond/{table}", app.file, methods=["GET"]),
            Route("/packages/{name}/world.json", app.file, methods=["GET"]),
            Route("/view/{name}", app.view, methods=["GET"]),
            Route("/viewer/{file}", app.viewer_file, methods=["GET"]),
            Route("/scenes/{name}/why/{id}", app.fact, methods=["GET"]),
            *(Route(f"/scenes/{{name}}/{fact}", app.fact, methods=["GET"]) for fact in FACTS),
            Route("/scenes/{name}/{file}", app.site_file, methods=["GET"]),
            WebSocketRoute("/stream", app.stream),
            WebSocketRoute("/stream/{name}", app.stream),
        ],
        middleware=[
            Middleware(Front, config.hosts, app.place, metrics, log),
            Middleware(Cors, app.entry),
        ],
    )
    found.state.publish = app.publish
    found.router.redirect_slashes = False  # a redirect would lack the prefix of a proxy
    return found
