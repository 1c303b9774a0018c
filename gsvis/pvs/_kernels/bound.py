"""Compute the capitals of bets for the confidence bound. Arrays are checked and contiguous."""

from __future__ import annotations

import math

from gsvis._kernels.compiled import kernel

_TOGETHER = 16  # factors between two logarithms; each lies in [0.05, 1e16]: no product vanishes or overflows


@kernel
def log_capitals(parts, wholes, ratio, stakes, out):
    """Write to out (K,) the logarithm of the final capital of each of K stakes (K,), which start with 1.

    parts (n,) and wholes (n,) are samples; ratio in [0, 1) is the claimed ratio that the bets oppose.
    """
    scale = 1.0 / (1.0 - ratio)
    for k in range(len(stakes)):
        stake = stakes[k] * scale
        total = 0.0
        product = 1.0
        count = 0
        for i in range(len(parts)):
            product *= 1.0 - stake * (parts[i] - ratio * wholes[i])
            count += 1
            if count == _TOGETHER:
                total += math.log(product)
                product = 1.0
                count = 0
        out[k] = total + math.log(product)
