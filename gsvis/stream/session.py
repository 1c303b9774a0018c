"""The session of one viewer: what the client holds, what to send next, and when. No socket, no clock.

Poses and acknowledgements go in, messages come out. The planner chooses records; the session measures the link, limits
the bytes in flight, and adds the rows of chunks that the client needs to decode the records. The session measures
throughput itself, so simulator and server see the same values, and a client cannot claim a false one. Times are in
seconds; sizes are bytes of messages.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis._kernels.blank import blank
from gsvis.abr.batches import Batch
from gsvis.abr.classes import FieldOfView
from gsvis.abr.config import AbrConfig
from gsvis.abr.estimate import estimator
from gsvis.abr.holdings import Holdings
from gsvis.abr.planner import Planner
from gsvis.stream._kernels import ids as kernels
from gsvis.stream.batch import FIXED_BYTES, Sections
from gsvis.stream.meter import LinkMeter
from gsvis.stream.scene import StreamedScene
from gsvis.stream.wire import Hello

__all__ = ["Message", "Session"]

LEAST = 1024
"""Bytes of the smallest message."""

PIECE = 4096.0
"""Bytes that a message should have at least, so that its overhead stays small."""

_FIRST = 1.2  # bytes of a message per byte of records, assumed before the first message
_LEARNED = 0.3  # weight of the last message in the running mean of that ratio


@dataclass(frozen=True, eq=False)
class Message:
    """Bytes for the client.

    Attributes:
        sequence: Number of the message; WELCOME has 0, batches follow without a gap.
        data: The bytes.
        batch: The records in it; empty for WELCOME.
    """

    sequence: int
    data: bytes
    batch: Batch


class Session:
    """The state of one viewer.

    Args:
        scene: The scene, shared by all sessions.
        view: The client's field of view.
        config: Settings of planner and estimator; None means `AbrConfig()`.
        holdings: What the client holds already; None means nothing. The session adds what it sends.
        memory: Bytes of records that the client can hold; None means no limit.

    Attributes:
        scene: The scene.
        config: Settings of planner and estimator.
        planner: Chooses the records.
        meter: Measures the bytes in flight and the time of transfers.
        piece: Seconds that the link should take for one message; `AbrConfig.piece` unless changed.
        wire_bytes: Bytes of all messages so far.
        record_bytes: Bytes of the records of all batches so far.
        filling_bytes: Bytes of the messages that only filled an idle link.
    """

    def __init__(
        self,
        scene: StreamedScene,
        view: FieldOfView,
        config: AbrConfig | None = None,
        *,
        holdings: Holdings | None = None,
        memory: float | None = None,
    ) -> None:
        self.scene = scene
        self.config = config or AbrConfig()
        self.planner = Planner(scene.candidates, view, self.config, holdings=holdings, memory=memory)
        self.meter = LinkMeter()
        self.piece = self.config.piece
        self._throughput = estimator(self.config.estimator, self.config.start_rate)
        self.wire_bytes = 0
        self.record_bytes = 0.0
        self.filling_bytes = 0
        self._sequence = 0
        self._overhead = _FIRST
        sizes = len(self.holdings.sent), len(self.holdings.sent_terms)
        self._marks, self._term_marks = ((blank(n, np.uint64), blank(-(-n // 64), np.uint64)) for n in sizes)
        self._has_row = blank(len(scene.records.chunk_rows), bool)
        if holdings is not None:
            self._has_row[scene.records.chunks[holdings.received]] = True

    @classmethod
    def from_hello(cls, scene: StreamedScene, hello: Hello, config: AbrConfig | None = None) -> Session:
        """Return the session for a HELLO; ignore holdings with the identity of a different scene.

        Raises:
            ValueError: If the client claims holdings that the scene cannot have.
        """
        holdings = None
        if hello.holdings and hello.identity.hex() == scene.about.identity:
            holdings = Holdings.from_bytes(hello.holdings, len(scene), scene.about.terms)
        return cls(scene, hello.view, config, holdings=holdings, memory=hello.memory or None)

    @property
    def holdings(self) -> Holdings:
        """What the session has sent, and what the client held before."""
        return self.planner.holdings

    @property
    def rate(self) -> float:
        """Estimated throughput, bytes of messages a second."""
        return self._throughput.estimate()

    @property
    def record_rate(self) -> float:
        """Estimated throughput, bytes of records a second: the rate without the overhead of the messages so far."""
        share = self.record_bytes / self.wire_bytes if self.wire_bytes > 0 else 1.0
        return self.rate * min(share, 1.0) if share > 0 else self.rate

    @property
    def outstanding(self) -> int:
        """Bytes sent and not acknowledged."""
        return self.meter.outstanding

    @property
    def done(self) -> bool:
        """Whether nothing is left to send; see `Planner.done`."""
        return self.planner.done

    @property
    def filling(self) -> bool:
        """Whether the next message only fills an idle link."""
        return self.planner.filling

    @property
    def has_to_prepare(self) -> bool:
        """Whether the next message will take long, because the candidates of the viewer's cell have to be computed."""
        return self.planner.has_to_prepare

    def welcome(self, t: float) -> Message:
        """Return WELCOME, the first message to send; its acknowledgement measures the round trip."""
        self._record_sent(t, 0, len(self.scene.header))
        return Message(0, self.scene.header, Batch.empty())

    def on_pose(self, t: float, position: ArrayLike, quat: ArrayLike) -> None:
        """Update the pose of the client at time t, in seconds; see `Planner.on_pose`.

        Raises:
            ValueError: If a value is not finite, or the quaternion is 0. Nothing changes then.
        """
        self.planner.on_pose(t, position, quat)

    def on_ack(self, t: float, sequence: int) -> None:
        """Count all messages up to this one as received; ignore a repeated acknowledgement.

        Raises:
            ValueError: If no such message was sent.
        """
        transfer = self.meter.on_ack(t, sequence)
        if transfer is not None:
            self._throughput.observe(*transfer)

    def allowance(self) -> float:
        """Return how many bytes may be sent now, to keep the link busy for the window and a round trip.

        Records that only fill the link have a window of two messages, so that they do not delay what the next view
        needs. If messages are longer than `AbrConfig.piece`, all windows have room for at least two.
        """
        return self._free_bytes(self._filling_window if self.filling else self._window)

    def room(self) -> float:
        """Return the bytes that the next message should have; 0 to wait for an acknowledgement.

        It is never 0 if nothing is in flight, so that the session retries a link that seems dead. The first messages
        are small, because a client shows a message only when it is complete.
        """
        size = max(self.rate * self.piece, PIECE)
        if self.wire_bytes < self.config.begin:
            size = min(size, max(PIECE, 0.25 * self.wire_bytes))
        room = max(self.allowance(), PIECE) if self.outstanding == 0 else self.allowance()
        return min(size, room) if room >= 0.5 * size else 0.0

    def prepare(self) -> None:
        """Compute the candidates that `has_to_prepare` reports; any thread may, while none else uses the session."""
        self.planner.prepare()

    def next_message(
        self, t: float, budget: float | None = None, *, sent_at: Callable[[], float] | None = None
    ) -> Message | None:
        """Return the next batch.

        Args:
            t: Seconds.
            budget: Bytes that the message should have; None means `room`. The size of chunks and ids is known only
                after the planner has chosen the records, so a message may exceed the budget by a few percent.
            sent_at: Called when the message is ready, returns the time in seconds. So planning does not count as
                transfer time. None means t.

        Returns:
            The batch; None if the budget is too small, nothing is left for the view, or no pose has arrived.
        """
        room = (self.room() if budget is None else budget) - FIXED_BYTES
        if room < LEAST - FIXED_BYTES:
            return None
        spare = min(room, self._spare_bytes()) / self._overhead
        batch = self.planner.next_batch(t, room / self._overhead, self.record_rate, spare=spare)
        self.record_bytes += batch.bytes
        if len(batch) == 0 and len(batch.evicted) == 0:
            return None
        self._sequence += 1
        data = self._encode(batch)
        if len(batch.evicted) == 0:
            self._overhead += _LEARNED * ((len(data) - FIXED_BYTES) / batch.bytes - self._overhead)
        self._record_sent(t if sent_at is None else sent_at(), self._sequence, len(data))
        self.filling_bytes += len(data) if batch.filling else 0
        return Message(self._sequence, data, batch)

    @property
    def _window(self) -> float:
        """Seconds of data that may be in flight."""
        wide = self.piece > self.config.piece
        return max(self.config.window, 2.0 * self.piece) if wide else self.config.window

    @property
    def _filling_window(self) -> float:
        """Seconds of data that may be in flight if it only fills the link."""
        return min(self._window, 2.0 * self.piece)

    def _free_bytes(self, window: float) -> float:
        """Return how many more bytes may be in flight, for a window in seconds plus a round trip."""
        return max(0.0, self.rate * (window + self.meter.round_trip) - self.outstanding)

    def _spare_bytes(self) -> float:
        """Return how many bytes may be sent that only fill the link; never 0 if nothing is in flight."""
        free = self._free_bytes(self._filling_window)
        return max(free, PIECE) if self.outstanding == 0 else free

    def _record_sent(self, t: float, sequence: int, nbytes: int) -> None:
        """Count a message as sent."""
        self.wire_bytes += nbytes
        self.meter.on_sent(t, sequence, nbytes)

    def _encode(self, batch: Batch) -> bytes:
        """Return the BATCH message of a batch, with the rows of chunks that are new to the client."""
        scene = self.scene
        coding = scene.coding
        gaussians = _sort_ids(batch.gaussians, *self._marks)
        terms = _sort_ids(batch.terms, *self._term_marks)
        of = np.empty_like(gaussians)
        fresh = np.empty_like(gaussians)
        records = scene.records
        count = kernels.lay_out(gaussians, records.chunks, records.starts, self._has_row, of, fresh)
        chunks = fresh[:count]
        owners = records.owners[terms]
        sections = Sections(
            sequence=self._sequence,
            chunks=records.starts[chunks],
            rows=records.chunk_rows[chunks],
            gaussians=gaussians,
            records=coding.encode_some(records.parts, gaussians, of, records.chunk_numbers),
            terms=terms,
            owners=owners,
            term_records=coding.encode_some_terms(records.term_records, terms, owners),
            gone=_sort_ids(batch.gone, *self._marks),
            evicted=np.sort(batch.evicted),
        )
        return sections.to_message(scene.about)


def _sort_ids(ids: NDArray[Any], marks: NDArray[np.uint64], summary: NDArray[np.uint64]) -> NDArray[Any]:
    """Return ids in ascending order; `marks` and `summary` are scratch, see `ascend`."""
    out = np.empty_like(ids)
    if len(ids):
        kernels.ascend(ids, marks, summary, out)
    return out
