"""The records that a view needs next, in their order, and how many of them have been taken."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsvis.abr._kernels.plan import Cell, Limits, Plan, View, rank
from gsvis.abr.candidate_sets import Candidates
from gsvis.abr.candidates import CandidateIndex
from gsvis.abr.holdings import Holdings

__all__ = ["Ranking"]

_NOTHING = Plan(np.zeros(0, np.int32), np.zeros(0, np.uint64), np.zeros(0, np.float32))


class Ranking:
    """Ranks the records of a view, as far as they are asked for.

    Args:
        candidates: Candidates of the scene.
        holdings: What the client holds.
        kinds: Kinds of terms, K.

    Attributes:
        plan: What was ranked last.
        place: Entries of it that have been taken.
    """

    def __init__(self, candidates: CandidateIndex, holdings: Holdings, kinds: int) -> None:
        self.plan = _NOTHING
        self.place = 0
        self._candidates = candidates
        self._holdings = holdings
        self._kinds = kinds
        self._table = np.zeros((0, 1 + kinds, 3), np.int32)
        self._keys = 0
        self._least = 0
        self._is_whole = True  # nothing is to be ranked behind the plan
        self._wanted = 0.0

    @property
    def is_at_end(self) -> bool:
        """Whether all that was ranked has been taken."""
        return self.place == len(self.plan.entries)

    @property
    def is_used_up(self) -> bool:
        """Whether all that is left to send has been taken."""
        return self._is_whole and self.is_at_end

    def restart(self, table: NDArray[np.int32], keys: int) -> None:
        """Begin with nothing ranked.

        Args:
            table: The order, see `gsvis.abr.policies.table`.
            keys: Number of its keys.
        """
        self.plan = _NOTHING
        self.place = 0
        self._table = table
        self._keys = keys
        self._least = 0
        self._is_whole = False
        self._wanted = 0.0

    def rank_more(self, here: Candidates, cell: Cell, view: View, enough: float) -> None:
        """Rank what comes behind the plan: at least `enough` bytes, and twice as many as the last time.

        Args:
            here: The candidates.
            cell: They as the client sees them.
            view: What the client looks at.
            enough: Bytes.
        """
        self._wanted = max(2.0 * self._wanted, enough)
        self.place = 0
        work = self._candidates.scratch.work(len(here.words), len(here), self._keys, self._kinds)
        limits = Limits(float(self._wanted), self._least)
        self.plan, self._least, self._is_whole = rank(
            here.units, here.runs, cell, self._holdings.words, view, self._table, limits, work
        )
