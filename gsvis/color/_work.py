"""Foresee how much work the fit of each Gaussian is, so that progress is even in time.

Few Gaussians have most of the terms, and a scene in order of its levels begins with them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["count_progress", "foresee_work"]

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

_PER_TERM = 0.8
"""Work for each term, over that for a Gaussian without one: 10 of 12 microseconds."""
_PER_PAIR = 0.08
"""The same for the square of the number of terms, because each new term changes the others."""
_GROUP = 64
"""Gaussians of a sample with about the same importance, whose mean work is used."""


def foresee_work(importance: F64, sampled: F64, terms: I64) -> F64:
    """Return (N,) work of each Gaussian, over that of one without terms: the mean of those about as important.

    Args:
        importance: (N,) importance of all Gaussians.
        sampled: (n,) importance of a sample, at least one.
        terms: (n,) numbers of terms of the sample.
    """
    order = np.argsort(sampled, kind="stable")
    work = 1.0 + _PER_TERM * terms[order] + _PER_PAIR * np.square(terms[order], dtype=np.float64)
    starts = np.arange(0, len(work), _GROUP)
    means = np.add.reduceat(work, starts) / np.diff(np.append(starts, len(work)))
    group = np.searchsorted(sampled[order][starts], importance, side="right") - 1
    return np.asarray(means[np.maximum(group, 0)], np.float64)


def count_progress(work: F64, parts: list[slice]) -> list[int]:
    """Return the number of N Gaussians that count as done after each part: its share of the work; N after the last.

    Args:
        work: (N,) work of each Gaussian, above 0.
        parts: Slices that follow each other and cover all Gaussians.
    """
    if not parts:
        return []
    spent = np.cumsum(np.add.reduceat(work, [part.start for part in parts]))
    return [*(len(work) * spent[:-1] / spent[-1]).astype(np.int64).tolist(), len(work)]
