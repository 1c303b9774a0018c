"""Scratch arrays for planning, one set for each thread. The next call of the same thread overwrites them.

In a large scene, allocating an array takes longer than filling it.
"""

from __future__ import annotations

import threading

import numpy as np
from numpy.typing import NDArray

from gsvis._kernels.blank import blank
from gsvis.abr._kernels import plan

__all__ = ["Scratch"]

I32 = NDArray[np.int32]

_WORKS = 64  # `Work` tuples that a thread keeps


class Scratch:
    """Scratch arrays of each thread that calls.

    Args:
        replaced: E, number of Gaussians that have replacements.
    """

    def __init__(self, replaced: int) -> None:
        self._replaced = replaced
        self._local = threading.local()

    def taken(self) -> list[I32]:
        """Return two (E,) int32 arrays, for the ids of all Gaussians that a batch replaces."""
        return self._arrays("taken", 2)

    def bounds(self) -> list[I32]:
        """Return four (E,) int32 arrays for the bounds of a cell. The first is 0, and its user leaves it so."""
        return self._arrays("bounds", 4)

    def work(self, slots: int, units: int, keys: int, terms: int = 1) -> plan.Work:
        """Return arrays to rank units in.

        Args:
            slots: S, number of words.
            units: U, number of units.
            keys: M, number of keys.
            terms: K, number of kinds of terms.
        """
        key = slots, units, keys, terms
        made: dict[tuple[int, ...], plan.Work] = self._local.__dict__.setdefault("made", {})
        if key not in made:
            if len(made) >= _WORKS:
                made.clear()
            made[key] = self._make_work(slots, units, keys, terms)
        return made[key]

    def _make_work(self, slots: int, units: int, keys: int, terms: int) -> plan.Work:
        """Return the arrays of `work` as views of the thread's memory, which grows if it is too small."""
        local = self._local
        entries = 3 * (1 + terms) * units
        sizes = []
        for name, size, kinds in (
            ("slots", slots, (*3 * (np.uint64,), *2 * (np.uint8,), np.float32, np.int32)),
            ("due", terms * slots, (np.uint64,)),
            ("units", units, (np.int32, np.int32)),
            ("entries", entries, (np.int32, np.int32, np.uint64, np.int32)),
            ("keys", keys, (np.int64, np.float64)),
        ):
            if not hasattr(local, name) or len(getattr(local, name)[0]) < size:
                local.made.clear()  # views of the old memory
                setattr(local, name, tuple(np.empty(size, kind) for kind in kinds))
            sizes.append([array[:size] for array in getattr(local, name)])
        (inside, middle, free, *others), (due,), of_units, listed, sums = sizes
        of_words = [inside, middle, free, due.reshape(terms, slots), *others]
        return plan.Work(*of_words, *of_units, *listed, *sums)

    def _arrays(self, name: str, count: int) -> list[I32]:
        """Return `count` (E,) arrays of the thread, which start as zeros."""
        if not hasattr(self._local, name):
            setattr(self._local, name, [blank(self._replaced, np.int32) for _ in range(count)])
        found: list[I32] = getattr(self._local, name)
        return found
