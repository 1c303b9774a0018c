"""Measure the light that a set misses in small square tiles around the rays that miss most. Scene frame.

A mean over all directions hides a hole that is small and dark. So the squares in which a certificate's worst rays lie
are traced with many rays. This searches for the worst tile; it bounds nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.pvs.certificate import heaviest_hits
from gsvis.raycast import Tracer

__all__ = ["TILE", "TileProbe", "probe_tiles"]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

TILE = 16.0 * math.radians(90.0) / 1920.0
"""Side of a tile as an angle: 16 pixels of a display of 1,920 over 90 degrees."""

_SIDE = 8  # rays along a side of a tile
_TURNS = np.array([0.7548776662, 0.5698402910])  # steps of an additive sequence that fills the square evenly


@dataclass(frozen=True, eq=False)
class TileProbe:
    """The light and the Gaussians that a set misses in T tiles.

    Attributes:
        missed: (T,) mean weight that the set misses, over the rays of each tile, in [0, 1].
        ids: (M,) missed Gaussians that have a weight of at least tau on some ray, ascending.
        id_weights: (M,) their largest weights.
        id_origins: (M, 3) origins of the rays with these weights.
    """

    missed: F64
    ids: I64
    id_weights: F32
    id_origins: F64


def probe_tiles(
    tracer: Tracer, held: NDArray[np.bool_], rays_o: ArrayLike, rays_d: ArrayLike, tau: float, *, turn: int = 0
) -> TileProbe:
    """Trace 64 rays in a square tile around each of T rays.

    Args:
        tracer: The scene, N Gaussians.
        held: (N,) the set.
        rays_o: (T, 3) origins.
        rays_d: (T, 3) unit directions; the middles of the tiles.
        tau: Weight from which a missed Gaussian is listed.
        turn: Number of the turn; each turn probes places between those of earlier turns.
    """
    origins, middles = (_check.floats(n, v, ("T", 3), np.float64) for n, v in (("rays_o", rays_o), ("rays_d", rays_d)))
    places = (np.arange(_SIDE)[:, None] + (0.5 + turn * _TURNS) % 1.0) / _SIDE - 0.5
    across, up = (TILE * each.ravel() for each in np.meshgrid(places[:, 0], places[:, 1]))
    least = np.eye(3)[np.abs(middles).argmin(axis=1)]
    right = np.cross(middles, least)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    above = np.cross(right, middles)
    directions = middles[:, None] + across[None, :, None] * right[:, None] + up[None, :, None] * above[:, None]
    count = _SIDE * _SIDE
    starts = np.repeat(origins, count, axis=0)
    hits = tracer.contributions(starts, directions.reshape(-1, 3))
    lost = ~held[hits.gaussian_ids]
    rays = hits.ray_ids[lost]
    weights = hits.weights[lost]
    missed = np.bincount(rays // count, weights, len(origins)) / count
    ids, heaviest = heaviest_hits(hits.gaussian_ids[lost], weights)
    listed = weights[heaviest] >= np.float32(tau)
    heaviest = heaviest[listed]
    return TileProbe(np.minimum(missed, 1.0), ids[listed], weights[heaviest], starts[rays[heaviest]])
