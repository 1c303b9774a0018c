"""A client in Python: sends its pose, receives batches, and reconnects with its holdings when the connection breaks.

    client = StreamClient("ws://127.0.0.1:8765/stream", FieldOfView.from_degrees(90, 70))
    await client.run(path.at, seconds=5.0)
    gaussians, colors = client.receiver.scene()

Scene frame and units, seconds, bytes of messages.
"""

from __future__ import annotations

import asyncio
import itertools
import random
import ssl
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus

from gsvis.abr.classes import FieldOfView
from gsvis.errors import ProtocolError
from gsvis.serve.clock import Clock
from gsvis.stream import Ack, Bye, Hello, PoseAt, Received, Receiver
from gsvis.stream.receiver import MOST_BYTES
from gsvis.stream.wire import ERROR, FAULTS, ServerFault

__all__ = ["ClientConfig", "Pose", "StreamClient", "fetch"]

Pose = Callable[[float], tuple[ArrayLike, ArrayLike]]
"""Function from seconds since the start to position (3,) and quaternion (4,) wxyz, world from camera; for example
`HeadPath.at`."""

_OPEN_S = 10.0  # most seconds to connect, to send HELLO, and to receive WELCOME, each
_LEAVE_S = 0.5  # most seconds to send BYE
_PING_S = 20.0  # seconds between pings, and for the answer to one

_AGAIN = {FAULTS[name] for name in ("too-many", "late", "internal", "ending")}


