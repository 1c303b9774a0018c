"""Quality of experience (QoE; equation 8 of the paper, normalized) of a session, and the difference of two systems.

PSNR in dB against the full scene, latency in seconds. A session is a row of steps, each with an image that was shown.
Two systems are compared over the same links and walks, by the differences of paired sessions with confidence intervals.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check

__all__ = [
    "Difference",
    "Qoe",
    "QoeConfig",
    "first_frame",
    "paired_difference",
    "quality_of_experience",
    "stall",
]

F64 = NDArray[np.float64]

FIRST_FRAME_DB = 20.0


@dataclass(frozen=True)
class QoeConfig:
    """Constants of equation 8.

    Attributes:
        psnr_scale: PSNR that counts as 1, dB; higher values count as 1 too.
        latency_scale: Latency that counts as 1, seconds: the paper's time-out; higher values count as 1 too.
        delay_weight: Weight of the delay, lambda in the paper.
        shown_db: PSNR at which a pose counts as shown.
    """

    psnr_scale: float = 50.0
    latency_scale: float = 1.0
    delay_weight: float = 5.0
    shown_db: float = 25.0

    def __post_init__(self) -> None:
        for name in ("psnr_scale", "latency_scale", "shown_db"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise ValueError(f"{name}: expected a finite number > 0, got {getattr(self, name)!r}")
        if not (np.isfinite(self.delay_weight) and self.delay_weight >= 0):
            raise ValueError(f"delay_weight: expected a finite number >= 0, got {self.delay_weight!r}")


@dataclass(frozen=True)
class Qoe:
    """QoE of a session and its parts, means over its steps.

    Attributes:
        score: quality - delay weight * delay.
        quality: f of equation 8, in [0, 1].
        delay: g of equation 8, in [0, 1].
        psnr: dB, mean of the values, each at most 100.
        latency: Seconds, mean of the values, each at most `latency_scale`.
        steps: Number of steps.
    """

    score: float
    quality: float
    delay: float
    psnr: float
    latency: float
    steps: int

    def as_dict(self) -> Mapping[str, float]:
        """Return plain numbers, ready for JSON."""
        return asdict(self)


def quality_of_experience(psnr: ArrayLike, latency: ArrayLike, config: QoeConfig | None = None) -> Qoe:
    """Return the QoE of a session.

    Args:
        psnr: (S,) dB at each step; inf where the images are equal.
        latency: (S,) seconds from each pose until it was shown; inf if never.
        config: Constants; None means `QoeConfig()`.

    Raises:
        ValueError: If lengths differ, there is no step, or a value is NaN or negative.

    References:
        SRBF-Gaussian, equation 8.

    Examples:
        >>> result = quality_of_experience([25.0, 50.0], [0.1, 0.0])
        >>> round(result.score, 6), result.quality, result.delay
        (0.5, 0.75, 0.05)
    """
    config = config or QoeConfig()
    values = _checked_steps("psnr", psnr)
    delays = _checked_steps("latency", latency)
    if _check.same_length(psnr=values, latency=delays) == 0:
        raise ValueError("psnr: expected at least one step, got none")
    quality = float(np.clip(values / config.psnr_scale, 0.0, 1.0).mean())
    delay = float(np.clip(delays / config.latency_scale, 0.0, 1.0).mean())
    score = quality - config.delay_weight * delay
    raw = float(np.minimum(values, 100.0).mean())
    return Qoe(score, quality, delay, raw, float(np.minimum(delays, config.latency_scale).mean()), len(values))


def first_frame(times: ArrayLike, psnr: ArrayLike, least: float = FIRST_FRAME_DB) -> float:
    """Return the time of the first step whose image has at least `least` dB of PSNR; inf if none has.

    Args:
        times: (S,) seconds of the steps.
        psnr: (S,) dB of each step.
        least: dB.
    """
    at = _check.floats("times", times, ("S",), np.float64)
    values = _checked_steps("psnr", psnr)
    _check.same_length(times=at, psnr=values)
    good = np.flatnonzero(values >= least)
    return float(at[good[0]]) if len(good) else np.inf


def stall(times: ArrayLike, psnr: ArrayLike, least: float = 25.0, end: float | None = None) -> float:
    """Return how many seconds the image is worse than `least`, from the first image of at least 20 dB on.

    Args:
        times: (S,) seconds, rising; each step lasts until the next.
        psnr: (S,) dB of each step.
        least: dB of an acceptable image.
        end: Seconds at which the last step ends; None means that it lasts as long as the one before.
    """
    at = _check.floats("times", times, ("S",), np.float64)
    values = _checked_steps("psnr", psnr)
    if _check.same_length(times=at, psnr=values) == 0:
        return 0.0
    last = at[-1] + (at[-1] - at[-2] if len(at) > 1 else 0.0) if end is None else end
    lengths = np.diff(np.append(at, last))
    if lengths.min() < 0:
        got = _check.not_rising(np.append(at, last))
        raise ValueError(f"times: expected rising times up to the end, got {got}")
    return float(lengths[(values < least) & (at >= first_frame(at, values))].sum())


@dataclass(frozen=True)
class Difference:
    """Mean of paired differences with its confidence interval.

    Attributes:
        mean: Mean of first minus second.
        low: Lower end of the interval.
        high: Upper end of the interval.
        pairs: Number of pairs.
        confidence: Confidence of the interval, in (0, 1).
        method: "t" or "bootstrap".
    """

    mean: float
    low: float
    high: float
    pairs: int
    confidence: float
    method: str

    @property
    def excludes_zero(self) -> bool:
        """Whether zero lies outside the interval."""
        return self.low > 0.0 or self.high < 0.0

    def as_dict(self) -> dict[str, Any]:
        """Return plain numbers and strings, ready for JSON."""
        return {**asdict(self), "excludes_zero": self.excludes_zero}


def paired_difference(
    first: ArrayLike,
    second: ArrayLike,
    *,
    confidence: float = 0.95,
    method: str = "t",
    resamples: int = 10_000,
    seed: int = 0,
) -> Difference:
    """Return the mean difference of two systems over the same sessions, with its confidence interval.

    Args:
        first: (M,) a figure of each session of one system, M >= 2.
        second: (M,) the same figure of the other system, sessions in the same order.
        confidence: Confidence of the interval, in (0, 1).
        method: "t", Student's interval of the mean, or "bootstrap", percentiles of means of resampled pairs.
        resamples: Number of resamples of the bootstrap.
        seed: Seed of the bootstrap.

    Examples:
        >>> found = paired_difference([3.0, 4.0, 6.0], [2.0, 2.0, 3.0])
        >>> found.mean, found.excludes_zero
        (2.0, False)
    """
    a = _check.floats("first", first, ("M",), np.float64)
    b = _check.floats("second", second, (len(a),), np.float64)
    if len(a) < 2:
        raise ValueError(f"first: expected at least two sessions, got {len(a)}")
    if not 0.0 < confidence < 1.0:
        raise ValueError(f"confidence: expected a share in (0, 1), got {confidence!r}")
    apart = a - b
    mean = float(apart.mean())
    if _check.one_of("method", method, ("t", "bootstrap")) == "t":
        from scipy.special import stdtrit  # seldom needed

        error = float(apart.std(ddof=1)) / np.sqrt(len(apart))
        reach = float(stdtrit(len(apart) - 1, 0.5 + confidence / 2.0)) * error
        low = mean - reach
        high = mean + reach
    else:
        rng = np.random.default_rng(seed)
        picks = rng.integers(len(apart), size=(_check.positive_int("resamples", resamples), len(apart)))
        tail = (1.0 - confidence) / 2.0
        low, high = (float(v) for v in np.quantile(apart[picks].mean(axis=1), [tail, 1.0 - tail]))
    return Difference(mean, float(low), float(high), len(apart), confidence, method)


def _checked_steps(name: str, value: ArrayLike) -> F64:
    """Return values (S,) of steps as float64; raise ValueError for NaN and values below 0. Inf is valid."""
    array = _check.floats(name, value, ("S",), np.float64, finite=False)
    if np.isnan(array).any() or (len(array) and array.min() < 0):
        got = "NaN" if np.isnan(array).any() else f"{array.min():g}"
        raise ValueError(f"{name}: expected values of at least 0, got {got}")
    return array
