"""Kernels that move the lobes of one Gaussian until their sum fits best: variable projection with damping.

A lobe is exp(v.x - |v|): v is its center times its decay, free in three dimensions. Intensities are always the best for
the lobes (with a ridge), so only the v are searched: Levenberg-Marquardt with the intensities eliminated.
"""

from __future__ import annotations

from collections import namedtuple

import numpy as np

from gsvis._kernels.compiled import inner, kernel
from gsvis.color._kernels.lobes import append_products, dots, gram, lobes

__all__ = [
    "Work",
    "add_lobe",
    "best_intensities",
    "copy",
    "error_after",
    "falls_along",
    "find_products",
    "refine",
    "settle",
    "work",
]

# A lobe of amplitude A and decay d changes a color by more than epsilon over a part of the sphere that is about
# L / (2 d), L = log(A / epsilon). Its width here is L / (L + 2 d): the same for narrow lobes, below 1 for wide ones,
# and smooth.

_ATTEMPTS = 4
_ATTEMPTS_TO_SETTLE = 16

Work = namedtuple(
    "Work",
    "rows inner outer inner2 outer2 small wide normal damped slope step trial intensities scratch factors"
    " alone own fresh",
)


@kernel
def work(most_terms, directions, channels):
    """Allocate arrays for fits of at most `most_terms` lobes over `directions`, a multiple of 16."""
    p = 4 * most_terms
    n = 3 * most_terms
    k = most_terms
    z = np.zeros
    return Work(
        z((p, directions), np.float32),
        z((p, p)),
        z((p, channels)),
        z((p, p)),
        z((p, channels)),
        z((k, k)),
        z((k, n)),
        z((n, n)),
        z((n, n)),
        z((n, 1)),
        z((n, 1)),
        z((k, 3)),
        z((k, channels)),
        z(16, np.float32),
        z(p),
        z((1, 3)),
        z((1, channels)),
        z((4, directions), np.float32),
    )


@kernel
def copy(source, rows, columns, target):
    """Copy a corner of a matrix.

    An assignment of slices would compile numba's shape checks into every kernel, which takes longer than the copy.
    """
    for i in range(rows):
        for j in range(columns):
            target[i, j] = source[i, j]


@inner(fastmath=True)
def _solve(matrix, size, right, columns):
    """Factorize (Cholesky) a symmetric matrix in place and solve in place of `right`; return whether it is definite."""
    for i in range(size):
        for j in range(i + 1):
            s = matrix[i, j]
            for k in range(j):
                s -= matrix[i, k] * matrix[j, k]
            if i == j:
                if not s > 1e-30:
                    return False
                matrix[i, i] = np.sqrt(s)
            else:
                matrix[i, j] = s / matrix[j, j]
    for i in range(size):
        scale = 1.0 / matrix[i, i]
        for k in range(i):
            for c in range(columns):
                right[i, c] -= matrix[i, k] * right[k, c]
        for c in range(columns):
            right[i, c] *= scale
    for i in range(size - 1, -1, -1):
        scale = 1.0 / matrix[i, i]
        for k in range(i + 1, size):
            for c in range(columns):
                right[i, c] -= matrix[k, i] * right[k, c]
        for c in range(columns):
            right[i, c] *= scale
    return True


@inner(fastmath=True)
def _count_prefixes(terms, emphasis, factors):
    """Compute the weight of each row in the error summed over all prefixes: the lobes, then three slopes of each.

    The prefix of all lobes has weight 1, each shorter prefix `emphasis`. A lobe belongs to all prefixes that include
    it.
    """
    for i in range(4 * terms):
        k = i if i < terms else (i - terms) // 3
        factors[i] = 1.0 + emphasis * (terms - 1 - k)


@inner(fastmath=True)
def _weigh_prefixes(inner, outer, number, channels, factors):
    """Convert inner products to those of the error summed over all prefixes.

    The error of a prefix is a quadratic form in the same inner products, so two lobes count together in as many
    prefixes as contain both.
    """
    for i in range(number):
        for c in range(channels):
            outer[i, c] *= factors[i]
        row = inner[i]
        for j in range(number):
            row[j] *= min(factors[i], factors[j])


