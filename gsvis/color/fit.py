"""Fit SRBF colors to a scene: few terms for the SH colors over the directions from which each Gaussian is seen.

Directions come as direction sets of `gsvis.raycast` or `gsvis.pvs`: from the Gaussian to the eye, by the 80 faces.
Terms are chosen from a dictionary and then refined. The number of terms of a Gaussian depends on the importance of its
error. Nothing here renders.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.color._assemble import Terms, assemble
from gsvis.color._prices import MOST_FITS, Curves, Prices, count_terms, find_prices
from gsvis.color._pursuit import Pursuit, SplitFit
from gsvis.color._work import count_progress, foresee_work
from gsvis.color.srbf import MAX_DECAY, SrbfColors
from gsvis.color.variants import DEFAULT_VARIANT, VARIANTS, variant
from gsvis.jobs.in_order import in_order
from gsvis.progress import Progress, silent
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.icosphere import NUM_FACES, face_directions, face_shares
from gsvis.scene.sh import sh_basis

__all__ = ["FitConfig", "SrbfFit", "WeighFaces", "face_weights", "fit_srbf", "fitted_for_price"]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

WeighFaces = Callable[[NDArray[np.int64]], F32]
"""Returns the weights >= 0 of the 80 faces (n, 80) for some Gaussians, by their numbers (n,)."""

_CHUNK = 2048
"""Number of Gaussians fitted at a time; bounds memory."""
_SAMPLE = 6144
"""Number of Gaussians in the sample that finds the price for the requested mean number of terms."""
_CAUTION = 0.98
"""Share of the requested mean to aim at: a sample errs by a percent or two, and the mean must not be exceeded."""
_PARTS = 4
"""Parts of a face at whose centers colors are fitted; avoids face corners, where a set is ambiguous."""


@dataclass(frozen=True)
class FitConfig:
    """What to fit, and with how much effort.

    Args:
        variant: One of `VARIANTS`.
        max_terms: Maximum number of terms of each function of a Gaussian, 0 to 32.
        mean_terms: Target for the mean number of terms per Gaussian, over all its functions: terms go where they
            lower the error (times importance) most. None gives every Gaussian all the terms that lower its error.
        refine: Move centers, widths and intensities continuously after each choice. Without it, terms stay on the
            atoms that orthogonal matching pursuit chooses.
        decays: Decays of the atoms; None means 4 and 12 for lobes that are refined as `rgb`, because narrow lobes stay
            narrow, else 1.5 and 6.
            Centers are the 42 vertices of the once-subdivided icosahedron if `refine`, else the 162 of the
            twice-subdivided one.
        ridge: Added to the squared norm of each lobe, relative to the weights: keeps intensities small.
        emphasis: Initial weight of the error after fewer terms in a fit of more: makes terms useful one by one. It
            rises for a Gaussian whose error would otherwise rise along its terms.
        width_price: What a term costs more at most if it is active along all directions of its Gaussian, over what it
            costs by itself; in between in proportion. Lobes are then narrower, and wide ones fewer. 0 asks nothing for
            width.
        width_loss: dB by which the price for width may raise the error of the fit, about, >= 0; the price falls until
            it does not cost more. 1000 or more keeps the price. Without `mean_terms` the price stays.
        epsilon: Change of a channel from which a term is active, for `width_price`, > 0.
        steps: Maximum number of refinement steps after each choice.
        tolerance: Relative gain of a step below which refinement stops.

    Raises:
        ValueError: If a value is out of its range.
    """

    variant: str = DEFAULT_VARIANT
    max_terms: int = 24
    mean_terms: float | None = 3.0
    refine: bool = True
    decays: tuple[float, ...] | None = None
    ridge: float = 1e-5
    emphasis: float = 0.01
    width_price: float = 3.0
    width_loss: float = 0.02
    epsilon: float = 0.02
    steps: int = 8
    tolerance: float = 0.01

    def __post_init__(self) -> None:
        variant(self.variant)
        if _check.positive_int("max_terms", self.max_terms, at_least=0) > 32:
            raise ValueError(f"max_terms: expected 0 to 32, got {self.max_terms}")
        if self.mean_terms is not None and not (np.isfinite(self.mean_terms) and self.mean_terms >= 0):
            raise ValueError(f"mean_terms: expected a finite number >= 0 or None, got {self.mean_terms!r}")
        _check.positive_int("steps", self.steps, at_least=0)
        decays = _check.floats("decays", self.atom_decays, ("A",), np.float64)
        _check.in_range("decays", decays, 0.0, MAX_DECAY, open_low=True)
        if len(decays) == 0:
            raise ValueError("decays: expected at least one, got none")
        if not 0.0 < self.epsilon <= 1.0:
            raise ValueError(f"epsilon: expected a change of color in (0, 1], got {self.epsilon!r}")
        for name in ("ridge", "emphasis", "tolerance", "width_price"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise ValueError(f"{name}: expected a finite number >= 0, got {value!r}")
        if not self.width_loss >= 0:
            raise ValueError(f"width_loss: expected dB >= 0, got {self.width_loss!r}")

    @property
    def atom_decays(self) -> tuple[float, ...]:
        """Decays of the atoms."""
        if self.decays is not None:
            return self.decays
        return (4.0, 12.0) if self.refine and self.variant == "rgb" else (1.5, 6.0)


@dataclass(frozen=True, eq=False)
class SrbfFit:
    """Result of a fit.

    Attributes:
        colors: The colors.
        base_errors: (N,) float32, mean squared RGB error (summed over channels) of the base color alone over the
            visible directions.
        errors: (N,) float32, the same with all terms.
        price: Least decrease of error times importance that each term had to achieve.
        width_price: What a term cost more that is active along all directions, over `price`; at most that of the
            config.
        unseen: Number of Gaussians without a direction: they get the mean over all directions and no terms.
    """

    colors: SrbfColors
    base_errors: F32
    errors: F32
    price: float
    width_price: float
    unseen: int


def face_weights(directions: ArrayLike | None, count: int) -> F32:
    """Return (N, 80) weights of the faces from the `directions` argument of `fit_srbf`.

    Args:
        directions: (N, 10) uint8 direction sets, (N, 80) bool or weights >= 0, or None for equal weights.
        count: N.

    Raises:
        ValueError: If `directions` is none of these.
    """
    if directions is None:
        return np.ones((count, NUM_FACES), np.float32)
    given = np.asarray(directions)
    if given.dtype == np.uint8 and given.shape == (count, NUM_FACES // 8):
        return np.unpackbits(given, axis=1, bitorder="little").astype(np.float32)
    if given.shape != (count, NUM_FACES):
        raise ValueError(
            f"directions: expected uint8 sets of shape ({count}, {NUM_FACES // 8}) or weights of shape "
            f"({count}, {NUM_FACES}), got {given.dtype} of shape {given.shape}"
        )
    weights = _check.floats("directions", given, (count, NUM_FACES))
    _check.in_range("directions", weights, 0.0, np.inf)
    return weights


def fit_srbf(
    g: Gaussians,
    directions: ArrayLike | WeighFaces | None = None,
    config: FitConfig | None = None,
    *,
    importance: ArrayLike | None = None,
    progress: Progress = silent,
) -> SrbfFit:
    """Fit base colors and SRBF terms that replace the SH colors of a scene.

    Colors below 0 count as 0, as displayed; colors above 1 count in full. Along the order of its terms the mean squared
    RGB error of a Gaussian over its visible directions never rises (in RGB: before colors are clipped at 0).

    Args:
        g: N Gaussians.
        directions: (N, 10) uint8 direction sets, or (N, 80) weights of the faces, from the Gaussian to the eye;
            None for all directions. Directions outside a Gaussian's set do not affect its fit. A function that returns
            such weights for some Gaussians saves memory: 320 bytes a Gaussian.
        config: Variant, number of terms, effort.
        importance: (N,) >= 0, weight of the error of each Gaussian, such as its summed squared blending weights
            over many views; equal by default. It decides which Gaussians get the terms.
        progress: Called with stage "price", then "fit"; counts Gaussians, in "fit" by their share of the work.

    Raises:
        ValueError: If a shape or a value does not fit; the message names the argument.

    References:
        SRBF-Gaussian, sections 5.1 and 5.2; docs/design/009-color-records.md.
    """
    config = config or FitConfig()
    n = len(g)
    weigh = _weigher(directions, n)
    counts = np.ones(n) if importance is None else _check.floats("importance", importance, (n,), np.float64)
    _check.in_range("importance", counts, 0.0, np.inf)
    prices, work = _sampled_prices(config, g, weigh, counts, progress)
    pursuit = Pursuit(replace(config, width_price=prices.width))
    terms: list[Terms] = []
    unseen = 0
    progress("fit", 0, n)

    def fit_part(part: slice) -> tuple[Terms, int]:
        """Return the terms of some Gaussians, and how many of them are not seen."""
        weights = weigh(np.arange(part.start, part.stop))
        fitted = _fit(pursuit, g[part], weights, counts[part], prices.term)
        return assemble(config, fitted, pursuit.directions), int((weights.max(axis=1) <= 0.0).sum())

    parts = [slice(start, min(start + _CHUNK, n)) for start in range(0, n, _CHUNK)]
    for done, (found, hidden) in zip(count_progress(work, parts), in_order(fit_part, parts), strict=True):
        terms.append(found)
        unseen += hidden
        progress("fit", done, n)
    return _join(config, terms, prices, unseen)


def fitted_for_price(count: int, config: FitConfig) -> int:
    """Return how many fits of a Gaussian `fit_srbf` makes beside those of `count`, to find the prices, about."""
    if config.mean_terms is None or config.max_terms == 0:
        return 0
    rounds = 3 if config.width_price > 0.0 and config.width_loss > 0.0 else 1
    return rounds * min(count, _SAMPLE)


def sample_colors(g: Gaussians) -> F32:
    """Return (N, 3, 320) RGB toward the centers of the parts of the faces, clipped at 0."""
    basis = sh_basis(-face_directions(_PARTS).reshape(-1, 3), g.sh_degree).astype(np.float32)
    coefficients = np.concatenate([g.sh0, g.shN], axis=1)
    colors = np.matmul(np.ascontiguousarray(coefficients.transpose(0, 2, 1)), basis.T)
    colors += np.float32(0.5)
    shown: F32 = np.maximum(colors, np.float32(0.0), out=colors)
    return shown


def _weigher(directions: ArrayLike | WeighFaces | None, count: int) -> WeighFaces:
    """Return the function that weighs the faces of some Gaussians, from the `directions` argument of `fit_srbf`."""
    if callable(directions):
        return directions
    weights = face_weights(directions, count)
    return lambda ids: weights[ids]


def _fit(pursuit: Pursuit, g: Gaussians, faces: F32, importance: F64, price: float) -> SplitFit:
    """Return the fit of a slice of Gaussians at a price."""
    shares = face_shares(_PARTS).astype(np.float32)
    weights = (faces[:, :, None] * (NUM_FACES * _PARTS * shares)).reshape(len(faces), -1)
    nowhere = weights.max(axis=1) <= 0.0
    weights[nowhere] = 1.0
    return pursuit.fit(sample_colors(g), weights, np.where(nowhere, 0.0, importance), price, nowhere)


def _sampled_prices(
    config: FitConfig, g: Gaussians, weigh: WeighFaces, importance: F64, progress: Progress
) -> tuple[Prices, F64]:
    """Return the prices at which Gaussians have the wanted number of terms on average, and the work (N,) of each.

    Uses the error curves of a sample: every k-th Gaussian by importance, because few Gaussians hold most of it.
    """
    if config.mean_terms is None or config.max_terms == 0 or len(g) == 0:
        return Prices(0.0, config.width_price), np.ones(len(g))
    order = np.argsort(importance, kind="stable")
    ids = np.sort(order[np.linspace(0, len(g) - 1, min(len(g), _SAMPLE)).astype(np.int64)])

    done = 0
    total = MOST_FITS * len(ids)
    latest: list[Curves] = []  # of each part of the sample
    progress("price", 0, total)

    def fit_sample(limited: FitConfig, price: float) -> Curves:
        """Return the curves of the sample at a price of a term."""
        nonlocal done
        pursuit = Pursuit(limited)
        latest.clear()
        for start in range(0, len(ids), _CHUNK):
            chosen = ids[start : start + _CHUNK]
            fitted = _fit(pursuit, g[chosen], weigh(chosen), importance[chosen], price)
            latest.append(fitted.curves(importance[chosen]))
            done += len(chosen)
            progress("price", done, total)
        return [curve for part in latest for curve in part]

    found = find_prices(fit_sample, config, _CAUTION * config.mean_terms, len(ids))
    progress("price", total, total)
    terms = np.concatenate([sum(count_terms(*curve, found) for curve in part) for part in latest])
    return found, foresee_work(importance, importance[ids], terms)


def _join(config: FitConfig, parts: list[Terms], prices: Prices, unseen: int) -> SrbfFit:
    """Return the fits of all slices as one."""
    kind = VARIANTS[config.variant]
    empty = Terms.empty(kind)
    parts = parts or [empty]

    def join(name: str) -> NDArray[np.float32]:
        """Return a field of all slices as one array."""
        return np.concatenate([getattr(part, name) for part in parts])

    counts = np.concatenate([part.counts for part in parts])
    colors = SrbfColors(
        config.variant,
        join("base"),
        join("scales"),
        np.concatenate([np.zeros(1, np.int64), np.cumsum(counts)]),
        np.concatenate([part.functions for part in parts]),
        join("centers"),
        join("decays"),
        join("intensities"),
    )
    return SrbfFit(colors, join("base_errors"), join("errors"), prices.term, prices.width, unseen)
