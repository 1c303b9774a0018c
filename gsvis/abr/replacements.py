"""Which Gaussians a client drops: how much of the replacements of each has arrived, and when to check it again.

Arrays have an entry for each of the E replaced Gaussians. Kernels write to them; see `gsvis.abr._kernels.plan.Cell`.
The Gaussians that were evicted for a view are kept here too: they are not sent again for that view.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsvis._kernels.blank import blanks, clear
from gsvis.abr._kernels.plan import Cell, Held
from gsvis.abr._kernels.take import adopt, doubt, widen
from gsvis.abr._kernels.units import Seen
from gsvis.abr.candidate_sets import Bounds, Candidates
from gsvis.abr.candidates import CandidateIndex

__all__ = ["Replacements"]

I32 = NDArray[np.int32]
Words = NDArray[np.uint64]


class Replacements:
    """The state of the replaced Gaussians of a scene for one client. Areas are in `UNITS` of the kernels.

    Args:
        candidates: Candidates of the scene.
        shares: (L,) share of the area of its replacements that must arrive before a Gaussian is dropped, by the level
            at which it ends.

    Attributes:
        shares: As given.
        arrived: (E,) area of the replacements that has arrived.
        looks: (E,) area that must arrive before a Gaussian is checked again, among the candidates of the cell.
        looks_far: (E,) the same, among the candidates of the shells so far.
        sure: (E,) area with which a Gaussian is dropped without a check; 0 where it is unknown.
        given_up: (W,) packed set of the Gaussians that were evicted for this view; None for none.
    """

    def __init__(self, candidates: CandidateIndex, shares: NDArray[np.float64]) -> None:
        self.shares = shares
        self._candidates = candidates
        self._bounds: Bounds | None = None
        count = len(candidates.tables.links.ending)
        # zeros take no memory until they are written, as those of far tiles
        self.arrived: I32
        self.arrived, self.looks, self.looks_far, self.sure = blanks(4, count, np.int32)
        self.given_up: Words | None = None

    def give_up(self, ids: I32, words: Words) -> None:
        """Record Gaussians (M,) that were evicted for this view; `words` (W,) is the same as a packed set."""
        self.doubt(ids)
        if self.given_up is None:
            self.given_up = words
        else:
            self.given_up |= words

    def allow(self, cell: Cell) -> Cell:
        """Return the cell, in which Gaussians that were evicted for this view may not be sent."""
        if self.given_up is None:
            return cell
        return cell._replace(allowed=cell.allowed & ~self.given_up[cell.words])

    def doubt(self, ids: NDArray[np.integer]) -> None:
        """Mark as unknown how much has arrived for the Gaussians that `ids` (M,) replace, so that each is checked."""
        doubt(ids, self._candidates.tables.links, self.arrived, self.looks, self.looks_far)

    def leave_cell(self) -> None:
        """Forget the areas that are valid for the candidates of one cell only."""
        self.looks = clear(self.looks)
        self.sure = clear(self.sure)
        self._bounds = None

    def bound(self, here: Candidates, *, make: bool) -> None:
        """Set bounds on `looks` and `sure` for the candidates of a cell, which save most checks.

        Args:
            here: The candidates.
            make: Whether to compute the bounds if they are not in the cache.
        """
        if self._bounds is not None:
            return
        found = self._candidates.bounds_of(here, self.shares, make=make)
        if found is not None:
            adopt(found, self.looks, self.sure)
            self._bounds = found

    def begin_far(self) -> None:
        """Start `looks_far` from `looks`, before candidates of shells are added."""
        if self._candidates.is_small:
            self.looks_far[:] = self.looks
            return
        self.looks_far = clear(self.looks_far)
        if self._bounds is not None:
            self.looks_far[self._bounds.ends] = self.looks[self._bounds.ends]

    def widen(self, seen: Words, added: Seen, held: Held) -> None:
        """Add candidates to the packed set `seen` (W,), and let the Gaussians that they replace be checked again."""
        widen(seen, added, held, self._candidates.tables.links, self.looks_far)
