"""The records that a view needs next, in their order, and how many of them have been taken."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.abr._kernels.plan import Cell, Limits, Plan, View, rank
from gsvis.abr.candidate_sets import Candidates
from gsvis.abr.candidates import CandidateIndex
from gsvis.abr.config import AbrConfig
from gsvis.abr.holdings import Holdings
from gsvis.abr.policies import fill_table, offset_table

__all__ = ["Ranking"]

_FOOTPRINT = 3.6e-5  # steradians, of a square of 6 mrad
_NOTHING = Plan(np.zeros(0, np.int32), np.zeros(0, np.uint64), np.zeros(0, np.float32))


class Ranking:
    """Ranks the records of a view by the policy of a configuration, some at a time.

    Args:
        candidates: Candidates of the scene.
        holdings: What the client holds.
        config: Settings.

    Attributes:
        plan: The records that were ranked last, in order.
        place: Number of its entries that have been taken.
        picture: Highest level of the first picture; -1 if there is none.
        kinds: Kinds of terms, K.
        first_gains: (K,) `View.gains` of the first pass over a view.
        gains: (K,) `View.gains` of the later passes.
    """

    def __init__(self, candidates: CandidateIndex, holdings: Holdings, config: AbrConfig) -> None:
        index = candidates.index
        by_change = index.cones is not None and index.num_terms > 0 and config.policy == "utility"
        self.plan = _NOTHING
        self.place = 0
        self.picture = index.highest_within(config.picture)
        self._strong = tuple(config.strong) if by_change else ()
        self.kinds = 1 + len(self._strong)
        self.first_gains = _gains(config.first_epsilon, *self._strong)
        self.gains = _gains(config.epsilon, *self._strong)
        self._candidates = candidates
        self._holdings = holdings
        self._config = config
        self._table = np.zeros((0, 1 + self.kinds, 3), np.int32)
        self._keys = 0
        self._least = 0
        self._is_whole = True  # the plan ends with the last record to send
        self._wanted = 0.0

    @property
    def is_at_end(self) -> bool:
        """Whether all that was ranked has been taken."""
        return self.place == len(self.plan.entries)

    @property
    def is_used_up(self) -> bool:
        """Whether all that is left to send has been taken."""
        return self._is_whole and self.is_at_end

    def begin_view(self, regime: str) -> None:
        """Begin with what a view needs: its Gaussians, and its terms that change the image much."""
        self._begin(*self._table_of(regime, strong=self._strong))

    def begin_terms(self, regime: str, parts: tuple[int, ...]) -> None:
        """Begin with what a view needs, with smaller changes by terms of Gaussians in some parts of the view."""
        self._begin(*self._table_of(regime, terms_in=parts))

    def begin_shell(self) -> None:
        """Begin with a shell, which only fills the link."""
        config = self._config
        levels = self._candidates.index.num_levels
        self._begin(*fill_table(config.policy, levels, config.utility, kinds=self.kinds))

    def _table_of(self, regime: str, **more: tuple[Any, ...]) -> tuple[NDArray[np.int32], int]:
        """Return the `offset_table` of a regime and its number of keys; `more` are arguments of `offset_table`."""
        config = self._config
        levels = self._candidates.index.num_levels
        return offset_table(
            config.policy, regime, levels, config.utility, picture=self.picture, kinds=self.kinds, **more
        )

    def _begin(self, table: NDArray[np.int32], keys: int) -> None:
        """Forget the plan, and rank by this table with this number of keys from now on."""
        self.plan = _NOTHING
        self.place = 0
        self._table = table
        self._keys = keys
        self._least = 0
        self._is_whole = False
        self._wanted = 0.0

    def rank_more(self, here: Candidates, cell: Cell, view: View, enough: float) -> None:
        """Rank the records that follow the plan: at least `enough` bytes, and twice as many as the last time.

        Args:
            here: The candidates.
            cell: The same candidates for the kernels, with what the client lacks.
            view: What the client looks at.
            enough: Bytes.
        """
        self._wanted = max(2.0 * self._wanted, enough)
        self.place = 0
        work = self._candidates.scratch.work(len(here.words), len(here), self._keys, self.kinds)
        limits = Limits(float(self._wanted), self._least)
        self.plan, self._least, self._is_whole = rank(
            here.units, here.runs, cell, self._holdings.words, view, self._table, limits, work
        )


def _gains(*epsilons: float) -> NDArray[np.float64]:
    """Return log gains: a term is sent if its change of the image times its gain is above 1, that is above epsilon."""
    return np.asarray(-np.log(epsilons) - 0.5 * np.log(_FOOTPRINT))
