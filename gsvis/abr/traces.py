"""Bandwidth over time: how many bytes a link carries, and how long a number of bytes takes.

Rates are constant between given times and repeat after the last. Seconds, Mbit/s (10^6 bits), bytes.
"""

from __future__ import annotations

import os
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.io.bandwidth_5g import read_bandwidth_5g
from gsvis.io.bandwidth_text import read_bandwidth_text

__all__ = ["BandwidthTrace", "load_trace"]

F64 = NDArray[np.float64]

BYTES = 125_000.0
"""Bytes a second of 1 Mbit/s."""


@dataclass(frozen=True, eq=False, repr=False)
class BandwidthTrace:
    """A link with known rates over time.

    Args:
        times: (S,) seconds > 0, strictly rising, at which each rate ends; the first rate starts at 0. The last time is
            the period.
        mbit_per_s: (S,) rates, >= 0.
        name: Name for reports.

    Raises:
        ValueError: If a shape or a value is wrong.

    Examples:
        >>> link = BandwidthTrace([1.0, 3.0], [8.0, 1.0])
        >>> link.bytes_between(0.0, 2.0), link.time_to_send(1_000_000, 2.0)
        (1125000.0, 1.875)
    """

    times: F64
    mbit_per_s: F64
    name: str = ""

    def __post_init__(self) -> None:
        times = _check.floats("times", self.times, ("S",), np.float64)
        rates = _check.floats("mbit_per_s", self.mbit_per_s, ("S",), np.float64)
        if _check.same_length(times=times, mbit_per_s=rates) == 0:
            raise ValueError("times: expected at least one rate, got none")
        if times[0] <= 0 or np.any(np.diff(times) <= 0):
            got = f"{times[0]:g} at index 0" if times[0] <= 0 else _check.not_rising(times, strictly=True)
            raise ValueError(f"times: expected strictly rising times > 0, got {got}; each is when its rate ends")
        _check.in_range("mbit_per_s", rates, 0.0, 1e9)
        edges = np.concatenate([[0.0], times])
        carried = np.concatenate([[0.0], np.cumsum(np.diff(edges) * rates * BYTES)])
        for name, array in (("times", times), ("mbit_per_s", rates), ("_edges", edges), ("_carried", carried)):
            view = array.view()
            view.flags.writeable = False
            object.__setattr__(self, name, view)

    @classmethod
    def constant(cls, mbit_per_s: float, name: str = "") -> BandwidthTrace:
        """Return a link with a constant rate."""
        return cls(np.ones(1), np.array([mbit_per_s]), name or f"{mbit_per_s:g} Mbit/s")

    def __repr__(self) -> str:
        return f"BandwidthTrace({self.name!r}, {self.mean:.3g} Mbit/s over {self.period:.3g} s)"

    @property
    def period(self) -> float:
        """Seconds after which the rates repeat."""
        return float(self.times[-1])

    @property
    def mean(self) -> float:
        """Mean rate over a period, Mbit/s."""
        return float(self._total / BYTES / self.period)

    def rate_at(self, t: float) -> float:
        """Return the rate in Mbit/s from time t on."""
        _, within = self._split_time(t)
        return float(self.mbit_per_s[min(int(np.searchsorted(self.times, within, side="right")), len(self.times) - 1)])

    def bytes_between(self, start: float, stop: float) -> float:
        """Return the bytes carried from `start` to `stop`, both in seconds >= 0.

        Raises:
            ValueError: If a time is negative or not finite, or `stop` lies before `start`.
        """
        periods, begin = self._split_time(start)
        periods_then, end = self._split_time(stop)
        if stop < start:
            raise ValueError(f"stop: expected at least start, {start:g}, got {stop:g}")
        return (periods_then - periods) * self._total + self._carried_until(end) - self._carried_until(begin)

    def time_to_send(self, size: float, start: float) -> float:
        """Return the seconds from `start` until `size` bytes have been carried; inf if the link carries nothing.

        Args:
            size: Bytes >= 0.
            start: Seconds >= 0.
        """
        if not (np.isfinite(size) and size >= 0):
            raise ValueError(f"size: expected finite bytes >= 0, got {size!r}")
        within = self._split_time(start)[1]
        if size == 0.0:
            return 0.0
        if self._total <= 0.0:
            return np.inf
        left = self._total - self._carried_until(within)
        if size <= left:
            return max(self._time_of(self._carried_until(within) + size) - within, 0.0)
        more, rest = divmod(size - left, self._total)  # whole periods after this one, and bytes after those
        if rest == 0.0:  # the last byte arrives before a silent end of the period
            more = more - 1.0
            rest = self._total
        whole = self.period - within
        return float(whole + max(more, 0.0) * self.period + self._time_of(rest)) if more >= 0 else float(whole)

    def from_time(self, start: float) -> BandwidthTrace:
        """Return the same link, starting `start` seconds later in its period."""
        _, within = self._split_time(start)
        if within == 0.0:
            return self
        later = self.times > within
        edges = np.concatenate([self.times[later] - within, self.times[~later] + self.period - within])
        rates = np.concatenate([self.mbit_per_s[later], self.mbit_per_s[~later]])
        if edges[-1] < self.period:  # the rest of the segment that `start` cut
            edges = np.append(edges, self.period)
            rates = np.append(rates, self.mbit_per_s[later][0])
        return BandwidthTrace(edges, rates, self.name)

    def scaled(self, factor: float) -> BandwidthTrace:
        """Return the same link with rates multiplied by a factor."""
        if not (np.isfinite(factor) and factor > 0):
            raise ValueError(f"factor: expected a finite number > 0, got {factor!r}")
        return BandwidthTrace(self.times, self.mbit_per_s * factor, self.name)

    @property
    def _total(self) -> float:
        """Bytes carried in a period."""
        return float(self._carried[-1])  # type: ignore[attr-defined]

    def _split_time(self, t: float) -> tuple[float, float]:
        """Return the number of whole periods before t, and the seconds since the last one ended."""
        if not (np.isfinite(t) and t >= 0):
            raise ValueError(f"t: expected finite seconds >= 0, got {t!r}")
        periods, within = divmod(t, self.period)
        return float(periods), float(within)

    def _carried_until(self, within: float) -> float:
        """Return the bytes carried from the start of a period until `within` seconds of it have passed."""
        edges, carried = self._edges, self._carried  # type: ignore[attr-defined]
        return float(np.interp(within, edges, carried))

    def _time_of(self, carried: float) -> float:
        """Return the first time in a period at which this many bytes (> 0) have been carried."""
        edges, sums = self._edges, self._carried  # type: ignore[attr-defined]
        k = min(max(int(np.searchsorted(sums, carried, side="left")), 1), len(edges) - 1)
        while sums[k] <= sums[k - 1]:  # rounding may lead past the end, where the link is silent
            k -= 1
        return float(edges[k - 1] + (carried - sums[k - 1]) / (sums[k] - sums[k - 1]) * (edges[k] - edges[k - 1]))


def load_trace(path: str | os.PathLike[str]) -> BandwidthTrace:
    """Read a link: a recorded 5G log (`.csv`), or lines of seconds and Mbit/s.

    Args:
        path: The file.

    Raises:
        FileNotFoundError: If there is no file.
        FormatError: If it is malformed.
    """
    path = _check.path("path", path)
    read = read_bandwidth_5g if path.suffix.lower() in (".csv", ".gz") else read_bandwidth_text
    return BandwidthTrace(*read(path), path.name)