@inner(fastmath=True)
def _unweigh_prefixes(inner, outer, number, channels, factors):
    """Undo `_weigh_prefixes`, to rounding."""
    for i in range(number):
        for c in range(channels):
            outer[i, c] /= factors[i]
        row = inner[i]
        for j in range(number):
            row[j] /= min(factors[i], factors[j])


@kernel
def find_products(w, points, targets, count, terms, channels, v):
    """Write the rows of `terms` lobes (v), and their plain inner products, into w."""
    lobes(points, count, v, terms, w.rows)
    gram(w.rows, 4 * terms, count, w.scratch, w.inner)
    dots(w.rows, 4 * terms, targets, channels, count, w.scratch, w.outer)


@kernel
def add_lobe(w, points, targets, count, terms, channels, v):
    """Do what `find_products` does for one lobe more, from rows and products of the first `terms` lobes in w."""
    for i in range(3):
        w.alone[0, i] = v[terms, i]
    lobes(points, count, w.alone, 1, w.fresh)
    append_products(w.fresh, w.rows, terms, targets, channels, count, w.scratch, w.inner, w.outer)


@inner(fastmath=True)
def best_intensities(inner, outer, terms, channels, ridge, small, intensities):
    """Solve for least-squares intensities; return the explained part of the squared target, minus the ridge's cost."""
    for i in range(terms):
        for j in range(terms):
            small[i, j] = inner[i, j]
        small[i, i] += ridge
        for c in range(channels):
            intensities[i, c] = outer[i, c]
    if not _solve(small, terms, intensities, channels):
        return -1.0
    explained = 0.0
    for i in range(terms):
        for c in range(channels):
            explained += intensities[i, c] * outer[i, c]
    return explained


@inner(fastmath=True)
def _log_size(intensities, k, channels, epsilon):
    """Return the logarithm of a lobe's largest intensity over epsilon, at least 0."""
    largest = 0.0
    for c in range(channels):
        largest = max(largest, abs(intensities[k, c]))
    return np.log(largest / epsilon) if largest > epsilon else 0.0


@inner(fastmath=True)
def _widths(v, intensities, terms, channels, epsilon):
    """Return the sum of the widths of lobes."""
    total = 0.0
    for k in range(terms):
        size = _log_size(intensities, k, channels, epsilon)
        decay = np.sqrt(v[k, 0] * v[k, 0] + v[k, 1] * v[k, 1] + v[k, 2] * v[k, 2])
        total += size / (size + 2.0 * decay)
    return total


@inner(fastmath=True)
def _narrow(w, v, intensities, terms, channels, narrow, epsilon):
    """Add slope and curvature of the widths, times `narrow`, to the normal equations; return the top diagonal."""
    largest = 0.0
    for k in range(terms):
        size = _log_size(intensities, k, channels, epsilon)
        decay = np.sqrt(v[k, 0] * v[k, 0] + v[k, 1] * v[k, 1] + v[k, 2] * v[k, 2])
        below = size + 2.0 * decay
        slope = narrow * size / (below * below)
        curvature = 4.0 * slope / below
        for i in range(3):
            p = 3 * k + i
            w.slope[p, 0] += slope * v[k, i] / decay
            for j in range(i + 1):
                w.normal[p, 3 * k + j] += curvature * v[k, i] * v[k, j] / (decay * decay)
            largest = max(largest, w.normal[p, p])
    return largest


