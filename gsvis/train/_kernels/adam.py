"""Take Adam steps on flat arrays in one pass over memory."""

from __future__ import annotations

import numpy as np

from gsvis._kernels.compiled import kernel
from gsvis._kernels.threads import in_parts

_BLOCK = 1 << 14


@in_parts(lambda values, *_: (len(values) + _BLOCK - 1) // _BLOCK)
@kernel(error_model="numpy")
def adam_step(begin, end, values, gradients, first, second, rate, beta1, beta2, eps, root):
    """Take one step in place: values -= rate * first / (sqrt(second) / root + eps).

    `rate` and `root` contain the bias corrections for moments that started at 0.
    """
    rate = np.float32(rate)
    beta1 = np.float32(beta1)
    beta2 = np.float32(beta2)
    eps = np.float32(eps)
    scale = np.float32(1.0 / root)
    one = np.float32(1.0)
    count = len(values)
    for block in range(begin, end):
        for i in range(block * _BLOCK, min((block + 1) * _BLOCK, count)):
            g = gradients[i]
            m = beta1 * first[i] + (one - beta1) * g
            v = beta2 * second[i] + (one - beta2) * g * g
            first[i] = m
            second[i] = v
            values[i] -= rate * m / (np.sqrt(v) * scale + eps)
