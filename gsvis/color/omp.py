"""Run orthogonal matching pursuit: few atoms of one dictionary for each of very many signals, in one parallel batch.

A signal is a function on D directions with weights; a weight of 0 masks a direction. This module does not know the
meaning of directions and atoms.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import get_num_threads
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.color._kernels import omp as kernels
from gsvis.color._kernels.products import BLOCK, WIDTH, multiply
from gsvis.progress import Progress, silent

__all__ = ["SparseCodes", "orthogonal_matching_pursuit"]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

_CHUNK = 64 * BLOCK
"""Number of signals that a thread takes at a time; bounds the memory beside arguments and results."""

LEAST_SHARE = 1e-6
"""Share of an atom's squared length that must be left under the weights for the atom to be chosen."""


@dataclass(frozen=True, eq=False)
class SparseCodes:
    """A few atoms for each of N signals, in the order of choice.

    Attributes:
        atoms: (N, K) int32, columns of the dictionary; -1 beyond `counts`.
        coefficients: (N, K) float32, or (N, K, C) for signals of C channels: the joint least-squares fit by all
            chosen atoms; 0 beyond `counts`.
        counts: (N,) int32 number of atoms of each signal.
        errors: (N, K + 1) float64, weighted squared error after 0, 1, ..., K terms, each time with the best
            coefficients. It never rises along a row; beyond `counts` it repeats that of the last term.
    """

    atoms: NDArray[np.int32]
    coefficients: F32
    counts: NDArray[np.int32]
    errors: F64

    def __len__(self) -> int:
        return len(self.counts)


def orthogonal_matching_pursuit(
    dictionary: ArrayLike,
    signals: ArrayLike,
    *,
    max_terms: int | ArrayLike,
    tolerance: float | ArrayLike = 0.0,
    weights: ArrayLike | None = None,
    least_share: float = LEAST_SHARE,
    progress: Progress = silent,
) -> SparseCodes:
    """Approximate each signal by a few atoms, chosen greedily and refitted jointly after each choice.

    With w the weights, inner products are <a, b> = sum over d of w_d a_d b_d. Each step chooses the atom a with the
    largest |<a, r>| / |a| for the residual r (of several channels: the root of the sum of squares), the first of a tie.
    Then all chosen atoms are fitted to the signal. A signal ends at `max_terms`, when its error is at or below
    `tolerance`, or when nothing can be gained: the best atom gains less than 1e-12 of the signal's energy <y, y>, or is
    a combination of the chosen atoms.

    A signal's result is bit-identical whatever the other signals, their number and the number of threads. Memory beside
    arguments and result does not grow with N, if `signals` is C-contiguous.

    Args:
        dictionary: (D, A) atoms in columns, of any length; a zero column is never chosen.
        signals: (N, D), or (N, D, C): the C channels share their atoms. Converted to float32.
        max_terms: Maximum number of terms of each signal, an int or (N,) ints, in 0..A. K is the int, or the
            largest of the (N,).
        tolerance: Weighted squared error sum over d of w_d r_d^2 (and over channels) at which to stop: absolute, in
            the square of the signals' unit; a float or (N,).
        weights: (D,) or (N, D), not negative, bool or numbers; None means 1. A signal without weight gets no terms,
            and its error is 0.
        least_share: An atom is skipped for a signal if its squared length under the weights is at most this share
            of its squared length with all weights equal to the largest: invisible parts cannot be fitted.
        progress: Called with stage "pursuit"; counts signals.

    Raises:
        ValueError: If shapes disagree, a value is not finite, a weight or a tolerance is negative, or more terms
            than atoms are requested.

    References:
        Pati, Rezaiifar and Krishnaprasad 1993; Rubinstein, Zibulevsky and Elad 2008 (correlations by recursion, if all
        signals have the same weights); Tropp, Gilbert and Strauss 2006 (several channels).
    """
    columns = _check.floats("dictionary", dictionary, ("D", "A"), np.float64)
    depth, number_of_atoms = columns.shape
    if 0 in columns.shape:
        raise ValueError(f"dictionary: expected at least one direction and one atom, got shape {columns.shape}")
    values = _signals(signals, depth)
    number = len(values)
    channels = values.shape[2] if values.ndim == 3 else 1
    own, shared = _weights(weights, number, depth)
    limits = _limits(max_terms, number, number_of_atoms)
    tolerances = np.full(number, tolerance) if np.ndim(tolerance) == 0 else tolerance
    (tolerances,) = _check.read_only(_check.floats("tolerance", tolerances, (number,), np.float64))
    _check.in_range("tolerance", tolerances, 0.0, np.inf)
    _check.in_range("least_share", np.asarray(least_share, np.float64), 0.0, 1.0)
    terms = int(max_terms) if isinstance(max_terms, int | np.integer) else int(limits.max(initial=0))
    codes = kernels.Codes(
        np.empty((number, terms), np.int32),
        np.empty((number, terms, channels), np.float32),
        np.empty(number, np.int32),
        np.empty((number, terms + 1)),
    )
    atoms = _prepare_atoms(columns, shared, own is not None, least_share)

    def pursue(start: int) -> int:
        """Run the pursuit for a part of the signals; return their number."""
        part = slice(start, min(start + _CHUNK, number))
        with np.errstate(over="ignore"):  # what overflows to inf is found by the kernel
            chunk = kernels.Chunk(
                np.ascontiguousarray(values[part], np.float32).reshape(part.stop - start, depth * channels),
                np.empty((0, depth), np.float32) if own is None else np.ascontiguousarray(own[part], np.float32),
                limits[part],
                tolerances[part],
            )
        kernels.pursue(chunk, atoms, _part_of_results(codes, part))
        _refuse(codes.counts[part], start)
        return part.stop

    progress("pursuit", 0, number)
    with ThreadPoolExecutor(get_num_threads()) as pool:
        for done in pool.map(pursue, range(0, number, _CHUNK)):
            progress("pursuit", done, number)
    coefficients = codes.coefficients if values.ndim == 3 else codes.coefficients[:, :, 0]
    return SparseCodes(codes.atoms, coefficients, codes.counts, codes.errors)


