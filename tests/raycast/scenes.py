"""Small scenes on which tracers go wrong: flat, thin, nested, coincident, faint, far from the origin."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsvis.scene.gaussians import Gaussians

KINDS = ("blobs", "discs", "needles", "nested", "coincident", "faint", "far", "mixed", "one", "none")


def scene(kind: str, seed: int = 0, n: int = 300) -> Gaussians:
    """A scene of about `n` Gaussians inside [-1, 1]^3 (but for "far")."""
    rng = np.random.default_rng(seed)
    if kind == "none":
        return Gaussians.empty()
    if kind == "one":
        n = 1
    means = rng.uniform(-1.0, 1.0, (n, 3))
    scales = rng.uniform(0.02, 0.2, (n, 3))
    opacities = rng.uniform(0.0, 1.0, n)
    if kind == "discs":
        scales[:, 2] = 3e-10
    elif kind == "needles":
        scales[:, 1:] = 1e-6
        scales[:, 0] = 0.5
        scales[: n // 2, 1:] = 1e-2
    elif kind == "nested":
        means[:] = rng.normal(scale=0.01, size=(n, 3))
        scales[:] = np.geomspace(0.001, 2.0, n)[:, None]
        opacities *= 0.2
    elif kind == "coincident":
        means[:] = means[rng.integers(0, n // 10, n)]
        scales[:] = scales[:, :1]
        scales[: n // 2] = scales[0]
    elif kind == "faint":
        opacities = rng.uniform(0.0, 0.02, n)
    elif kind == "far":
        means += 1000.0
        means[0] = 2e4
    elif kind == "mixed":
        scales[: n // 3, 2] = 1e-9
        scales[n // 3 : n // 2, :2] = 1e-5
        scales[-3:] = 30.0
        opacities[-3:] = 0.05
        opacities[: n // 4] = 1.0
    quats = rng.normal(size=(n, 4))
    return Gaussians(means, quats, scales, opacities, rng.normal(size=(n, 1, 3)), rng.normal(size=(n, 3, 3)))


def rays(kind: str, seed: int = 1, count: int = 120) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rays from outside, from inside, from the very centers of Gaussians, and along the axes."""
    rng = np.random.default_rng(seed)
    origins = rng.uniform(-1.5, 1.5, (count, 3))
    origins[: count // 4] = rng.uniform(-0.05, 0.05, (count // 4, 3))
    toward = rng.uniform(-1.0, 1.0, (count, 3))
    directions = toward - origins
    directions[::10] = np.eye(3)[rng.integers(0, 3, len(directions[::10]))] * rng.choice([-1.0, 1.0])
    shift = 1000.0 if kind == "far" else 0.0
    g = scene(kind)
    if len(g):
        starts = rng.integers(0, len(g), count // 6)
        origins[-(count // 6) :] = g.means[starts].astype(np.float64) - shift
    return origins + shift, directions
