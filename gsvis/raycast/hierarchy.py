"""Build the hierarchy over ellipsoids that finds the Gaussians on a ray, front to back, until light is spent.

Embree's Python interfaces return either the first face or all faces of a ray. Real scenes are deep: half of all faces
lie behind spent transmittance. Contributions are therefore traced through our own eight-wide hierarchy over the
ellipsoids themselves (docs/design/003-contributions.md). World frame, scene units.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsvis.raycast._kernels import bvh as _kernels_bvh
from gsvis.raycast._kernels.trace import OPACITY, RANK, REACH
from gsvis.raycast.proxies import EllipsoidProxies
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.repeats import hash_columns

__all__ = ["Hierarchy"]

_CHUNK = 1 << 17


@dataclass(frozen=True, eq=False)
class Hierarchy:
    """M Gaussians in hierarchy order with the boxes above them, as arrays for the kernels.

    Attributes:
        ids: (M,) int64; position in the hierarchy -> Gaussian of the scene.
        positions: (N,) int64; the inverse, -1 for a Gaussian without proxy.
        table: (M, 16) float32; mean (3), quaternion wxyz (4), inverse standard deviations (3), squared reach, opacity,
            rank among Gaussians of equal mean, and what rounding left of the inverses (3).
        boxes: (K, 6, 8) float32 child boxes of each node.
        children: (K, 8) int32.
    """

    ids: NDArray[np.int64]
    positions: NDArray[np.int64]
    table: NDArray[np.float32]
    boxes: NDArray[np.float32]
    children: NDArray[np.int32]

    @classmethod
    def from_proxies(cls, proxies: EllipsoidProxies) -> Hierarchy:
        """Build the hierarchy; takes some seconds for 1.5 million Gaussians."""
        g = proxies.gaussians
        low, high = _boxes(proxies)
        order, boxes, children = _kernels_bvh.build(low, high)
        del low, high
        ids = proxies.ids[order]
        positions = np.full(len(g), -1, np.int64)
        positions[ids] = np.arange(len(ids))
        return cls(ids, positions, _table(g, ids, proxies.min_alpha), boxes, children.astype(np.int32))

    @property
    def arrays(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.int32]]:
        """Return the first arguments of every kernel: table, boxes, children."""
        return self.table, self.boxes, self.children

    @property
    def nbytes(self) -> int:
        """Bytes held."""
        return sum(array.nbytes for array in (self.ids, self.positions, *self.arrays))


def _boxes(proxies: EllipsoidProxies) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the lowest and the highest corners (M, 3) of boxes around the ellipsoids."""
    low = np.empty((len(proxies), 3), np.float32)
    high = np.empty_like(low)
    for part in _parts(len(proxies)):
        some = proxies.gaussians[proxies.ids[part]]
        half = np.linalg.norm(some.rotations() * proxies.radii[part, None, :], axis=2)
        means = some.means.astype(np.float64)
        half += 1e-9 * (np.abs(means) + half)  # rounding of the boxes and of the slab test
        low[part] = np.nextafter((means - half).astype(np.float32), np.float32(-np.inf))
        high[part] = np.nextafter((means + half).astype(np.float32), np.float32(np.inf))
    return low, high


def _table(g: Gaussians, ids: NDArray[np.int64], min_alpha: float) -> NDArray[np.float32]:
    """Return the rows of Gaussians (M,) of a scene; see `Hierarchy`."""
    table = np.zeros((len(ids), 16), np.float32)
    table[:, :3] = g.means[ids]
    table[:, 3:7] = g.quats[ids]
    inverse = np.minimum(1.0 / g.scales[ids].astype(np.float64), np.finfo(np.float32).max)
    table[:, 7:10] = inverse
    table[:, 13:16] = inverse - table[:, 7:10]
    # More than the reach, because the exact test is alpha >= min_alpha.
    reach = 2.0 * np.log(np.maximum(g.opacities[ids].astype(np.float64) / min_alpha, 1.0)) + 1e-9
    table[:, REACH] = np.nextafter(reach.astype(np.float32), np.float32(np.inf))
    table[:, OPACITY] = g.opacities[ids]
    table[:, RANK] = _ranks(g, ids)
    return table


def _ranks(g: Gaussians, ids: NDArray[np.int64]) -> NDArray[np.float32]:
    """Return numbers (M,) that order Gaussians of equal mean by all else; exact repeats have equal numbers.

    Up to 2^24 Gaussians may share their mean with others; beyond that, neighbors may count as repeats.
    """
    ranks = np.zeros(len(ids), np.float32)
    keys = hash_columns(tuple((g.means[ids] + np.float32(0.0)).T))  # -0 is 0
    order = np.argsort(keys)
    equal = keys[order[1:]] == keys[order[:-1]]
    if not equal.any():
        return ranks
    shared = order[np.append(equal, False) | np.append(False, equal)]
    some = g[ids[shared]]
    higher = some.shN.reshape(len(some), -1)[:, :3]
    rows = np.concatenate([some.scales, some.quats, some.opacities[:, None], some.sh0[:, 0], higher], axis=1)
    ascending = np.lexsort(rows.T[::-1])
    differs = np.any(rows[ascending[1:]] != rows[ascending[:-1]], axis=1)
    ranks[shared[ascending]] = np.append(0, np.cumsum(differs))
    return ranks


def _parts(count: int) -> list[slice]:
    """Return slices that divide `count` rows."""
    return [slice(start, min(start + _CHUNK, count)) for start in range(0, count, _CHUNK)]
