"""The candidates of a cell and of its shells: values that all clients share.

`CandidateIndex` makes them; see there for rings and shells.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gsvis._kernels.blank import PAGE
from gsvis.abr._kernels.units import Runs, Seen, Units

__all__ = ["Bounds", "Candidates", "Shell"]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I32 = NDArray[np.int32]
Words = NDArray[np.uint64]

_PAGE_BITS = (PAGE // 8).bit_length() - 1  # of a number of words


@dataclass(frozen=True, eq=False)
class Candidates:
    """U units of a cell and its neighbors, in S words.

    Attributes:
        cell: Number of the cell.
        step: Distance of the eye from the cell for which they were made, see `gsvis.abr.outside`; 0 inside.
        words: (S,) int32 ascending, the words that have candidates: word w is Gaussians 64 w to 64 w + 63.
        places: (6, S) float32 for each word: center (x, y, z) and radius of a sphere around its Gaussians, mean square
            of their distance from its center, mean bytes of their records.
        owing: (S,) uint64, the Gaussians that have terms in `active`.
        units: The units.
        runs: Where the ring or word of the units changes.
        union: (W,) uint64, all candidates.
        active: (X,) uint64, terms that may be active, as a packed set: the active terms of the cell, or all terms if
            the scene has cones; empty if it has no terms.
        term_bytes: Mean bytes of these terms of a Gaussian that has any.
        level_bytes: (L,) bytes of the Gaussians of each level that the cell itself sees, with their terms in `active`.
    """

    cell: int
    step: int
    words: NDArray[np.int32]
    places: F32
    owing: Words
    units: Units
    runs: Runs
    union: Words
    active: Words
    term_bytes: float
    level_bytes: F64

    def __len__(self) -> int:
        """Return U."""
        return len(self.units.slots)

    @property
    def nbytes(self) -> int:
        """Bytes in memory."""
        arrays = *self.units, *self.runs, self.words, self.places, self.owing, self.active
        pages = np.count_nonzero(np.diff(self.words >> _PAGE_BITS, prepend=-1)) * PAGE  # the others hold nothing
        return sum(array.nbytes for array in arrays) + min(int(pages), self.union.nbytes)

    @property
    def seen(self) -> Seen:
        """All candidates."""
        return Seen(self.words, self.union[self.words])


class Bounds(NamedTuple):
    """Bounds on the area of replacements, for the B replaced Gaussians that candidates of a cell replace."""

    ends: I32  # (B,) numbers in [0, E)
    least: I32  # (B,) least area in `UNITS` with which the Gaussian can be dropped
    sure: I32  # (B,) area in `UNITS` with which it is dropped, whichever replacements make it up


class Shell(NamedTuple):
    """What the cells of a shell see."""

    seen: Seen  # all of it, in the words of the candidates
    candidates: Candidates  # its Gaussians of the highest level, with an empty union; or `CandidateTables.everything`
