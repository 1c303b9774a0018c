"""A server: an application bound to an address, run until stopped, in this thread or in its own."""

from __future__ import annotations

import asyncio
import itertools
import logging
import socket
import ssl
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from os import PathLike
from typing import Any
from urllib.parse import quote, urlsplit

import uvicorn

from gsvis import _check
from gsvis.serve._addresses import Proxies
from gsvis.serve._door import Door
from gsvis.serve._guard import Shared
from gsvis.serve._head import MOST_BYTES
from gsvis.serve._log import EventLog
from gsvis.serve._protocols import Plain, Socket
from gsvis.serve.app import AppConfig, build_app
from gsvis.serve.clock import Clock
from gsvis.serve.hang import HangWatch
from gsvis.serve.limits import Pace, RateBucket
from gsvis.serve.metrics import Metrics
from gsvis.serve.precedence import Precedence, run
from gsvis.serve.scenes import ServedScene
from gsvis.serve.siblings import Siblings
from gsvis.serve.turns import Readings
from gsvis.serve.upkeep import LOOK_S, Upkeep

__all__ = ["Address", "Server", "is_loopback", "listen", "page_of", "url_of"]

_LATE_S = 0.2
_LOOKS = 4  # looks between two publications of what siblings read
_BEAT_S = 1.0  # seconds between two signs of life
_STOP_S = 3.0  # seconds that connections have to end when the server stops
_NEVER = 1_000_000  # seconds; for time-outs of uvicorn that the guards replace
_LINES_PER_S = 20.0  # most lines a second of each logger of asyncio and uvicorn


@dataclass(frozen=True)
class Address:
    """Where a server listens.

    Attributes:
        host: Name or number; the default is reachable from this machine only.
        port: Port number; 0 takes a free one.
        ssl_certfile: Certificate chain, PEM; None serves without TLS.
        ssl_keyfile: Key of the certificate; None if it is in the same file.
        ssl_keyfile_password: Password of the key.
    """

    host: str = "127.0.0.1"
    port: int = 8765
    ssl_certfile: str | PathLike[str] | None = None
    ssl_keyfile: str | PathLike[str] | None = None
    ssl_keyfile_password: str | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        _check.positive_int("port", self.port, at_least=0)
        if self.port > 65535:
            raise ValueError(f"port: expected at most 65535, got {self.port}")
        if self.ssl_certfile is None and self.ssl_keyfile is not None:
            raise ValueError("ssl_certfile: expected a certificate for the key, got none")


