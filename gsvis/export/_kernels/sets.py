"""Kernels that round spherical harmonics of a bare scene to bytes. Arrays are checked and contiguous."""

from __future__ import annotations

import numpy as np

from gsvis._kernels.compiled import kernel

__all__ = ["pack_sets"]


@kernel
def pack_sets(coefficients, ids, factors, out):
    """Write the bytes of coefficients of some Gaussians, with their upper bits turned.

    Args:
        coefficients: (N, F) float32, all higher coefficients of each Gaussian.
        ids: (M,) int64 Gaussians.
        factors: (F,) float32 by which a coefficient is multiplied before it is rounded.
        out: (M, S) uint8 with S >= F; the first F columns are written.
    """
    least = np.float32(-128.0)
    most = np.float32(127.0)
    for i in range(len(ids)):
        row = coefficients[ids[i]]
        for k in range(len(factors)):
            value = np.rint(row[k] * factors[k])
            # The byte is the value plus 128, and turning its upper bit takes 128 off again, modulo 256.
            out[i, k] = np.uint8(np.int32(min(max(value, least), most)) & 255)
