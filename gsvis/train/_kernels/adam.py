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


@in_parts(lambda rows, *_: len(rows))
@kernel(error_model="numpy")
def catch_up_rows(begin, end, rows, values, first, second, last, now, moved, fade1, fade2):
    """Take the steps that some rows missed, in which their gradients were 0.

    Args:
        begin: First of the thread's part; the caller leaves it out.
        end: After the last of the part; the caller leaves it out.
        rows: (M,) int64, different rows.
        values: (R, K) float32, changed in place.
        first: (R, K) float32, first moments, changed in place.
        second: (R, K) float32, second moments, changed in place.
        last: (R,) int32, the last step that each row took with a gradient; 0 for none.
        now: The last step taken.
        moved: (now + 1,) float64, by the last step of a row: how far a row of moments 1 has moved since.
        fade1: (now + 1,) float64, powers of the decay of first moments.
        fade2: (now + 1,) float64, powers of the decay of second moments.
    """
    for k in range(begin, end):
        r = rows[k]
        since = last[r]
        if since == 0 or since == now:
            continue
        far = moved[since]
        less1 = np.float32(fade1[now - since])
        less2 = np.float32(fade2[now - since])
        for c in range(values.shape[1]):
            m = np.float64(first[r, c])
            v = np.float64(second[r, c])
            if v > 0.0:
                values[r, c] -= np.float32(far * m / np.sqrt(v))
            first[r, c] *= less1
            second[r, c] *= less2


@in_parts(lambda rows, *_: len(rows))
@kernel(error_model="numpy")
def step_rows(begin, end, rows, values, gradients, first, second, rate, beta1, beta2, root):
    """Take one step for some rows in place; `rate` and `root` as for `adam_step`.

    Args:
        begin: First of the thread's part; the caller leaves it out.
        end: After the last of the part; the caller leaves it out.
        rows: (M,) int64, different rows.
        values: (R, K) float32.
        gradients: (M, K) float32.
        first: (R, K) float32, first moments.
        second: (R, K) float32, second moments.
        rate: Learning rate over the correction of first moments.
        beta1: Decay of first moments.
        beta2: Decay of second moments.
        root: Root of the correction of second moments.
    """
    beta1 = np.float32(beta1)
    beta2 = np.float32(beta2)
    scale = np.float32(rate * root)
    one = np.float32(1.0)
    for k in range(begin, end):
        r = rows[k]
        for c in range(values.shape[1]):
            g = gradients[k, c]
            m = beta1 * first[r, c] + (one - beta1) * g
            v = beta2 * second[r, c] + (one - beta2) * g * g
            first[r, c] = m
            second[r, c] = v
            if v > 0.0:
                values[r, c] -= scale * m / np.sqrt(v)
