"""Play one delivery over one link along one path: compute all times of arrival. Nothing is rendered here.

Server and client have the same clock. The client sends its pose at every tick and acknowledges parcels immediately;
both take half of the round trip. The server sends after every message, as long as the delivery has something to send.
Time is in seconds from the client's request for the scene.
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

_POSE = 0
_ACK = 1


@dataclass(frozen=True, eq=False)
class Playback:
    """Arrival times of a delivery.

    Attributes:
        name: Name of the delivery.
        exact: Whether a view with all of the highest level shows the full scene itself.
        link: The link.
        seconds: Duration of the visit.
        gaussian_at: (N,) seconds at which each Gaussian could be drawn, inf for never.
        gone_at: (N,) seconds at which each Gaussian is dropped.
        term_at: (T,) seconds at which each term could be used.
        times: (P,) seconds of arrival of each parcel, ascending.
        sizes: (P,) bytes of each parcel.
        filling: (P,) whether each parcel only filled an idle link.
        filler: (N,) whether each Gaussian came in such a parcel.
        twice: Number of Gaussians and terms that arrived more than once.
        about: Description of the delivery.
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
    filling: NDArray[np.bool_]
    filler: NDArray[np.bool_]
    twice: int
    about: dict[str, Any]

    @cached_property
    def first(self) -> float:
        """Seconds at which the first Gaussian could be drawn; inf for never."""
        return float(self.gaussian_at.min(initial=np.inf))

    def bytes_at(self, times: NDArray[Any] | float) -> F64:
        """Return the bytes of the parcels that have arrived, at each of the times."""
        sums = np.concatenate([[0.0], np.cumsum(self.sizes, dtype=np.float64)])
        return np.asarray(sums[np.searchsorted(self.times, times, side="right")])

    def gaussians_at(self, times: NDArray[Any] | float) -> NDArray[np.int64]:
        """Return the number of Gaussians that have arrived, still shown or not."""
        return np.asarray(np.searchsorted(np.sort(self.gaussian_at), np.asarray(times, np.float32), side="right"))

    def terms_at(self, times: NDArray[Any] | float) -> NDArray[np.int64]:
        """Return the number of terms that have arrived."""
        return np.asarray(np.searchsorted(np.sort(self.term_at), np.asarray(times, np.float32), side="right"))


def play(
    delivery: Delivery, link: Link, path: HeadPath, size: tuple[int, int], *, seconds: float = 31.0, tick: float = 0.1
) -> Playback:
    """Play a delivery over a link.

    Args:
        delivery: The server's side, in its initial state.
        link: Link from the server to the client.
        path: Path of the client from its request on; its last pose holds after the end.
        size: N and T, Gaussians and terms of the scene.
        seconds: Duration.
        tick: Seconds between poses.

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
    times = np.array(entered.times)
    sizes = np.array(entered.sizes, np.int64)
    return Playback(
        delivery.name,
        delivery.exact,
        link,
        seconds,
        gaussians,
        gone,
        terms,
        times,
        sizes,
        np.array(entered.filling, np.bool_),
        entered.filler,
        entered.twice,
        delivery.describe(),
    )


class _Arrivals:
    """Times of arrival of Gaussians and terms."""

    def __init__(self, gaussians: int, terms: int) -> None:
        self.moments: tuple[F32, F32, F32] = (
            np.full(gaussians, np.inf, np.float32),
            np.full(gaussians, np.inf, np.float32),
            np.full(terms, np.inf, np.float32),
        )
        self.times: list[float] = []
        self.sizes: list[int] = []
        self.filling: list[bool] = []
        self.filler = np.zeros(gaussians, np.bool_)
        self.twice = 0

    def add(self, t: float, parcel: Parcel) -> None:
        """Record the arrival of a parcel at time t."""
        gaussians, gone, terms = self.moments
        for at, ids in ((gaussians, parcel.gaussians), (terms, parcel.terms)):
            self.twice += int(np.isfinite(at[ids]).sum()) + len(ids) - len(np.unique(ids))
            at[ids] = np.minimum(at[ids], np.float32(t))
        gone[parcel.dropped] = np.minimum(gone[parcel.dropped], np.float32(t))
        self.times.append(t)
        self.sizes.append(parcel.nbytes)
        self.filling.append(parcel.filling)
        self.filler[parcel.gaussians] |= parcel.filling
