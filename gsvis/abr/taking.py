"""One batch while it is filled: the records taken so far, their bytes, and what they replace."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsvis.abr._kernels import plan as kernels
from gsvis.abr._kernels.take import take
from gsvis.abr.batches import Batch
from gsvis.abr.candidates import CandidateIndex
from gsvis.abr.cursor import Cursor
from gsvis.abr.holdings import Holdings
from gsvis.abr.ranking import Ranking

__all__ = ["Taking"]

_MOST_BYTES = 1e12  # of a batch


class Taking:
    """Take the records of one batch.

    Args:
        candidates: Candidates of the scene.
        holdings: What the client holds; it holds what is taken from then on.
        budget: Most bytes of the batch.

    Attributes:
        total: Bytes of the records taken so far.
    """

    def __init__(self, candidates: CandidateIndex, holdings: Holdings, budget: float) -> None:
        self._candidates = candidates
        self._holdings = holdings
        self.total = 0.0
        self._taken = [0, 0, 0, 0]  # Gaussians, terms, dropped, gone
        gaussians, terms = (
            min(n, int(min(budget, _MOST_BYTES) / size) + 1)
            for n, size in zip((holdings.gaussians, holdings.terms), candidates.tables.numbers.least_sizes, strict=True)
        )
        ids = np.empty(gaussians, np.int32)
        self._out = kernels.Taken(ids, np.empty(terms, np.uint32), *candidates.scratch.taken())

    @property
    def gaussians(self) -> int:
        """Number of Gaussians taken so far."""
        return self._taken[0]

    @property
    def terms(self) -> int:
        """Number of terms taken so far."""
        return self._taken[1]

    @property
    def has_records(self) -> bool:
        """Whether a record was taken."""
        return self._taken[0] + self._taken[1] > 0

    def take_ranked(self, ranking: Ranking, cursor: Cursor, limit: float) -> None:
        """Take the next records that were ranked, while the batch has at most `limit` bytes."""
        rest = kernels.Taken(*(array[count:] for array, count in zip(self._out, self._taken, strict=True)))
        ranking.place, *found, size = take(
            ranking.plan,
            ranking.place,
            cursor.cell,
            self._holdings.words,
            cursor.view,
            self._candidates.tables.records,
            self._candidates.tables.links,
            limit - self.total,
            rest,
        )
        self._taken = [a + b for a, b in zip(self._taken, found, strict=True)]
        self.total += size

    def batch(self, *, filling: bool, evicted: NDArray[np.int32] | None) -> Batch:
        """Return the batch.

        Args:
            filling: Whether its records only fill an idle link.
            evicted: Ids that the client forgets before; None for none.
        """
        gaussians, terms, dropped, gone = (a[:count].copy() for a, count in zip(self._out, self._taken, strict=True))
        none = dropped[:0]
        filling = filling and self.has_records
        return Batch(gaussians, terms, dropped, self.total, filling, none if evicted is None else evicted, gone)
