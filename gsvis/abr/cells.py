"""Cells as a scheduler wants them, from the store of visible sets and the store of active terms.

A cell is decoded when it is first asked for and kept while there is room. Records may stand in another order than the
scene of the stores; ids are then turned into places of records. Safe to share by threads.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.abr.index import CellMembers
from gsvis.package.active_terms import ActiveTerms
from gsvis.pvs.codec import ids_of, pack
from gsvis.pvs.store import VisibilityStore

__all__ = ["StoreCells", "class_weights"]

I64 = NDArray[np.int64]
U32 = NDArray[np.uint32]


class StoreCells:
    """Sets of cells, read from stores.

    Args:
        sets: The visible sets.
        active: The active terms of their cells; None where the scene has none.
        order: (N,) the scene's Gaussian in each place of the records; None: the records stand as the scene.
        term_offsets: (N + 1,) terms of Gaussian i of the scene; needed with `order` and `active`.
        max_bytes: Most bytes of decoded cells kept; the one used last stays in any case.

    Raises:
        ValueError: If `order` is no permutation of the scene's Gaussians, or offsets are missing.
    """

    def __init__(
        self,
        sets: VisibilityStore,
        active: ActiveTerms | None = None,
        *,
        order: ArrayLike | None = None,
        term_offsets: ArrayLike | None = None,
        max_bytes: int = 256 << 20,
    ) -> None:
        self._sets, self._active = sets, active
        self._places: I64 | None = None
        self._term_places: I64 | None = None
        self._max_bytes = _check.positive_int("max_bytes", max_bytes, at_least=0)
        self._kept: OrderedDict[tuple[str, int], Any] = OrderedDict()
        self._bytes = 0
        self._lock = threading.Lock()
        if order is not None:
            of_place = _check.integers("order", order, (sets.gaussians,))
            if not np.array_equal(np.sort(of_place), np.arange(sets.gaussians)):
                raise ValueError("order: expected each Gaussian of the scene once, got another list")
            self._places = np.argsort(of_place)
            if active is not None:
                if term_offsets is None:
                    raise ValueError("term_offsets: expected those of the scene with order and active, got None")
                self._term_places = term_places(of_place, np.asarray(term_offsets, np.int64))

    def members(self, cell: int) -> CellMembers:
        """What a cell sees."""

        def read() -> tuple[CellMembers, int]:
            ids, classes = self._sets.classes(cell)
            if self._places is not None:
                ids = self._places[ids]
                by_place = np.argsort(ids)
                ids, classes = ids[by_place], classes[by_place]
            words = pack(ids, self._sets.gaussians)
            return CellMembers(words, classes), words.nbytes + classes.nbytes

        found: CellMembers = self._held(("members", cell), read)
        return found

    def words(self, cell: int) -> NDArray[np.uint64]:
        """What a cell sees as a packed set, without classes."""

        def read() -> tuple[NDArray[np.uint64], int]:
            words = self._sets.visible_words(cell)
            if self._places is not None:
                words = pack(self._places[ids_of(words)], self._sets.gaussians)
            return words, words.nbytes

        found: NDArray[np.uint64] = self._held(("words", cell), read)
        return found

    def terms(self, cell: int) -> U32:
        """(A,) rising ids of the active terms of a cell."""

        def read() -> tuple[U32, int]:
            ids = np.zeros(0, np.int64) if self._active is None else self._active.active_ids(cell)
            if self._term_places is not None:
                ids = np.sort(self._term_places[ids])
            return ids.astype(np.uint32), 4 * len(ids)

        found: U32 = self._held(("terms", cell), read)
        return found

    def _held(self, key: tuple[str, int], read: Callable[[], tuple[Any, int]]) -> Any:
        with self._lock:
            if key in self._kept:
                self._kept.move_to_end(key)
                return self._kept[key][0]
        value, size = read()
        with self._lock:
            if key not in self._kept:
                self._kept[key] = value, size
                self._bytes += size
                while self._bytes > self._max_bytes and len(self._kept) > 1:
                    self._bytes -= self._kept.popitem(last=False)[1][1]
        return value


def class_weights(sets: VisibilityStore) -> NDArray[np.float32]:
    """(K,) weight that stands for each class of a store: the geometric mean of its ends."""
    ends = [sets.class_interval(level) for level in range(len(sets.info.class_edges))]
    return np.array([np.sqrt(low * min(high, 1.0)) for low, high in ends], np.float32)


def term_places(order: I64, offsets: I64) -> I64:
    """(T,) the place of each term of a scene when its Gaussians stand in an order, with their terms beside them."""
    counts = np.diff(offsets)[order]
    starts = np.concatenate([[0], np.cumsum(counts)])
    within = np.arange(starts[-1]) - np.repeat(starts[:-1], counts)
    out = np.empty(int(offsets[-1]), np.int64)
    out[np.repeat(offsets[:-1][order], counts) + within] = np.arange(starts[-1])
    return out
