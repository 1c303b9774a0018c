"""Numba kernel that measures the light along lines of sight. Arrays are checked and contiguous; scene frame."""

from __future__ import annotations

import math

import numpy as np

from gsvis._kernels.compiled import kernel
from gsvis._kernels.threads import in_parts

__all__ = ["pass_light"]

_FAR = 80.0  # squared deviations beside a line, from which a Gaussian takes less light than float64 can hold
_MOST = 0.99  # largest share of the light that one Gaussian takes


@in_parts(lambda means, turns, opacities, aims, *_: len(aims))
@kernel(error_model="numpy")
def pass_light(begin, end, means, turns, opacities, aims, back, steps, free, found):
    """Write the share of light that passes from near each target back to each of some steps into found (P, S).

    Args:
        begin: First row of the range of targets.
        end: Row after the last one.
        means: (K, 3) float64 means of Gaussians, turned by `turns`.
        turns: (K, 3, 3) float64, from the scene to where a Gaussian is a unit sphere.
        opacities: (K,) float32.
        aims: (P, 3) float64 targets.
        back: (P, 3) float64 unit directions from them.
        steps: (P, S) float64 distances.
        free: Share of a distance, at the side of the step, that Gaussians are asked for.
        found: (P, S) float64 result.
    """
    dark = np.empty(steps.shape[1])
    for p in range(begin, end):
        dark[:] = 0.0
        for k in range(len(means)):
            squared = 0.0
            along = 0.0
            apart = 0.0
            for i in range(3):
                at = -means[k, i]
                way = 0.0
                for j in range(3):
                    at += turns[k, i, j] * aims[p, j]
                    way += turns[k, i, j] * back[p, j]
                squared += way * way
                along += at * way
                apart += at * at
            squared = max(squared, 1e-300)
            nearest = -along / squared
            beside = apart - squared * nearest * nearest
            if beside > _FAR:
                continue
            taken = math.log1p(-min(opacities[k] * math.exp(-0.5 * max(beside, 0.0)), _MOST))
            for s in range(steps.shape[1]):
                if (1.0 - free) * steps[p, s] < nearest < steps[p, s]:
                    dark[s] += taken
        for s in range(steps.shape[1]):
            found[p, s] = math.exp(dark[s])
