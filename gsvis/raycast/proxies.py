"""Build proxy meshes: for each Gaussian a stretched icosahedron that encloses its ellipsoid.

The ellipsoid is the surface where alpha is `min_alpha`, so its size depends on opacity. A ray that misses the proxy
gets no contribution from the Gaussian. World frame, scene units. Knows nothing of rays.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.raycast._kernels.near import mark_near
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.icosphere import icosphere

if TYPE_CHECKING:
    import trimesh

__all__ = ["MIN_ALPHA", "EllipsoidProxies", "reaches"]

MIN_ALPHA = 1.0 / 255.0
"""Alpha below this counts as 0 (docs/conventions.md)."""

_THINNEST = 1e-4  # least ratio of a proxy's smallest to largest half-width; thinner ones collapse in float32
_CHUNK = 1 << 16
_ROUNDING = 1e-6  # of float32, relative, with a margin


def reaches(opacities: NDArray[np.float32], min_alpha: float = MIN_ALPHA) -> NDArray[np.float64]:
    """Return the distance, in standard deviations, within which each Gaussian's alpha is at least `min_alpha`.

    Args:
        opacities: (N,) in [0, 1].
        min_alpha: In (0, 1).

    Returns:
        (N,) float64: sqrt(2 ln(opacity / min_alpha)); NaN where opacity is below `min_alpha`.

    References:
        docs/conventions.md; solves opacity * exp(-r^2 / 2) = min_alpha.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.sqrt(2.0 * np.log(opacities.astype(np.float64) / min_alpha)))


