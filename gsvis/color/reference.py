"""Plain twins of the fast paths of this room, short and in float64. Only tests need these."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis.color.omp import LEAST_SHARE, SparseCodes
from gsvis.color.spaces import hsl_to_rgb
from gsvis.color.srbf import SrbfColors, srbf, unit_vectors

__all__ = ["evaluate", "orthogonal_matching_pursuit", "refine"]

F64 = NDArray[np.float64]


def evaluate(colors: SrbfColors, means: ArrayLike, eye: ArrayLike, *, active: ArrayLike | None = None) -> F64:
    """Return (N, 3) colors as one eye sees them; arguments as `gsvis.color.evaluate`."""
    offsets = np.asarray(means, np.float64).reshape(-1, 3) - np.asarray(eye, np.float64)
    lengths = np.linalg.norm(offsets, axis=1, keepdims=True)
    directions = np.where(lengths > 0, offsets / np.where(lengths > 0, lengths, 1.0), [0.0, 0.0, 1.0])
    terms = np.arange(colors.num_terms) if active is None else np.flatnonzero(active)
    ids = colors.gaussian_ids[terms]
    lobes = srbf(directions[ids], unit_vectors(colors.centers[terms]), colors.decays[terms])
    values = colors.base.astype(np.float64)
    np.add.at(values, ids, lobes[:, None] * colors.amplitudes()[terms])
    return _to_rgb(colors, values)


def _to_rgb(colors: SrbfColors, values: F64) -> F64:
    """Return RGB of (N, 3) values in the variant's space."""
    if colors.kind.space == "rgb":
        return np.asarray(np.maximum(values, 0.0))
    rgb = np.asarray(hsl_to_rgb(np.clip(values, [-np.inf, 0, 0], [np.inf, 1, 1])))
    return np.asarray(np.maximum(rgb, 0.0) * colors.scales[:, None].astype(np.float64))


def orthogonal_matching_pursuit(
    dictionary: ArrayLike,
    signals: ArrayLike,
    *,
    max_terms: int,
    tolerance: float = 0.0,
    weights: ArrayLike | None = None,
    least_share: float = LEAST_SHARE,
) -> SparseCodes:
    """Solve signal by signal; arguments as in `gsvis.color`, with one limit for all."""
    columns = np.asarray(dictionary, np.float64)
    values = np.asarray(signals, np.float64)
    number, depth = values.shape[:2]
    shared = np.ones(depth) if weights is None else np.asarray(weights, np.float64)
    roots = np.sqrt(np.broadcast_to(shared, (number, depth)))
    atoms = np.full((number, max_terms), -1, np.int32)
    coefficients = np.zeros((number, max_terms, *values.shape[2:]))
    counts = np.zeros(number, np.int32)
    errors = np.zeros((number, max_terms + 1))
    for n in range(number):
        seen = columns * roots[n][:, None]
        target = (values[n].T * roots[n]).T.reshape(depth, -1)
        squares = (seen**2).sum(axis=0)
        usable = squares > least_share * (columns**2).sum(axis=0) * roots[n].max() ** 2
        chosen: list[int] = []
        residual = target
        energy = (target**2).sum()
        errors[n] = energy
        while len(chosen) < max_terms and errors[n, -1] > tolerance:
            scores = np.where(usable, ((seen.T @ residual) ** 2).sum(axis=1) / np.where(usable, squares, 1.0), 0.0)
            scores[chosen] = 0.0
            best = int(scores.argmax())
            rest = seen[:, best] - seen[:, chosen] @ np.linalg.lstsq(seen[:, chosen], seen[:, best], rcond=None)[0]
            if scores[best] <= 1e-12 * energy or (rest**2).sum() <= 1e-10 * squares[best]:
                break
            chosen.append(best)
            fit = np.linalg.lstsq(seen[:, chosen], target, rcond=None)[0]
            residual = target - seen[:, chosen] @ fit
            counts[n] = len(chosen)
            atoms[n, : len(chosen)] = chosen
            coefficients[n, : len(chosen)] = fit.reshape(len(chosen), *values.shape[2:])
            errors[n, len(chosen) :] = (residual**2).sum()
    return SparseCodes(atoms, coefficients.astype(np.float32), counts, errors)


def refine(
    targets: ArrayLike, directions: ArrayLike, weights: ArrayLike, v: ArrayLike, *, ridge: float
) -> tuple[float, F64]:
    """Return the least error that SciPy finds from given lobes: weighted squared residuals plus the ridge's cost.

    Args:
        targets: (D, C) target values.
        directions: (D, 3) unit vectors.
        weights: (D,) >= 0.
        v: (K, 3) decay times center of the initial lobes.
        ridge: Cost of a squared intensity.

    Returns:
        The error, and the (K, 3) lobes.
    """
    from scipy.optimize import least_squares  # slow to import, seldom needed

    points = np.asarray(directions, np.float64)
    root = np.sqrt(np.asarray(weights, np.float64))
    goal = np.asarray(targets, np.float64) * root[:, None]

    def residuals(flat: F64) -> F64:
        """Return the weighted errors of lobes (3 K,), with the best intensities."""
        moved = flat.reshape(-1, 3)
        decays = np.linalg.norm(moved, axis=1)
        lobes = np.exp(points @ moved.T - decays) * root[:, None]
        padded = np.vstack([lobes, np.sqrt(ridge) * np.eye(len(moved))])
        full = np.vstack([goal, np.zeros((len(moved), goal.shape[1]))])
        intensities = np.linalg.lstsq(padded, full, rcond=None)[0]
        return np.asarray((full - padded @ intensities).ravel())

    solved = least_squares(residuals, np.asarray(v, np.float64).ravel())
    return float(2.0 * solved.cost), np.asarray(solved.x.reshape(-1, 3))
