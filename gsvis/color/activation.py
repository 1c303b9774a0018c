"""Find the active terms: equation 7 of the paper, for one eye and for all eyes in a box.

A term's contribution is the largest absolute change that it makes in a channel of its Gaussian's RGB color; 1 is the
step from black to white. A term is active if its contribution is above epsilon. Scene frame and units. This module
knows nothing about visibility.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.color._kernels import activation as kernels
from gsvis.color._kernels.rgb import SPACES
from gsvis.color.srbf import SrbfColors, unit_vectors

__all__ = ["Activation", "active", "active_in_box", "contributions"]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

_ROUNDING = 1e-4  # relative error of a change through color conversion, besides 4 float32 steps of the color
_STEPS = 4.0 * float(np.finfo(np.float32).eps)
_MARGIN = 4e-6  # error of logarithms stored as float32
_WIDEST = 1e30
_BLOCK = 1 << 20  # terms that are prepared at a time


class Activation:
    """Find active terms for many eyes or boxes; prepares the terms once.

    Args:
        colors: N Gaussians with T terms.
        means: (N, 3) centers of the Gaussians.
        epsilon: Contribution above which a term is active, >= 0.

    Attributes:
        colors: The colors.
        epsilon: The threshold.

    Raises:
        ValueError: If lengths differ or epsilon is negative or not finite.

    References:
        SRBF-Gaussian, section 6.2, equation 7.
    """

    def __init__(self, colors: SrbfColors, means: ArrayLike, epsilon: float) -> None:
        if not isinstance(colors, SrbfColors):
            raise ValueError(f"colors: expected SrbfColors, got {type(colors).__name__}")
        if not (isinstance(epsilon, int | float | np.floating) and 0.0 <= epsilon < np.inf):
            raise ValueError(f"epsilon: expected a finite change of color of at least 0, got {epsilon!r}")
        self.colors = colors
        self.epsilon = float(epsilon)
        self._means = _check.floats("means", means, ("N", 3))
        _check.same_length(colors=colors.base, means=self._means)
        self._centers = _in_blocks(unit_vectors, colors.centers, (colors.num_terms, 3))
        self._amplitudes = colors.amplitudes()
        self._change_bounds = _change_bounds(colors, self._amplitudes)
        self._logs = self._above_epsilon()
        with np.errstate(over="ignore", divide="ignore"):
            self._widths = np.minimum(1.0 / colors.decays, _WIDEST).astype(np.float32)

    def __repr__(self) -> str:
        return f"Activation({self.colors!r}, epsilon {self.epsilon:g})"

    def contributions(self, eye: ArrayLike) -> F32:
        """Return (T,) the largest channel change of each term as an eye (3,) sees it; see `contributions`."""
        at = _check.floats("eye", eye, (3,), np.float64)
        colors = self.colors
        additive = colors.kind.space == "rgb"
        factors = self._change_bounds if additive else np.ones(colors.num_terms)
        found = np.zeros(colors.num_terms)
        means, at = _check.read_only(self._means, at)
        kernels.responses(means, colors.offsets, self._centers, colors.decays, factors, at, found)
        if additive:
            return found.astype(np.float32)
        out = np.zeros(colors.num_terms, np.float32)
        code = SPACES[colors.kind.space]
        kernels.changes(code, colors.base, colors.scales, colors.offsets, self._amplitudes, found, out)
        return out

    def active(self, eye: ArrayLike, visible: ArrayLike | None = None, weights: ArrayLike | None = None) -> Mask:
        """Return (T,) bool, the terms that are active for an eye.

        Args:
            eye: (3,) position.
            visible: (V,) Gaussians to test; None means all. The terms of other Gaussians are not active.
            weights: (V,) largest blending weight of each of them, in [0, 1]. If given, a term is active if its
                change of a pixel, contribution times weight, is above epsilon: fewer terms at the same image quality.
        """
        found = self.contributions(eye)
        ids, factors = self._select(visible, weights)
        of_gaussian = np.zeros(len(self.colors), np.float32)
        of_gaussian[ids] = 1.0 if factors is None else factors
        return np.asarray(found * np.repeat(of_gaussian, self.colors.counts) > np.float32(self.epsilon))

    def active_in_box(
        self,
        low: ArrayLike,
        high: ArrayLike,
        visible: ArrayLike | None = None,
        weights: ArrayLike | None = None,
    ) -> Mask:
        """Return (T,) bool, the terms that may be active for some eye in a box; never misses an active term.

        A cone around the direction from the middle of the box bounds the directions from the box to a Gaussian, so the
        result may include terms that no eye needs.

        Args:
            low: (3,) lowest corner of the box.
            high: (3,) highest corner.
            visible: (V,) Gaussians to test; None means all. The cost grows with their number.
            weights: (V,) as in `active`, the largest over all eyes in the box.

        Raises:
            ValueError: If a corner is not below the other, an id is not in [0, N), or a weight is not in [0, 1].
        """
        first = _check.floats("low", low, (3,), np.float64)
        last = _check.floats("high", high, (3,), np.float64)
        if (first > last).any():
            raise ValueError(f"low: expected at most high, {last.tolist()}, got {first.tolist()}")
        ids, factors = self._select(visible, weights)
        with np.errstate(divide="ignore"):
            faint = np.zeros(0) if factors is None else -np.log(factors.astype(np.float64))
        out = np.zeros(self.colors.num_terms, np.bool_)
        terms = *_check.read_only(self._means), self.colors.offsets, self._centers, self._logs, self._widths
        kernels.mark_terms(ids, faint, *terms, first, last, out)
        return out

    def least_cosines(self) -> F32:
        """Return (T,) bounds on the cosine between the center of a term and the direction from an eye to its Gaussian.

        A term can be active only at cosines of at least the bound; 2 means never and -inf always. In RGB it is active
        exactly at these cosines.
        """
        with np.errstate(invalid="ignore"):
            found = 1.0 - self._logs.astype(np.float64) * self._widths
        return np.where(np.isneginf(self._logs), 2.0, found).astype(np.float32)

    def _select(self, visible: ArrayLike | None, weights: ArrayLike | None) -> tuple[NDArray[np.int64], F32 | None]:
        """Return (V,) ids of the selected Gaussians, and their weights if given."""
        count = len(self.colors)
        ids = np.arange(count) if visible is None else _check.integers("visible", visible, ("V",))
        if len(ids) and not 0 <= ids.min() <= ids.max() < count:
            raise ValueError(f"visible: expected ids in [0, {count}), got {ids.min()} to {ids.max()}")
        if weights is None:
            return ids, None
        factors = _check.floats("weights", weights, (len(ids),))
        _check.in_range("weights", factors, 0.0, 1.0)
        return ids, factors

    def _above_epsilon(self) -> F32:
        """Return (T,) upper bounds of the logarithm of each term's largest change over epsilon; -inf for no change."""
        bounds = self._change_bounds
        if self.colors.kind.space == "rgb":
            return _in_blocks(lambda some: _logs_above(some, np.full(len(some), self.epsilon)), bounds, bounds.shape)
        steps = _STEPS * self.colors.scales[self.colors.gaussian_ids].astype(np.float64)
        return _logs_above(bounds, np.maximum((1.0 - _ROUNDING) * self.epsilon - steps, 0.0))


