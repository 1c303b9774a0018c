"""Calibrate the epsilon of equation 7: find the color changes an observer notices, by a weighted up-down staircase.

Epsilon is the strength of the stimulus: the larger it is, the more terms are dropped and the easier the difference
is to see. It moves in equal steps of its logarithm, one down if the difference was noticed and three up if not. It
settles where 75% of the trials are noticed. The observer is a person or a metric. Nothing here draws an image.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check

__all__ = [
    "DEFAULT_EPSILON",
    "FLIP_JND",
    "EpsilonCalibration",
    "MetricObserver",
    "Observer",
    "Staircase",
    "StaircaseRule",
    "calibrate_epsilon",
    "replay",
]

F64 = NDArray[np.float64]

UP_STEPS = 3
"""Steps up for each step down; equilibrium is where p / (1 - p) equals this, p = 0.75."""

STUCK = 8
"""Consecutive trials at a bound, all answered toward it, after which the staircase stops."""

MOST_AT_BOUND = 0.25
"""Largest share of the counted reversals that may lie at a bound."""

FLIP_JND = 0.1
"""FLIP error of a pixel above which the model observer notices it: a convention.

FLIP itself gives no threshold. In a flat field a difference of E in CIELAB (HyAB, lightness alone) has the FLIP error
0.95 E^0.7 / (0.4 * 41.28). Hence 2.3, the just noticeable difference of Mahy et al., becomes 0.103; the often-used 1.0
becomes 0.058. (wgpu's image tests, which use FLIP, recommend thresholds of 0.01 to 0.1.)

References:
    Andersson et al., "FLIP: a difference evaluator for alternating images", HPG 2020.
    Mahy et al., "Evaluation of uniform color spaces developed after the adoption of CIELAB and CIELUV", 1994.
"""


DEFAULT_EPSILON = 0.02
"""Default epsilon for scenes without a calibration.

The staircase with FLIP as observer (99th percentile of the error map of the worst of 6 views, `FLIP_JND`, 67 pixels per
degree) found 0.022 on flowers LOD 1 and 0.034 on nika LOD 0, with colors of the `rgb` variant of 4 terms a Gaussian
(`benchmarks/color_epsilon.py`). This is the smaller one, rounded down. It keeps about 49 dB against all terms in the
worst view. No person has been tested yet. Thresholds of 0.058 and 0.2 in place of 0.1 give 0.010 to 0.013 and 0.057 to
0.114: the threshold matters more than the scene.
"""


class Observer(Protocol):
    """An observer that views a scene without the terms below epsilon and reports whether the difference is visible.

    `name` and `provenance` may be plain attributes.
    """

    @property
    def name(self) -> str:
        """Kind of observer, such as "flip" or "person"."""
        ...

    @property
    def provenance(self) -> Mapping[str, Any]:
        """JSON values needed to repeat its answers."""
        ...

    def __call__(self, epsilon: float) -> bool:
        """Return whether the observer notices the difference."""
        ...


@dataclass(frozen=True)
class StaircaseRule:
    """How epsilon moves, and when the search ends.

    Steps are in the logarithm of epsilon, because its ratio to the size of a term matters. Term sizes spread over
    decades: an arithmetic step that is fine at 0.1 would skip all of 0.01 to 0.05 at once.

    Attributes:
        start: Epsilon of the first trial; 0.1 in the paper.
        down_step: Step down of the natural logarithm, > 0; a step up is three times that.
        coarse: Factors on the steps before the first, second, ... reversal, for quick convergence. Two of each size
            let the walk recover from an early mistake.
        discard: Number of first reversals that do not count, at least the length of `coarse`.
        reversals: Number of reversals that count, even, at least 2.
        max_trials: Number of trials after which the staircase ends without convergence.
        lowest: Least epsilon, > 0.
        highest: Largest epsilon, at most 1.

    Raises:
        ValueError: If a value is out of range.

    References:
        SRBF-Gaussian, section 6.2. Kaernbach, "Simple adaptive testing with the weighted up-down method", 1991.
    """

    start: float = 0.1
    down_step: float = math.log(2.0) / 8.0
    coarse: tuple[int, ...] = (8, 8, 4, 4, 2, 2)
    discard: int = 8
    reversals: int = 40
    max_trials: int = 400
    lowest: float = 1e-4
    highest: float = 1.0

    def __post_init__(self) -> None:
        if not (_number(self.lowest) and _number(self.highest) and 0.0 < self.lowest < self.highest <= 1.0):
            raise ValueError(f"lowest, highest: expected 0 < lowest < highest <= 1, got {self.lowest}, {self.highest}")
        if not (_number(self.start) and self.lowest <= self.start <= self.highest):
            raise ValueError(f"start: expected a value in [{self.lowest:g}, {self.highest:g}], got {self.start!r}")
        if not (_number(self.down_step) and 1e-4 <= self.down_step <= 2.0):
            raise ValueError(f"down_step: expected a value in [0.0001, 2], got {self.down_step!r}")
        if not isinstance(self.coarse, tuple | list):
            raise ValueError(f"coarse: expected integers, got {self.coarse!r}")
        object.__setattr__(self, "coarse", tuple(_check.positive_int("coarse", step) for step in self.coarse))
        _check.positive_int("discard", self.discard, at_least=len(self.coarse))
        if _check.positive_int("reversals", self.reversals, at_least=2) % 2:
            raise ValueError(f"reversals: expected an even number, as many highs as lows, got {self.reversals}")
        _check.positive_int("max_trials", self.max_trials)

    @property
    def rungs(self) -> F64:
        """All possible epsilons of trials, descending; neighbors are one step apart, except at the bounds."""
        return self.start * np.exp(self.down_step * np.arange(self.above, -self.below - 1, -1, dtype=np.float64)).clip(
            self.lowest / self.start, self.highest / self.start
        )

    @property
    def above(self) -> int:
        """Number of rungs above the start, which is also the index of the start in `rungs`."""
        return math.ceil(math.log(self.highest / self.start) / self.down_step - 1e-9)

    @property
    def below(self) -> int:
        """Number of rungs below the start."""
        return math.ceil(math.log(self.start / self.lowest) / self.down_step - 1e-9)

    def as_dict(self) -> dict[str, Any]:
        """Return JSON values by name; `StaircaseRule(**d)` restores the rule."""
        return {name: list(v) if isinstance(v, tuple) else v for name, v in vars(self).items()}


@dataclass(frozen=True, eq=False)
class EpsilonCalibration:
    """Result of a staircase.

    Attributes:
        epsilon: Noticed in 75% of trials: the geometric mean of the counted reversals, with as many highs as lows.
            If none count, the last epsilon.
        standard_error: Of the natural logarithm of epsilon, from the differences of overlapping batches of
            reversals and from the unknown place of the threshold within a step. NaN with fewer than 8 reversals. It
            covers this run alone, not observers in general.
        converged: Whether epsilon is a threshold at all.
        reason: Why, or why not.
        epsilons: (T,) epsilons of all trials.
        detected: (T,) bool answers.
        reversals: (R,) indices of all trials at which the answer changed.
        counted: Number of last reversals in the estimate.
        rule: The rule of the run.
        provenance: Observer and stimulus.
    """

    epsilon: float
    standard_error: float
    converged: bool
    reason: str
    epsilons: F64
    detected: NDArray[np.bool_]
    reversals: NDArray[np.int64]
    counted: int
    rule: StaircaseRule
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"EpsilonCalibration({self.epsilon:.4g}, {len(self.epsilons)} trials, {self.reason})"

    @property
    def interval(self) -> tuple[float, float]:
        """Epsilon one standard error below and above; NaN without an error."""
        factor = math.exp(self.standard_error)
        return self.epsilon / factor, self.epsilon * factor

    def as_dict(self) -> dict[str, Any]:
        """Return JSON values; `load_staircase_result` of `benchmarks/paper/staircase.py` reads them from a file."""
        return {
            "format": "gsvis-epsilon",
            "version": 1,
            "epsilon": self.epsilon,
            "standard_error": None if math.isnan(self.standard_error) else self.standard_error,
            "converged": self.converged,
            "reason": self.reason,
            "trials": [[e, d] for e, d in zip(self.epsilons.tolist(), self.detected.tolist(), strict=True)],
            "rule": self.rule.as_dict(),
            "provenance": dict(self.provenance),
        }


class Staircase:
    """Run a staircase: propose an epsilon, take an answer.

    Args:
        rule: How epsilon moves; None means `StaircaseRule()`.

    Attributes:
        rule: The rule.
        rung: Current index into `rule.rungs`.
        reversals: Trials at which the answer differed from the previous one.
    """

    def __init__(self, rule: StaircaseRule | None = None) -> None:
        self.rule = StaircaseRule() if rule is None else rule
        self.rung = self.rule.above
        self.reversals: list[int] = []
        self._rungs = self.rule.rungs
        self._visited: list[int] = []
        self._answers: list[bool] = []
        self._stuck = 0

    @property
    def epsilon(self) -> float:
        """Epsilon of the next trial."""
        return float(self._rungs[self.rung])

    @property
    def finished(self) -> bool:
        """Whether the staircase has ended."""
        enough = len(self.reversals) >= self.rule.discard + self.rule.reversals
        return enough or self._stuck >= STUCK or len(self._answers) >= self.rule.max_trials

    def answer(self, detected: bool) -> None:
        """Record the answer to the trial at `epsilon`, and move."""
        if self._answers and detected != self._answers[-1]:
            self.reversals.append(len(self._answers))
        self._visited.append(self.rung)
        self._answers.append(bool(detected))
        last = len(self._rungs) - 1
        self._stuck = self._stuck + 1 if self.rung == (last if detected else 0) else 0
        turned = len(self.reversals)
        size = self.rule.coarse[turned] if turned < len(self.rule.coarse) else 1
        self.rung = min(max(self.rung + (size if detected else -UP_STEPS * size), 0), last)

    def result(self, provenance: Mapping[str, Any] | None = None) -> EpsilonCalibration:
        """Return the result so far.

        Args:
            provenance: Observer and stimulus.
        """
        counted = self.reversals[self.rule.discard :]
        counted = counted[len(counted) % 2 :]  # as many highs as lows
        visited = np.asarray(self._visited, np.int64)
        epsilons = self._rungs[visited]
        at = visited[counted]
        at_bound = float(((at == 0) | (at == len(self._rungs) - 1)).mean()) if len(at) else 0.0
        found = self.epsilon
        error = math.nan
        if self._stuck >= STUCK:
            seen = self._answers[-1]
            reason = f"noticed even at the {'lowest' if seen else 'highest'} epsilon, {found:g}"
            reason = reason if seen else reason.replace("noticed even", "not noticed even")
        elif len(self.reversals) < self.rule.discard + self.rule.reversals:
            reason = f"{len(self.reversals)} reversals in {len(visited)} trials are too few"
        elif at_bound > MOST_AT_BOUND:
            reason = f"{at_bound:.0%} of the reversals lie at a bound"
        else:
            reason = "converged"
        if len(at) and self._stuck < STUCK:
            logarithms = np.log(epsilons[counted])
            found = float(np.exp(logarithms.mean()))
            error = _standard_error(logarithms, self.rule.down_step)
        answers = np.asarray(self._answers, bool)
        turns = np.asarray(self.reversals, np.int64)
        provenance = {} if provenance is None else provenance
        return EpsilonCalibration(
            found, error, reason == "converged", reason, epsilons, answers, turns, len(at), self.rule, provenance
        )


def calibrate_epsilon(observer: Observer, rule: StaircaseRule | None = None) -> EpsilonCalibration:
    """Find the epsilon at which an observer notices the difference in 75% of trials.

    Accuracy with the default rule, over observers with a logistic psychometric function of log epsilon, of spreads up
    to 0.4 (an epsilon twice the midpoint is noticed with p = 0.85): estimates lie 5% above the 75% point on average,
    with a standard deviation below 10%, in 90 to 150 trials; with a guess rate of one half, 1% and 15%. For an observer
    without spread, who notices everything above a threshold, the estimate lies 0.5 to 1.5 down steps above the
    threshold: after a miss the walk jumps up three steps and comes down one by one, so it spends its time above.

    Args:
        observer: Returns whether it notices the difference at an epsilon.
        rule: How epsilon moves; None means `StaircaseRule()`.

    Returns:
        The estimate with all trials; check `converged`.

    References:
        SRBF-Gaussian, section 6.2. Kaernbach 1991. On the effect of large steps on the equilibrium: Garcia-Perez,
        "Forced-choice staircases with fixed step sizes", Vision Research 1998.

    Examples:
        >>> found = calibrate_epsilon(MetricObserver(lambda epsilon: 5.0 * epsilon, threshold=0.1))
        >>> found.converged, round(found.epsilon, 3)
        (True, 0.022)
    """
    staircase = Staircase(rule)
    while not staircase.finished:
        staircase.answer(bool(observer(staircase.epsilon)))
    return staircase.result({"observer": observer.name, **observer.provenance})


def replay(
    rule: StaircaseRule, epsilons: ArrayLike, detected: ArrayLike, provenance: Mapping[str, Any] | None = None
) -> EpsilonCalibration:
    """Return the result of trials made elsewhere, such as on a web page.

    Args:
        rule: Rule of the trials.
        epsilons: (T,) epsilons of the trials.
        detected: (T,) bool answers.
        provenance: Observer and stimulus.

    Raises:
        ValueError: If an epsilon differs from the one that the rule gives after the previous answers (relative
            tolerance 1e-6), or if trials follow after the end.
    """
    shown = _check.floats("epsilons", epsilons, ("T",), np.float64)
    answers = np.asarray(detected)
    if answers.dtype != bool or answers.shape != shown.shape:
        raise ValueError(f"detected: expected bool of shape {shown.shape}, got {answers.dtype} of {answers.shape}")
    staircase = Staircase(rule)
    for trial, (epsilon, answer) in enumerate(zip(shown.tolist(), answers.tolist(), strict=True)):
        if staircase.finished:
            raise ValueError(f"epsilons: expected {trial} trials, after which the staircase ends, got {len(shown)}")
        if not math.isclose(epsilon, staircase.epsilon, rel_tol=1e-6):
            raise ValueError(f"epsilons: expected {staircase.epsilon:g} at trial {trial} by the rule, got {epsilon:g}")
        staircase.answer(answer)
    return staircase.result(provenance)


class MetricObserver:
    """Model observer that notices the difference if a metric of the images is above a threshold.

    Args:
        difference: The metric for an epsilon, from images with all terms and with active terms alone; finite, >= 0.
            Called once for each epsilon. For FLIP: the largest 99th percentile of the error map over the views, so that
            the noticed part covers at least 1% of the image.
        threshold: Value of the metric, > 0, see `FLIP_JND`.
        slope: Spread, in the natural logarithm of the metric, of a logistic psychometric function p = guess + (1 -
            guess) / (1 + exp(-log(difference / threshold) / slope)); None is a step at the threshold. The staircase
            settles where p is 0.75: at the threshold with a guess rate of one half, as for a person who has to choose
            one of two; at 3^slope times the threshold with a guess rate of 0.
        guess: Probability, below 0.75, of a detection without a difference.
        rng: Generator or seed of the answers.
        name: Name of the metric.
        images: What was compared, for the provenance; JSON values.

    Raises:
        ValueError: If a number is out of range, in the constructor or when the metric returns one.
    """

    def __init__(
        self,
        difference: Callable[[float], float],
        threshold: float,
        slope: float | None = None,
        guess: float = 0.0,
        rng: np.random.Generator | int = 0,
        *,
        name: str = "flip",
        images: Mapping[str, Any] | None = None,
    ) -> None:
        if not (_number(threshold) and threshold > 0.0):
            raise ValueError(f"threshold: expected a finite number > 0, got {threshold!r}")
        if slope is not None and not (_number(slope) and slope > 0.0):
            raise ValueError(f"slope: expected None or a finite number > 0, got {slope!r}")
        if not (_number(guess) and 0.0 <= guess < 0.75):
            raise ValueError(f"guess: expected a probability in [0, 0.75), got {guess!r}")
        self.name = name
        self.provenance: dict[str, Any] = {"threshold": float(threshold), "slope": slope, "guess": float(guess)}
        if slope is not None or guess > 0.0:
            self.provenance["seed"] = rng if isinstance(rng, int) else "a generator"
        self.provenance["images"] = {} if images is None else dict(images)
        self._difference = difference
        self._threshold = float(threshold)
        self._slope = slope
        self._guess = float(guess)
        self._rng = np.random.default_rng(rng)
        self._known: dict[float, float] = {}

    @property
    def differences(self) -> dict[float, float]:
        """The metric at every epsilon tested so far."""
        return dict(sorted(self._known.items()))

    def probability(self, epsilon: float) -> float:
        """Return the probability that the difference at this epsilon is noticed."""
        if epsilon not in self._known:
            value = float(self._difference(epsilon))
            if not (math.isfinite(value) and value >= 0.0):
                raise ValueError(f"difference: expected a finite number >= 0 at epsilon {epsilon:g}, got {value}")
            self._known[epsilon] = value
        value = self._known[epsilon]
        if self._slope is None or value == 0.0:
            noticed = float(value > self._threshold)
        else:
            steps = (math.log(value) - math.log(self._threshold)) / self._slope
            noticed = 0.5 * (1.0 + math.tanh(0.5 * steps))
        return self._guess + (1.0 - self._guess) * noticed

    def __call__(self, epsilon: float) -> bool:
        """Return whether the observer notices the difference."""
        p = self.probability(epsilon)
        return bool(p >= 1.0 or (p > 0.0 and self._rng.random() < p))


def _standard_error(values: F64, step: float) -> float:
    """Return the standard error of the mean of reversals.

    Highs and lows are paired, because they differ by design, and the pairs are averaged in overlapping batches. All may
    lie on the same few rungs, so the place of the rungs adds a uniform error over one step.
    """
    pairs = values.reshape(-1, 2).mean(axis=1)
    n = len(pairs)
    if n < 4:
        return math.nan
    batch = round(math.sqrt(n))
    sums = np.cumsum(np.concatenate([np.zeros(1), pairs - pairs.mean()]))
    means = (sums[batch:] - sums[:-batch]) / batch
    return float(math.sqrt(batch / (n - batch) * np.square(means).mean() + step**2 / 12.0))


def _number(value: Any) -> bool:
    """Return whether a value is a finite real number."""
    return isinstance(value, int | float | np.floating) and not isinstance(value, bool) and math.isfinite(value)
