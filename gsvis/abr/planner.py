"""The order of records for one client, kept while it is used up: ranked when the view changes, then taken from.

A plan reaches as far as the bytes of the near future; when it is used up, ranking goes on behind it. Between two
changes of the view, batches together are one order, whatever their sizes. Knows no time, no estimator and no predictor.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.abr._kernels import plan as kernels
from gsvis.abr.candidates import Candidates, CandidateStore
from gsvis.abr.holdings import Holdings
from gsvis.abr.policies import UtilityConfig, table

__all__ = ["Batch", "Planner"]

I32 = NDArray[np.int32]

_NOTHING = np.zeros(0, np.int32), np.zeros(0, np.uint64)


@dataclass(frozen=True, eq=False)
class Batch:
    """What is sent at once.

    Attributes:
        gaussians: (G,) int32 ids of the records of geometry and base color, in order.
        terms: (M,) uint32 ids of the records of terms, in order; their Gaussians are in this batch or before it.
        dropped: (D,) int32 ids of Gaussians that the client is to show no more: their replacements are all there.
        bytes: Of the records.
    """

    gaussians: I32
    terms: NDArray[np.uint32]
    dropped: I32
    bytes: float

    def __len__(self) -> int:
        """Records in all."""
        return len(self.gaussians) + len(self.terms)


class Planner:
    """The order for one client.

    Args:
        store: Candidates of the scene, shared.
        policy: One of `POLICIES`.
        holdings: What the client holds; changed by `take`. None is nothing.
        utility: Factors of the policy "utility".
        reach: Bytes that are ranked at least at a time.
    """

    def __init__(
        self,
        store: CandidateStore,
        policy: str = "utility",
        *,
        holdings: Holdings | None = None,
        utility: UtilityConfig | None = None,
        reach: float = 1e6,
    ) -> None:
        index = store.index
        self.store, self.policy, self.utility, self.reach = store, policy, utility, reach
        self._table, self._keys = table(policy, "high", index.num_levels, utility)  # refuses what it does not know
        self.holdings = Holdings(len(index), index.num_terms) if holdings is None else holdings
        if (self.holdings.gaussians, self.holdings.terms) != (len(index), index.num_terms):
            raise ValueError(f"holdings: expected those of {index!r}, got {self.holdings!r}")
        self._candidates: Candidates | None = None
        self._eye, self._planes = np.zeros(3, np.float32), np.zeros((1, 5, 4), np.float32)
        self._owed = np.zeros(0, np.uint64)
        self._plan, self._place = _NOTHING, 0
        self._least, self._whole, self._wanted = 0, True, 0.0
        self._waits = np.empty((len(store.ending), 2), np.int32)
        self._records = store.sizes, index.term_offsets, index.term_bytes

    @property
    def done(self) -> bool:
        """Whether all that the view asks for has been taken."""
        return self._whole and self._place == len(self._plan[0])

    def aim(self, cell: int, eye: ArrayLike, planes: ArrayLike, regime: str = "high") -> None:
        """Turn to a view; the next records are ranked for it.

        Args:
            cell: The cell of the eye.
            eye: (3,) position.
            planes: (F, 5, 4) frusta; what is in one of them is in view.
            regime: One of `REGIMES`.
        """
        levels = self.store.index.num_levels
        view = _check.floats("eye", eye, (3,)), _check.floats("planes", planes, ("F", 5, 4))
        self._table, self._keys = table(self.policy, regime, levels, self.utility)
        candidates = self.store.of(cell)
        if self._candidates is None or self._candidates.cell != cell:
            self._enter(candidates)
        self._candidates, self._eye, self._planes = candidates, *view
        self._plan, self._place, self._least, self._whole, self._wanted = _NOTHING, 0, 0, False, 0.0

    def take(self, budget: float) -> Batch:
        """The next records, of at most so many bytes; from now on they count as held.

        Nothing, when the next record is larger than the budget, or all has been taken.
        """
        if not budget >= 0:
            raise ValueError(f"budget: expected bytes >= 0, got {budget!r}")
        candidates = self._candidates
        if candidates is None or self.done:
            return Batch(np.zeros(0, np.int32), np.zeros(0, np.uint32), np.zeros(0, np.int32), 0.0)
        counts, sizes = (self.holdings.gaussians, self.holdings.terms), self.store.least_sizes
        most = [min(n, int(min(budget, 1e12) / size) + 1) for n, size in zip(counts, sizes, strict=True)]
        out = np.empty(most[0], np.int32), np.empty(most[1], np.uint32), np.empty(len(self._waits), np.int32)
        queue = np.empty_like(out[2])
        taken, total = [0, 0, 0], 0.0
        cell = candidates.words, self._owed, candidates.active
        while not self.done:
            if self._place == len(self._plan[0]):
                self._wanted = max(2.0 * self._wanted, self.reach, budget - total)  # a view that lasts is ranked seldom
                self._rank(candidates, self._wanted)
            rest = tuple(array[count:] for array, count in zip(out, taken, strict=True))
            links = candidates.union, *self.store.links, self._waits
            self._place, *found, size = kernels.take(
                self._plan, self._place, cell, self.holdings.words, self._records, links,
                budget - total, (*rest, queue),
            )  # fmt: skip
            taken, total = [a + b for a, b in zip(taken, found, strict=True)], total + size
            if self._place < len(self._plan[0]):
                break
        gaussians, terms, dropped = (array[:count].copy() for array, count in zip(out, taken, strict=True))
        return Batch(gaussians, terms, dropped, total)

    def _enter(self, candidates: Candidates) -> None:
        """Begin with the units of another cell."""
        self._waits[:, 0] = kernels.UNKNOWN
        self._owed = candidates.owing.copy()
        if self.holdings.sent_terms.any():
            kernels.forget_paid(
                candidates.words, candidates.active, self.holdings.sent_terms, self.store.index.term_offsets, self._owed
            )

    def _rank(self, candidates: Candidates, enough: float) -> None:
        store, c = self.store, candidates
        room = store.room(len(c.words), len(c), self._keys)
        self._plan, self._least, self._whole = kernels.rank(
            c.units, c.runs, (c.words, c.places, c.term_bytes), self._owed, self.holdings.words,
            (self._eye, self._planes, store.bodies), self._table, (float(enough), self._least), room,
        )  # fmt: skip
        self._place = 0
