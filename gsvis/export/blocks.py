"""Divide a static scene into blocks, up to 64 Gaussians of one chunk that are fetched together, and order them.

Chunks of equal levels follow each other. Of each such run the files hold the first 64 Gaussians of every chunk,
then the next 64 of every chunk, and on. Gaussians of a chunk are in the order of their coverage. So the start of a run
is a coarse picture of a region, in few ranges of bytes. Ids are those of the package; places are those in the files.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from gsvis.package.codec import ChunkTable

__all__ = ["BLOCK", "Blocks", "quantize_gains"]

I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]

BLOCK = 64
"""Most Gaussians of a block."""

GAIN_STEPS = 4
"""Steps of a gain for each doubling."""


@dataclass(frozen=True, eq=False)
class Blocks:
    """B blocks in the order of the files.

    Attributes:
        chunks: (B,) chunk of each block.
        firsts: (B,) id of the first Gaussian of each block.
        counts: (B,) Gaussians of each block, 1 to `BLOCK`.
        ids: (N,) id in the package of each id of the static form.
    """

    chunks: I64
    firsts: I64
    counts: I64
    ids: I64

    @classmethod
    def from_chunks(cls, table: ChunkTable, levels: U8, gains: NDArray[np.floating] | None = None) -> Blocks:
        """Return the blocks of C chunks.

        Args:
            table: The chunks.
            levels: (C, 2) first and last level of each chunk.
            gains: (N,) gain of each Gaussian; those of a chunk are sorted by it, largest first. None keeps their order.
        """
        ids = np.arange(table.starts[-1])
        if gains is not None:
            ids = np.lexsort((-gains, np.repeat(np.arange(len(table)), table.counts)))
        parts = -(-table.counts.astype(np.int64) // BLOCK)
        chunks = np.repeat(np.arange(len(table)), parts)
        strata = np.arange(len(chunks)) - np.repeat(np.cumsum(parts) - parts, parts)
        runs = np.concatenate([[0], np.cumsum((levels[1:] != levels[:-1]).any(axis=1))])[: len(table)]
        order = np.lexsort((chunks, strata, runs[chunks]))
        chunks = chunks[order]
        strata = strata[order]
        firsts = table.starts[chunks] + BLOCK * strata
        return cls(chunks, firsts, np.minimum(table.counts[chunks] - BLOCK * strata, BLOCK), ids)

    def __len__(self) -> int:
        """Return the number of blocks."""
        return len(self.chunks)

    @cached_property
    def starts(self) -> I64:
        """(B + 1,) place of the first Gaussian of each block, then N."""
        return np.concatenate([np.zeros(1, np.int64), np.cumsum(self.counts)])

    @cached_property
    def order(self) -> I64:
        """(N,) id of the Gaussian at each place."""
        places = np.repeat(self.firsts - self.starts[:-1], self.counts) + np.arange(self.starts[-1])
        return np.asarray(self.ids[places])

    @cached_property
    def of_ids(self) -> NDArray[np.int32]:
        """(N,) block of each id."""
        out = np.empty(len(self.order), np.int32)
        out[self.order] = np.repeat(np.arange(len(self), dtype=np.int32), self.counts)
        return out

    def sums(self, ids: NDArray[np.integer], values: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return the (B,) sums over blocks of the values (M,) of ids (M,)."""
        return np.asarray(np.bincount(self.of_ids[ids], values, minlength=len(self)), np.float64)


def quantize_gains(gains: NDArray[np.float64], top: int) -> U8:
    """Return gains > 0 as bytes: 255 is 2^(top / 4), and each step below it divides by 2^(1/4), down to 1."""
    places = np.rint(GAIN_STEPS * np.log2(np.maximum(gains, np.finfo(np.float64).tiny)))
    return np.asarray(np.clip(places - top + 255, 1, 255), np.uint8)