@dataclass(frozen=True)
class ClientConfig:
    """Settings of a client.

    Attributes:
        token: Token to send; None sends none.
        poses_per_s: Poses a second. The server plans ten times a second, so more than 20 help little.
        give_up_s: Seconds without any stream after which the client gives up. It should be longer than a server keeps
            the seats of silent viewers (`Limits.idle_s`), to survive an outage.
        first_wait_s: Seconds before the first new attempt; they double each time, up to `longest_wait_s`.
        longest_wait_s: Most seconds between two attempts.
        message_bytes: Most bytes of a message of the server.
        tls: TLS settings for wss://; None checks certificates as usual.
        scene_bytes: Most bytes that sets and tables of a scene may take before the first Gaussian arrives.
        memory_bytes: Most bytes of records of Gaussians and terms to hold. The server then evicts what is farthest from
            use. 0 sets no limit.
    """

    token: str | None = field(default=None, repr=False)
    poses_per_s: float = 20.0
    give_up_s: float = 90.0
    first_wait_s: float = 0.1
    longest_wait_s: float = 5.0
    message_bytes: int = 64 << 20
    tls: ssl.SSLContext | None = None
    scene_bytes: int = MOST_BYTES
    memory_bytes: int = 0

    def __post_init__(self) -> None:
        for name in ("poses_per_s", "give_up_s", "first_wait_s", "longest_wait_s", "message_bytes", "scene_bytes"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise ValueError(f"{name}: expected a finite number > 0, got {value!r}")
        if self.memory_bytes < 0:
            raise ValueError(f"memory_bytes: expected bytes >= 0, got {self.memory_bytes!r}; 0 sets no limit")


class StreamClient:
    """One viewer of one scene.

    Args:
        url: Address of the stream, ws:// or wss://.
        view: The client's field of view.
        config: Settings; None means `ClientConfig()`.
        receiver: Receiver of an earlier client; None starts with nothing.
        clock: Clock of the deadlines; None means `Clock()`.

    Attributes:
        receiver: The received scene; None before the first WELCOME.
        connections: Number of streams opened.
        nbytes: Bytes of batches received.
        restarts: Number of times that the server had another scene, so that the client started again from nothing.
    """

    def __init__(
        self,
        url: str,
        view: FieldOfView,
        config: ClientConfig | None = None,
        *,
        receiver: Receiver | None = None,
        clock: Clock | None = None,
    ) -> None:
        self.url = url
        self.view = view
        self.config = config or ClientConfig()
        self.receiver = receiver
        self.connections = 0
        self.nbytes = 0
        self.restarts = 0
        self._clock = clock or Clock()
        self._stopped = asyncio.Event()
        self._began = 0.0

    def stop(self) -> None:
        """Let `run` end; call it from the thread of `run`, for example in `on_batch`."""
        self._stopped.set()

    async def run(
        self, pose: Pose, *, seconds: float = np.inf, on_batch: Callable[[Received], None] | None = None
    ) -> None:
        """Stream for some time; reconnect after every failure.

        Args:
            pose: Pose of the viewer over time.
            seconds: How long to stream; inf streams until `stop`.
            on_batch: Called with each batch after it is decoded.

        Raises:
            ProtocolError: If the server refuses this client, or does not speak the protocol.
            ConnectionError: If no server can be reached for `give_up_s`.
        """
        self._stopped.clear()
        self._began = time.monotonic()
        work = asyncio.create_task(self._reconnect(pose, on_batch))
        ended = asyncio.create_task(self._stopped.wait())
        timer = None if np.isinf(seconds) else self._clock.call_later(seconds, self.stop)
        try:
            done, _ = await asyncio.wait({work, ended}, return_when=asyncio.FIRST_COMPLETED)
            if work in done:
                work.result()
        finally:
            if timer is not None:
                timer.cancel()
            for task in (work, ended):
                task.cancel()
            await asyncio.gather(work, ended, return_exceptions=True)

    async def _reconnect(self, pose: Pose, on_batch: Callable[[Received], None] | None) -> None:
        """Stream; connect again whenever the connection ends."""
        wait = self.config.first_wait_s
        lost = self._clock.now()
        while True:
            before = self.connections
            try:
                await self._stream(pose, on_batch)
                why = "the connection was closed"
            except ProtocolError as error:
                if error.code not in _AGAIN:
                    raise
                why = str(error)
            except InvalidStatus as error:
                answer = (error.response.body or b"").decode("utf-8", "replace").strip()
                status = error.response.status_code
                if status < 500:
                    raise ProtocolError(f"{self.url}: {status} {answer[:200]}", FAULTS["refused"]) from None
                why = f"{status} {answer[:200]}"
            except (OSError, ConnectionClosed, InvalidHandshake) as error:
                why = str(error) or type(error).__name__
            if self.connections > before:
                wait = self.config.first_wait_s
                lost = self._clock.now()
            if self._clock.now() - lost > self.config.give_up_s:
                raise ConnectionError(f"{self.url}: no stream for {self.config.give_up_s:g} s; {why}")
            await asyncio.sleep(wait * random.uniform(0.5, 1.0))
            wait = min(2.0 * wait, self.config.longest_wait_s)

    async def _stream(self, pose: Pose, on_batch: Callable[[Received], None] | None) -> None:
        """Run one connection to its end."""
        config = self.config
        options: dict[str, Any] = {} if config.tls is None else {"ssl": config.tls}
        if config.token is not None:
            options["additional_headers"] = {"Authorization": f"Bearer {config.token}"}
        opening = connect(
            self.url,
            compression=None,
            max_size=config.message_bytes,
            open_timeout=None,
            close_timeout=1,
            proxy=None,
            ping_interval=None,
            **options,
        )
        async with await self._clock.within(_OPEN_S, _open(opening)) as socket:
            first = Hello(self.view, memory=config.memory_bytes)
            hello = first if self.receiver is None else self.receiver.hello(self.view)
            await self._clock.within(_OPEN_S, _send(socket, hello.to_bytes()))
            welcome = await self._clock.within(_OPEN_S, _next(socket))
            if self.receiver is None:
                self.receiver = self._start_scene(welcome)
            elif not self.receiver.resume(welcome):
                self.receiver = self._start_scene(welcome)
                self.restarts += 1
            self.connections += 1
            await _send(socket, Ack(0).to_bytes())
            beside = [
                asyncio.create_task(self._send_poses(socket, pose)),
                asyncio.create_task(self._keep_alive(socket)),
            ]
            try:
                while True:
                    data = await _next(socket)
                    received = self.receiver.receive(data)
                    self.nbytes += received.nbytes
                    await _send(socket, Ack(received.sequence).to_bytes())
                    if on_batch is not None:
                        on_batch(received)
            except asyncio.CancelledError:
                await self._leave(socket)
                raise
            finally:
                for task in beside:
                    task.cancel()
                await asyncio.gather(*beside, return_exceptions=True)

    def _start_scene(self, welcome: bytes) -> Receiver:
        """Return a receiver of a scene, within the memory limit."""
        try:
            return Receiver(welcome, most_bytes=self.config.scene_bytes, memory=self.config.memory_bytes)
        except ProtocolError as error:
            if error.code != FAULTS["too-large"]:
                raise
            raise ProtocolError(error.message, error.code, "raise scene_bytes of ClientConfig") from None

    async def _keep_alive(self, socket: ClientConnection) -> None:
        """Close the connection when the server no longer answers."""
        with suppress(ConnectionClosed):
            while True:
                await asyncio.sleep(_PING_S)
                answer = await socket.ping()
                try:
                    await self._clock.within(_PING_S, answer)
                except TimeoutError:
                    await socket.close()

    async def _leave(self, socket: ClientConnection) -> None:
        """Send BYE if the server takes it soon."""
        with suppress(ConnectionClosed, TimeoutError):
            await self._clock.within(_LEAVE_S, socket.send(Bye().to_bytes()))

    async def _send_poses(self, socket: ClientConnection, pose: Pose) -> None:
        """Send the viewer's pose at a steady rate."""
        start = time.monotonic()
        step = 1.0 / self.config.poses_per_s
        for k in itertools.count():
            now = time.monotonic() - self._began
            position, quat = (np.asarray(values, np.float64) for values in pose(now))
            x, y, z = position.tolist()
            w, i, j, k_ = quat.tolist()
            await socket.send(PoseAt(int(1e3 * now), (x, y, z), (w, i, j, k_)).to_bytes())
            await asyncio.sleep(max(start + (k + 1) * step - time.monotonic(), 0.1 * step))


async def _next(socket: ClientConnection) -> bytes:
    """Return the next message of the server.

    Raises:
        ProtocolError: If the server says why it ends the connection, or sends text.
    """
    data = await socket.recv()
    if isinstance(data, str):
        raise ProtocolError("message: expected bytes, got text")
    if data[:1] == bytes([ERROR]):
        fault = ServerFault.parse(data)
        raise ProtocolError(fault.line, fault.code)
    return data


async def _send(socket: ClientConnection, data: bytes) -> None:
    """Send data; ignore a closed connection, since the last message of the server, read later, says why."""
    with suppress(ConnectionClosed):
        await socket.send(data)


async def _open(opening: connect) -> ClientConnection:
    """Return the connection as a coroutine, which `Clock.within` takes."""
    return await opening


def fetch(
    url: str,
    view: FieldOfView,
    pose: Pose,
    seconds: float,
    config: ClientConfig | None = None,
    *,
    receiver: Receiver | None = None,
    clock: Clock | None = None,
) -> StreamClient:
    """Stream for some time, from a program without an event loop.

    Args:
        url: Address of the stream, ws:// or wss://.
        view: The client's field of view.
        pose: Pose of the viewer over time.
        seconds: How long to stream.
        config: Settings; None means `ClientConfig()`.
        receiver: Receiver of an earlier client; None starts with nothing.
        clock: Clock of the deadlines; None means `Clock()`.

    Returns:
        The client; its `receiver` has the received scene.

    Raises:
        ProtocolError: If the server refuses this client, or does not speak the protocol.
        ConnectionError: If no server can be reached for `give_up_s`.
    """

    async def stream() -> StreamClient:
        client = StreamClient(url, view, config, receiver=receiver, clock=clock)
        await client.run(pose, seconds=seconds)
        return client

    return asyncio.run(stream())