def _logs_above(bounds: F64, epsilon: F64) -> F32:
    """Return (T,) logarithms of bounds over epsilon, not below them; -inf for bounds of 0."""
    something = bounds > 0.0
    with np.errstate(divide="ignore"):
        logs = np.log(np.where(something, bounds, 1.0)) - np.log(epsilon) + _MARGIN
    return np.where(something, logs, -np.inf).astype(np.float32)


def _in_blocks(function: Callable[[NDArray[Any]], NDArray[Any]], rows: NDArray[Any], shape: tuple[int, ...]) -> F32:
    """Return a function of rows as float32 of a shape, a block at a time: it computes in float64."""
    found = np.empty(shape, np.float32)
    for start in range(0, len(rows), _BLOCK):
        some = slice(start, start + _BLOCK)
        found[some] = function(rows[some])
    return found


def contributions(colors: SrbfColors, means: ArrayLike, eye: ArrayLike) -> F32:
    """Compute how much each term changes the color that an eye sees.

    If terms add in RGB, it is the largest amplitude times the lobe, G(x; c, lambda): the change before negative colors
    are clipped, hence an upper bound. In HSL it is the largest difference between the final colors with
    and without this term.

    Args:
        colors: N Gaussians with T terms.
        means: (N, 3) centers of the Gaussians.
        eye: (3,) position.

    Returns:
        (T,) float32, >= 0, where 1 is the step from black to white.

    Raises:
        ValueError: If a shape is wrong or a value is not finite.

    References:
        SRBF-Gaussian, section 6.2, equation 7.
    """
    return Activation(colors, means, 0.0).contributions(eye)


