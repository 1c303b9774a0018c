"""Estimate the throughput of a link from the times of its transfers. Bytes and seconds.

All estimators share one protocol: `observe` a transfer, ask for an `estimate`. They use no clock and no network.
"""

from __future__ import annotations

from collections import deque
from typing import Protocol

import numpy as np

from gsvis import _check

__all__ = ["ESTIMATORS", "Ewma", "HarmonicMean", "RobustMpc", "ThroughputEstimator", "estimator"]

DEFAULT_START = 250e3
"""Bytes a second assumed before the first transfer: 2 Mbit/s."""


class ThroughputEstimator(Protocol):
    """Interface of an estimator."""

    def observe(self, sent: float, seconds: float, /) -> None:
        """Record that `sent` bytes took `seconds`."""
        ...

    def estimate(self) -> float:
        """Return the estimated rate in bytes per second, > 0."""
        ...


class Ewma:
    """Estimate with the lower of two exponentially weighted means, a fast and a slow one, as dash.js and hls.js do.

    Transfers are weighted by their duration: the weight of a transfer halves with each half-life of later transfers.
    Both means start at 0; the estimate corrects this bias.

    Args:
        fast: Half-life of the fast mean, seconds of transfers.
        slow: Half-life of the slow mean, seconds of transfers.
        start: Bytes a second before the first transfer.
    """

    def __init__(self, fast: float = 3.0, slow: float = 8.0, start: float = DEFAULT_START) -> None:
        self._half_lives = _positive("fast", fast), _positive("slow", slow)
        self._start = _positive("start", start)
        self._means = [0.0, 0.0]
        self._seconds = 0.0

    def observe(self, sent: float, seconds: float) -> None:
        """Record a transfer; see `ThroughputEstimator.observe`."""
        rate = _transfer_rate(sent, seconds)
        self._seconds += seconds
        for k, half_life in enumerate(self._half_lives):
            kept = 0.5 ** (seconds / half_life)
            self._means[k] = kept * self._means[k] + (1.0 - kept) * rate

    def estimate(self) -> float:
        """Return the estimated rate in bytes per second."""
        if self._seconds <= 0.0:
            return self._start
        unbiased = [
            mean / -np.expm1(-np.log(2.0) * self._seconds / half_life)
            for mean, half_life in zip(self._means, self._half_lives, strict=True)
        ]
        return max(float(min(unbiased)), 1.0)


class HarmonicMean:
    """Estimate with the harmonic mean of the last few rates, which a slow transfer changes more than a fast one.

    Args:
        last: Number of transfers in the mean.
        start: Bytes a second before the first transfer.
    """

    def __init__(self, last: int = 5, start: float = DEFAULT_START) -> None:
        self._rates: deque[float] = deque(maxlen=_check.positive_int("last", last))
        self._mean = _positive("start", start)

    def observe(self, sent: float, seconds: float) -> None:
        """Record a transfer; see `ThroughputEstimator.observe`."""
        self._rates.append(max(_transfer_rate(sent, seconds), 1.0))
        self._mean = len(self._rates) / sum(1.0 / rate for rate in self._rates)

    def estimate(self) -> float:
        """Return the estimated rate in bytes per second."""
        return self._mean


class RobustMpc:
    """Estimate with a harmonic mean, divided by 1 plus the largest relative error of its recent estimates.

    Args:
        last: Number of transfers in the mean, and of errors that are remembered.
        start: Bytes a second before the first transfer.

    References:
        Yin et al., "A Control-Theoretic Approach for Dynamic Adaptive Video Streaming over HTTP", SIGCOMM 2015.
    """

    def __init__(self, last: int = 5, start: float = DEFAULT_START) -> None:
        self._mean = HarmonicMean(last, start)
        self._errors: deque[float] = deque(maxlen=last)
        self._seen = False

    def observe(self, sent: float, seconds: float) -> None:
        """Record a transfer; see `ThroughputEstimator.observe`."""
        rate = max(_transfer_rate(sent, seconds), 1.0)
        if self._seen:
            self._errors.append(abs(self._mean.estimate() - rate) / rate)
        self._mean.observe(sent, seconds)
        self._seen = True

    def estimate(self) -> float:
        """Return the estimated rate in bytes per second."""
        return max(self._mean.estimate() / (1.0 + max(self._errors, default=0.0)), 1.0)


ESTIMATORS = ("ewma", "harmonic", "robust-mpc")


def estimator(name: str, start: float = DEFAULT_START) -> ThroughputEstimator:
    """Return an estimator by name, one of `ESTIMATORS`."""
    _check.one_of("name", name, ESTIMATORS)
    if name == "ewma":
        return Ewma(start=start)
    return HarmonicMean(start=start) if name == "harmonic" else RobustMpc(start=start)


def _positive(name: str, value: float) -> float:
    """Return a number as float; raise ValueError unless it is finite and > 0."""
    if not (np.isfinite(value) and value > 0):
        raise ValueError(f"{name}: expected a finite number > 0, got {value!r}")
    return float(value)


def _transfer_rate(sent: float, seconds: float) -> float:
    """Return bytes per second of a transfer; raise ValueError unless bytes are >= 0 and seconds > 0."""
    if not (np.isfinite(sent) and sent >= 0):
        raise ValueError(f"sent: expected finite bytes >= 0, got {sent!r}")
    return sent / _positive("seconds", seconds)