def _signals(signals: ArrayLike, depth: int) -> NDArray[Any]:
    """Return checked signals."""
    values = np.asarray(signals)
    if values.ndim not in (2, 3) or values.shape[1] != depth or (values.ndim == 3 and values.shape[2] == 0):
        raise ValueError(f"signals: expected shape (N, {depth}) or (N, {depth}, C), got {values.shape}")
    return _require_real("signals", values)


def _require_real(name: str, values: NDArray[Any]) -> NDArray[Any]:
    """Return the array if it holds real numbers; parts are converted to float32 later."""
    if values.dtype.kind not in "fiub":
        raise ValueError(f"{name}: expected numbers, got dtype {values.dtype}")
    return values


def _weights(weights: ArrayLike | None, number: int, depth: int) -> tuple[NDArray[Any] | None, F64]:
    """Return the signals' own weights (checked by the kernel) or None, and the shared weights."""
    if weights is None:
        return None, np.ones(depth)
    if np.ndim(weights) == 1:
        shared = _check.floats("weights", weights, (depth,), np.float64)
        _check.in_range("weights", shared, 0.0, np.inf)
        return None, shared
    own = np.asarray(weights)
    if own.shape != (number, depth):
        raise ValueError(f"weights: expected shape ({depth},) or ({number}, {depth}), got {own.shape}")
    return _require_real("weights", own), np.ones(depth)


def _limits(max_terms: int | ArrayLike, number: int, most: int) -> NDArray[np.int64]:
    """Return the checked maximum number of terms of each signal."""
    if np.ndim(max_terms) == 0:
        max_terms = np.full(number, _check.positive_int("max_terms", max_terms, at_least=0))
    limits: NDArray[np.int64] = _check.integers("max_terms", max_terms, (number,))
    if number and not 0 <= limits.min() <= limits.max() <= most:
        worst = limits.min() if limits.min() < 0 else limits.max()
        raise ValueError(f"max_terms: expected 0 to {most}, the number of atoms, got {worst}")
    return limits


def _part_of_results(codes: kernels.Codes, part: slice) -> kernels.Codes:
    """Return the results of a part of the signals, as views."""
    return kernels.Codes(codes.atoms[part], codes.coefficients[part], codes.counts[part], codes.errors[part])


def _refuse(counts: NDArray[np.int32], start: int) -> None:
    """Raise if the kernel found an invalid signal or invalid weights."""
    bad = np.flatnonzero(counts < 0)
    if len(bad):
        name = "signals" if counts[bad[0]] == kernels.BAD_SIGNAL else "weights"
        wanted = "finite values in the range of float32" + (" and not negative" if name == "weights" else "")
        got = "a value that is infinite, NaN or too large" + (", or negative" if name == "weights" else "")
        raise ValueError(f"{name}: expected {wanted}, got {got} in row {start + bad[0]}")


def _prepare_atoms(columns: F64, shared: F64, own: bool, least_share: float) -> kernels.Atoms:
    """Return the prepared dictionary."""
    number = columns.shape[1]
    depth = columns.shape[0]
    largest = np.abs(columns).max(axis=0)
    unit = np.ascontiguousarray((columns / np.where(largest > 0.0, largest, 1.0)).T)
    lengths = np.sqrt(np.einsum("ad,ad->a", unit, unit))
    unit /= np.where(lengths > 0.0, lengths, 1.0)[:, None]
    scale = float(shared.max())
    roots = np.sqrt(shared / scale if scale > 0.0 else shared).astype(np.float32)
    unit *= roots
    panels = -(-number // WIDTH)
    rows = np.zeros((-(-number // BLOCK) * BLOCK, depth), np.float32)
    rows[:number] = unit
    table = np.zeros((panels * WIDTH, depth), np.float32)
    table[:number] = unit
    table = np.ascontiguousarray(table.reshape(panels, WIDTH, depth).transpose(0, 2, 1))
    shares = np.zeros(panels * WIDTH)
    shares[:number] = np.einsum("ad,ad->a", unit, unit)
    seen = shares > least_share
    gram = np.empty((0 if own else len(rows), len(shares)), np.float32)
    if not own:
        multiply(rows, table, gram)
    return kernels.Atoms(
        unit=unit,
        lengths=lengths * largest,
        panels=table,
        squares=table * table if own else table[:0],
        gram=gram[:number],
        gains=(seen / np.where(seen, shares, 1.0)).astype(np.float32)[None],
        roots=roots[None],
        scale=scale,
        least_share=np.float32(least_share),
    )
