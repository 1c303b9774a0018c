"""Number the Gaussians of a static scene: chunk after chunk, and within a chunk part after part."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

__all__ = ["Placing"]

I64 = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Placing:
    """The ids of the static form for some of N Gaussians.

    Attributes:
        order: (M,) Gaussian with each id of the static form.
        part_of: (N,) part of each Gaussian, -1 for those that are not in the static form.
    """

    order: I64
    part_of: I64

    @classmethod
    def from_parts(cls, parts: list[I64], chunks: NDArray[np.int32], count: int) -> Placing:
        """Return the numbers for parts.

        Args:
            parts: Gaussians of each part; each Gaussian is in one part at most, and all or none of a chunk are.
            chunks: (N,) chunk of each Gaussian, never decreasing.
            count: N.
        """
        part_of = np.full(count, -1, np.int64)
        for k, part in enumerate(parts):
            part_of[part] = k
        ids = np.flatnonzero(part_of >= 0)
        return cls(ids[np.lexsort((part_of[ids], chunks[ids]))], part_of)

    @cached_property
    def placed(self) -> I64:
        """(N,) id in the static form of each Gaussian, -1 for those that are not in it."""
        out = np.full(len(self.part_of), -1, np.int64)
        out[self.order] = np.arange(len(self.order))
        return out

    @cached_property
    def _by_part(self) -> tuple[I64, I64]:
        """Ids of the static form, part after part, and where each part begins, and their end."""
        of = self.part_of[self.order]
        return np.argsort(of, kind="stable"), np.concatenate([[0], np.cumsum(np.bincount(of))])

    def of_part(self, part: int) -> I64:
        """Return the ascending ids of the static form of a part."""
        ids, starts = self._by_part
        return ids[starts[part] : starts[part + 1]]
