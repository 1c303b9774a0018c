"""A server: an application bound to an address, run until it is told to stop, here or in a thread of its own."""

from __future__ import annotations

import asyncio
import logging
import socket
import threading
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from os import PathLike

import uvicorn

from gsvis import _check
from gsvis.serve._log import EventLog
from gsvis.serve._protocols import protocols
from gsvis.serve.app import AppConfig, build_app
from gsvis.serve.limits import Pace
from gsvis.serve.metrics import Metrics
from gsvis.serve.scenes import ServedScene

__all__ = ["Address", "Server"]

_LOOK_S = 0.2
_STOP_S = 3  # seconds that connections have to end when the server stops


@dataclass(frozen=True)
class Address:
    """Where a server listens.

    Attributes:
        host: Name or number; the default is this machine alone.
        port: 0 takes one that is free.
        ssl_certfile: Certificate chain, PEM; None serves without TLS.
        ssl_keyfile: Its key; None if it is in the same file.
        ssl_keyfile_password: Of the key.
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
    """Serves scenes; `run` here, or `running` in a thread.

    Args:
        scenes: As `open_scenes` gives them.
        config: None means `AppConfig()`.
        address: None means `Address()`.
        planners: Threads that plan; 0 plans in the thread of the event loop.

    Attributes:
        metrics: What it counts.
        port: The one it listens on.

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
    ) -> None:
        self.config, self.address = config or AppConfig(), address or Address()
        self.metrics, self._log = Metrics(), EventLog()
        self._threads = None
        if _check.positive_int("planners", planners, at_least=0):
            self._threads = ThreadPoolExecutor(planners, thread_name_prefix="gsvis-plan")
        self._pace = Pace()
        app = build_app(
            scenes, self.config, metrics=self.metrics, log=self._log, planners=self._threads, pace=self._pace
        )
        limits = self.config.limits
        plain, stream = protocols(limits, self._log)
        open_scenes = [served.opened for served in scenes.values() if served.opened is not None]
        a = self.address
        settings = uvicorn.Config(
            app,
            http=plain,
            ws=stream,
            ws_max_size=limits.message_bytes or max([scene.most_hello for scene in open_scenes], default=1 << 16),
            ws_per_message_deflate=False,
            ws_ping_interval=None,
            lifespan="off",
            log_config=None,
            log_level="warning",
            access_log=False,
            server_header=False,
            limit_concurrency=2 * limits.connections + 1,
            timeout_graceful_shutdown=_STOP_S,
            ssl_certfile=None if a.ssl_certfile is None else str(_check.path("ssl_certfile", a.ssl_certfile)),
            ssl_keyfile=None if a.ssl_keyfile is None else str(_check.path("ssl_keyfile", a.ssl_keyfile)),
            ssl_keyfile_password=a.ssl_keyfile_password,
        )
        settings.load()  # a wrong certificate shows here
        self._server = uvicorn.Server(settings)
        self._socket = _listen(a.host, a.port)
        self.port = int(self._socket.getsockname()[1])

    @property
    def url(self) -> str:
        """Of the first scene, for a client."""
        host = f"[{self.address.host}]" if ":" in self.address.host else self.address.host
        return f"{'wss' if self.address.ssl_certfile else 'ws'}://{host}:{self.port}/stream"

    def run(self) -> None:
        """Serve until SIGINT or SIGTERM, which are raised again at the end, or until `stop`."""
        self._log("listening", url=self.url, token="needed" if self.config.token else "none")
        if self.config.token is None and not _is_loopback(self._socket.getsockname()[0]):
            self._log("open", logging.WARNING, why="everybody who reaches this address can stream: no token is set")
        try:
            asyncio.run(self._serve())
        finally:
            self._socket.close()
            if self._threads is not None:
                self._threads.shutdown(wait=False, cancel_futures=True)
            self._log("stopped", clients=int(self.metrics.clients.value()))

    async def _serve(self) -> None:
        watching = asyncio.create_task(self._watch_lateness())
        try:
            await self._server.serve([self._socket])
        finally:
            watching.cancel()

    async def _watch_lateness(self) -> None:
        loop = asyncio.get_running_loop()
        while True:
            due = loop.time() + _LOOK_S
            await asyncio.sleep(_LOOK_S)
            late = max(0.0, loop.time() - due)
            self.metrics.late.observe(late)
            self._pace.observe(late)

    def stop(self) -> None:
        """Ask it to end, from any thread."""
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


def _listen(host: str, port: int) -> socket.socket:
    family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    found = socket.socket(family, kind, protocol)
    try:
        found.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        found.bind(address)
        found.listen(256)
        found.setblocking(False)
    except OSError as error:
        found.close()
        raise OSError(error.errno, error.strerror, f"{host}:{port}") from error
    return found


def _is_loopback(host: str) -> bool:
    return host.startswith("127.") or host == "::1"
