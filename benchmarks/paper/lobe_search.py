"""Search for the lobes of one function, in float64: add and remove one at a time, refine all after each change.

A lobe is exp(v.x - |v|); v is its center times its decay. This is the slow, thorough counterpart of the kernels that
fit whole scenes: a small ridge and no rounding to float32, so that lobes that nearly cancel (a flat top, a sharp edge)
can be used.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gsvis.scene.icosphere import icosphere

if TYPE_CHECKING:
    from paper.sphere import SphereConfig

__all__ = ["Fit", "LobeSearch"]

F64 = NDArray[np.float64]

LEAST_DECAY = 0.02
_ATTEMPTS = 6
_SHARE = 0.01
"""Share of an atom's squared length outside the span of the current lobes from which its gain counts in full."""
_SCALED = (0.4, 0.7, 1.4, 2.5)
"""Factors on the decays of current lobes that give further candidates beside the dictionary: rings and flat tops."""
_SHARPNESS = 8
"""Power of the gain to which the probability of a random choice is proportional."""


@dataclass(frozen=True, eq=False)
class Fit:
    """Some lobes with their best intensities.

    Attributes:
        error: Squared error, relative to that without lobes.
        v: (K, 3) decay times center.
        intensities: (K,).
        left: (D,) residual, times the roots of the weights.
    """

    error: float
    v: F64
    intensities: F64
    left: F64

    def __len__(self) -> int:
        return len(self.v)


@dataclass(frozen=True, eq=False)
class _Solved:
    """Intensities, residual, Cholesky factor and cost of a solved least-squares problem."""

    intensities: F64
    left: F64
    factor: F64
    cost: float


