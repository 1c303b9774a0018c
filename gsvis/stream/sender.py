"""The server's side of one client: poses and acknowledgements in, messages out. No socket, no clock.

A batch of the scheduler becomes a message of records; what the client must have first, rows of chunks and color axes,
goes with it. Throughput is measured here, so a simulator and a server see the same, and a client cannot claim one.
Budgets are bytes of messages.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis.abr.classes import FieldOfView
from gsvis.abr.holdings import Holdings
from gsvis.abr.planner import Batch
from gsvis.abr.scheduler import Scheduler, SchedulerConfig
from gsvis.stream._kernels import ids as kernels
from gsvis.stream.batch import FIXED_BYTES, Sections
from gsvis.stream.meter import LinkMeter
from gsvis.stream.scene import StreamedScene
from gsvis.stream.wire import Hello

__all__ = ["Message", "Sender"]

LEAST = 1024
"""Bytes below which no message is begun."""

PIECE = 4096.0
"""Bytes that a message should have at least, so that what is around records stays small."""

_FIRST = 1.2  # bytes of a message for each byte of records, before there was one
_LEARNED = 0.3  # how much of what the last one had is believed


@dataclass(frozen=True, eq=False)
class Message:
    """What goes to the client at once.

    Attributes:
        sequence: Its number; WELCOME has 0, batches follow without a gap.
        data: The bytes.
        batch: What is in it; empty for WELCOME.
    """

    sequence: int
    data: bytes
    batch: Batch


class Sender:
    """What one client gets.

    Args:
        scene: Shared by all clients.
        view: What the client shows.
        config: Of the scheduler; None means `SchedulerConfig()`.
        holdings: What the client holds already; None is nothing. It is changed by what is sent.

    Attributes:
        scene: As given.
        scheduler: What decides.
        meter: What is under way, and how long it took.
        wire_bytes: Of all messages.
    """

    def __init__(
        self,
        scene: StreamedScene,
        view: FieldOfView,
        config: SchedulerConfig | None = None,
        *,
        holdings: Holdings | None = None,
    ) -> None:
        self.scene = scene
        self.scheduler = Scheduler(scene.store, view, config, holdings=holdings)
        self.meter = LinkMeter()
        self.wire_bytes, self._sequence, self._added = 0, 0, _FIRST
        self._starts = scene.contents.table.starts
        self._has_row = np.zeros(len(scene.chunk_rows), bool)
        self._has_row[scene.contents.chunks[self.holdings.received]] = True
        self._has_axes = np.zeros(len(scene) if scene.about.axis_bytes else 0, bool)
        if scene.about.axis_bytes:
            self._has_axes[scene.owners[self.holdings.received_terms]] = True
        self._gone, self._room = self.holdings.gone.copy(), np.empty(scene.ending, np.int32)

    @classmethod
    def greeted(cls, scene: StreamedScene, hello: Hello, config: SchedulerConfig | None = None) -> Sender:
        """For a client that says HELLO; what it holds of another scene is nothing.

        Raises:
            ValueError: If it says that it holds what cannot be.
        """
        holdings = None
        if hello.holdings and hello.identity.hex() == scene.about.identity:
            holdings = Holdings.from_bytes(hello.holdings, len(scene), scene.about.terms)
        return cls(scene, hello.view, config, holdings=holdings)

    @property
    def holdings(self) -> Holdings:
        """What has been sent, and what the client had before."""
        return self.scheduler.holdings

    @property
    def rate(self) -> float:
        """Estimated throughput, bytes of messages a second."""
        return self.scheduler.rate

    @property
    def outstanding(self) -> int:
        """Bytes sent and not acknowledged."""
        return self.meter.outstanding

    @property
    def done(self) -> bool:
        """Whether the client has been sent all that its view asks for."""
        return self.scheduler.done

    def welcome(self, t: float) -> Message:
        """WELCOME, which is to be sent first; acknowledged, it shows the round trip."""
        data, none = self.scene.header, np.zeros(0, np.int32)
        self._count(t, 0, len(data))
        return Message(0, data, Batch(none, none.astype(np.uint32), none, 0.0))

    def on_pose(self, t: float, position: ArrayLike, quat: ArrayLike) -> None:
        """The client is here at time t; see `Scheduler.on_pose`.

        Raises:
            ValueError: If something is not finite, or no rotation; nothing has changed then.
        """
        self.scheduler.on_pose(t, position, quat)

    def on_ack(self, t: float, sequence: int) -> None:
        """All messages up to this one have arrived; one that is told twice is passed over.

        Raises:
            ValueError: If no such message was sent.
        """
        before = self.meter.outstanding
        found = self.meter.on_ack(t, sequence)
        self.scheduler.on_ack(t, before - self.meter.outstanding)
        if found is not None:
            self.scheduler.on_transfer(*found)

    def allowance(self) -> float:
        """Bytes that may be sent now, so that the link has work for the window and for a round trip, and no more."""
        scheduler = self.scheduler
        return max(0.0, self.rate * (scheduler.config.window + self.meter.round_trip) - scheduler.outstanding)

    def room(self, seconds: float | None = None) -> float:
        """Bytes that the next message should have.

        Args:
            seconds: That the link should take for it; None means the `piece` of the scheduler.

        Returns:
            0 where so little may be sent that it had better wait for the next acknowledgement. Where nothing is under
            way it is never 0: a link thought dead is asked once more.
        """
        size = max(self.rate * (self.scheduler.config.piece if seconds is None else seconds), PIECE)
        room = max(self.allowance(), PIECE) if self.outstanding == 0 else self.allowance()
        return min(size, room) if room >= 0.5 * size else 0.0

    def next_message(self, t: float, budget: float | None = None) -> Message | None:
        """The next batch.

        Args:
            t: Seconds.
            budget: Bytes that the message should have; None means `room`. What chunks and ids add is known only
                when records have been chosen, so it may have some percent more; what is under way says so.

        Returns:
            None where the budget is too small to begin, nothing is left for the view, or no pose has come.
        """
        room = (self.room() if budget is None else budget) - FIXED_BYTES
        if room < LEAST - FIXED_BYTES:
            return None
        batch = self.scheduler.next_batch(t, room / self._added)
        if len(batch) == 0:
            return None
        self._sequence += 1
        data = self._encoded(batch)
        self._added += _LEARNED * ((len(data) - FIXED_BYTES) / batch.bytes - self._added)
        self._count(t, self._sequence, len(data))
        return Message(self._sequence, data, batch)

    def _count(self, t: float, sequence: int, nbytes: int) -> None:
        self.wire_bytes += nbytes
        self.meter.on_sent(t, sequence, nbytes)
        self.scheduler.on_sent(t, nbytes)

    def _encoded(self, batch: Batch) -> bytes:
        scene, contents = self.scene, self.scene.contents
        gaussians, terms = np.sort(batch.gaussians), np.sort(batch.terms)
        owners = scene.owners[terms]
        fresh = np.empty(min(len(gaussians), len(scene.chunk_rows)), np.int32)
        chunks = fresh[: kernels.first_times(gaussians, contents.chunks, self._has_row, fresh)]
        axes = contents.axes[:0]
        if scene.about.axis_bytes:
            fresh = np.empty(len(terms), np.int32)
            axes = contents.axes[fresh[: kernels.first_times(terms, scene.owners, self._has_axes, fresh)]]
        gone = self._room[: kernels.added(self.holdings.gone, self._gone, self._room)]
        return Sections(
            self._sequence, self._starts[chunks], scene.chunk_rows[chunks], gaussians,
            _gathered(contents.records, gaussians), terms, owners, _gathered(contents.term_records, terms), axes, gone,
        ).to_message(scene.about)  # fmt: skip


def _gathered(rows: NDArray[np.uint8], places: NDArray[np.integer[Any]]) -> NDArray[np.uint8]:
    out = np.empty((len(places), rows.shape[1]), np.uint8)
    kernels.gather(rows, places, out.reshape(-1))
    return out
