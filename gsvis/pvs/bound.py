"""Compute an upper confidence bound of a small ratio, from independent samples, valid at any time.

The bound is found by betting. A player bets against the claim that the share is r. If the claim holds, the capital of
the player is a martingale that starts at 1, so it ever reaches 1 / error with a probability of at most `error` (Ville's
inequality). The bound is the least share at which the player has become that rich. This module knows no rays.

References:
    I. Waudby-Smith and A. Ramdas, "Estimating means of bounded random variables by betting", Journal of the Royal
    Statistical Society B 86 (2024), section 4; there for means, here for the ratio of two means.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.pvs._kernels import bound as kernels

__all__ = ["STAKES", "staged_bound", "upper_bound"]

F64 = NDArray[np.float64]

STAKES = ((0.95, 0.65), (0.5, 0.17), (0.2, 0.1), (0.07, 0.05), (0.02, 0.03))
"""Stakes of the players, as a share of the largest possible stake, and the part of the first capital each gets.

The largest stake is below 1, because a stake of 1 loses everything to one sample of 1."""

_OF_ALL = 0.8  # part of the error that the bound from all stages gets; the last stage alone gets the rest
_PRECISION = 1e-7  # of the bound, relative; it is rounded up


def upper_bound(part: ArrayLike, whole: ArrayLike | None = None, *, error: float = 0.05) -> float:
    """Return an upper confidence bound of the mean of `part` over the mean of `whole`.

    Samples may be added, and the bound computed again, as often as wanted: the probability that any of these bounds
    lies below the true ratio is at most `error`. The order of the samples does not matter.

    The bound comes from betting. A player claims that the ratio is below r and stakes a share s of the capital on each
    sample, which multiplies the capital by 1 - s (part - r whole) / (1 - r). This factor is never negative, because
    part <= whole <= 1. Its mean is at most 1 if the true ratio is r or more, so a large capital refutes that. The total
    capital is the weighted mean over the players of `STAKES`. It grows with r.

    Independent samples with different means are allowed if their number was fixed in advance. The bound is then that
    of the ratio of the sums of the means, because a product of means with a sum of 0 in the logarithm is largest where
    all are equal.

    Args:
        part: (n,) samples in [0, whole].
        whole: (n,) samples in [0, 1] of the same draws; None means 1 for each, and bounds the mean of `part`.
        error: Probability in (0, 1) that the bound is too low.

    Returns:
        The bound in [0, 1], never below the ratio of the sums. 1 without samples, or where `whole` is 0 everywhere.

    Raises:
        ValueError: If a value is out of range, or the lengths differ.

    References:
        Waudby-Smith and Ramdas, section 4. They choose each stake from the samples before it. Here several players
        keep constant stakes, so the order of the samples does not matter.
    """
    parts = _check.floats("part", part, ("n",), np.float64)
    wholes = np.ones(len(parts)) if whole is None else _check.floats("whole", whole, ("n",), np.float64)
    _check.same_length(part=parts, whole=wholes)
    if not 0.0 < error < 1.0:
        raise ValueError(f"error: expected a probability in (0, 1), got {error!r}")
    if len(parts) and (parts.min() < 0.0 or wholes.max() > 1.0 or (parts > wholes).any()):
        k = int(np.argmax((parts < 0.0) | (wholes > 1.0) | (parts > wholes)))
        got = f"{parts[k]:g} of {wholes[k]:g} at index {k}"
        raise ValueError(f"part: expected values in [0, whole] and whole in [0, 1], got {got}; clip them")
    if not wholes.any():
        return 1.0
    lit = wholes > 0.0
    # samples of 0 change no capital
    parts = parts[lit]
    wholes = wholes[lit]
    wanted = -math.log(error)
    low = float(min(1.0, parts.sum() / wholes.sum()))
    high = 1.0
    step = 2.0 * wanted / float(wholes.sum())
    while low + step < 1.0 and _log_capital(parts, wholes, low + step) < wanted:
        low = low + step
        step = 2.0 * step
    high = min(1.0, low + step)
    while high - low > _PRECISION * high:
        middle = 0.5 * (low + high)
        if _log_capital(parts, wholes, middle) < wanted:
            low = middle
        else:
            high = middle
    return high


def staged_bound(stages: Sequence[tuple[ArrayLike, ArrayLike]], *, error: float = 0.05) -> float:
    """Return an upper confidence bound of a ratio that never grew, from samples of several stages.

    Between stages, samples are used to repair the set, so the ratio never grows. Samples of a stage therefore also
    bound the ratio of later stages, and all samples together bound the last one. Because early samples include light
    that was missing only then, the last stage is also bounded by its own samples, with an error that halves from stage
    to stage, for any number of stages. The smaller bound is returned.

    Args:
        stages: (part, whole) of each stage, see `upper_bound`; samples of a stage are drawn after the repair.
        error: Probability in (0, 1) that any bound of any stage is too low.

    Returns:
        The bound in [0, 1], never below the ratio of the sums of the last stage; 1 without stages.

    Raises:
        ValueError: As `upper_bound`.
    """
    if not stages:
        return 1.0
    parts, wholes = (np.concatenate([np.asarray(stage[side], np.float64) for stage in stages]) for side in (0, 1))
    bound = upper_bound(parts, wholes, error=_OF_ALL * error)
    if len(stages) > 1:
        rest = (1.0 - _OF_ALL) * error / 2.0 ** (len(stages) - 1)
        bound = min(bound, upper_bound(*stages[-1], error=rest))
        part, whole = (float(np.sum(side)) for side in stages[-1])
        bound = max(bound, part / whole if whole else 0.0)  # a rare last stage looks worse than all before it
    return bound


def _log_capital(parts: F64, wholes: F64, ratio: float) -> float:
    """Return the logarithm of the total capital of all players who claim that the ratio is below `ratio`, in [0, 1)."""
    stakes, shares = np.array(STAKES).T
    logs = np.empty(len(stakes))
    kernels.log_capitals(parts, wholes, ratio, stakes, logs)
    return float(np.logaddexp.reduce(logs + np.log(shares)))
