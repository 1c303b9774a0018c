"""Kernel that fits the lobes of many Gaussians: greedy choice from a dictionary, all lobes refined after each choice.

Gaussians are fitted in sequence within a block, blocks in parallel. Each result is independent of other Gaussians.
"""

from __future__ import annotations

import numpy as np

from gsvis._kernels.compiled import inner, kernel
from gsvis._kernels.threads import in_parts
from gsvis.color._kernels.lobes import LANES
from gsvis.color._kernels.refine import (
    add_lobe,
    copy,
    error_after,
    falls_along,
    find_products,
    refine,
    settle,
    work,
)

__all__ = ["fit_lobes", "settle_lobes"]

_BLOCK = 64
_PATIENCE = 4
"""Refinements after a choice, each with more emphasis on shorter prefixes, until the error falls along them."""
_UNPAID = 2
"""Lobes in a row that are not worth their price, after which no more are tried."""


@inner(fastmath=True)
def _gather(directions, weights, targets, points, seen, rows):
    """Gather the directions of weight > 0, padded with weight 0; return their number and the sum of the weights."""
    count = 0
    total = 0.0
    channels = targets.shape[0]
    for d in range(len(weights)):
        if weights[d] > 0.0:
            root = np.sqrt(weights[d])
            for i in range(3):
                points[i, count] = directions[i, d]
            points[3, count] = root
            for c in range(channels):
                rows[c, count] = targets[c, d] * root
            seen[count] = d
            total += weights[d]
            count += 1
    padded = (count + LANES - 1) // LANES * LANES
    for d in range(count, padded):
        points[3, d] = 0.0
        for c in range(channels):
            rows[c, d] = 0.0
    return count, padded, total


@inner(fastmath=True)
def _choose(atoms, norms, left, channels, count):
    """Return the atom that explains most of the residual."""
    best = np.float32(-1.0)
    chosen = 0
    for a in range(len(norms)):
        explained = np.float32(0.0)
        atom = atoms[a]
        for c in range(channels):
            row = left[c]
            s = np.float32(0.0)
            for d in range(count):
                s += atom[d] * row[d]
            explained += s * s
        explained /= norms[a]
        if explained > best:
            best = explained
            chosen = a
    return chosen


@inner(fastmath=True)
def _subtract_lobes(rows, targets, intensities, terms, channels, count, left):
    """Subtract the lobes from the targets; write what is left."""
    for c in range(channels):
        row = left[c]
        for d in range(count):
            row[d] = targets[c, d]
        for k in range(terms):
            lobe = rows[k]
            factor = np.float32(intensities[k, c])
            for d in range(count):
                row[d] -= factor * lobe[d]


@inner(fastmath=True)
def _seen_widths(w, points, intensities, terms, channels, count, weight, epsilon):
    """Return the sum over lobes of the weighted share of directions along which each changes a channel noticeably."""
    total = 0.0
    for k in range(terms):
        largest = 0.0
        for c in range(channels):
            largest = max(largest, abs(intensities[k, c]))
        size = np.float32(largest / epsilon)
        lobe = w.rows[k]
        for d in range(count):
            root = points[3, d]
            total += root * root if size * lobe[d] > root else np.float32(0.0)
    return total / weight


@inner(fastmath=True)
def _append(w, points, left, padded, total, terms, channels, start, lobe, intensities, limits):
    """Add a lobe to `terms` fixed lobes; only the new one moves, to fit what they leave."""
    for i in range(3):
        w.alone[0, i] = start[i]
    find_products(w, points, left, padded, np.int64(1), channels, w.alone)
    refine(w, points, left, padded, total, np.int64(1), channels, w.alone, w.own, limits)
    for i in range(3):
        lobe[terms, i] = w.alone[0, i]
    for c in range(channels):
        intensities[terms, c] = w.own[0, c]


