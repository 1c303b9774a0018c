"""The limits of a server: what a client may ask for, how often, and how long it may take.

Seconds, bytes, and counts. The server disconnects a client that exceeds a limit; others are not affected.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Protocol

import numpy as np

from gsvis import _check
from gsvis.serve.turns import Preparations, Turns
from gsvis.stream.wire import LEAST_HELLO

__all__ = ["Limits", "Pace", "RateBucket", "Seats", "Viewer"]

_SILENT_S = 5.0  # seconds of silence after which a seat goes to another viewer of its address, if no other is free


@dataclass(frozen=True)
class Limits:
    """Bounds of one server; the defaults are safe for a public server.

    Attributes:
        connections: Most streaming clients at once.
        waiting: Most connections at once that do not stream: requests, idle ones, handshakes. None means as many as
            `connections`, at least 32. Above it the server closes the one that has waited longest.
        per_address: Most streaming clients of one address at once, and most other connections of it. None means half of
            `connections`, at least 8. An IPv6 network of 64 bits counts as one address.
        message_bytes: Most bytes of one message of a client. None means enough for the holdings of the largest scene.
        messages_per_s: Most messages of a client a second, averaged over `burst_s`; the server disconnects a client
            that sends more.
        burst_s: Seconds' worth of messages that may arrive at once, as after a link has stalled.
        poses_per_s: Most poses of a client a second that are used; the server ignores further ones.
        handshake_s: Seconds from a connection to a complete request, TLS included, and from there to the first message.
        keep_alive_s: Seconds from an answer to the end of the next request of a connection.
        idle_s: Seconds of silence after which a client counts as gone.
        stall_s: Seconds without an acknowledgement, or without room in the socket, after which a client counts as not
            reading.
        tick_s: Seconds before the server plans again for a client that had nothing to receive.
        batch_bytes: Most bytes of one batch, approximately.
        close_s: Seconds without viewers after which a scene with kept tables is closed.
        tables_bytes: Most bytes of kept tables in the memory of the process, checked four times a second.
    """

    connections: int = 100
    waiting: int | None = None
    per_address: int | None = None
    message_bytes: int | None = None
    messages_per_s: float = 200.0
    burst_s: float = 10.0
    poses_per_s: float = 60.0
    handshake_s: float = 10.0
    keep_alive_s: float = 15.0
    idle_s: float = 60.0
    stall_s: float = 30.0
    tick_s: float = 0.1
    batch_bytes: int = 512 * 1024
    close_s: float = 600.0
    tables_bytes: int = 800_000_000

    def __post_init__(self) -> None:
        for entry in fields(self):
            value = getattr(self, entry.name)
            if entry.name in ("connections", "batch_bytes", "tables_bytes"):
                _check.positive_int(entry.name, value)
            elif entry.name in ("message_bytes", "waiting", "per_address"):
                if value is not None:
                    _check.positive_int(entry.name, value, at_least=LEAST_HELLO if entry.name == "message_bytes" else 1)
            elif not (np.isfinite(value) and value > 0):
                raise ValueError(f"{entry.name}: expected a finite number > 0, got {value!r}")

    @property
    def most_waiting(self) -> int:
        """Most connections at once that do not stream."""
        return max(self.connections, 32) if self.waiting is None else self.waiting

    @property
    def most_per_address(self) -> int:
        """Most streaming clients of one address, and most connections of it that do not stream."""
        return max(self.connections // 2, 8) if self.per_address is None else self.per_address


class Viewer(Protocol):
    """Interface of a viewer with a seat."""

    @property
    def silent_s(self) -> float:
        """Seconds since the last message of the viewer."""
        ...

    def give_way(self) -> None:
        """Give up the seat to another viewer."""
        ...


class Seats:
    """Give seats to viewers that stream, with a limit in all and a limit for each address.

    If no seat is free, a viewer takes the seat of the longest silent viewer of its own address, if that has been silent
    for 5 s. After an outage of a shared link, all viewers reconnect before the server knows that the old ones are gone.
    Nobody can take the seat of another address.

    Args:
        limits: Bounds.
        others: Returns how many viewers other processes of the server have, in all and of an address.

    Attributes:
        taken: Number of seats taken.
    """

    def __init__(self, limits: Limits, others: Callable[[str], tuple[int, int]] = lambda owner: (0, 0)) -> None:
        self._limits = limits
        self._others = others
        self._by_owner: dict[str, list[Viewer]] = {}
        self.taken = 0

    @property
    def by_owner(self) -> dict[str, int]:
        """Number of viewers of each address."""
        return {owner: len(seated) for owner, seated in self._by_owner.items()}

    def why_not(self, owner: str) -> str:
        """Return why a viewer of an address cannot get a seat: "too-many" or "address-full"; "" if it can."""
        why = self._why_full(owner)
        return "" if not why or self._silent(owner) is not None else why

    def take(self, owner: str, viewer: Viewer) -> str:
        """Take a seat, perhaps that of a silent viewer; return why there is none, or ""."""
        if why := self._why_full(owner):
            silent = self._silent(owner)
            if silent is None:
                return why
            self.leave(owner, silent)
            silent.give_way()
        self.taken += 1
        self._by_owner.setdefault(owner, []).append(viewer)
        return ""

    def leave(self, owner: str, viewer: Viewer) -> None:
        """Give a seat back; do nothing if another viewer has taken it."""
        seated = self._by_owner.get(owner, [])
        if viewer not in seated:
            return
        self.taken -= 1
        seated.remove(viewer)
        if not seated:
            del self._by_owner[owner]

    def _why_full(self, owner: str) -> str:
        """Return which limit leaves no free seat to an address; "" if a seat is free."""
        elsewhere, same = self._others(owner)
        if self.taken + elsewhere >= self._limits.connections:
            return "too-many"
        full = len(self._by_owner.get(owner, [])) + same >= self._limits.most_per_address
        return "address-full" if full else ""

    def _silent(self, owner: str) -> Viewer | None:
        """Return the viewer of an address that has been silent longest, if that is long enough."""
        found = max(self._by_owner.get(owner, []), key=lambda viewer: viewer.silent_s, default=None)
        return found if found is not None and found.silent_s > _SILENT_S else None


class RateBucket:
    """Limit the rate of events: `take` returns whether one more is allowed.

    Args:
        rate: Events a second.
        burst: Most events at once.

    Examples:
        >>> bucket = RateBucket(10.0, burst=2)
        >>> [bucket.take(0.0), bucket.take(0.0), bucket.take(0.0), bucket.take(0.1)]
        [True, True, False, True]
    """

    def __init__(self, rate: float, burst: float) -> None:
        self._rate = rate
        self._burst = max(burst, 1.0)
        self._left = self._burst
        self._time = -np.inf

    def take(self, t: float) -> bool:
        """Return whether an event at time t is within the rate, and count it if so; t must not decrease, seconds."""
        self._left = min(self._burst, self._left + (t - self._time) * self._rate)
        self._time = t
        if self._left < 1.0:
            return False
        self._left -= 1.0
        return True


class Pace:
    """Measure how late a server runs, and lengthen its batches if it does.

    A batch costs a server about the same for any number of records. A late server sends fewer and larger batches, so
    that clients get the same bytes, less often.

    Attributes:
        turns: Turns of the clients that are planned for in the thread of the event loop.
        preparations: What these clients wait for.

    Examples:
        >>> pace = Pace()
        >>> pace.stretched(0.05)
        0.05
        >>> for _ in range(50):
        ...     pace.observe(0.03)
        >>> round(pace.stretched(0.05), 3)
        0.17
        >>> for _ in range(50):
        ...     pace.observe(0.3)
        >>> round(pace.stretched(0.05), 3)
        0.35
    """

    _WEIGHT = 0.2  # weight of the last observation
    _MOST = 4.0  # largest factor, unless a client waits longer for its turn

    def __init__(self) -> None:
        self._late = 0.0
        self.turns = Turns()
        self.preparations = Preparations()

    def observe(self, late: float) -> None:
        """Record that something ran late by this many seconds."""
        self._late += self._WEIGHT * (late - self._late)

    def stretched(self, piece: float) -> float:
        """Return the seconds of its link that a client's next batch should take, where `piece` is the target.

        A client whose turn comes seldom gets what its link carries until the next one.
        """
        return min(piece + 4.0 * self._late, max(self._MOST * piece, piece + self._late))