class LobeSearch:
    """Search from the atoms of a dictionary for the lobes of one function.

    Args:
        values: (D,), not all 0.
        directions: (D, 3) unit.
        weights: (D,) > 0, sum 1.
        config: Effort and limits.
        most_decay: Largest decay, that of the narrowest lobe.
    """

    def __init__(self, values: F64, directions: F64, weights: F64, config: SphereConfig, most_decay: float) -> None:
        self.points = np.ascontiguousarray(directions.T)
        self.roots = np.sqrt(weights)
        self.target = values * self.roots
        self.total = float(self.target @ self.target)
        self.ridge = config.ridge
        self.most_decay = most_decay
        self.config = config
        self.starts = atoms(config.subdivisions, most_decay)
        self.dictionary = self._rows(self.starts)
        self.squares = np.einsum("ad,ad->a", self.dictionary, self.dictionary)
        self.nothing = Fit(1.0, np.zeros((0, 3)), np.zeros(0), self.target)

    def fit(self, v: F64) -> Fit:
        """Fit intensities to given lobes, without moving the lobes."""
        solved = self._solve(self._rows(v)) if len(v) else None
        return self.nothing if solved is None else self._fit(v, solved)

    def extend(self, fit: Fit, rng: np.random.Generator | None = None) -> Fit:
        """Add the lobe that lowers the error most, or with `rng` a random good one; refine all."""
        starts, gains = self._gains(fit)
        if rng is None:
            chosen = int(gains.argmax())
        else:
            chances = (gains / gains.max()) ** _SHARPNESS
            chosen = int(rng.choice(len(starts), p=chances / chances.sum()))
        return self.refine(np.concatenate([fit.v, starts[chosen : chosen + 1]]))

    def reduce(self, fit: Fit) -> Fit:
        """Remove the lobe whose removal raises the error least; refine the rest."""
        rows = self._rows(fit.v)
        gram = rows @ rows.T
        gram.flat[:: len(rows) + 1] += self.ridge
        growth = fit.intensities**2 / np.linalg.inv(gram).diagonal()
        return self.refine(np.delete(fit.v, int(growth.argmin()), axis=0))

    def refine(self, v: F64) -> Fit:
        """Move all lobes to a nearby optimum: Levenberg-Marquardt with the intensities eliminated (Kaufman)."""
        from scipy.linalg import lapack  # slow to import, seldom needed

        rows = self._rows(v)
        now = self._solve(rows) if len(v) else None
        if now is None:
            return self.nothing
        damping = 1e-2
        slow = 0
        for _ in range(self.config.steps):
            error = now.cost
            if error <= 1e-13 * self.total:
                break
            slopes = self._slopes(v, rows, now.intensities)
            shared = rows @ slopes.T
            normal = slopes @ slopes.T
            normal -= shared.T @ lapack.dpotrs(now.factor, shared, lower=1)[0]
            moved = None
            for _ in range(_ATTEMPTS):
                moved = self._move(v, normal, slopes @ now.left, damping)
                if moved is not None and moved[2].cost < error:
                    break
                moved = None
                damping = 5.0 * damping
            if moved is None:
                break
            v, rows, now = moved
            damping = max(0.2 * damping, 1e-9)
            slow = slow + 1 if error - now.cost < self.config.tolerance * error else 0
            if slow == 2:
                break
        return self._fit(v, now)

    def _fit(self, v: F64, solved: _Solved) -> Fit:
        """Return the fit of solved lobes."""
        return Fit(float(solved.left @ solved.left) / self.total, v, solved.intensities, solved.left)

    def _rows(self, v: F64) -> F64:
        """Return (K, D) lobes times the roots of the weights."""
        rows = v @ self.points
        rows -= np.linalg.norm(v, axis=1)[:, None]
        np.exp(rows, out=rows)
        rows *= self.roots
        return np.asarray(rows)

    def _slopes(self, v: F64, rows: F64, intensities: F64) -> F64:
        """Return (3 K, D) derivatives of the sum of lobes by each v."""
        centers = v / np.linalg.norm(v, axis=1)[:, None]
        slopes = (rows * intensities[:, None])[:, None] * (self.points[None] - centers[:, :, None])
        return np.asarray(slopes.reshape(3 * len(v), -1))

    def _solve(self, rows: F64) -> _Solved | None:
        """Return the best intensities, refined once against rounding; None if the lobes are numerically dependent."""
        from scipy.linalg import lapack

        gram = rows @ rows.T
        gram.flat[:: len(rows) + 1] += self.ridge
        factor, failed = lapack.dpotrf(gram, lower=1)
        if failed:
            return None
        intensities = lapack.dpotrs(factor, rows @ self.target, lower=1)[0]
        left = self.target - intensities @ rows
        intensities += lapack.dpotrs(factor, rows @ left - self.ridge * intensities, lower=1)[0]
        left = self.target - intensities @ rows
        return _Solved(intensities, left, factor, float(left @ left + self.ridge * (intensities @ intensities)))

    def _move(self, v: F64, normal: F64, slope: F64, damping: float) -> tuple[F64, F64, _Solved] | None:
        """Return the lobes after a damped step with their decays and solution; None if the step cannot be solved."""
        from scipy.linalg import lapack

        damped = normal.copy()
        diagonal = normal.diagonal()
        damped.flat[:: len(slope) + 1] = diagonal * (1.0 + damping) + 1e-13 * diagonal.max()
        factor, failed = lapack.dpotrf(damped, lower=1)
        if failed:
            return None
        trial = v + lapack.dpotrs(factor, slope, lower=1)[0].reshape(-1, 3)
        decays = np.linalg.norm(trial, axis=1)
        if not decays.min() > 0.0:
            return None
        trial *= (np.clip(decays, LEAST_DECAY, self.most_decay) / decays)[:, None]
        rows = self._rows(trial)
        solved = self._solve(rows)
        return None if solved is None else (trial, rows, solved)

    def _gains(self, fit: Fit) -> tuple[F64, F64]:
        """Return candidates for a new lobe, and how much each lowers the error after a new fit of all intensities."""
        if len(fit) == 0:
            return self.starts, (self.dictionary @ fit.left) ** 2 / self.squares
        scaled = np.concatenate([fit.v * factor for factor in _SCALED])
        decays = np.linalg.norm(scaled, axis=1)
        scaled = scaled[(decays > LEAST_DECAY) & (decays < self.most_decay)]
        own = self._rows(scaled)
        candidates = np.concatenate([self.dictionary, own])
        squares = np.concatenate([self.squares, np.einsum("ad,ad->a", own, own)])
        rows = self._rows(fit.v)
        gram = rows @ rows.T
        gram.flat[:: len(rows) + 1] += 1e-9
        shared = candidates @ rows.T
        beside = squares - np.einsum("ak,ka->a", shared, np.linalg.solve(gram, shared.T))
        gains = (candidates @ fit.left) ** 2 / np.maximum(beside, _SHARE * squares)
        return np.concatenate([self.starts, scaled]), np.asarray(gains)


def atoms(subdivisions: int, most_decay: float) -> F64:
    """Return (A, 3) decay times center of atoms: vertices of an icosphere, decays 1, 3, 9, ... up to the largest."""
    decays = 3.0 ** np.arange(1 + int(np.log(max(most_decay, 1.0)) / np.log(3.0) + 1e-9))
    return np.asarray((decays[:, None, None] * icosphere(subdivisions)[0]).reshape(-1, 3))
