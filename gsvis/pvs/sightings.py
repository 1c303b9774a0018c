"""What viewpoints see, and what they see too faintly for a set, which a set that misses light may take.

In a large scene many Gaussians are smaller than a pixel. Each takes little of a pixel's light, together they take much.
World frame; ids are those of the union of levels.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsvis.pvs.weight_classes import FAINTEST

__all__ = ["FaintOnes", "Sighting"]

F64 = NDArray[np.float64]
I8 = NDArray[np.int8]
I32 = NDArray[np.int32]

_FIRST = -2  # highest class down to which a set takes at first: the one above is small
_SHARE = 0.5  # of the limit: the missed light that should be left
_PAYS = 0.75  # part of the missed light that may be left by the last classes, if fainter ones are to follow


@dataclass(frozen=True, eq=False)
class Sighting:
    """The Gaussians that one viewpoint sees.

    Attributes:
        viewpoint: (3,) the viewpoint.
        looks: Levels that were looked at, without those in which it lies inside something solid.
        ids: (V,) int32, Gaussians of a weight that has a class in some level, ascending; see `WeightClasses`.
        classes: (V,) int8, class of the largest weight of each; negative if it is below tau.
    """

    viewpoint: F64
    looks: int
    ids: I32
    classes: I8

    @property
    def seen(self) -> NDArray[np.bool_]:
        """(V,) whether the weight of each is tau or more."""
        return self.classes >= 0

    def between(self, low: int, high: int) -> I32:
        """Return the Gaussians of the classes `low` to `high` - 1."""
        return self.ids[(self.classes >= low) & (self.classes < high)]


class FaintOnes:
    """What the viewpoints of a cell saw of a level too faintly for its set. The set may take it, class by class.

    In a large scene many Gaussians are smaller than a pixel. Each takes little of a pixel's light, together they take
    much. Half the weight halves about what is missed.

    Args:
        sightings: What the viewpoints saw.
        members: (N,) which Gaussians are of the level.
        limit: Share of the light that a set may miss.

    Attributes:
        taken: Lowest class that the set has taken; 0 before the first.
    """

    def __init__(self, sightings: Sequence[Sighting], members: NDArray[np.bool_], limit: float) -> None:
        self.taken = 0
        self._sightings = sightings
        self._members = members
        self._limit = limit
        self._before = np.inf

    def pay(self, missed: float) -> bool:
        """Return whether there are more and taking the last ones left little of the light that was missed before."""
        return self.taken > FAINTEST and missed <= _PAYS * self._before

    def take(self, missed: float) -> Iterator[tuple[I32, F64]]:
        """Take as many classes as a set needs that misses this share of the light.

        Yields:
            For each viewpoint the Gaussians of these classes (V,), and the viewpoint (3,).
        """
        steps = np.ceil(np.log2(missed / (_SHARE * self._limit)))
        low = max(FAINTEST, min(self.taken - int(max(steps, 1)), _FIRST))
        high = self.taken
        self.taken = low
        self._before = missed
        for each in self._sightings:
            ids = each.between(low, high)
            yield ids[self._members[ids]], each.viewpoint
