"""Fit one function on the sphere by few lobes, with a thorough search, for the experiment of figure 15.

A function is given by its values along directions, unit vectors in any frame. Nothing here knows of Gaussians or
colors. Each number of terms has its own fit. For scenes, a million functions at a time, use `fit_srbf`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.color.omp import orthogonal_matching_pursuit
from gsvis.color.srbf import MAX_DECAY
from gsvis.progress import Progress, silent
from paper.lobe_search import LEAST_DECAY, Fit, LobeSearch

__all__ = ["SphereConfig", "SphereFit", "fit_function"]

F64 = NDArray[np.float64]


@dataclass(frozen=True)
class SphereConfig:
    """How much effort to spend on a search.

    Args:
        refine: Move centers and decays continuously, and add and remove lobes. Without it, terms are the atoms that
            orthogonal matching pursuit chooses.
        subdivisions: Subdivisions of the icosphere whose vertices are the centers of the atoms, 0 to 4.
        max_decay: Largest decay, > 1; None for D / 4 pi, a lobe about as wide as the spacing of D even directions.
        ridge: Cost of a squared intensity, added to the mean squared error, for values of unit variance.
        steps: Maximum number of refinement steps after each change.
        tolerance: Relative gain below which two steps in a row end a refinement.
        searches: Number of searches from zero lobes: lobes are added up to the maximum and removed again. All but the
            first choose at random among the good lobes. Each random search is followed by 4 shorter ones up to half as
            many lobes and 16 up to a quarter.
        sweeps: Number of times that the best fits of all searches are extended and reduced again.
        seed: Seed of the random choices.

    Raises:
        ValueError: If a value is out of its range.
    """

    refine: bool = True
    subdivisions: int = 2
    max_decay: float | None = None
    ridge: float = 1e-10
    steps: int = 60
    tolerance: float = 1e-3
    sweeps: int = 1
    searches: int = 1
    seed: int = 0

    def __post_init__(self) -> None:
        if _check.positive_int("subdivisions", self.subdivisions, at_least=0) > 4:
            raise ValueError(f"subdivisions: expected 0 to 4, got {self.subdivisions}")
        for name, least in (("steps", 0), ("sweeps", 0), ("searches", 1), ("seed", 0)):
            _check.positive_int(name, getattr(self, name), at_least=least)
        if self.max_decay is not None and not 1.0 <= self.max_decay <= MAX_DECAY:
            raise ValueError(f"max_decay: expected 1 to {MAX_DECAY:g} or None, got {self.max_decay!r}")
        if not (np.isfinite(self.ridge) and self.ridge >= 1e-13):
            raise ValueError(f"ridge: expected a finite number >= 1e-13, got {self.ridge!r}")
        if not (np.isfinite(self.tolerance) and self.tolerance >= 0):
            raise ValueError(f"tolerance: expected a finite number >= 0, got {self.tolerance!r}")


@dataclass(frozen=True, eq=False)
class SphereFit:
    """A base and fits of 0, 1, ..., K terms; row k of each array is the fit of k terms.

    Attributes:
        base: Weighted mean of the function, to which terms are added.
        centers: (K + 1, K, 3) unit vectors; 0 beyond `counts`.
        decays: (K + 1, K) lambda of equation 3; 0 beyond `counts`.
        intensities: (K + 1, K) in the function's unit; 0 beyond `counts`.
        counts: (K + 1,) number of terms in use: fewer than k if more did not help.
        errors: (K + 1,) weighted mean squared error over the given directions; never rises.
    """

    base: float
    centers: F64
    decays: F64
    intensities: F64
    counts: NDArray[np.int64]
    errors: F64

    @property
    def max_terms(self) -> int:
        """Largest number of terms, K."""
        return len(self.counts) - 1

    def evaluate(self, directions: ArrayLike, terms: int | None = None) -> F64:
        """Evaluate the fit with a given number of terms.

        Args:
            directions: (R, 3) of any length > 0, in the frame of the fit.
            terms: 0 to K; K by default.

        Returns:
            (R,) values.

        Raises:
            ValueError: If a direction is zero or `terms` is out of range.
        """
        row = self.max_terms if terms is None else _check.positive_int("terms", terms, at_least=0)
        if row > self.max_terms:
            raise ValueError(f"terms: expected 0 to {self.max_terms}, got {row}")
        used = slice(int(self.counts[row]))
        v = self.centers[row, used] * self.decays[row, used, None]
        exponents = _check.unit_vectors("directions", directions) @ v.T - self.decays[row, used]
        return np.asarray(self.base + np.exp(exponents) @ self.intensities[row, used])


def fit_function(
    values: ArrayLike,
    directions: ArrayLike,
    *,
    max_terms: int,
    weights: ArrayLike | None = None,
    config: SphereConfig | None = None,
    progress: Progress = silent,
) -> SphereFit:
    """Fit a function by a base and 0, 1, ..., `max_terms` SRBFs.

    Each step adds the lobe that lowers the error most, then moves all lobes. From the maximum on, the least useful lobe
    is removed and the rest is moved again. For each k the best fit found with k terms is kept.

    Args:
        values: (D,) the function.
        directions: (D, 3) of any length > 0, one for each value.
        max_terms: K; at most D / 4 terms are used for D directions.
        weights: (D,) >= 0, weight of a squared error, such as the solid angle. None for equal weights.
        config: Effort and limits.
        progress: Called with stage "search"; counts searches and sweeps.

    Raises:
        ValueError: If shapes disagree, a value is not finite, a direction is zero, or all weights are zero.

    References:
        SRBF-Gaussian, equations 3 and 4 and figure 15; Golub and Pereyra 1973 (intensities eliminated); Chen, Billings
        and Luo 1989 (choice by the gain after all intensities are fitted again).

    Examples:
        >>> from gsvis.scene.icosphere import face_directions
        >>> x = face_directions(4).reshape(-1, 3)
        >>> fit = fit_function(np.exp(5.0 * (x[:, 2] - 1.0)), x, max_terms=2)
        >>> bool(fit.errors[2] < 1e-3 * fit.errors[0])
        True
    """
    config = config or SphereConfig()
    along = _check.unit_vectors("directions", directions)
    y = _check.floats("values", values, (len(along),), np.float64)
    most = _check.positive_int("max_terms", max_terms, at_least=0)
    shares = np.ones(len(y)) if weights is None else _check.floats("weights", weights, (len(y),), np.float64)
    _check.in_range("weights", shares, 0.0, np.inf)
    seen = shares > 0.0
    if not seen.any():
        raise ValueError("weights: expected some above 0, got none; a function needs at least one direction")
    y = y[seen]
    along = along[seen]
    shares = shares[seen] / shares.max()
    shares /= shares.sum()
    base = float(shares @ y)
    variance = float(shares @ (y - base) ** 2)
    limit = min(most, len(y) // 4)
    if limit == 0 or not variance > (1e-12 * float(np.abs(y).max())) ** 2:
        return _stack(base, variance, [], most)
    most_decay = config.max_decay or min(max(len(seen) / (4.0 * np.pi), 8.0), MAX_DECAY)
    deviation = variance**0.5
    search = LobeSearch((y - base) / deviation, along, shares, config, most_decay)
    fits = _search(search, limit, len(y) // 4, config, progress) if config.refine else _pursue(search, limit)
    scaled = [Fit(fit.error, fit.v, deviation * fit.intensities, fit.left) for fit in fits]
    return _stack(base, variance, scaled, most)


def _search(search: LobeSearch, limit: int, possible: int, config: SphereConfig, progress: Progress) -> list[Fit]:
    """Return the best fits of 0 to `limit` lobes. Also tries a few more lobes, to reach the last fits from above."""
    high = min(limit + 1 + limit // 10, possible)
    pool: dict[int, Fit] = {0: search.nothing}
    rng = np.random.default_rng(config.seed)
    depths = [high]
    for _ in range(config.searches - 1):
        depths += [high, *[high // 2] * 4, *[high // 4] * 16]
    progress("search", 0, len(depths) + config.sweeps)
    for turn, depth in enumerate(depths):
        own = {0: search.nothing}
        _sweep(search, own, depth, rng if turn else None)
        for k, fit in own.items():
            _keep(pool, k, fit)
        progress("search", turn + 1, len(depths) + config.sweeps)
    for sweep in range(config.sweeps):
        _sweep(search, pool, high, None)
        progress("search", len(depths) + sweep + 1, len(depths) + config.sweeps)
    return [pool[k] for k in range(limit + 1)]


def _sweep(search: LobeSearch, fits: dict[int, Fit], high: int, rng: np.random.Generator | None) -> None:
    """Extend fits up to `high` lobes and reduce them again; each number of lobes keeps the best."""
    for k in range(high):
        exact = fits[k].error <= 1e-13
        _keep(fits, k + 1, fits[k] if exact else search.extend(fits[k], rng))
    for k in range(high, 1, -1):
        if len(fits[k]) == k:
            _keep(fits, k - 1, search.reduce(fits[k]))


def _keep(fits: dict[int, Fit], k: int, fit: Fit) -> None:
    """Keep a fit of k lobes if it is the best so far."""
    if k not in fits or fit.error < fits[k].error:
        fits[k] = fit


def _pursue(search: LobeSearch, limit: int) -> list[Fit]:
    """Return fits on the atoms that orthogonal matching pursuit chooses."""
    codes = orthogonal_matching_pursuit(
        (search.dictionary / search.roots).T,
        (search.target / search.roots)[None],
        max_terms=min(limit, len(search.starts)),
        weights=search.roots**2,
    )
    chosen = search.starts[codes.atoms[0, : codes.counts[0]]]
    return [search.fit(chosen[:k]) for k in range(len(chosen) + 1)]


def _stack(base: float, variance: float, fits: list[Fit], most: int) -> SphereFit:
    """Return the fits as arrays; if more lobes are not better, the row repeats the previous fit."""
    centers = np.zeros((most + 1, most, 3))
    decays = np.zeros((most + 1, most))
    intensities = np.zeros((most + 1, most))
    counts = np.zeros(most + 1, np.int64)
    errors = np.full(most + 1, variance)
    best: Fit | None = None
    for k in range(most + 1):
        if k < len(fits) and (best is None or fits[k].error < best.error):
            best = fits[k]
        if best is None or len(best) == 0:
            continue
        order = np.argsort(-np.abs(best.intensities), kind="stable")
        lengths = np.maximum(np.linalg.norm(best.v[order], axis=1), LEAST_DECAY)
        used = slice(len(best))
        centers[k, used] = best.v[order] / lengths[:, None]
        decays[k, used] = lengths
        intensities[k, used] = best.intensities[order]
        counts[k], errors[k] = len(best), variance * best.error
    return SphereFit(base, centers, decays, intensities, counts, errors)
