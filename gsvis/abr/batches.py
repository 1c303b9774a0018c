"""Records that a planner chooses to be sent together."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

__all__ = ["Batch"]

I32 = NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class Batch:
    """Records that are sent together.

    Attributes:
        gaussians: (G,) int32 ids of the records of geometry and base color, in order.
        terms: (M,) uint32 ids of the records of terms, in order; their Gaussians are in this batch or before it.
        dropped: (D,) int32 ids of Gaussians that the client stops showing: all their replacements have been sent.
        bytes: Bytes of the records.
        filling: Whether the batch only fills an idle link, as the view needs none of it.
        evicted: (E,) int32 ids that the client forgets first, to have memory for the new records: Gaussians that it
            evicts with their terms, and Gaussians that those had replaced.
        gone: (R,) int32 ids of all Gaussians that this batch replaces, held or not; `dropped` is part of it.
    """

    gaussians: I32
    terms: NDArray[np.uint32]
    dropped: I32
    bytes: float
    filling: bool = False
    evicted: I32 = field(default_factory=lambda: np.zeros(0, np.int32))
    gone: I32 = field(default_factory=lambda: np.zeros(0, np.int32))

    def __len__(self) -> int:
        """Return the number of records."""
        return len(self.gaussians) + len(self.terms)

    @classmethod
    def empty(cls) -> Batch:
        """Return a batch without records."""
        return cls(np.zeros(0, np.int32), np.zeros(0, np.uint32), np.zeros(0, np.int32), 0.0)
