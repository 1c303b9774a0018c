"""Find what a term and what its width cost, so that Gaussians have a wanted number of terms on average.

Prices are in units of importance times error. They come from a sample of Gaussians, which is fitted several times.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from gsvis.color.fit import FitConfig

__all__ = ["MOST_FITS", "Curves", "Prices", "count_terms", "find_prices"]

F64 = NDArray[np.float64]

Curves = list[tuple[F64, F64]]
"""For each part of a sample and each function, (n, K + 1) importance times error, and (n, K + 1) sum of the widths,
with 0, 1, ... K terms."""

_TRIALS = 4
"""Prices of width that are tried at most; each takes a fit of the sample."""
MOST_FITS = 2 + _TRIALS
"""Fits of the sample at most."""
_GROWTH = 1.7
"""The error grows with about this power of the price of width (1.6 to 1.9 on four scenes), until two are tried."""
_CLOSE = 1.1
"""Growth over the allowed one with which a price of width is good enough."""


class Prices(NamedTuple):
    """What a term must gain.

    Attributes:
        term: Least decrease of importance times error for a term without width.
        width: What a term costs more that is active along all directions, over `term`.
    """

    term: float
    width: float


def find_prices(fit: Callable[[FitConfig, float], Curves], config: FitConfig, mean_terms: float, count: int) -> Prices:
    """Return the prices at which a sample has `mean_terms` on average.

    A first price is found with few terms a Gaussian. More terms can only raise it, so longer curves are fitted only for
    Gaussians that can pay the first price. Then the price of width falls from `config.width_price` until it raises the
    error of the sample by about `config.width_loss` at most; it is 0 if all that are tried raise it more. Lobes depend
    on the price of width, so each is fitted.

    Args:
        fit: Function that fits the sample at a price of a term.
        config: Limits of the fit.
        mean_terms: Number of terms, on average.
        count: Number of Gaussians of the sample.
    """
    few = max(4, int(np.ceil(2 * mean_terms)))
    free = Prices(0.0, 0.0)
    curves: Curves = []
    for most in sorted({min(few, config.max_terms), config.max_terms}):
        curves = fit(replace(config, max_terms=most, width_price=0.0), free.term)
        free = Prices(_least_price(curves, 0.0, mean_terms, count), 0.0)
    allowed = _growth_of(config.width_loss)
    width = config.width_price if allowed > 0.0 else 0.0
    least = _error(curves, free)
    tried: list[tuple[float, float]] = []
    for _ in range(_TRIALS if width > 0.0 else 0):
        guess = _least_price(curves, width, mean_terms, count)
        priced = fit(replace(config, width_price=width), guess)
        found = Prices(_least_price(priced, width, mean_terms, count), width)
        growth = _error(priced, found) / max(least, 1e-300) - 1.0
        if growth <= _CLOSE * allowed:
            return found
        tried.append((width, growth))
        width = _lower_width(tried, allowed)
    return free


def _growth_of(loss: float) -> float:
    """Return by which share of itself an error grows that becomes `loss` dB larger."""
    return 10.0 ** (0.1 * loss) - 1.0 if loss < 1000.0 else math.inf


def _lower_width(tried: list[tuple[float, float]], allowed: float) -> float:
    """Return the price of width that should raise the error by what is allowed, from (price, growth) of those tried."""
    width, growth = tried[-1]
    power = _GROWTH
    if len(tried) > 1:
        earlier, more = tried[-2]
        power = min(max(float(np.log(more / growth) / np.log(earlier / width)), 1.0), 3.0)
    lower = width * (allowed / growth) ** (1.0 / power)
    return float(f"{lower:.3g}")  # so that the last bits of sums decide nothing


def _error(curves: Curves, prices: Prices) -> float:
    """Return the sum of importance times error at prices."""
    total = 0.0
    for costs, wide in curves:
        best = count_terms(costs, wide, prices)
        total += float(costs[np.arange(len(costs)), best].sum())
    return total


def count_terms(costs: F64, wide: F64, prices: Prices) -> NDArray[np.int64]:
    """Return (n,) numbers of terms that are worth their prices.

    Args:
        costs: (n, K + 1) importance times error with 0, 1, ... K terms.
        wide: (n, K + 1) sums of the widths.
        prices: The prices.
    """
    spent = np.arange(costs.shape[1]) + prices.width * wide
    counts: NDArray[np.int64] = (costs + prices.term * spent).argmin(axis=1)
    return counts


def _least_price(curves: Curves, width: float, mean_terms: float, count: int) -> float:
    """Return the least price of a term at which Gaussians have at most `mean_terms` on average, by bisection."""

    def mean(price: float) -> float:
        """Return the mean number of terms at a price."""
        return sum([float(count_terms(*part, Prices(price, width)).sum()) for part in curves]) / count

    high = max(float(costs[:, 0].max()) for costs, _ in curves)
    low = high * 1e-15
    if high <= 0.0 or mean(low) <= mean_terms:
        return low
    for _ in range(60):
        middle = float(np.sqrt(low * high))
        low, high = (middle, high) if mean(middle) > mean_terms else (low, middle)
    return high