def active(colors: SrbfColors, means: ArrayLike, eye: ArrayLike, epsilon: float) -> Mask:
    """Return (T,) bool, the terms whose contribution for an eye (3,) is above epsilon.

    Args:
        colors: N Gaussians with T terms.
        means: (N, 3) centers of the Gaussians.
        eye: (3,) position.
        epsilon: Change of color above which a term is active, >= 0.

    Examples:
        >>> lobe = SrbfColors("rgb", [[0.5, 0.5, 0.5]], [1], [0, 1], [0],
        ...                   [[0, 0]], [10.0], [[0.2, 0, 0]])
        >>> [bool(active(lobe, [[0, 0, 0]], eye, 0.01)[0]) for eye in ([0, 0, -1], [1, 0, 0], [0, 0, 1])]
        [True, False, False]
    """
    return Activation(colors, means, epsilon).active(eye)


def active_in_box(colors: SrbfColors, means: ArrayLike, low: ArrayLike, high: ArrayLike, epsilon: float) -> Mask:
    """Return (T,) bool, the terms that may be active for some eye in a box; see `Activation.active_in_box`."""
    return Activation(colors, means, epsilon).active_in_box(low, high)


def _change_bounds(colors: SrbfColors, amplitudes: F32) -> F64:
    """Return (T,) bounds on the change of a channel per unit of the lobe.

    With S and L in [0, 1] a channel of HSL is L - S min(L, 1 - L) w, |w| <= 1: its slope by L is at most 1 + S, its
    slope by S at most min(L, 1 - L). The possible values of S and L follow from the signs of the amplitudes, because
    lobes lie in (0, 1].
    """
    kind = colors.kind
    if kind.space == "rgb":
        largest = np.maximum(amplitudes.max(axis=1, initial=0.0), -amplitudes.min(axis=1, initial=0.0))
        return np.asarray(largest, np.float64)
    sizes = np.abs(amplitudes.astype(np.float64))
    ids = colors.gaussian_ids
    scaled = colors.scales.astype(np.float64)[ids]
    base = colors.base.astype(np.float64)

    def bound(component: int, sign: float) -> F64:
        """Return the lowest (sign -1) or highest (sign 1) possible value of a component, (T,)."""
        change = np.maximum(sign * amplitudes[:, component].astype(np.float64), 0.0)
        ends = base[:, component] + sign * np.bincount(ids, change, len(colors))
        return np.asarray(np.clip(ends, 0.0, 1.0)[ids])

    by_lightness = 1.0 + bound(1, 1.0)
    darkest = bound(2, -1.0)
    lightest = bound(2, 1.0)
    middle = np.clip(0.5, darkest, lightest)
    by_saturation = np.minimum(middle, 1.0 - middle)
    return np.asarray(scaled * np.maximum(sizes[:, 1] * by_saturation, sizes[:, 2] * by_lightness))
