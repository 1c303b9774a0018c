"""The cell of one client and the shells around it, for the kernels, with what the client has not received.

Shells are taken one by one, and again from the first when the client enters a cell.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gsvis._kernels.blank import blank
from gsvis.abr._kernels.evict import owe_again
from gsvis.abr._kernels.plan import Cell
from gsvis.abr._kernels.take import forget_paid, is_left
from gsvis.abr.candidate_sets import Candidates
from gsvis.abr.candidates import CandidateIndex
from gsvis.abr.holdings import Holdings
from gsvis.abr.replacements import Replacements
from gsvis.pvs.codec import pack

__all__ = ["ClientCells", "Near"]

I32 = NDArray[np.int32]
Words = NDArray[np.uint64]


class Near(NamedTuple):
    """The cell of the viewer, kept while shells fill the link."""

    here: Candidates
    cell_ahead: int
    first: Cell  # for the first pass over a view
    again: Cell  # for later passes, which have their own checks of terms


class ClientCells:
    """Makes the `Cell` of the kernels for candidates.

    Args:
        candidates: Candidates of the scene.
        holdings: What the client holds.
        replacements: Which Gaussians it drops.
        kinds: K, number of kinds of terms.
        has_terms: Whether the client may hold terms.

    Attributes:
        replacements: As given.
        has_terms: Whether the client may hold terms; the planner sets it when it sends one.
        near: The cell of the viewer; None before the first.
        shells: Number of shells around it; 0 if the client held every record when it entered the cell.
        shell: Number of the first shell with records that may be left to send; `shells` if none has.
        seen: (W,) candidates of the cell and of the shells so far; None before the first shell.
    """

    def __init__(
        self, candidates: CandidateIndex, holdings: Holdings, replacements: Replacements, kinds: int, *, has_terms: bool
    ) -> None:
        self.replacements = replacements
        self.has_terms = has_terms
        self.near: Near | None = None
        self.shells = 0
        self.shell = 0
        self.seen: Words | None = None
        self._candidates = candidates
        self._holdings = holdings
        self._kinds = kinds
        self._last_shell: Cell | None = None  # written anew for a shell with the same words
        self._is_complete = False  # the client holds every record

    def enter(self, here: Candidates, cell_ahead: int) -> Cell:
        """Enter the cell of candidates, or return to it from its shells; return it for the first pass over a view.

        Args:
            here: Candidates of the cell.
            cell_ahead: The cell that the viewer is about to enter; may be the same.
        """
        before = self.near
        is_new = before is None or before.here is not here
        if is_new:
            self.shell = 0
            self.seen = None
            self.replacements.leave_cell()
        self.replacements.bound(here, make=not is_new)
        self.shells = 0 if self._is_complete else self._candidates.count_shells(here.cell)
        if before is not None and not is_new and before.cell_ahead == cell_ahead:
            return before.first
        if cell_ahead == here.cell:
            first = self._cell_of(here, here.owing, here.active)
        else:
            ahead, owing, active = self._candidates.ahead_of(here, cell_ahead)
            first = self._cell_of(here, owing, active)._replace(ahead=ahead)
        checked = np.zeros_like(first.checked)
        again = first._replace(checked=checked, checked_at=np.zeros_like(first.checked_at))
        self.near = Near(here, cell_ahead, first, again)
        return first

    def next_shell(self, number: int) -> tuple[Candidates, Cell] | None:
        """Go on to the next shell with records left to send; return its candidates and cell, or None if there is none.

        Args:
            number: The shell to begin with.
        """
        near = self.near
        if near is None:
            return None
        shared = self._candidates
        held = self._holdings.words
        if self.seen is None:
            self.seen = self._begin_seen(near.here.union)
        for k in range(number, self.shells):
            self.shell = k
            shell = shared.shell(near.here, k)
            cell = self._shell_of(shell.candidates, self.seen)
            if is_left(shell.seen, shared.tables.highest, held, cell.owed, cell.allowed):
                self.replacements.widen(self.seen, shell.seen, held)
                return shell.candidates, self.replacements.allow(cell)
        self.shell = self.shells
        self._is_complete = self.replacements.given_up is None
        return None

    def evict(self, ids: I32) -> None:
        """Record Gaussians (M,) that were evicted for this view: they owe terms again, and shells begin again."""
        assert self.near is not None
        words = pack(ids, len(self._candidates.index))
        for cell in (self.near.first, self.near.again):
            owe_again(cell.words, words, cell.owed, cell.checked)
        self.replacements.give_up(ids, words)
        self.shell = 0
        self._is_complete = False

    def _begin_seen(self, union: Words) -> Words:
        """Return a copy (W,) of the candidates of the cell, to which shells are added."""
        assert self.near is not None
        self.replacements.begin_far()
        seen: Words
        if self._candidates.is_small:
            seen = union.copy()
        else:
            words = self.near.here.words
            seen = blank(len(union), np.uint64)
            seen[words] = union[words]
        return seen

    def _cell_of(self, here: Candidates, owing: Words, active: Words) -> Cell:
        """Return the cell of candidates; all of them may be sent.

        Args:
            here: The candidates.
            owing: (S,) those that have terms in `active`.
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
            arrived=self.replacements.arrived,
            looks=self.replacements.looks,
            sure=self.replacements.sure,
            last=shared.index.last,
            shares=self.replacements.shares,
        )
        self._forget_paid(cell)
        return cell

    def _shell_of(self, here: Candidates, seen: Words) -> Cell:
        """Return the cell of a shell. Its `allowed` is not set, and arrays of the previous shell's cell are reused.

        Args:
            here: The candidates.
            seen: (W,) candidates of the cell and of the shells so far.
        """
        made = self._last_shell
        if made is None or made.words is not here.words:
            made = self._cell_of(here, here.owing, here.active)
            self._last_shell = made = made._replace(allowed=np.empty_like(made.allowed))
        elif len(made.owed):
            made.owed[:] = here.owing
            made.checked[:] = 0
            made.checked_at[:] = 0.0
            self._forget_paid(made)
        return made._replace(candidates=seen, looks=self.replacements.looks_far)

    def _forget_paid(self, cell: Cell) -> None:
        """Remove from `owed` the words whose active terms the client holds."""
        if self.has_terms:
            offsets = self._candidates.index.term_offsets
            forget_paid(cell.words, cell.active, self._holdings.words.terms, offsets, cell.owed)