@dataclass(frozen=True, eq=False)
class EllipsoidProxies:
    """Proxies of the M Gaussians of a scene whose opacity reaches `min_alpha`.

    Attributes:
        gaussians: The whole scene, N Gaussians.
        ids: (M,) int64, the Gaussian of each proxy, ascending.
        radii: (M, 3) float64, semi-axes of the enclosed ellipsoids, scene units.
        faces_per_proxy: 20 or 80.
        min_alpha: Alpha on the surface of the ellipsoids.
    """

    gaussians: Gaussians
    ids: NDArray[np.int64]
    radii: NDArray[np.float64]
    faces_per_proxy: int
    min_alpha: float

    @classmethod
    def from_scene(cls, g: Gaussians, faces: int = 20, min_alpha: float = MIN_ALPHA) -> EllipsoidProxies:
        """Build proxies for every Gaussian that can be visible.

        Args:
            g: The scene.
            faces: 20 (icosahedron) or 80 (once subdivided, tighter).
            min_alpha: Alpha on the ellipsoids; larger values give only the opaque cores.

        Raises:
            ValueError: If `faces` or `min_alpha` is out of range.
        """
        if faces not in (20, 80):
            raise ValueError(f"faces: expected 20 or 80, got {faces!r}")
        if not 0.0 < min_alpha < 1.0:
            raise ValueError(f"min_alpha: expected a value in (0, 1), got {min_alpha!r}")
        reach = reaches(g.opacities, min_alpha)
        ids = np.flatnonzero(reach >= 0.0)
        return cls(g, ids, reach[ids, None] * g.scales[ids].astype(np.float64), faces, float(min_alpha))

    def __len__(self) -> int:
        return len(self.ids)

    def __repr__(self) -> str:
        return f"EllipsoidProxies({len(self):,} of {self.faces_per_proxy} faces, alpha {self.min_alpha:.5g})"

    def __getitem__(self, chosen: NDArray[np.int64]) -> EllipsoidProxies:
        """Return some proxies (K,) of the same scene, ascending."""
        return EllipsoidProxies(
            self.gaussians, self.ids[chosen], self.radii[chosen], self.faces_per_proxy, self.min_alpha
        )

    def near(self, rays_o: NDArray[np.float64], rays_d: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which proxies (M,) a ray may meet: those whose circumscribed ellipsoid a ray comes near.

        Args:
            rays_o: (R, 3) origins, world frame.
            rays_d: (R, 3) unit directions.
        """
        found = np.empty(len(self), bool)
        away = float(np.linalg.norm(rays_o, axis=1).max(initial=0.0))
        for start in range(0, len(self), _CHUNK):
            some = np.arange(start, min(start + _CHUNK, len(self)))
            mark_near(*self._balls(some, away), np.empty((0, 3, 3)), rays_o, rays_d, _ROUNDING, found[some[0] :])
            some = some[found[some]]
            met = np.empty(len(some), bool)
            mark_near(*self._balls(some, away), self._whitening(some, away), rays_o, rays_d, _ROUNDING, met)
            found[some] = met
        return found

    def _balls(self, some: NDArray[np.int64], away: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return centers (K, 3) and radii (K,) of balls around some proxies, for rays from points up to `away`."""
        corner = float(np.linalg.norm(self.template[0], axis=1).max())
        means = self.gaussians.means[self.ids[some]].astype(np.float64)
        finest = _finest(means)
        return means, corner * np.maximum(self.radii[some].max(axis=1), finest) + finest + _ROUNDING * away

    def _whitening(self, some: NDArray[np.int64], away: float) -> NDArray[np.float64]:
        """Return (K, 3, 3) what maps the ellipsoids around some proxies to the unit ball.

        They also hold all points within rounding error of a proxy: an ellipsoid with squared semi-axes
        1.01 a^2 + 101 e^2 holds all within e of one with semi-axes a.
        """
        corner = float(np.linalg.norm(self.template[0], axis=1).max())
        part = self.gaussians[self.ids[some]]
        means = part.means.astype(np.float64)
        errors = _finest(means) + _ROUNDING * (2.0 * away + np.linalg.norm(means, axis=1))
        squared = 1.01 * (corner * self._half_widths(some, means)) ** 2 + 101.0 * errors[:, None] ** 2
        return np.ascontiguousarray(np.swapaxes(part.rotations(), 1, 2) / np.sqrt(squared)[:, :, None])

    def _half_widths(self, some: NDArray[np.int64] | slice, means: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the half-widths (K, 3) of some proxies, none too thin for float32, from their centers (K, 3)."""
        radii = self.radii[some]
        return np.asarray(np.maximum(radii, np.maximum(_THINNEST * radii.max(axis=1), _finest(means))[:, None]))

    @cached_property
    def template(self) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Vertices (V, 3) and faces (F, 3) of the unit proxy, whose inscribed sphere has radius 1."""
        vertices, faces = icosphere(0 if self.faces_per_proxy == 20 else 1)
        corners = vertices[faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        heights = np.einsum("fi,fi->f", normals, corners[:, 0]) / np.linalg.norm(normals, axis=1)
        return vertices / heights.min(), faces

    def meshes(self, start: int = 0, stop: int | None = None) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
        """Return the triangles of proxies start..stop as one mesh.

        Args:
            start: First proxy.
            stop: One past the last; None means all.

        Returns:
            vertices: (M * V, 3) float32, world frame.
            faces: (M * F, 3) uint32; face f belongs to proxy `start + f // faces_per_proxy`.
        """
        unit, unit_faces = self.template
        chosen = range(*slice(start, stop).indices(len(self)))
        m = len(chosen)
        v = len(unit)
        _check.positive_int("proxies", m, at_least=0)
        vertices = np.empty((m, v, 3), np.float32)
        for first in range(0, m, _CHUNK):
            some = slice(chosen.start + first, chosen.start + min(first + _CHUNK, m))
            part = self.gaussians[self.ids[some]]
            means = part.means.astype(np.float64)
            axes = part.rotations() * self._half_widths(some, means)[:, None, :]
            vertices[first : first + len(part)] = np.einsum("mij,vj->mvi", axes, unit) + means[:, None, :]
        faces = unit_faces[None].astype(np.uint32) + (v * np.arange(m, dtype=np.uint32))[:, None, None]
        return vertices.reshape(-1, 3), faces.reshape(-1, 3)

    def to_trimesh(self) -> trimesh.Trimesh:
        """Return all proxies as one `trimesh.Trimesh`, to view or export."""
        import trimesh

        vertices, faces = self.meshes()
        return trimesh.Trimesh(vertices, faces, process=False)


def _finest(means: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the least half-width (M,) that float32 resolves around centers (M, 3)."""
    return np.asarray(4.0 * np.finfo(np.float32).eps * np.abs(means).max(axis=1))
