"""The door of a server: accept connections, count them by kind and by address, and close some if there are too many.

Viewers that stream have their own seats (see `app`) and are never closed to make room. All other connections share
`Limits.waiting` places, with at most `Limits.per_address` for one address. A new connection is always accepted. The one
closed for it belongs to the address with most connections, and has waited longest. So a client with many
connections harms itself first.
"""

from __future__ import annotations

import asyncio
import errno
import logging
import socket
import ssl
import sys
from collections import Counter
from collections.abc import Callable
from typing import Any

from gsvis.serve._addresses import Proxies
from gsvis.serve._guard import Guard, Phase, Shared

__all__ = ["Door"]

_NO_ROOM = (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM)
_PAUSE_S = 0.05  # pause before accepting again after an error; doubles each time
_LONGEST_PAUSE_S = 1.0
_QUIET_S = 10.0  # seconds between log lines about failures to accept
_YIELD_S = 0.02  # head start of a process with fewer viewers
_IN_A_ROW = 2  # connections to accept in a slot
_NEVER = 1e6  # seconds; for time-outs of asyncio that the guard replaces


class Door:
    """Accepts connections.

    Args:
        listener: A listening socket that does not block.
        shared: What all guards share.
        inner: Makes the protocol that answers the requests of a connection.
        proxies: Proxies to trust about client addresses; their own addresses have no limit.
        tls: None for plain connections.
        is_ahead: Returns whether another process that listens to the same socket has fewer viewers; it then gets a
            moment to take a new connection first. None if there is no other process.

    Attributes:
        guards: All connections.
    """

    def __init__(
        self,
        listener: socket.socket,
        shared: Shared,
        inner: Callable[[], Any],
        proxies: Proxies,
        tls: ssl.SSLContext | None = None,
        is_ahead: Callable[[], bool] | None = None,
    ) -> None:
        self._is_ahead = is_ahead
        self._listener = listener
        self._shared = shared
        self._limits = shared.limits
        self._log = shared.log
        self._inner = inner
        self._proxies = proxies
        self._tls = tls
        self.guards: set[Guard] = set()
        self._tasks: set[asyncio.Task[None]] = set()
        self._accepting: asyncio.Task[None] | None = None
        self._logged_at = -_QUIET_S

    def open(self) -> None:
        """Start to accept connections."""
        self._accepting = asyncio.create_task(self._accept())

    def close(self) -> None:
        """Stop accepting connections."""
        if self._accepting is not None:
            self._accepting.cancel()

    def make_protocol(self) -> Any:
        """Return the protocol that answers the requests of a connection."""
        return self._inner()

    def client_of(self, peer: str, forwarded: list[str]) -> str:
        """Return the address of a client: that of its socket, or the one that trusted proxies report."""
        return self._proxies.client_of(peer, forwarded)

    def forget(self, guard: Guard) -> None:
        """Forget a connection, which has ended."""
        self.guards.discard(guard)

    async def wait_closed(self) -> None:
        """Wait until the door has stopped accepting connections."""
        if self._accepting is not None:
            await asyncio.wait([self._accepting])

    async def _accept(self) -> None:
        """Accept connections until cancelled."""
        pause = _PAUSE_S
        try:
            while True:
                await self._wait_for_connections()
                for _ in range(_IN_A_ROW):
                    try:
                        sock, place = self._accept_one()
                    except BlockingIOError:  # no more, or another process has taken it
                        break
                    except OSError as error:
                        self._log_failure(error)
                        await asyncio.sleep(pause)
                        pause = min(2.0 * pause, _LONGEST_PAUSE_S)
                        continue
                    pause = _PAUSE_S
                    self._admit(sock, (str(place[0]), int(place[1])) if isinstance(place, tuple) else ("-", 0))
        finally:
            self._listener.close()

    async def _wait_for_connections(self) -> None:
        """Wait until connections can be accepted, and then for a slot."""
        loop = asyncio.get_running_loop()
        there = asyncio.Event()
        loop.add_reader(self._listener, there.set)
        try:
            await there.wait()
        finally:
            loop.remove_reader(self._listener)
        if self._is_ahead is not None and self._is_ahead():
            await asyncio.sleep(_YIELD_S)
        slot = asyncio.Event()
        self._shared.precedence.call(slot.set)
        await slot.wait()

    def _accept_one(self) -> tuple[socket.socket, Any]:
        """Return a new connection and its peer; raise BlockingIOError if there is none."""
        return self._listener.accept()

    def _log_failure(self, error: OSError) -> None:
        """Log that a connection could not be accepted; close a connection if resources ran out."""
        name = errno.errorcode.get(error.errno or 0, "other")
        self._shared.metrics.accept_failures.add(of=name)
        now = self._shared.clock.now()
        if now - self._logged_at >= _QUIET_S:
            self._logged_at = now
            self._log("accept-failed", logging.ERROR, why=str(error), connections=len(self.guards))
        if error.errno in _NO_ROOM:
            self._make_room(self._waiting())

    def _admit(self, sock: socket.socket, peer: tuple[str, int]) -> None:
        """Watch a new connection; close one that is less needed if there are too many."""
        sock.setblocking(False)
        guard = Guard(sock, peer, self._shared, self)
        self.guards.add(guard)
        self._enforce_limits(guard)
        task = asyncio.create_task(self._start_transport(guard, sock))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _start_transport(self, guard: Guard, sock: socket.socket) -> None:
        """Connect a socket with its guard; with TLS, after the handshake."""
        options: dict[str, Any] = {}
        if self._tls is not None:
            options = {"ssl": self._tls, "ssl_handshake_timeout": _NEVER}
            if sys.version_info >= (3, 11):  # older versions have no such time-out
                options["ssl_shutdown_timeout"] = _NEVER
        try:
            await asyncio.get_running_loop().connect_accepted_socket(lambda: guard, sock, **options)
        except OSError as error:  # no handshake; the connection is closed by now
            if not guard.phase.has_ended:
                self._shared.metrics.cut.add(of="no TLS")
                self._log("cut", logging.INFO, reason="no TLS", peer=str(guard), why=type(error).__name__)
            guard.end()
            error.__traceback__ = None  # a frame of asyncio in it refers to the error, and to the buffers of TLS
        except asyncio.CancelledError:
            guard.end()
            raise

    def _waiting(self) -> list[Guard]:
        """Return the connections that are no viewers."""
        return [guard for guard in self.guards if guard.phase is not Phase.STREAMING and not guard.phase.has_ended]

    def _enforce_limits(self, newcomer: Guard) -> None:
        """Close a connection if a new one exceeds the limits."""
        waiting = self._waiting()
        if newcomer.client.address not in self._proxies:
            same = [guard for guard in waiting if guard.client.owner == newcomer.client.owner]
            if len(same) > self._limits.most_per_address:
                self._make_room([guard for guard in same if guard is not newcomer])
                waiting = self._waiting()
        if len(waiting) > self._limits.most_waiting:
            self._make_room([guard for guard in waiting if guard is not newcomer])

    def _make_room(self, among: list[Guard]) -> None:
        """Cut the connection that is least needed."""
        if not among:
            return
        held = Counter(guard.client.owner for guard in among)
        last = min(
            among,
            key=lambda guard: (
                guard.phase is Phase.ANSWERING and not guard.is_full,
                -held[guard.client.owner],
                guard.unsent > 0,
                guard.phase is not Phase.ENDING,
                guard.since,
            ),
        )
        last.cut("gives way to others")
