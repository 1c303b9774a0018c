"""Kernel that merges the lobes of several functions into one order along which the RGB error never rises.

The error is that of the displayed colors, so the joint effect of two functions counts. A lobe that would raise the
error at its place is dropped.
"""

from __future__ import annotations

import numpy as np

from gsvis._kernels.compiled import inner, kernel
from gsvis._kernels.threads import in_parts
from gsvis.color._kernels.refine import copy
from gsvis.color._kernels.rgb import to_rgb

__all__ = ["measure_shown_errors", "order_lobes"]


@inner
def _shown_error(space, summed, factors, count, colors, weights, shown):
    """Return the weighted squared RGB error of the first `count` directions."""
    copy(summed, 3, count, shown)
    to_rgb(space, shown[:, :count], factors[:count])
    error = 0.0
    for c in range(3):
        for d in range(count):
            error += np.float64(weights[d]) * (np.float64(shown[c, d]) - np.float64(colors[c, d])) ** 2
    return error


@inner
def _add_lobe(directions, count, v, amplitude, summed, out):
    """Add a lobe, times its amplitude, to the summed colors along the directions."""
    decay = np.sqrt(v[0] ** 2 + v[1] ** 2 + v[2] ** 2)
    for d in range(count):
        lobe = np.exp(v[0] * directions[0, d] + v[1] * directions[1, d] + v[2] * directions[2, d] - decay)
        for c in range(3):
            out[c, d] = summed[c, d] + amplitude[c] * lobe


@inner
def _gather(directions, colors, weights, seen, target, heavy):
    """Gather the directions of weight > 0; return their number."""
    count = 0
    for d in range(len(weights)):
        if weights[d] > 0.0:
            for c in range(3):
                seen[c, count], target[c, count] = directions[c, d], colors[c, d]
            heavy[count] = weights[d]
            count += 1
    return count


@inner(error_model="numpy")
def _order_one(g, space, directions, colors, weights, base, scales, v, amplitudes, counts, order, kept):
    """Order the lobes of Gaussian g for `order_lobes`."""
    functions = v.shape[0]
    most = v.shape[2]
    width = directions.shape[1]
    seen = np.empty((3, width), np.float32)
    target = np.empty((3, width), np.float32)
    heavy = np.empty(width, np.float32)
    count = _gather(directions, colors[g], weights[g], seen, target, heavy)
    summed = np.empty((3, width), np.float32)
    trial = np.empty((3, width), np.float32)
    shown = np.empty((3, width), np.float32)
    factors = np.full(width, scales[g])
    for c in range(3):
        summed[c] = base[g, c]
    error = _shown_error(space, summed, factors, count, target, heavy, shown)
    heads = np.zeros(functions, np.int64)
    number = 0
    while True:
        best = np.inf
        chosen = -1
        for f in range(functions):
            if heads[f] < counts[f, g]:
                _add_lobe(seen, count, v[f, g, heads[f]], amplitudes[f, g, heads[f]], summed, trial)
                found = _shown_error(space, trial, factors, count, target, heavy, shown)
                if found < best:
                    best = found
                    chosen = f
        if chosen < 0:
            break
        k = heads[chosen]
        heads[chosen] += 1
        if best <= error:
            _add_lobe(seen, count, v[chosen, g, k], amplitudes[chosen, g, k], summed, summed)
            error = best
            order[g, number] = chosen * most + k
            number += 1
    kept[g] = number


@in_parts(lambda space, directions, colors, *_: len(colors))
@kernel(error_model="numpy")
def order_lobes(begin, end, space, directions, colors, weights, base, scales, v, amplitudes, counts, order, kept):
    """Merge the lobes of F functions of each of n Gaussians.

    Args:
        begin: First of the thread's part; the caller leaves it out.
        end: After the last of the part; the caller leaves it out.
        space: Code of the space the base lives in.
        directions: (3, D) float32.
        colors: (n, 3, D) RGB targets.
        weights: (n, D) weights of the directions.
        base: (n, 3) in the space.
        scales: (n,).
        v: (F, n, K, 3) float32, decay times center, the lobes of a function in the order to keep.
        amplitudes: (F, n, K, 3) float32, what a lobe adds in the space.
        counts: (F, n) number of lobes of each.
        order: (n, F K) int64, written: f K + k for the lobes kept.
        kept: (n,) int64, written.
    """
    for g in range(begin, end):
        _order_one(np.int64(g), space, directions, colors, weights, base, scales, v, amplitudes, counts, order, kept)


@inner(error_model="numpy")
def _errors_of_one(g, space, directions, colors, weights, base, scales, v, amplitudes, order, kept, before, after):
    """Measure the errors of Gaussian g for `measure_shown_errors`."""
    most = v.shape[2]
    width = directions.shape[1]
    seen = np.empty((3, width), np.float32)
    target = np.empty((3, width), np.float32)
    heavy = np.empty(width, np.float32)
    count = _gather(directions, colors[g], weights[g], seen, target, heavy)
    summed = np.empty((3, width), np.float32)
    shown = np.empty((3, width), np.float32)
    factors = np.full(width, scales[g])
    total = 0.0
    for d in range(count):
        total += heavy[d]
    for c in range(3):
        summed[c] = base[g, c]
    before[g] = _shown_error(space, summed, factors, count, target, heavy, shown) / total
    for j in range(kept[g]):
        f = order[g, j] // most
        k = order[g, j] % most
        _add_lobe(seen, count, v[f, g, k], amplitudes[f, g, k], summed, summed)
    after[g] = _shown_error(space, summed, factors, count, target, heavy, shown) / total


@in_parts(lambda space, directions, colors, *_: len(colors))
@kernel(error_model="numpy")
def measure_shown_errors(
    begin,
    end,
    space,
    directions,
    colors,
    weights,
    base,
    scales,
    v,
    amplitudes,
    order,
    kept,
    before,
    after,
):
    """Write weighted mean squared RGB errors (n,) of the bases alone and with all kept lobes; see `order_lobes`."""
    for g in range(begin, end):
        _errors_of_one(
            np.int64(g), space, directions, colors, weights, base, scales, v, amplitudes, order, kept, before, after
        )