class Server:
    """Serve scenes: with `run` in this thread, or with `running` in another.

    Args:
        scenes: Scenes by name, from `open_scenes`.
        config: Settings of the application; None means `AppConfig()`.
        address: Address to listen on; None means `Address()`.
        planners: Threads that plan; 0 plans in the thread of the event loop.
        clock: Clock of the deadlines; None means `Clock()`.
        listener: A socket that listens at the address already; None makes one.
        siblings: Other processes of the same server; None if there are none.

    Attributes:
        clock: Clock of the deadlines.
        metrics: Counters of the server.
        port: Port that it listens on.

    Raises:
        OSError: If the address cannot be taken.
        ValueError: If an argument is wrong.
    """

    def __init__(
        self,
        scenes: Mapping[str, ServedScene],
        config: AppConfig | None = None,
        address: Address | None = None,
        *,
        planners: int = 0,
        clock: Clock | None = None,
        listener: socket.socket | None = None,
        siblings: Siblings | None = None,
    ) -> None:
        self._scenes = scenes
        self.config = config or AppConfig()
        self.address = address or Address()
        self.clock = clock or Clock()
        self.metrics, self._log = Metrics(), EventLog(clock=self.clock.now)
        self._threads = None
        if _check.positive_int("planners", planners, at_least=0):
            self._threads = ThreadPoolExecutor(planners, thread_name_prefix="gsvis-plan")
        self._pace = Pace()
        self._precedence = Precedence()
        self._upkeep = Upkeep(scenes, self.config.limits, self.metrics, self._log, self.clock.now)
        app = build_app(
            scenes,
            replace(self.config, hosts=(*self.config.hosts, self.address.host)),
            metrics=self.metrics,
            log=self._log,
            planners=self._threads,
            pace=self._pace,
            clock=self.clock,
            siblings=siblings,
        )
        self._siblings = siblings
        self._publish = app.state.publish
        most_hello = max([served.most_hello for served in scenes.values()], default=1 << 16)
        settings = _settings(app, self.address, self.config.limits.message_bytes or most_hello)
        self._socket = listener or listen(self.address)
        self.port = int(self._socket.getsockname()[1])
        self._server = _Uvicorn(settings, self.clock, self._log, self._open_door)

    def _open_door(self, inner: Callable[[], Any], tls: ssl.SSLContext | None) -> Door:
        """Return the door; `inner` makes uvicorn's protocol of a connection."""
        proxies = Proxies(self.config.proxies)
        readings = Readings(call=self._precedence.call)
        shared = Shared(self.config.limits, self.clock, self._log, self.metrics, readings, self._precedence)
        siblings = self._siblings
        clients = self.metrics.clients
        is_ahead = None if siblings is None else lambda: siblings.is_ahead(int(clients.value()))
        return Door(self._socket, shared, inner, proxies, tls, is_ahead)

    @property
    def url(self) -> str:
        """Address of the first scene, for a client."""
        return url_of(self.address, self.port)

    def page(self, name: str) -> str:
        """Return the address of the viewer's page of a scene, for a browser on this machine."""
        return page_of(self.url, name)

    def run(self, *, hung_s: float | None = None) -> None:
        """Serve until SIGINT or SIGTERM, which it raises again at the end, or until `stop`.

        Args:
            hung_s: Seconds for which the event loop may stand still; then the whole process ends with status 1 and the
                stack in the log, for a program that starts it again. None never ends it.
        """
        page = self.page(next(iter(self._scenes)))
        self._log("listening", url=self.url, page=page, token="needed" if self.config.token else "none")
        if self.config.token is None and not is_loopback(self._socket.getsockname()[0]):
            self._log("open", logging.WARNING, why="everybody who reaches this address can stream: no token is set")
        try:
            run(self._serve(hung_s), self._precedence)
        finally:
            self._socket.close()
            if self._threads is not None:
                self._threads.shutdown(wait=False, cancel_futures=True)
            self._log("stopped", clients=int(self.metrics.clients.value()))

    async def _serve(self, hung_s: float | None) -> None:
        """Serve until stopped, with all that runs beside the viewers."""
        asyncio.get_running_loop().set_exception_handler(self._log_asyncio_event)
        with nullcontext() if hung_s is None else HangWatch(self._log, hung_s) as watch:
            beats = [each.beat for each in (self._siblings, watch) if each is not None]
            beside = (self._watch_lateness(), self._look_after(), self._beat(beats))
            tasks = [asyncio.create_task(each) for each in beside]
            try:
                with _limit_lines(self.clock):
                    await self._server.serve()
            finally:
                for task in tasks:
                    task.cancel()

    async def _look_after(self) -> None:
        """Close scenes without viewers, bound memory, open tiles ahead, publish to siblings; see `Upkeep`."""
        for look in itertools.count():
            if look % _LOOKS == 0:
                self._publish()
                for opening in self._upkeep.ahead():
                    await asyncio.to_thread(opening)
            await asyncio.sleep(LOOK_S)
            self._upkeep.look()

    async def _beat(self, beats: Sequence[Callable[[], object]]) -> None:
        """Show those who watch this event loop that it turns."""
        while beats:
            for beat in beats:
                beat()
            await asyncio.sleep(_BEAT_S)

    def _log_asyncio_event(self, _: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """Log an event of asyncio in one bounded line, in place of its own log."""
        error = context.get("exception")
        why = context.get("message", "") + (f": {type(error).__name__}: {error}" if error is not None else "")
        self._log("failed", logging.ERROR, why=why)

    async def _watch_lateness(self) -> None:
        """Measure how late the event loop runs, with the wait for a turn."""
        loop = asyncio.get_running_loop()
        while True:
            due = loop.time() + _LATE_S
            await asyncio.sleep(_LATE_S)
            await self._pace.turns.take()
            late = max(0.0, loop.time() - due)
            self.metrics.late.observe(late)
            self._pace.observe(late)

    def stop(self) -> None:
        """Ask the server to end, from any thread."""
        self._server.should_exit = True

    @contextmanager
    def running(self) -> Iterator[str]:
        """Serve in a thread of its own.

        Yields:
            The address of the first scene, for a client.
        """
        thread = threading.Thread(target=self.run, name="gsvis-serve", daemon=True)
        thread.start()
        try:
            while not self._server.started and thread.is_alive():
                thread.join(0.005)
            yield self.url
        finally:
            self.stop()
            thread.join()


class _Uvicorn(uvicorn.Server):
    """uvicorn's server with our door, and a shutdown that no connection can block."""

    def __init__(
        self,
        settings: uvicorn.Config,
        clock: Clock,
        log: EventLog,
        door: Callable[[Callable[[], Any], ssl.SSLContext | None], Door],
    ) -> None:
        super().__init__(settings)
        self._clock = clock
        self._log = log
        self._make_door = door

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start to accept connections."""
        self._door = self._make_door(self._plain, self.config.ssl)
        self._door.open()
        self.started = True

    def _plain(self) -> Plain:
        """Return the protocol of a new connection."""
        return Plain(self.config, self.server_state, {})

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Announce the shutdown to all connections, wait a little, cut the rest."""
        door = self._door
        tasks = self.server_state.tasks
        door.close()
        await door.wait_closed()
        for guard in list(door.guards):
            guard.shut_down()
        end = self._clock.now() + _STOP_S
        while (door.guards or tasks) and not self.force_exit and self._clock.now() < end:
            await asyncio.sleep(0.02)
        for guard in list(door.guards):
            guard.cut("does not end", logging.INFO)
        for task in tasks:
            task.cancel()


def _settings(app: Any, address: Address, message_bytes: int) -> uvicorn.Config:
    """Return the settings of uvicorn, which leaves limits, deadlines and logs to us."""
    settings = uvicorn.Config(
        app,
        http=Plain,
        ws=Socket,
        ws_max_size=message_bytes,
        ws_per_message_deflate=False,
        ws_ping_interval=None,
        lifespan="off",
        log_config=None,
        log_level="warning",
        access_log=False,
        server_header=False,
        proxy_headers=False,
        h11_max_incomplete_event_size=2 * MOST_BYTES,
        timeout_keep_alive=_NEVER,
        ssl_certfile=None if address.ssl_certfile is None else str(_check.path("ssl_certfile", address.ssl_certfile)),
        ssl_keyfile=None if address.ssl_keyfile is None else str(_check.path("ssl_keyfile", address.ssl_keyfile)),
        ssl_keyfile_password=address.ssl_keyfile_password,
    )
    settings.load()  # a wrong certificate shows here
    return settings


class _LineLimit(logging.Filter):
    """Limit the log lines a second, from any thread."""

    def __init__(self, clock: Clock) -> None:
        super().__init__()
        self._clock = clock
        self._lock = threading.Lock()
        self._bucket = RateBucket(_LINES_PER_S, 10.0 * _LINES_PER_S)

    def filter(self, record: logging.LogRecord) -> bool:
        with self._lock:
            return self._bucket.take(self._clock.now())


@contextmanager
def _limit_lines(clock: Clock) -> Iterator[None]:
    """Limit the log lines of asyncio and uvicorn, which peers can cause."""
    filters = [(logging.getLogger(name), _LineLimit(clock)) for name in ("asyncio", "uvicorn.error")]
    for logger, few in filters:
        logger.addFilter(few)
    try:
        yield
    finally:
        for logger, few in filters:
            logger.removeFilter(few)


def page_of(url: str, name: str) -> str:
    """Return the address of the viewer's page of a scene, for a browser on this machine.

    Args:
        url: Address of the server for clients, as `url_of` returns it.
        name: Name of the scene.
    """
    parts = urlsplit(url)
    wild = {"0.0.0.0": "127.0.0.1", "[::]": "[::1]"}  # addresses to listen on that are none to go to
    host = parts.netloc.rpartition(":")[0]
    scheme = "https" if parts.scheme == "wss" else "http"
    return f"{scheme}://{wild.get(host, host)}:{parts.port}/view/{quote(name, safe='')}"


def url_of(address: Address, port: int) -> str:
    """Return the address of the first scene of a server that listens on a port, for a client."""
    host = f"[{address.host}]" if ":" in address.host else address.host
    return f"{'wss' if address.ssl_certfile else 'ws'}://{host}:{port}/stream"


def listen(address: Address) -> socket.socket:
    """Return a socket that listens at an address.

    Raises:
        OSError: If the address cannot be taken.
    """
    host = address.host
    port = address.port
    try:
        family, kind, protocol, _, place = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    except OSError as error:
        raise OSError(error.errno, error.strerror, f"{host}:{port}") from error
    found = socket.socket(family, kind, protocol)
    try:
        found.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        found.bind(place)
        found.listen(1024)
        found.setblocking(False)
    except OSError as error:
        found.close()
        raise OSError(error.errno, error.strerror, f"{host}:{port}") from error
    return found


def is_loopback(host: str) -> bool:
    """Return whether an address is reachable from this machine only."""
    return host.startswith("127.") or host == "::1"
