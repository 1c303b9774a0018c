"""One delivery over one link along one path: when everything arrives. No picture is drawn here.

Server and client keep the same time. The client says where it is at every tick, and that it has received something at
once; both travel for half of the round trip. The server sends whenever it hears something, for as long as the delivery
has something to send. Time in seconds from the moment at which the client asks for the scene.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.scene.paths import HeadPath
from gsvis.simulate.delivery import Delivery, Parcel
from gsvis.simulate.link import Link, Pipe

__all__ = ["Playback", "play"]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

_POSE, _ACK = 0, 1


@dataclass(frozen=True, eq=False)
class Playback:
    """When what arrived.

    Attributes:
        name: Of the delivery.
        exact: As the delivery's.
        link: The link that it went over.
        seconds: How long the client was there.
        gaussian_at: (N,) seconds at which each Gaussian could be drawn, inf for never.
        gone_at: (N,) seconds from which on it is shown no more.
        term_at: (T,) seconds at which each term could be used.
        times: (P,) arrival of each parcel, rising.
        sizes: (P,) bytes of each.
        twice: Gaussians and terms that arrived once more than needed.
        about: What the delivery says of itself.
    """

    name: str
    exact: bool
    link: Link
    seconds: float
    gaussian_at: F32
    gone_at: F32
    term_at: F32
    times: F64
    sizes: NDArray[np.int64]
    twice: int
    about: dict[str, Any]

    @cached_property
    def first(self) -> float:
        """Seconds at which the first Gaussian could be drawn; inf if none ever."""
        return float(self.gaussian_at.min(initial=np.inf))

    def bytes_at(self, times: NDArray[Any] | float) -> F64:
        """Bytes of the parcels that have arrived, at each of the times."""
        sums = np.concatenate([[0.0], np.cumsum(self.sizes, dtype=np.float64)])
        return np.asarray(sums[np.searchsorted(self.times, times, side="right")])

    def gaussians_at(self, times: NDArray[Any] | float) -> NDArray[np.int64]:
        """How many Gaussians have arrived, shown still or not."""
        return np.asarray(np.searchsorted(np.sort(self.gaussian_at), np.asarray(times, np.float32), side="right"))

    def terms_at(self, times: NDArray[Any] | float) -> NDArray[np.int64]:
        """How many terms have arrived."""
        return np.asarray(np.searchsorted(np.sort(self.term_at), np.asarray(times, np.float32), side="right"))


def play(
    delivery: Delivery, link: Link, path: HeadPath, size: tuple[int, int], *, seconds: float = 31.0, tick: float = 0.1
) -> Playback:
    """Let a delivery run.

    Args:
        delivery: The server's side, fresh.
        link: From the server to the client.
        path: Where the client is, from the moment at which it asks; it stands still after the end.
        size: N and T, Gaussians and terms of the scene.
        seconds: How long.
        tick: Seconds from one pose to the next.

    Raises:
        ValueError: If a time is out of range.
    """
    for name, value in (("seconds", seconds), ("tick", tick)):
        if not (np.isfinite(value) and 0.0 < value < 1e5):
            raise ValueError(f"{name}: expected seconds > 0, got {value!r}")
    entered = _Arrivals(*(_check.positive_int("size", count, at_least=0) for count in size))
    pipe = Pipe(link)
    ticks = np.arange(int(np.ceil(seconds / tick - 1e-9))) * tick
    positions, quats = path.at(ticks)
    events = [(float(t) + link.delay, _POSE, k) for k, t in enumerate(ticks)]
    heapq.heapify(events)
    while events:
        t, kind, number = heapq.heappop(events)
        if t > seconds:
            break
        if kind == _POSE:
            delivery.on_pose(t, positions[number], quats[number])
        else:
            delivery.on_ack(t, number)
        while (parcel := delivery.next(t)) is not None:
            arrival = pipe.send(t, parcel.nbytes)
            if arrival <= seconds:
                entered.add(arrival, parcel)
                heapq.heappush(events, (arrival + link.delay, _ACK, parcel.sequence))
    gaussians, gone, terms = entered.moments
    times, sizes = np.array(entered.times), np.array(entered.sizes, np.int64)
    about = delivery.describe()
    return Playback(
        delivery.name, delivery.exact, link, seconds, gaussians, gone, terms, times, sizes, entered.twice, about
    )


class _Arrivals:
    """What has come, and when."""

    def __init__(self, gaussians: int, terms: int) -> None:
        self.moments: tuple[F32, F32, F32] = (
            np.full(gaussians, np.inf, np.float32),
            np.full(gaussians, np.inf, np.float32),
            np.full(terms, np.inf, np.float32),
        )
        self.times: list[float] = []
        self.sizes: list[int] = []
        self.twice = 0

    def add(self, t: float, parcel: Parcel) -> None:
        gaussians, gone, terms = self.moments
        for at, ids in ((gaussians, parcel.gaussians), (terms, parcel.terms)):
            self.twice += int(np.isfinite(at[ids]).sum()) + len(ids) - len(np.unique(ids))
            at[ids] = np.minimum(at[ids], np.float32(t))
        gone[parcel.dropped] = np.minimum(gone[parcel.dropped], np.float32(t))
        self.times.append(t)
        self.sizes.append(parcel.nbytes)
