"""Convert SRBF colors to spherical harmonics by least squares, for viewers without SRBF, and report the loss.

Directions run from the eye to the Gaussian, scene frame; `towards_gaussian` converts those of a direction set.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.color.evaluate import evaluate_along
from gsvis.color.srbf import SrbfColors
from gsvis.progress import Progress, silent
from gsvis.scene.icosphere import face_directions, face_shares
from gsvis.scene.sh import SH_C0, sh_basis

__all__ = ["FittedSh", "to_sh"]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

_NUMBERS = 2_000_000
"""Number of color values held at a time."""

_LEAST_RIDGE = 1e-6  # ridge of the fit over all directions, which should cover the sphere


class FittedSh(NamedTuple):
    """SH coefficients of N Gaussians, and their error.

    Attributes:
        sh0: (N, 1, 3) float32.
        shN: (N, K-1, 3) float32.
        losses: (N,) float32, root mean squared RGB error over the directions and the three channels.
    """

    sh0: F32
    shN: F32  # noqa: N815  the field's own name
    losses: F32


def to_sh(
    colors: SrbfColors,
    *,
    sh_degree: int = 3,
    directions: ArrayLike | None = None,
    weights: ArrayLike | None = None,
    ridge: float = 1e-2,
    progress: Progress = silent,
) -> FittedSh:
    """Return SH coefficients whose colors are nearest to SRBF colors, by weighted least squares.

    Args:
        colors: N Gaussians.
        sh_degree: Degree of the result, 0 to 3.
        directions: (D, 3) from the eye to the Gaussian, of any length > 0; None means 320 over the sphere, four in
            each of the 80 faces in their order, with the faces' shares as weights.
        weights: (D,) shared by all, or (N, D), >= 0: weight of each direction, such as the views of a Gaussian.
            None means equal weights. A Gaussian whose weights are all 0 is fitted with equal weights.
        ridge: Cost, relative to the sum of the weights, of a departure from the fit over all directions. Weighted
            directions do not constrain the others; without the ridge, harmonics explode there.
        progress: Called with stage "harmonics".

    Returns:
        Coefficients and losses; both colors are clipped below at 0 before the comparison.

    Raises:
        ValueError: If a shape is wrong, a value is not finite or out of its range.

    Examples:
        >>> gray = SrbfColors.without_terms([[0.5, 0.5, 0.5]])
        >>> [part.shape for part in to_sh(gray, sh_degree=1)]
        [(1, 1, 3), (1, 3, 3), (1,)]
    """
    if not isinstance(colors, SrbfColors):
        raise ValueError(f"colors: expected SrbfColors, got {type(colors).__name__}")
    points, shared = _directions(directions)
    basis = sh_basis(points, sh_degree)  # checks the degree
    if not (isinstance(ridge, int | float) and 0.0 < ridge < np.inf):
        raise ValueError(f"ridge: expected a finite number > 0, got {ridge!r}")
    n, (d, k) = len(colors), basis.shape
    own = None if weights is None else _weights(weights, n, d)
    varying = np.full(k, 1.0 / (4.0 * np.pi))  # a harmonic's mean square over the sphere
    varying[0] = 0.0
    everywhere = _solver(basis, shared, _LEAST_RIDGE * varying)
    fitted = FittedSh(np.empty((n, 1, 3), np.float32), np.empty((n, k - 1, 3), np.float32), np.empty(n, np.float32))
    step = max(1, _NUMBERS // (3 * d))
    progress("harmonics", 0, n)
    for first in range(0, n, step):
        part = slice(first, min(first + step, n))
        seen = evaluate_along(colors[part], points)
        # Differences from the first direction: for a constant color they are 0, and so are all varying coefficients.
        apart = seen - seen[:, :1]
        found = _per_channel(apart, everywhere)
        chosen = np.broadcast_to(shared, (len(seen), d))
        if own is not None:
            chosen = np.where(own[part].any(axis=1, keepdims=True), own[part], shared)
            found += _improvement(apart - _per_channel(found, basis.T), basis, chosen, ridge * varying)
        found[:, 0] += (seen[:, 0] - 0.5) / SH_C0
        fitted.sh0[part], fitted.shN[part] = found[:, :1], found[:, 1:]
        fitted.losses[part] = _losses(found, basis, seen, chosen)
        progress("harmonics", part.stop, n)
    return fitted


def _directions(directions: ArrayLike | None) -> tuple[F64, F64]:
    """Return (D, 3) unit directions and their (D,) weights."""
    if directions is None:
        return face_directions(4).reshape(-1, 3), face_shares(4).ravel()
    points = _check.unit_vectors("directions", directions)
    if not len(points):
        raise ValueError("directions: expected at least one, got none")
    return points, np.ones(len(points))


def _weights(weights: ArrayLike, n: int, d: int) -> F32:
    """Return (N, D) weights."""
    checked = _check.floats("weights", weights, (d,) if np.ndim(weights) == 1 else (n, d))
    _check.in_range("weights", checked, 0.0, np.inf)
    return np.broadcast_to(checked, (n, d))


def _solver(basis: F64, weights: F64, penalty: F64) -> F64:
    """Return the (D, K) map from values along the directions to coefficients, for shared weights."""
    right = (basis * (weights / weights.sum())[:, None]).T
    return np.asarray(np.linalg.solve(right @ basis + np.diag(penalty), right).T)


def _improvement(left: F32, basis: F64, weights: F64, penalty: F64) -> F32:
    """Return (M, K, 3) coefficients that remove (M, D, 3) errors, each Gaussian with its own (M, D) weights."""
    k = basis.shape[1]
    shares = weights / weights.sum(axis=1, keepdims=True, dtype=np.float64)
    squares = (basis[:, :, None] * basis[:, None, :]).reshape(len(basis), k * k)
    normal = (shares @ squares).reshape(-1, k, k) + np.diag(penalty)
    right = _per_channel(left * shares[:, :, None].astype(np.float32), basis)
    return np.linalg.solve(normal, right).astype(np.float32)


def _per_channel(values: F32, matrix: F64) -> F32:
    """Return (M, B, 3) from (M, A, 3) values and an (A, B) matrix, channel by channel, as one product of matrices."""
    m, a, _ = values.shape
    columns = np.einsum("ab,ce->acbe", matrix, np.eye(3)).reshape(3 * a, -1).astype(np.float32)
    return np.asarray((values.reshape(m, 3 * a) @ columns).reshape(m, -1, 3))


def _losses(found: F32, basis: F64, seen: F32, weights: NDArray[Any]) -> F64:
    """Return the (N,) root mean squared RGB error of the fits."""
    errors = _per_channel(found, basis.T)
    errors += np.float32(0.5)
    np.maximum(errors, 0.0, out=errors)
    errors -= seen
    squares = np.einsum("mdc,mdc->md", errors, errors) / 3.0
    return np.asarray(np.sqrt(np.einsum("md,md->m", squares, weights) / weights.sum(axis=1, dtype=np.float64)))
