"""What cells see, as packed sets without empty words: of a large scene a cell sees little. Threads may share it."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis._kernels.blank import blank
from gsvis.abr._kernels import units as kernels
from gsvis.abr._kernels.units import Seen
from gsvis.abr.index import SceneIndex
from gsvis.files.cache import Cache
from gsvis.pvs.codec import word_count

__all__ = ["SeenSets"]

Words = NDArray[np.uint64]

_STRANGERS = "the set belongs to a different scene"
_FEW = 32  # words of a scene for each listed one, above which sorting takes less time than a pass over all


class SeenSets:
    """The visible sets of a scene.

    Args:
        index: The scene.
        cache: Keeps the sets.
    """

    def __init__(self, index: SceneIndex, cache: Cache[Any]) -> None:
        self._index = index
        self._cache = cache
        self._local = threading.local()

    def of_cell(self, cell: int) -> Seen:
        """Return the visible set of a cell; cache it, since cells share neighbors.

        Raises:
            ValueError: If it names Gaussians that the scene does not have.
        """
        found: Seen | None = self._cache.find(("words", cell))
        if found is None:
            found = Seen(*self._index.sets.visible_masks(cell))
            self._cache.keep(("words", cell), self._checked(found), sum(array.nbytes for array in found))
        return found

    def of_rings(self, rings: list[list[int]]) -> list[list[Seen]]:
        """Return sets of each ring of cells for `join`: one for each cell, or fewer that hold as much.

        Raises:
            ValueError: If they name Gaussians that the scene does not have.
        """
        found = self._index.sets.ring_masks(rings)
        return [[self._checked(Seen(*masks)) for masks in ring] for ring in found]

    def join(self, rings: list[list[Seen]]) -> tuple[list[Seen], Seen]:
        """Return what the sets of each ring have that those of earlier rings lack, and all together."""
        before, fresh = self._scratch()
        sizes = [sum(len(seen.words) for seen in ring) for ring in rings]
        union = np.empty(sum(sizes), np.int32)
        known = 0
        found = []
        for ring, size in zip(rings, sizes, strict=True):
            listed = np.empty(size, np.int32)
            count = 0
            for seen in ring:
                count = kernels.add_fresh(seen, before, fresh, listed, count)
            words = _sort_words(listed[:count], fresh)
            masks = np.empty(count, np.uint64)
            known = kernels.settle(words, fresh, before, masks, union, known)
            found.append(Seen(words, masks))
        words = _sort_words(union[:known], before)
        masks = np.empty(known, np.uint64)
        kernels.take_out(words, before, masks)
        return found, Seen(words, masks)

    def pack(self, cells: list[int]) -> Words:
        """Return all that cells see as a packed set (W,), in a scene that is not large."""
        packed = np.zeros(word_count(len(self._index)), np.uint64)
        for cell in cells:
            kernels.add(self.of_cell(cell), packed)
        return packed

    def _checked(self, seen: Seen) -> Seen:
        n = len(self._index)
        last = 64 * int(seen.words[-1]) + int(seen.masks[-1]).bit_length() if len(seen.words) else 0
        if last > n:
            got = f"one with ids up to {last - 1:,}"
            raise ValueError(f"words: expected a set of {n:,} Gaussians, got {got}; {_STRANGERS}")
        return seen

    def _scratch(self) -> tuple[Words, Words]:
        """Return two packed sets of the calling thread, which it leaves empty."""
        if not hasattr(self._local, "sets"):
            size = word_count(len(self._index))
            self._local.sets = blank(size, np.uint64), blank(size, np.uint64)
        found: tuple[Words, Words] = self._local.sets
        return found


def _sort_words(listed: NDArray[np.int32], words: Words) -> NDArray[np.int32]:
    """Return the numbers of the words that are not empty, which are listed, ascending."""
    if len(words) < _FEW * len(listed):  # one pass takes less time than sorting
        return np.flatnonzero(words).astype(np.int32)
    return np.sort(listed)
