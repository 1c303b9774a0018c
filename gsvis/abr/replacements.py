"""Which Gaussians a client is to drop: what has arrived of the replacements of each, and when to look at it again.

Arrays are by number of a replaced Gaussian, in [0, E). Kernels write to them; see `gsvis.abr._kernels.plan.Cell`.
What was evicted for a view is kept here too, because it is not sent again for that view.
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
    """The replaced Gaussians of a scene, as one client has them.

    Args:
        candidates: Candidates of the scene.
        shares: (L,) of the area of its replacements that a Gaussian needs, by the level at which it ends.

    Attributes:
        shares: As given.
        arrived: (E,) area of the replacements of each that has arrived.
        looks: (E,) how much has to have arrived before each is looked at, among the candidates of the cell.
        looks_far: (E,) the same among those of the shells so far.
        sure: (E,) how much suffices without a look.
        given_up: (W,) packed set of what was evicted for this view; None for nothing.
    """

    def __init__(self, candidates: CandidateIndex, shares: NDArray[np.float64]) -> None:
        self.shares = shares
        self._candidates = candidates
        self._bounds: Bounds | None = None
        count = len(candidates.tables.links.ending)  # those of far tiles take no memory
        self.arrived: I32
        self.arrived, self.looks, self.looks_far, self.sure = blanks(4, count, np.int32)
        self.given_up: Words | None = None

    def give_up(self, ids: I32, words: Words) -> None:
        """Note that Gaussians (M,), as a packed set `words` (W,), were evicted for this view."""
        self.doubt(ids)
        if self.given_up is None:
            self.given_up = words
        else:
            self.given_up |= words

    def allow(self, cell: Cell) -> Cell:
        """Return a cell that allows nothing that was evicted for this view."""
        if self.given_up is None:
            return cell
        return cell._replace(allowed=cell.allowed & ~self.given_up[cell.words])

    def doubt(self, ids: NDArray[np.integer]) -> None:
        """Note that it is not known what has arrived of the replacements of what some Gaussians (M,) replace."""
        doubt(ids, self._candidates.tables.links, self.arrived, self.looks, self.looks_far)

    def leave_cell(self) -> None:
        """Forget what holds among the candidates of a cell."""
        self.looks = clear(self.looks)
        self.sure = clear(self.sure)
        self._bounds = None

    def bound(self, here: Candidates, *, make: bool) -> None:
        """Skip looks at what cannot be dropped yet among candidates, and at what is dropped whatever has arrived.

        Args:
            here: The candidates.
            make: Whether to compute the bounds if nobody has.
        """
        if self._bounds is not None:
            return
        found = self._candidates.bounds_of(here, self.shares, make=make)
        if found is not None:
            adopt(found, self.looks, self.sure)
            self._bounds = found

    def begin_far(self) -> None:
        """Begin to look among more than the candidates of the cell."""
        if self._candidates.is_small:
            self.looks_far[:] = self.looks
            return
        self.looks_far = clear(self.looks_far)
        if self._bounds is not None:
            self.looks_far[self._bounds.ends] = self.looks[self._bounds.ends]

    def widen(self, seen: Words, others: Seen, held: Held) -> None:
        """Add others to the candidates `seen` (W,) among which is looked."""
        widen(seen, others, held, self._candidates.tables.links, self.looks_far)