@inner(fastmath=True, error_model="numpy")
def _fit_block(
    block, directions, dictionary, starts, targets, weights, importance, most, price, limits, v, a, counts, curves, wide
):
    """Fit one block of `fit_lobes`; inlined there, it would be 4% slower."""
    n, channels, size = targets.shape
    width = (size + LANES - 1) // LANES * LANES
    terms_at_most = v.shape[1]
    w = work(terms_at_most, width, channels)
    points = np.zeros((4, width), np.float32)
    rows = np.zeros((4, width), np.float32)
    left = np.zeros((4, width), np.float32)  # inner products read four rows
    seen = np.zeros(width, np.int64)
    atoms = np.zeros((len(dictionary), width), np.float32)
    norms = np.zeros(len(dictionary), np.float32)
    lobe = np.zeros((terms_at_most, 3))
    intensities = np.zeros((terms_at_most, channels))
    old_lobe = np.zeros_like(lobe)
    old_intensities = np.zeros_like(intensities)
    for g in range(_BLOCK * block, min(n, _BLOCK * (block + 1))):
        counts[g] = 0
        count, padded, weight = _gather(directions, weights[g], targets[g], points, seen, rows)
        total = 0.0
        for c in range(channels):
            for d in range(count):
                total += np.float64(rows[c, d]) ** 2
        mean = total / weight if weight > 0.0 else 0.0
        curves[g, :] = mean
        wide[g, :] = 0.0
        best = importance[g] * mean
        at_most = min(most[g], terms_at_most, count // 4)
        if at_most == 0 or best <= price or mean <= 1e-12:
            continue
        for k in range(len(dictionary)):
            atom = atoms[k]
            s = np.float32(0.0)
            for d in range(count):
                atom[d] = dictionary[k, seen[d]] * points[3, d]
                s += atom[d] * atom[d]
            norms[k] = s + np.float32(1e-12)
        copy(rows, channels, count, left)
        emphasis = limits[5]
        narrow = price * limits[6] * weight / importance[g]
        unpaid = 0
        for k in range(at_most):
            chosen = _choose(atoms, norms, left, channels, count)
            copy(lobe, k, 3, old_lobe)
            copy(intensities, k, channels, old_intensities)
            for i in range(3):
                lobe[k, i] = starts[chosen, i]
            add_lobe(w, points, rows, padded, np.int64(k), channels, lobe)
            for _ in range(_PATIENCE):
                scaled = (
                    limits[0] * weight,
                    limits[1],
                    limits[2],
                    limits[3],
                    limits[4],
                    emphasis,
                    narrow,
                    limits[7],
                )
                refine(w, points, rows, padded, total, k + 1, channels, lobe, intensities, scaled)
                if falls_along(w, total, k + 1, channels, intensities):
                    break
                emphasis = min(4.0 * emphasis, 1.0)
            error = settle(w, total, k + 1, channels, scaled, intensities, np.bool_(False))
            if error > mean * weight:
                copy(old_lobe, k, 3, lobe)
                copy(old_intensities, k, channels, intensities)
                _append(w, points, left, padded, mean * weight, k, channels, starts[chosen], lobe, intensities, scaled)
                find_products(w, points, rows, padded, np.int64(k + 1), channels, lobe)
                error = error_after(w, total, k + 1, channels, intensities)
            mean = error / weight
            _subtract_lobes(w.rows, rows, intensities, k + 1, channels, count, left)
            curves[g, k + 1 :] = mean
            wide[g, k + 1 :] = _seen_widths(w, points, intensities, k + 1, channels, padded, weight, limits[7])
            cost = importance[g] * mean + price * (k + 1 + limits[6] * wide[g, k + 1])
            unpaid += 1
            if cost < best:
                unpaid = 0
                best = cost
                counts[g] = k + 1
                for j in range(k + 1):
                    for i in range(3):
                        v[g, j, i] = lobe[j, i]
                    for c in range(channels):
                        a[g, j, c] = intensities[j, c]
            spent = price * (k + 1 + limits[6] * wide[g, k + 1])
            if unpaid == _UNPAID or best <= spent + price:  # even a perfect further term is not worth its price
                break


@in_parts(lambda directions, dictionary, starts, targets, *_: (len(targets) + _BLOCK - 1) // _BLOCK)
@kernel(fastmath=True, error_model="numpy")
def fit_lobes(
    begin,
    end,
    directions,
    dictionary,
    starts,
    targets,
    weights,
    importance,
    most,
    price,
    limits,
    v,
    a,
    counts,
    curves,
    wide,
):
    """Fit as many lobes to each of n Gaussians as are worth their price.

    Args:
        begin: First of the thread's part; the caller leaves it out.
        end: After the last of the part; the caller leaves it out.
        directions: (3, D) float32 unit vectors.
        dictionary: (A, D) float32, values of the atoms.
        starts: (A, 3) decay times center of each atom.
        targets: (n, C, D) float32, C at most 4; the residual after subtraction of the base color.
        weights: (n, D) float32 >= 0; a direction of weight 0 is ignored.
        importance: (n,) float64, cost of a unit of weighted mean squared error.
        most: (n,) int64, maximum number of lobes of each.
        price: Cost of a lobe.
        limits: The limits of `refine`; the ridge is relative to the sum of the weights, and the cost of a width is
            one of a lobe.
        v: (n, K, 3) float32, written: decay times center, in sending order.
        a: (n, K, C) float32, written: intensities.
        counts: (n,) int64, written: lobes worth their price.
        curves: (n, K + 1) float32, written: weighted mean squared error (summed over channels) with 0, 1, ... lobes.
        wide: (n, K + 1) float32, written: sum over the lobes of the weighted share of directions along which each
            changes a channel by more than epsilon.
    """
    for block in range(begin, end):
        _fit_block(
            np.int64(block),
            directions,
            dictionary,
            starts,
            targets,
            weights,
            importance,
            most,
            price,
            limits,
            v,
            a,
            counts,
            curves,
            wide,
        )


@in_parts(lambda directions, targets, *_: (len(targets) + _BLOCK - 1) // _BLOCK)
@kernel(fastmath=True, error_model="numpy")
def settle_lobes(begin, end, directions, targets, weights, limits, counts, v, a, errors):
    """Fit the jointly best intensities of given lobes such that the error falls with each further lobe.

    Args:
        begin: First of the thread's part; the caller leaves it out.
        end: After the last of the part; the caller leaves it out.
        directions: (3, D) float32 unit vectors.
        targets: (n, C, D) float32.
        weights: (n, D) float32.
        limits: Those of `refine`; the ridge is relative to the sum of the weights.
        counts: (n,) int64, number of lobes of each.
        v: (n, K, 3) float32, decay times center.
        a: (n, K, C) float32, written: intensities.
        errors: (n,) float32, written: weighted mean squared error.
    """
    n, channels, size = targets.shape
    width = (size + LANES - 1) // LANES * LANES
    most = max(v.shape[1], 1)
    w = work(most, width, channels)
    points = np.zeros((4, width), np.float32)
    rows = np.zeros((4, width), np.float32)
    seen = np.zeros(width, np.int64)
    lobe = np.zeros((most, 3))
    intensities = np.zeros((most, channels))
    for g in range(_BLOCK * begin, min(n, _BLOCK * end)):
        count, padded, weight = _gather(directions, weights[g], targets[g], points, seen, rows)
        total = 0.0
        terms = counts[g]
        for c in range(channels):
            for d in range(count):
                total += np.float64(rows[c, d]) ** 2
        errors[g] = total / weight if weight > 0.0 else 0.0
        if terms == 0:
            continue
        copy(v[g], terms, 3, lobe)
        find_products(w, points, rows, padded, terms, channels, lobe)
        scaled = (limits[0] * weight, *limits[1:])
        intensities[:] = 0.0
        errors[g] = settle(w, total, terms, channels, scaled, intensities, np.bool_(True)) / weight
        copy(intensities, terms, channels, a[g])
