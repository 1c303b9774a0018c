"""Kernels that fit intensities to SRBFs whose centers and decays have been rounded.

Inner products are means over the whole sphere, so the terms alone suffice. Terms of different functions do not mix.
float64; T terms of N Gaussians, Gaussian i from offsets[i] to offsets[i + 1].
"""

from __future__ import annotations

import numpy as np

from gsvis._kernels.compiled import inner, kernel
from gsvis._kernels.threads import in_parts

__all__ = ["project", "round_jointly"]

RIDGE = 1e-4
"""Regularization toward the original intensities, relative to each term's own energy."""


@kernel
def _product(a, b):
    """Return the mean over the sphere of the product of two SRBFs, each decay times center (3,) and the decay."""
    x = a[0] + b[0]
    y = a[1] + b[1]
    z = a[2] + b[2]
    length = np.sqrt(x * x + y * y + z * z)
    # sinh(length) / length exp(-both decays), without overflow
    falling = -np.expm1(-2.0 * length) / (2.0 * length) if length > 1e-12 else 1.0
    return np.exp(length - a[3] - b[3]) * falling


@inner
def _cholesky(matrix, count):
    """Factorize a symmetric positive definite matrix in place into a lower triangle."""
    for j in range(count):
        for k in range(j):
            matrix[j, j] -= matrix[j, k] * matrix[j, k]
        matrix[j, j] = np.sqrt(max(matrix[j, j], 1e-300))
        for i in range(j + 1, count):
            for k in range(j):
                matrix[i, j] -= matrix[i, k] * matrix[j, k]
            matrix[i, j] /= matrix[j, j]


@in_parts(lambda offsets, *_: len(offsets) - 1)
@kernel(error_model="numpy")
def project(begin, end, offsets, functions, lobes, rounded, intensities, out):
    """Write the intensities (T, I) with which rounded SRBFs best match the given ones, in the mean over the sphere.

    `lobes` and `rounded` are (T, 4) decay times center and decay, before and after rounding. A thread has the
    Gaussians from `begin` to `end`; the caller leaves both out.
    """
    most = 0
    for g in range(begin, end):
        most = max(most, offsets[g + 1] - offsets[g])
    channels = intensities.shape[1]
    gram = np.empty((most, most))
    change = np.empty((most, channels))
    for g in range(begin, end):
        start = offsets[g]
        count = offsets[g + 1] - offsets[g]
        for j in range(count):
            change[j] = 0.0
            for k in range(count):
                if functions[start + j] != functions[start + k]:
                    gram[j, k] = 0.0
                    continue
                gram[j, k] = _product(rounded[start + j], rounded[start + k])
                missing = _product(rounded[start + j], lobes[start + k]) - gram[j, k]
                for c in range(channels):
                    change[j, c] += missing * intensities[start + k, c]
            gram[j, j] *= 1.0 + RIDGE
        _cholesky(gram, count)
        for c in range(channels):
            for j in range(count):
                for k in range(j):
                    change[j, c] -= gram[j, k] * change[k, c]
                change[j, c] /= gram[j, j]
            for j in range(count - 1, -1, -1):
                for k in range(j + 1, count):
                    change[j, c] -= gram[k, j] * change[k, c]
                change[j, c] /= gram[j, j]
                out[start + j, c] = intensities[start + j, c] + change[j, c]


@in_parts(lambda offsets, *_: len(offsets) - 1)
@kernel(error_model="numpy")
def round_jointly(begin, end, offsets, functions, lobes, intensities, table, middles, out):
    """Write intensities as indices (T, I) into a table; each term compensates for the rounding of larger ones.

    The largest term of a Gaussian has the largest step and is rounded first. Its rounding error is spread over the
    following terms by least squares in the mean over the sphere. If the result is not better, each term is rounded on
    its own. A thread has the Gaussians from `begin` to `end`; the caller leaves both out.
    """
    most = 0
    for g in range(begin, end):
        most = max(most, offsets[g + 1] - offsets[g])
    channels = intensities.shape[1]
    gram = np.empty((most, most))
    sizes = np.empty(most)
    errors = np.empty(most)
    alone = np.empty(most)
    places = np.empty(most, np.int64)
    order = np.empty(most, np.int64)
    for g in range(begin, end):
        start = offsets[g]
        count = offsets[g + 1] - offsets[g]
        for j in range(count):  # insertion sort, ascending by size; numba's own sort takes long to compile
            size = 0.0
            at = j
            for c in range(channels):
                size = max(size, np.float64(abs(intensities[start + j, c])))
            while at > 0 and sizes[at - 1] >= size:
                sizes[at], order[at] = sizes[at - 1], order[at - 1]
                at -= 1
            sizes[at] = size
            order[at] = start + j
        for j in range(count):
            for k in range(j + 1):
                alike = functions[order[j]] == functions[order[k]]
                gram[j, k] = _product(lobes[order[j]], lobes[order[k]]) if alike else 0.0
            gram[j, j] *= 1.0 + RIDGE
        _cholesky(gram, count)
        for c in range(channels):
            apart = 0.0
            together = 0.0
            for j in range(count):
                alone[j] = table[np.searchsorted(middles, intensities[order[j], c])] - intensities[order[j], c]
            for j in range(count - 1, -1, -1):
                value = intensities[order[j], c]
                left = alone[j]
                for k in range(j + 1, count):
                    value -= gram[k, j] / gram[j, j] * errors[k]
                    left += gram[k, j] / gram[j, j] * alone[k]
                places[j] = np.searchsorted(middles, value)
                errors[j] = table[places[j]] - intensities[order[j], c]
                apart += (gram[j, j] * left) ** 2
                together += (gram[j, j] * (table[places[j]] - value)) ** 2
            for j in range(count):
                worse = together > apart
                out[order[j], c] = np.searchsorted(middles, intensities[order[j], c]) if worse else places[j]
