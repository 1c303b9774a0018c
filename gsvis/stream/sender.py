"""The server's side of one client: poses and acknowledgements in, messages out. No socket, no clock.

A batch of the scheduler becomes a message of records; what the client must have first, rows of chunks and colour axes,
goes with it. Throughput is measured here, so a simulator and a server see the same, and a client cannot claim one.
Budgets are bytes of messages.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis.abr.classes import FieldOfView
from gsvis.abr.holdings import Holdings
from gsvis.abr.planner import Batch
from gsvis.abr.scheduler import Scheduler, SchedulerConfig
from gsvis.stream.batch import CHUNK_ROW, Sections
from gsvis.stream.meter import LinkMeter
from gsvis.stream.scene import StreamedScene
from gsvis.stream.wire import Hello
from gsvis.visibility._codec import ids_of

__all__ = ["Message", "Sender"]

LEAST = 1024
"""Bytes below which no message is begun."""

_FIXED = 256  # bytes of a message without records


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
        self.wire_bytes, self._record_bytes, self._sequence = 0, 0.0, 0
        table, contents = scene.contents.table, scene.contents
        self._has_row = np.zeros(len(table), bool)
        self._has_axes = np.zeros(len(contents), bool)
        self._gone = self.holdings.gone.copy()
        self._has_row[contents.chunks[self.holdings.received]] = True
        owners = np.searchsorted(contents.term_offsets, self.holdings.received_terms, side="right") - 1
        self._has_axes[owners] = True

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
        self.scheduler.on_ack(t, before - self.meter.outstanding, 0.0 if found is None else found[1])

    def allowance(self) -> float:
        """Bytes that may be sent now."""
        return self.scheduler.allowance()

    def next_message(self, t: float, budget: float | None = None) -> Message | None:
        """The next batch.

        Args:
            t: Seconds.
            budget: Bytes of the message at most; None means `allowance`.

        Returns:
            None where the budget is too small to begin, nothing is left for the view, or no pose has come.
        """
        room = self.allowance() if budget is None else budget
        if room < LEAST:
            return None
        batch = self.scheduler.next_batch(t, (room - _FIXED) / 1.4)
        if len(batch) == 0:
            return None
        data = self._sections(batch).to_message()
        self._record_bytes += batch.bytes
        self._count(t, self._sequence, len(data))
        return Message(self._sequence, data, batch)

    def _count(self, t: float, sequence: int, nbytes: int) -> None:
        self.wire_bytes += nbytes
        self.meter.on_sent(t, sequence, nbytes)
        self.scheduler.on_sent(t, nbytes)

    def _sections(self, batch: Batch) -> Sections:
        contents, table = self.scene.contents, self.scene.contents.table
        self._sequence += 1
        gaussians, terms = (np.sort(ids).astype(np.int64) for ids in (batch.gaussians, batch.terms))
        gone = ids_of(self.holdings.gone & ~self._gone)
        self._gone[:] = self.holdings.gone
        chunks = np.unique(contents.chunks[gaussians])
        chunks = chunks[~self._has_row[chunks]]
        self._has_row[chunks] = True
        owners = np.searchsorted(contents.term_offsets, terms, side="right") - 1
        fresh = np.unique(owners)
        fresh = fresh[~self._has_axes[fresh]]
        self._has_axes[fresh] = True
        rows: NDArray[np.void] = np.zeros(len(chunks), CHUNK_ROW)
        for name, values in (
            ("origin", table.origins), ("step", table.steps), ("low", table.lows), ("count", table.counts),
            ("stride", table.strides), ("first_level", contents.chunk_levels[:, 0]),
            ("last_level", contents.chunk_levels[:, 1]),
        ):  # fmt: skip
            rows[name] = values[chunks]
        return Sections(
            self._sequence, table.starts[chunks], rows, gaussians, contents.records[gaussians], terms, owners,
            contents.term_records[terms], contents.axes[fresh], gone,
        )  # fmt: skip
