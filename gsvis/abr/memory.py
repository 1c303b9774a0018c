"""The memory of one client: how many bytes it holds, and which Gaussians to evict for what the view needs.

Gaussians that no cell near the viewer sees are evicted first, the farthest first, then Gaussians that are out of view.
Nothing in view is evicted. Words of 64 Gaussians are judged together, by a sphere around them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.abr._kernels import evict as kernels
from gsvis.abr._kernels.plan import test_words
from gsvis.abr.candidates import CandidateIndex
from gsvis.abr.holdings import Holdings

__all__ = ["ClientMemory"]

F32 = NDArray[np.float32]
I32 = NDArray[np.int32]
Words = NDArray[np.uint64]

_AT_ONCE = 0.02  # least share of the memory to free at a time


class ClientMemory:
    """The memory of one client.

    Args:
        candidates: Candidates of the scene.
        holdings: What the client holds. `make_room` changes it.
        most_bytes: Bytes that the client can hold: of Gaussians that it shows, and of their terms; see
            `TableNumbers.stored`.

    Attributes:
        most_bytes: Bytes that the client can hold.
        held_bytes: Bytes that it holds.

    Raises:
        ValueError: If `most_bytes` is not above 0.
    """

    def __init__(self, candidates: CandidateIndex, holdings: Holdings, most_bytes: float) -> None:
        if not most_bytes > 0:
            raise ValueError(f"most_bytes: expected bytes > 0, got {most_bytes!r}")
        self._shared = candidates
        self._holdings = holdings
        self.most_bytes = float(most_bytes)
        self.held_bytes = self._bytes_of(holdings.shown)

    @property
    def free(self) -> float:
        """Bytes that are free; never below 0."""
        return max(0.0, self.most_bytes - self.held_bytes)

    @property
    def is_full(self) -> bool:
        """Whether too little is free to send records that the view does not need."""
        return self.free < _AT_ONCE * self.most_bytes

    def add(self, gaussians: int, terms: int, dropped: I32) -> None:
        """Count the bytes of a sent batch: numbers of Gaussians and terms, (D,) ids of Gaussians that it replaced."""
        self.held_bytes += (
            gaussians * self._shared.tables.numbers.stored[0] + terms * self._shared.tables.numbers.stored[1]
        )
        if len(dropped):
            self.held_bytes -= self._bytes_of(dropped)

    def make_room(self, needed: float, near: Words, eye: F32, planes: F32, *, for_view: bool) -> I32:
        """Evict Gaussians with their terms.

        Args:
            needed: Bytes to free; a little more is freed, so that not every batch has to evict.
            near: (W,) uint64, packed set of what the cells near the viewer see.
            eye: (3,) position.
            planes: (F, 5, 4) frusta.
            for_view: Whether the bytes are for records in view. Then nearby Gaussians out of view may go too.

        Returns:
            (E,) ids that the client forgets: the evicted Gaussians, and those that they had replaced.
        """
        shared = self._shared
        held = self._holdings.words
        some = np.flatnonzero(held.gaussians)
        shown = held.gaussians[some] & ~held.gone[some]
        spheres = shared.tables.spheres[some]
        apart = np.square(spheres[:, :3] - eye).sum(axis=1)
        out = np.empty(self._holdings.gaussians, np.int32)
        found = [np.zeros(0, np.int32)]
        needed = max(needed, _AT_ONCE * self.most_bytes)
        for masks in _evictable_masks(shown, near[some], spheres, planes, for_view=for_view):
            words = np.flatnonzero(masks)
            order = words[np.argsort(-apart[words], kind="stable")]
            count, freed = kernels.evict(
                some[order],
                masks[order],
                needed,
                shared.tables.numbers.stored,
                held,
                shared.index.term_offsets,
                shared.tables.links,
                out,
            )
            found.append(out[:count].copy())
            self.held_bytes -= freed
            needed -= freed
            if needed <= 0:
                break
        return np.concatenate(found)

    def _bytes_of(self, ids: NDArray[Any]) -> float:
        """Return the bytes of Gaussians (M,) with those of their terms that are held."""
        shared = self._shared
        terms = kernels.held_terms_of(ids, self._holdings.sent_terms, shared.index.term_offsets)
        return float(len(ids) * shared.tables.numbers.stored[0] + terms * shared.tables.numbers.stored[1])


def _evictable_masks(shown: Words, near: Words, spheres: F32, planes: F32, *, for_view: bool) -> list[Words]:
    """Return masks (S,) of the Gaussians that may be evicted first, and of those that may be evicted after them.

    Args:
        shown: (S,) masks of the Gaussians that the client shows, in S words.
        near: (S,) masks of those that the cells near the viewer see.
        spheres: (S, 4) center and radius of a sphere around each word.
        planes: (F, 5, 4) frusta.
        for_view: See `ClientMemory.make_room`.
    """
    if not for_view:
        return [shown & ~near]
    sides = np.zeros(len(shown), np.uint8)
    x, y, z, radii = np.ascontiguousarray(spheres.T)
    for frustum in planes:
        test_words(x, y, z, radii, frustum, sides)
    return [shown & ~near, np.where(sides == 0, shown & near, np.uint64(0))]
