"""The visible sets of cells as packed sets without empty words, since a cell sees little of a large scene.

Threads may share them.
"""

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
            ValueError: If it contains ids that the scene does not have.
        """
        found: Seen | None = self._cache.find(("words", cell))
        if found is None:
            found = Seen(*self._index.sets.visible_masks(cell))
            self._cache.keep(("words", cell), self._checked(found), sum(array.nbytes for array in found))
        return found

    def of_rings(self, rings: list[list[int]]) -> list[list[Seen]]:
        """Return the visible sets of each ring of cells, for `join`: one a cell, or fewer with the same union.

        Raises:
            ValueError: If they contain ids that the scene does not have.
        """
        found = self._index.sets.ring_masks(rings)
        return [[self._checked(Seen(*masks)) for masks in ring] for ring in found]

    def join(self, rings: list[list[Seen]]) -> tuple[list[Seen], Seen]:
        """Return for each ring the Gaussians that no earlier ring sees, and the union of all rings."""
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
        """Return the union of what cells see as a packed set (W,); for small scenes, as it has all words."""
        packed = np.zeros(word_count(len(self._index)), np.uint64)
        for cell in cells:
            kernels.add(self.of_cell(cell), packed)
        return packed

    def _checked(self, seen: Seen) -> Seen:
        """Return a set; raise ValueError if it contains ids that the scene does not have."""
        n = len(self._index)
        last = 64 * int(seen.words[-1]) + int(seen.masks[-1]).bit_length() if len(seen.words) else 0
        if last > n:
            got = f"one with ids up to {last - 1:,}; the set belongs to a different scene"
            raise ValueError(f"words: expected a set of {n:,} Gaussians, got {got}")
        return seen

    def _scratch(self) -> tuple[Words, Words]:
        """Return two empty packed sets (W,) of the calling thread, which has to leave them empty."""
        if not hasattr(self._local, "sets"):
            size = word_count(len(self._index))
            self._local.sets = blank(size, np.uint64), blank(size, np.uint64)
        found: tuple[Words, Words] = self._local.sets
        return found


def _sort_words(listed: NDArray[np.int32], words: Words) -> NDArray[np.int32]:
    """Return the listed numbers of words in ascending order: `listed` names all words of `words` that are not 0."""
    if len(words) < _FEW * len(listed):  # one pass takes less time than sorting
        return np.flatnonzero(words).astype(np.int32)
    return np.sort(listed)
