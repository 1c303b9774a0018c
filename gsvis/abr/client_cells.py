"""Candidates as one client sees them, for the kernels: with the terms that it has not received yet."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsvis.abr._kernels.plan import Cell
from gsvis.abr._kernels.take import forget_paid
from gsvis.abr.candidate_sets import Candidates
from gsvis.abr.candidates import CandidateIndex
from gsvis.abr.holdings import Holdings
from gsvis.abr.replaced import Replaced

__all__ = ["ClientCells"]

Words = NDArray[np.uint64]


class ClientCells:
    """Makes what the kernels read of candidates.

    Args:
        candidates: Candidates of the scene.
        holdings: What the client holds.
        replaced: What it is to drop.
        kinds: Kinds of terms, K.
        has_terms: Whether the client may hold terms.

    Attributes:
        has_terms: As given; set it when the client gets one.
    """

    def __init__(
        self, candidates: CandidateIndex, holdings: Holdings, replaced: Replaced, kinds: int, *, has_terms: bool
    ) -> None:
        self.has_terms = has_terms
        self._candidates = candidates
        self._holdings = holdings
        self._replaced = replaced
        self._kinds = kinds
        self._shell: Cell | None = None  # the last one; written anew for one with the same words

    def of(self, here: Candidates, owing: Words, active: Words) -> Cell:
        """Return candidates of which all may be sent.

        Args:
            here: The candidates.
            owing: (S,) which of them have terms in `active`.
            active: (X,) the terms that may be active.
        """
        shared = self._candidates
        slots = len(here.words)
        owed = owing[: slots if shared.index.num_terms else 0].copy()
        full, empty = shared.full_and_empty(slots)
        cell = Cell(
            words=here.words,
            places=here.places,
            term_bytes=here.term_bytes,
            owed=owed,
            active=active,
            candidates=here.union,
            allowed=full,
            ahead=empty,
            checked=np.zeros((self._kinds, len(owed)), np.uint64),
            checked_at=np.zeros((self._kinds, len(owed)), np.float32),
            arrived=self._replaced.arrived,
            looks=self._replaced.looks,
            sure=self._replaced.sure,
            last=shared.index.last,
            shares=self._replaced.shares,
        )
        self._forget_paid(cell)
        return cell

    def of_shell(self, here: Candidates, seen: Words) -> Cell:
        """Return candidates of a shell, of which nothing may be sent yet; the cell of the shell before may change.

        Args:
            here: The candidates.
            seen: (W,) candidates of the cell and of the shells so far.
        """
        made = self._shell
        if made is None or made.words is not here.words:
            made = self.of(here, here.owing, here.active)
            self._shell = made = made._replace(allowed=np.empty_like(made.allowed))
        elif len(made.owed):
            made.owed[:] = here.owing
            made.checked[:] = 0
            made.checked_at[:] = 0.0
            self._forget_paid(made)
        return made._replace(candidates=seen, looks=self._replaced.looks_far)

    def _forget_paid(self, cell: Cell) -> None:
        if self.has_terms:
            offsets = self._candidates.index.term_offsets
            forget_paid(cell.words, cell.active, self._holdings.words.terms, offsets, cell.owed)
