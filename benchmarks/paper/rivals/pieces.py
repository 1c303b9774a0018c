"""Cut a package into pieces that rivals send whole, and send them one by one, the most urgent first.

A piece has measured bytes, and names the Gaussians and terms that can be drawn when all of it has arrived. Its box, in
the scene frame, is what a rule knows of its place. What is urgent is decided by the rules of each rival.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.abr.predict import Pose
from gsvis.package.contents import Contents
from gsvis.simulate.baselines import CHUNK, terms_of
from gsvis.simulate.delivery import Parcel
from paper.rivals.flow import Flow

__all__ = ["Pieces", "Sender", "boxes_in_view", "boxes_of", "distances_to"]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Mask = NDArray[np.bool_]

_REACH = 3.0  # standard deviations at which a Gaussian ends
_NONE = np.zeros(0, np.int64)


@dataclass(frozen=True, eq=False)
class Pieces:
    """K pieces of a package.

    Attributes:
        gaussians: K arrays of ids that can be drawn when a piece has arrived; no id is in two pieces.
        dropped: K arrays of ids that are no longer shown then.
        nbytes: (K,) measured bytes of each piece, header and all; 0 for a piece that does not exist.
        boxes: (K, 2, 3) lowest and highest corner of what a piece holds, scene frame.
        after: (K,) piece that has to go before each; -1 for none.
    """

    gaussians: Sequence[I64]
    dropped: Sequence[I64]
    nbytes: I64
    boxes: F64
    after: I64

    def __post_init__(self) -> None:
        k = len(self.nbytes)
        lengths = {len(self.gaussians), len(self.dropped), len(self.boxes), len(self.after)}
        if lengths != {k}:
            raise ValueError(f"nbytes: expected one for each piece, got {k} for {sorted(lengths)}")
        _check.in_range("nbytes", np.asarray(self.nbytes), 0, 1e12)
        _check.in_range("after", np.asarray(self.after), -1, max(k - 1, 0))
        ids = np.concatenate([*self.gaussians, _NONE])
        if len(np.unique(ids)) != len(ids):
            raise ValueError("gaussians: expected each Gaussian in one piece, got one in two")

    def __len__(self) -> int:
        """Return K."""
        return len(self.nbytes)


class Sender(ABC):
    """Send pieces on request. Rivals say which is the most urgent for a pose.

    The first message of the client brings a header; pieces follow when all of it has arrived. A piece is split into
    parcels as a download is, and counts with its last one.

    Args:
        contents: The package.
        pieces: Its pieces.
        flow: What may be in flight.
        header: Bytes to send before any piece: the description of the pieces, and what is always drawn.
        always: Ids that the header brings.
        waits: Whether the piece before has to have arrived, not only been sent: a client that decides from what it has.
        measured: How the sizes were measured, for reports.

    Attributes:
        name: Name for reports.
        exact: Whether views that have all of the highest level show the full scene itself.
        sent: (K,) which pieces have been sent.
        arrived: (K,) which pieces are known to have arrived.
    """

    name = "pieces"
    exact = True

    def __init__(
        self,
        contents: Contents,
        pieces: Pieces,
        flow: Flow,
        *,
        header: int = 0,
        always: ArrayLike = _NONE,
        waits: bool = False,
        measured: str = "",
    ) -> None:
        self.pieces = pieces
        self.measured = measured
        self._flow = flow
        self._waits = waits
        self._contents = contents
        self.sent = np.asarray(pieces.nbytes) <= 0
        self.arrived = np.asarray(pieces.nbytes) <= 0
        self._header = int(header)
        self._always = np.asarray(always, np.int64)
        self._opened = self._header <= 0 and len(self._always) == 0  # whether the header has arrived
        self._asked = self._opened  # whether it was sent
        self._parcels: deque[Parcel] = deque()
        self._waiting: deque[tuple[int, int]] = deque()  # last parcel of each piece in flight, and the piece
        self._sequence = 0
        self._pose: Pose | None = None
        self._urgency: F64 | None = None

    def on_pose(self, t: float, position: ArrayLike, quat: ArrayLike) -> None:
        """Take a pose; see `Delivery`."""
        self._pose = Pose.from_arrays(position, quat)
        self._urgency = None

    def on_ack(self, t: float, sequence: int) -> None:
        """Take an acknowledgement; see `Delivery`."""
        self._flow.on_ack(t, sequence)
        while self._waiting and self._waiting[0][0] <= sequence:
            piece = self._waiting.popleft()[1]
            if piece < 0:
                self._opened = True
            else:
                self.arrived[piece] = True
            self._urgency = None

    def next(self, t: float) -> Parcel | None:
        """Return the next parcel; see `Delivery`. None before the first pose."""
        if not self._parcels and self._pose is not None:
            if not self._asked:
                self._asked = True
                self._put(t, -1, max(self._header, 1), self._always, _NONE)
            elif self._opened and self._flow.ready() and (piece := self._most_urgent(t)) is not None:
                self.sent[piece] = True
                p = self.pieces
                self._put(t, piece, int(p.nbytes[piece]), p.gaussians[piece], p.dropped[piece])
        return self._parcels.popleft() if self._parcels else None

    @abstractmethod
    def urgency(self, t: float, pose: Pose) -> F64:
        """Return (K,) the urgency of each piece, larger first; -inf for what is not wanted."""

    def describe(self) -> dict[str, Any]:
        """Return facts for reports; see `Delivery`."""
        p = self.pieces
        return {
            "pieces": int(np.count_nonzero(p.nbytes)),
            "bytes": self._header + int(p.nbytes.sum()),
            "measured": self.measured,
        }

    def _most_urgent(self, t: float) -> int | None:
        if self._urgency is None:
            assert self._pose is not None
            self._urgency = self.urgency(t, self._pose)
        before = self.pieces.after
        known = self.arrived if self._waits else self.sent
        free = ~self.sent & ((before < 0) | known[before])
        if not free.any():
            return None
        best = int(np.where(free, self._urgency, -np.inf).argmax())
        return best if free[best] and np.isfinite(self._urgency[best]) else None

    def _put(self, t: float, piece: int, nbytes: int, ids: I64, dropped: I64) -> None:
        cuts = [*range(0, nbytes, CHUNK), nbytes]
        sizes = [high - low for low, high in pairwise(cuts)]
        parcels = [Parcel(self._sequence + k + 1, size, _NONE, _NONE, _NONE) for k, size in enumerate(sizes)]
        last = parcels[-1]
        parcels[-1] = Parcel(last.sequence, last.nbytes, ids, terms_of(self._contents, ids), dropped)
        self._sequence = last.sequence
        self._parcels.extend(parcels)
        self._waiting.append((last.sequence, piece))
        self._flow.on_sent(t, [(parcel.sequence, parcel.nbytes) for parcel in parcels])


def boxes_of(means: F32, scales: F32, groups: Sequence[I64]) -> F64:
    """Return (K, 2, 3) boxes around the ellipsoids of K groups of ids; a group without any has a box at 0."""
    reach = _REACH * scales.max(axis=1, keepdims=True).astype(np.float64)
    low = means - reach
    high = means + reach
    out = np.zeros((len(groups), 2, 3))
    for k, ids in enumerate(groups):
        if len(ids):
            out[k] = low[ids].min(axis=0), high[ids].max(axis=0)
    return out


def boxes_in_view(planes: F32, boxes: F64) -> Mask:
    """Return (K,) whether each box touches a frustum.

    Args:
        planes: (5, 4) as `FieldOfView.planes`: normals that point inward, and offsets.
        boxes: (K, 2, 3) lowest and highest corners.
    """
    normals = planes[:, :3].astype(np.float64)
    farthest = np.where(normals[:, None] > 0, boxes[None, :, 1], boxes[None, :, 0])  # (5, K, 3)
    return np.asarray(((farthest * normals[:, None]).sum(axis=2) + planes[:, 3, None] >= 0).all(axis=0))


def distances_to(eye: F64, boxes: F64) -> F64:
    """Return (K,) the distance from an eye to the nearest point of each box."""
    return np.asarray(np.linalg.norm(np.clip(eye, boxes[:, 0], boxes[:, 1]) - eye, axis=1))
