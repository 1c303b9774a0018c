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
from gsvis.raycast.proxies import EllipsoidProxies

__all__ = ["Hierarchy"]

_CHUNK = 1 << 17


@dataclass(frozen=True, eq=False)
class Hierarchy:
    """M Gaussians in hierarchy order with the boxes above them, as arrays for the kernels.

    Attributes:
        ids: (M,) int64; position in the hierarchy -> Gaussian of the scene.
        positions: (N,) int64; the inverse, -1 for a Gaussian without proxy.
        table: (M, 16) float64; mean, whitening matrix by rows, squared reach, opacity, two unused.
        content: (M, C) float32; orders hits of equal depth and equal mean.
        boxes: (K, 6, 8) float32 child boxes of each node.
        children: (K, 8) int64.
    """

    ids: NDArray[np.int64]
    positions: NDArray[np.int64]
    table: NDArray[np.float64]
    content: NDArray[np.float32]
    boxes: NDArray[np.float32]
    children: NDArray[np.int64]

    @classmethod
    def from_proxies(cls, proxies: EllipsoidProxies) -> Hierarchy:
        """Build the hierarchy; takes some seconds for 1.5 million Gaussians."""
        g = proxies.gaussians
        m = len(proxies)
        low = np.empty((m, 3), np.float32)
        high = np.empty((m, 3), np.float32)
        for part in _parts(m):
            some = g[proxies.ids[part]]
            half = np.linalg.norm(some.rotations() * proxies.radii[part, None, :], axis=2)
            means = some.means.astype(np.float64)
            half += 1e-9 * (np.abs(means) + half)  # rounding of the boxes and of the slab test
            low[part] = np.nextafter((means - half).astype(np.float32), np.float32(-np.inf))
            high[part] = np.nextafter((means + half).astype(np.float32), np.float32(np.inf))
        order, boxes, children = _kernels_bvh.build(low, high)
        ids = proxies.ids[order]
        table = np.zeros((m, 16), np.float64)
        content = np.empty((m, 14 if g.sh_degree else 11), np.float32)
        for part in _parts(m):
            some = g[ids[part]]
            table[part, :3] = some.means
            whitening = np.swapaxes(some.rotations(), 1, 2) / some.scales.astype(np.float64)[:, :, None]
            table[part, 3:12] = whitening.reshape(-1, 9)
            table[part, 13] = some.opacities
            higher = some.shN.reshape(len(some), -1)[:, :3]
            values = some.scales, some.quats, some.opacities[:, None], some.sh0[:, 0], higher
            content[part] = np.concatenate(values, axis=1)
        # Slightly more than the reach: the exact test is alpha >= min_alpha.
        table[:, 12] = 2.0 * np.log(np.maximum(table[:, 13] / proxies.min_alpha, 1.0)) + 1e-9
        positions = np.full(len(g), -1, np.int64)
        positions[ids] = np.arange(m)
        return cls(ids, positions, table, content, boxes, children)

    @property
    def arrays(
        self,
    ) -> tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.float32], NDArray[np.int64]]:
        """Return the first arguments of every kernel: table, content, boxes, children."""
        return self.table, self.content, self.boxes, self.children

    @property
    def nbytes(self) -> int:
        """Bytes held."""
        held = (self.ids, self.positions, self.table, self.content, self.boxes, self.children)
        return sum(array.nbytes for array in held)


def _parts(count: int) -> list[slice]:
    """Return slices that divide `count` rows."""
    return [slice(start, min(start + _CHUNK, count)) for start in range(0, count, _CHUNK)]
