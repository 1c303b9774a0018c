"""Kernels of orthogonal matching pursuit on blocks of signals; all signals of a block gain one term at a time.

Correlations are float32; the chosen atoms are orthogonalized in float64. The result of a signal does not depend on its
neighbors, on blocks or on threads.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gsvis._kernels.compiled import inner, kernel
from gsvis.color._kernels.products import BLOCK, best_atom, multiply_rows

__all__ = ["BAD_SIGNAL", "BAD_WEIGHTS", "Atoms", "Chunk", "Codes", "pursue"]

BAD_SIGNAL = -1
BAD_WEIGHTS = -2
"""Error codes in `counts`: a signal that is not finite, or a weight that is not finite or negative."""

_NOISE = 1e-6  # share of a signal's norm; correlations below it are rounding errors
_DEPENDENT = 1e-10  # share of an atom's squared norm; a smaller part outside the others' span is a rounding error
_REASSOCIATE = {"reassoc", "contract"}

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


class Atoms(NamedTuple):
    """A prepared dictionary. P panels hold the A atoms; entries beyond A are zero.

    Attributes:
        unit: (A, D) float64, atoms over their lengths, times `roots`.
        lengths: (A,) float64.
        panels: (P, D, WIDTH) float32, `unit` panel by panel.
        squares: (P, D, WIDTH) float32, squares of `panels`; (0, D, WIDTH) if no signal has weights of its own.
        gram: (A, P * WIDTH) float32, inner products of `unit`; (0, P * WIDTH) if signals have weights of their own.
        gains: (1, P * WIDTH) float32, 1 over the squared lengths of `unit`, 0 for skipped atoms.
        roots: (1, D) float32, square roots of the shared weights over the largest.
        scale: The largest shared weight.
        least_share: Atoms whose squared length falls below this share of itself, under weights, are skipped.
    """

    unit: F64
    lengths: F64
    panels: F32
    squares: F32
    gram: F32
    gains: F32
    roots: F32
    scale: float
    least_share: np.float32


class Chunk(NamedTuple):
    """M signals and their limits.

    Attributes:
        signals: (M, D * C) float32, the channels of a direction adjacent.
        weights: (M, D) float32; (0, D) if the signals share them.
        limits: (M,) int64, maximum number of terms of each.
        tolerances: (M,) float64, weighted squared errors at which to stop.
    """

    signals: F32
    weights: F32
    limits: NDArray[np.int64]
    tolerances: F64


class Codes(NamedTuple):
    """Results: atoms (M, K) int32, coefficients (M, K, C) float32, counts (M,) int32, errors (M, K + 1)."""

    atoms: NDArray[np.int32]
    coefficients: F32
    counts: NDArray[np.int32]
    errors: F64


class _Work(NamedTuple):
    """Buffers of one block: B signals, C channels, K terms. Row b * K + k belongs to term k of signal b."""

    raw: Any  # (1, D) float32, one channel of one signal as given
    rows: Any  # (C * B, D) float32, weighted and scaled signals; row c * B + b belongs to channel c of signal b
    roots: Any  # (B or 0, D) float32, square roots of the signals' own weights
    correlations: Any  # (C * B, P * WIDTH) float32, of the residuals with the atoms
    gains: Any  # (B, P * WIDTH) float32, factors on squared correlations; 0 for atoms that must not be chosen
    basis: Any  # (B * K, D) float64, chosen atoms made orthonormal
    triangle: Any  # (B * K, K) float64: chosen atom k = sum over i of triangle[k, i] basis[i]
    parts: Any  # (B * K, C) float64, signal along the basis
    sent: Any  # (B, D) float32, newest basis vectors of the active signals
    spread: Any  # (B, P * WIDTH) float32, their inner products with all atoms
    spreads: Any  # (B * K or 0, P * WIDTH) float32, all such products, if recursion is used
    scales: Any  # (B,) float64: weighted squared error = scales * that of the rows
    sizes: Any  # (B,) float64: weighted signal = sizes * row
    energies: Any  # (B,) float64, squared norms of the rows
    active: Any  # (B,) int64, signals that may gain more terms


@inner(fastmath=_REASSOCIATE)
def _dot(a, i, b, j):
    """Return a[i] . b[j]. Rows are passed by index: making a slice costs as much as the product."""
    total = 0.0
    for d in range(a.shape[1]):
        total += np.float64(a[i, d]) * np.float64(b[j, d])
    return total


@inner(fastmath={"contract"})
def _subtract(a, i, factor, b, j):
    """Compute a[i] -= factor * b[j]."""
    for d in range(a.shape[1]):
        a[i, d] -= factor * b[j, d]


@inner
def _scale(a, i, factor):
    """Compute a[i] *= factor."""
    for d in range(a.shape[1]):
        a[i, d] *= factor


@inner
def _copy(a, i, out, j):
    """Copy a[i] into out[j]."""
    for d in range(out.shape[1]):
        out[j, d] = a[i, d]


@inner
def _product(a, i, b, j, out, k):
    """Write a[i] * b[j], entry by entry, into out[k]."""
    for d in range(out.shape[1]):
        out[k, d] = a[i, d] * b[j, d]


@inner(fastmath={"nnan", "nsz", "reassoc"})
def _least_and_most(a, i):
    """Return the least and the largest entry of a[i]; valid only if all entries are finite."""
    least = a[i, 0]
    most = a[i, 0]
    for d in range(a.shape[1]):
        least = min(least, a[i, d])
        most = max(most, a[i, d])
    return least, most


@inner(error_model="numpy")
def _take_weights(weights, m, roots, b):
    """Write the square roots of weights[m] over their largest into roots[b]; return the largest, -1 if invalid."""
    least, most = _least_and_most(weights, m)
    if not math.isfinite(_dot(weights, m, weights, m)) or least < 0.0:
        return np.float32(-1.0)
    over = np.float32(1.0) / math.sqrt(most) if most > 0.0 else np.float32(0.0)
    for d in range(roots.shape[1]):
        roots[b, d] = math.sqrt(weights[m, d]) * over
    return most


@inner
def _load(chunk, start, count, atoms, work, codes):
    """Load signals start .. start + count of the chunk, weighted and scaled, into the block; counts: 0 or BAD_*."""
    signals = chunk.signals
    weights = chunk.weights
    raw = work.raw
    rows = work.rows
    counts = codes.counts
    energies = work.energies
    sizes = work.sizes
    scales = work.scales
    channels = codes.coefficients.shape[2]
    own = len(weights) > 0
    roots = work.roots if own else atoms.roots
    scale = atoms.scale
    for b in range(count):
        m = start + b
        counts[m] = 0
        if own:
            scale = np.float64(_take_weights(weights, m, roots, b))
            if scale < 0.0:
                counts[m] = BAD_WEIGHTS
        energy = 0.0
        whole = 0.0
        for c in range(channels):
            for d in range(raw.shape[1]):
                raw[0, d] = signals[m, d * channels + c]
            whole += _dot(raw, np.int64(0), raw, np.int64(0))
            _product(raw, np.int64(0), roots, b if own else 0, rows, c * BLOCK + b)
            energy += _dot(rows, c * BLOCK + b, rows, c * BLOCK + b)
        if not math.isfinite(whole):
            counts[m] = BAD_SIGNAL
        size = math.ldexp(1.0, math.frexp(math.sqrt(energy))[1]) if counts[m] == 0 else 1.0
        for c in range(channels):
            _scale(rows, c * BLOCK + b, 1.0 / size)
        energies[b] = energy / (size * size)
        sizes[b] = size
        scales[b] = scale * size * size


@inner(error_model="numpy")
def _reciprocals(shares, b, least_share, gains):
    """Write the inverse of each share into a row of gains; 0 where the share is too small."""
    for a in range(shares.shape[1]):
        share = shares[b, a]
        gains[b, a] = np.float32(1.0) / share if share > least_share else np.float32(0.0)


@inner
def _correlate(atoms, work, count):
    """Correlate all atoms with the signals of the block."""
    rows = work.rows
    roots = work.roots
    sent = work.sent
    correlations = work.correlations
    for first in range(0, len(rows), BLOCK):
        out = correlations[first : first + BLOCK]
        if len(roots) > 0:
            for b in range(count):
                _product(rows, first + b, roots, b, sent, b)
            multiply_rows(sent, count, atoms.panels, out)
        else:
            multiply_rows(rows[first : first + BLOCK], count, atoms.panels, out)


@inner
def _weigh(atoms, work, count):
    """Compute the gains of all atoms under the weights of each signal of the block."""
    roots = work.roots
    sent = work.sent
    shares = work.spread
    gains = work.gains
    if len(roots) == 0:
        for b in range(count):
            _copy(atoms.gains, np.int64(0), gains, b)
        return
    for b in range(count):
        _product(roots, b, roots, b, sent, b)
    multiply_rows(sent, count, atoms.squares, shares)
    for b in range(count):
        _reciprocals(shares, b, atoms.least_share, gains)


@inner
def _orthogonalise(basis, first, k, triangle):
    """Orthonormalize row first + k of the basis against rows first .. first + k.

    Stores the coefficients in triangle[first + k]. Returns False if only rounding errors would be left.
    """
    new = first + k
    whole = _dot(basis, new, basis, new)
    for i in range(k):
        along = _dot(basis, first + i, basis, new)
        _subtract(basis, new, along, basis, first + i)
        triangle[new, i] = along
    rest = _dot(basis, new, basis, new)
    if rest <= _DEPENDENT * whole:
        return False
    triangle[new, k] = math.sqrt(rest)
    _scale(basis, new, 1.0 / triangle[new, k])
    return True


@inner
def _choose(atoms, work, going, k, codes, start):
    """Choose term k of the `going` active signals; update atom, basis, parts along it and remaining error.

    A signal keeps its count if there is nothing left to choose.
    """
    unit = atoms.unit
    roots = work.roots
    gains = work.gains
    rows = work.rows
    correlations = work.correlations
    basis = work.basis
    triangle = work.triangle
    parts = work.parts
    energies = work.energies
    active = work.active
    found = codes.atoms
    errors = codes.errors
    counts = codes.counts
    terms = found.shape[1]
    channels = parts.shape[1]
    for s in range(going):
        b = active[s]
        m = start + b
        new = b * terms + k
        score, atom = best_atom(correlations, channels, gains, b)
        if score <= _NOISE * _NOISE * energies[b]:
            continue
        if len(roots) > 0:
            _product(unit, atom, roots, b, basis, new)
        else:
            _copy(unit, atom, basis, new)
        if not _orthogonalise(basis, b * terms, k, triangle):
            continue
        gained = 0.0
        for c in range(channels):
            part = _dot(basis, new, rows, c * BLOCK + b)
            parts[new, c] = part
            gained += part * part
        gains[b, atom] = 0.0
        found[m, k] = atom
        errors[m, k + 1] = max(errors[m, k] - gained, 0.0)
        counts[m] = k + 1


@inner
def _keep_active(chunk, start, going, k, codes, work):
    """Keep the active signals that found k terms and may gain more; return their number."""
    active = work.active
    scales = work.scales
    counts = codes.counts
    errors = codes.errors
    limits = chunk.limits
    tolerances = chunk.tolerances
    kept = 0
    for s in range(going):
        b = active[s]
        m = start + b
        if counts[m] == k and k < limits[m] and errors[m, k] > 0.0 and errors[m, k] * scales[b] > tolerances[m]:
            active[kept] = b
            kept += 1
    return kept


@inner
def _spread(atoms, work, going, k, codes, start):
    """Write inner products of all atoms with the newest basis vector of active signal s into row s of work.spread.

    Uses recursion from the inner products between atoms, or a matrix product if those depend on the signal.
    """
    found = codes.atoms
    roots = work.roots
    gram = atoms.gram
    active = work.active
    basis = work.basis
    triangle = work.triangle
    sent = work.sent
    spread = work.spread
    spreads = work.spreads
    terms = found.shape[1]
    for s in range(going):
        b = active[s]
        new = b * terms + k
        if len(roots) > 0:
            _product(basis, new, roots, b, sent, s)
            continue
        _copy(gram, found[start + b, k], spread, s)
        for i in range(k):
            _subtract(spread, s, np.float32(triangle[new, i]), spreads, b * terms + i)
        _scale(spread, s, np.float32(1.0 / triangle[new, k]))
        _copy(spread, s, spreads, new)
    if len(roots) > 0:
        multiply_rows(sent, going, atoms.panels, spread)


@inner
def _update_correlations(work, going, k, terms):
    """Subtract term k from the correlations of the active signals."""
    active = work.active
    parts = work.parts
    correlations = work.correlations
    spread = work.spread
    channels = parts.shape[1]
    for s in range(going):
        b = active[s]
        for c in range(channels):
            _subtract(correlations, c * BLOCK + b, np.float32(parts[b * terms + k, c]), spread, s)


@inner
def _finish(atoms, work, count, codes, start):
    """Compute the coefficients of the chosen atoms from the parts along the basis; clear the rest; rescale errors."""
    found = codes.atoms
    coefficients = codes.coefficients
    counts = codes.counts
    errors = codes.errors
    parts = work.parts
    triangle = work.triangle
    sizes = work.sizes
    scales = work.scales
    lengths = atoms.lengths
    terms = found.shape[1]
    channels = parts.shape[1]
    for b in range(count):
        m = start + b
        first = b * terms
        number = max(counts[m], 0)
        for c in range(channels):
            for k in range(number - 1, -1, -1):
                value = parts[first + k, c]
                for i in range(k + 1, number):
                    value -= triangle[first + i, k] * parts[first + i, c]
                parts[first + k, c] = value / triangle[first + k, k]
            for k in range(number):
                coefficients[m, k, c] = parts[first + k, c] * sizes[b] / lengths[found[m, k]]
        for k in range(terms):
            if k >= number:
                found[m, k] = -1
                errors[m, k + 1] = errors[m, number]
                for c in range(channels):
                    coefficients[m, k, c] = 0.0
        for k in range(terms + 1):
            errors[m, k] *= scales[b]


@inner
def _pursue_block(chunk, start, count, atoms, codes, work):
    """Find all terms of signals start .. start + count."""
    terms = codes.atoms.shape[1]
    _load(chunk, start, count, atoms, work, codes)
    for b in range(count):
        work.active[b] = b
        codes.errors[start + b, 0] = work.energies[b]
    going = _keep_active(chunk, start, count, np.int64(0), codes, work)
    if going > 0:
        _correlate(atoms, work, count)
        _weigh(atoms, work, count)
    for k in range(terms):
        if going == 0:
            break
        _choose(atoms, work, going, k, codes, start)
        going = _keep_active(chunk, start, going, k + 1, codes, work)
        _spread(atoms, work, going, k, codes, start)
        _update_correlations(work, going, k, terms)
    _finish(atoms, work, count, codes, start)


@kernel
def pursue(chunk, atoms, codes):
    """Run orthogonal matching pursuit for all signals of a chunk, into codes."""
    number = len(chunk.signals)
    depth = chunk.signals.shape[1] // codes.coefficients.shape[2]
    terms, channels = codes.coefficients.shape[1:]
    columns = atoms.gains.shape[1]
    own = BLOCK if len(chunk.weights) > 0 else 0
    work = _Work(
        np.empty((1, depth), np.float32),
        np.zeros((BLOCK * channels, depth), np.float32),
        np.empty((own, depth), np.float32),
        np.empty((BLOCK * channels, columns), np.float32),
        np.empty((BLOCK, columns), np.float32),
        np.empty((BLOCK * terms, depth)),
        np.empty((BLOCK * terms, terms)),
        np.empty((BLOCK * terms, channels)),
        np.zeros((BLOCK, depth), np.float32),
        np.empty((BLOCK, columns), np.float32),
        np.empty((0 if own else BLOCK * terms, columns), np.float32),
        np.empty(BLOCK),
        np.empty(BLOCK),
        np.empty(BLOCK),
        np.empty(BLOCK, np.int64),
    )
    for start in range(0, number, BLOCK):
        _pursue_block(chunk, start, min(BLOCK, number - start), atoms, codes, work)