@inner(fastmath=True)
def _normal_equations(w, terms, channels, ridge, intensities):
    """Compute slope and curvature of the error by v, with intensities eliminated (Kaufman); return the top diagonal."""
    n = 3 * terms
    for i in range(terms):
        for j in range(terms):
            w.small[i, j] = w.inner[i, j]
        w.small[i, i] += ridge
        for j in range(n):
            w.wide[i, j] = w.inner[i, terms + j]
    if not _solve(w.small, terms, w.wide, n):
        return -1.0
    largest = 0.0
    for p in range(n):
        k = p // 3
        slope = 0.0
        for c in range(channels):
            left = w.outer[terms + p, c]
            for i in range(terms):
                left -= w.inner[terms + p, i] * intensities[i, c]
            slope += intensities[k, c] * left
        w.slope[p, 0] = slope
        row = w.normal[p]
        own = w.inner[terms + p]
        for q in range(p + 1):
            row[q] = own[terms + q]
        for i in range(terms):
            known = w.wide[i]
            factor = own[i]
            for q in range(p + 1):
                row[q] -= factor * known[q]
        for q in range(p + 1):
            shared = 0.0
            for c in range(channels):
                shared += intensities[k, c] * intensities[q // 3, c]
            row[q] *= shared
        largest = max(largest, w.normal[p, p])
    return largest


@inner(fastmath=True)
def _try_step(w, v, terms, damping, largest, least_decay, most_decay):
    """Write the result of a damped step into w.trial; return False if the step cannot be solved."""
    n = 3 * terms
    for p in range(n):
        w.step[p, 0] = w.slope[p, 0]
        for q in range(p + 1):
            w.damped[p, q] = w.normal[p, q]
        w.damped[p, p] += damping * w.normal[p, p] + 1e-7 * largest + 1e-30
    if not _solve(w.damped, n, w.step, np.int64(1)):
        return False
    for k in range(terms):
        squared = 0.0
        for i in range(3):
            w.trial[k, i] = v[k, i] + w.step[3 * k + i, 0]
            squared += w.trial[k, i] ** 2
        decay = np.sqrt(squared)
        kept = min(max(decay, least_decay), most_decay)
        for i in range(3):
            w.trial[k, i] = w.trial[k, i] * kept / decay if decay > 1e-9 else v[k, i]
    return True


@kernel(fastmath=True)
def refine(w, points, targets, count, total, terms, channels, v, intensities, limits):
    """Move `terms` lobes (v, intensities, in place) to a nearby optimum.

    Args:
        w: Work space, with rows and products of the lobes (`find_products`), before and after.
        points: (4, D) x, y, z, root of the weight.
        targets: (4, D) weighted targets; rows beyond `channels` are 0.
        count: Number of directions, a multiple of 16.
        total: Sum of the squared targets.
        terms: Number of lobes.
        channels: Number of targets.
        v: (K, 3) decay times center of each lobe, changed in place.
        intensities: (K, channels), changed in place.
        limits: Ridge, least decay, most decay, relative gain below which to stop, maximum number of steps, emphasis
            on shorter prefixes, cost of a lobe's width, change of color from which a lobe counts.
    """
    ridge, least_decay, most_decay, tolerance, steps, emphasis, narrow, epsilon = limits
    total *= 1.0 + emphasis * (terms - 1)
    size = 4 * terms
    _count_prefixes(terms, emphasis, w.factors)
    _weigh_prefixes(w.inner, w.outer, size, channels, w.factors)
    tried = False  # whether the rows are those of a step that was not taken
    explained = best_intensities(w.inner, w.outer, terms, channels, ridge, w.small, intensities)
    price = narrow * _widths(v, intensities, terms, channels, epsilon) if narrow > 0.0 else 0.0
    damping = 1e-2
    for _ in range(int(steps)):
        error = total - explained
        if explained < 0.0 or error <= 1e-6 * total:
            break
        largest = _normal_equations(w, terms, channels, ridge, intensities)
        if largest <= 0.0:
            break
        if narrow > 0.0:
            largest = _narrow(w, v, intensities, terms, channels, narrow, epsilon)
        gained = -1.0
        for _ in range(_ATTEMPTS):
            if _try_step(w, v, terms, damping, largest, least_decay, most_decay):
                lobes(points, count, w.trial, terms, w.rows)
                tried = True
                gram(w.rows, size, count, w.scratch, w.inner2)
                dots(w.rows, size, targets, channels, count, w.scratch, w.outer2)
                _weigh_prefixes(w.inner2, w.outer2, size, channels, w.factors)
                better = best_intensities(w.inner2, w.outer2, terms, channels, ridge, w.small, w.intensities)
                wide = narrow * _widths(w.trial, w.intensities, terms, channels, epsilon) if narrow > 0.0 else 0.0
                if better - wide > explained - price:
                    gained = better - wide - (explained - price)
                    break
            damping *= 6.0
        if gained < 0.0:
            break
        tried = False
        explained = better
        price = wide
        damping = max(0.2 * damping, 1e-6)
        copy(w.trial, terms, 3, v)
        copy(w.intensities, terms, channels, intensities)
        copy(w.inner2, size, size, w.inner)
        copy(w.outer2, size, channels, w.outer)
        if gained < tolerance * error:
            break
    if tried:
        lobes(points, count, v, terms, w.rows)
    _unweigh_prefixes(w.inner, w.outer, size, channels, w.factors)


@inner(fastmath=True)
def _change(w, k, channels, intensities):
    """Return the change of the squared error when lobe k is added to the lobes before it; negative if it helps."""
    change = 0.0
    for c in range(channels):
        left = w.outer[k, c]
        for j in range(k):
            left -= w.inner[k, j] * intensities[j, c]
        change += intensities[k, c] * (intensities[k, c] * w.inner[k, k] - 2.0 * left)
    return change


@inner(fastmath=True)
def falls_along(w, total, terms, channels, intensities):
    """Return whether the squared error falls from each lobe to the next; inner and outer hold plain inner products."""
    k = np.int64(0)  # a literal would compile the function once more
    while k < terms and _change(w, k, channels, intensities) <= 1e-7 * total:
        k += 1
    return k == terms


@inner(fastmath=True)
def error_after(w, total, terms, channels, intensities):
    """Return the squared error after all lobes; inner and outer hold plain inner products."""
    error = total
    for k in range(terms):
        error += _change(w, k, channels, intensities)
    return max(error, 0.0)


@inner(fastmath=True)
def _fit_sequentially(w, terms, channels, ridge, intensities):
    """Give each lobe the best intensity for what the lobes before it leave; the error then falls with each lobe."""
    for k in range(terms):
        for c in range(channels):
            left = w.outer[k, c]
            for j in range(k):
                left -= w.inner[k, j] * intensities[j, c]
            intensities[k, c] = left / (w.inner[k, k] + ridge)


@kernel(fastmath=True)
def settle(w, total, terms, channels, limits, intensities, anew):
    """Make the squared error fall with each further lobe; return the error after all of them.

    Lobes that cancel each other can raise the error on the way. The intensities are then fitted again with more
    emphasis on the shorter prefixes. The last attempt gives each lobe the best intensity for what the lobes before it
    leave.

    Args:
        w: Work space; inner and outer hold plain inner products of the lobes.
        total: Sum of the squared targets.
        terms: Number of lobes.
        channels: Number of targets.
        limits: Those of `refine`.
        intensities: (K, channels), changed in place.
        anew: Whether to fit the intensities before the first check.
    """
    emphasis = limits[5]
    error = total
    for attempt in range(_ATTEMPTS_TO_SETTLE):
        if attempt > 0:
            emphasis = max(3.0 * emphasis, 0.03)
        if attempt == _ATTEMPTS_TO_SETTLE - 1:
            _fit_sequentially(w, terms, channels, limits[0], intensities)
        elif attempt > 0 or anew:
            copy(w.inner, terms, terms, w.inner2)
            copy(w.outer, terms, channels, w.outer2)
            _count_prefixes(terms, emphasis, w.factors)
            _weigh_prefixes(w.inner2, w.outer2, terms, channels, w.factors)
            best_intensities(w.inner2, w.outer2, terms, channels, limits[0], w.small, intensities)
        error = total
        falls = True
        for k in range(terms):
            change = _change(w, k, channels, intensities)
            if change > 1e-7 * total:
                falls = False
                break
            error += change
        if falls:
            break
    return max(error, 0.0)
