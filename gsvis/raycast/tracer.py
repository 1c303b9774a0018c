"""Trace rays against a scene: all Gaussians that contribute to a ray, front to back, or the first proxy it meets.

Rays start at `rays_o` and run along unit `rays_d` in the world frame; depths are in scene units. docs/conventions.md
defines alpha, weight and depth on a ray, and where a ray stops.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.raycast._kernels import trace as _kernels
from gsvis.raycast.engines import ENGINES, Engine, fastest_engine
from gsvis.raycast.hierarchy import Hierarchy
from gsvis.raycast.proxies import EllipsoidProxies

__all__ = ["MAX_ALPHA", "MIN_TRANSMITTANCE", "TAU", "TRACERS", "Contributions", "FirstHits", "Tracer"]

MAX_ALPHA = 0.999
"""Upper bound of alpha."""
MIN_TRANSMITTANCE = 1e-4
"""A ray stops when less light than this is left."""
TAU = 1.0 / 255.0
"""Default least weight of a visible Gaussian."""

TRACERS = ("hierarchy", "embree")
"""Names of tracers; see `Tracer.named`."""

_SEARCHES = ("hierarchy", "faces")
_ROW = 128  # initial capacity of a ray's row; the few rays with more hits are traced again
_BYTES_A_HIT = 16
_PART = 1 << 16  # proxies whose triangles an engine holds at a time
_CHUNK_RAYS = 8192  # larger chunks are not faster

F64 = NDArray[np.float64]
Columns = tuple[NDArray[np.int32], NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]


@dataclass(frozen=True, eq=False)
class Contributions:
    """Gaussians that R rays meet, in CSR form: ray r owns `ray_offsets[r]:ray_offsets[r + 1]`, front to back.

    Attributes:
        ray_offsets: (R + 1,) int64.
        gaussian_ids: (H,) int64.
        alphas: (H,) float32 in [min_alpha, 0.999].
        weights: (H,) float32, alpha times the transmittance in front.
        depths: (H,) float32, scene units along the ray.
    """

    ray_offsets: NDArray[np.int64]
    gaussian_ids: NDArray[np.int64]
    alphas: NDArray[np.float32]
    weights: NDArray[np.float32]
    depths: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.ray_offsets) - 1

    def __repr__(self) -> str:
        return f"Contributions({len(self.gaussian_ids):,} hits of {len(self):,} rays)"

    @property
    def ray_ids(self) -> NDArray[np.int64]:
        """(H,) index of the ray of each hit."""
        return np.repeat(np.arange(len(self)), np.diff(self.ray_offsets))

    @property
    def transmittance(self) -> F64:
        """(R,) light left behind all hits of each ray, in [0, 1]."""
        logs = np.concatenate([[0.0], np.cumsum(np.log1p(-self.alphas.astype(np.float64)))])
        return np.asarray(np.exp(logs[self.ray_offsets[1:]] - logs[self.ray_offsets[:-1]]))

    @staticmethod
    def concatenate(parts: list[Contributions]) -> Contributions:
        """Return the contributions of several batches of rays as one."""
        if len(parts) == 1:
            return parts[0]
        counts = np.concatenate([np.diff(part.ray_offsets) for part in parts] or [np.zeros(0, np.int64)])
        offsets = np.concatenate([[0], np.cumsum(counts)])
        fields = [("gaussian_ids", np.int64), ("alphas", np.float32), ("weights", np.float32), ("depths", np.float32)]
        joined = [np.concatenate([getattr(p, name) for p in parts] or [np.zeros(0, dtype)]) for name, dtype in fields]
        return Contributions(offsets, *joined)


@dataclass(frozen=True, eq=False)
class FirstHits:
    """The first proxy face of each ray, as if proxies were opaque.

    Attributes:
        t_hit: (R,) float64, scene units; inf for a miss.
        gaussian_ids: (R,) int64; -1 for a miss.
    """

    t_hit: F64
    gaussian_ids: NDArray[np.int64]


class Tracer:
    """Trace rays against the proxies of a scene.

    Acceleration structures are built on first use: an Embree scene of the triangles for `first_hit` and
    `search="faces"`, the ellipsoid hierarchy for everything else.

    Args:
        proxies: Proxies of the scene.
        engine: "open3d" (all cores, extra 'open3d') or "embreex" (one core); both are Embree. None takes the first
            that is installed.
        search: How contributions are found if a call does not say it: "hierarchy" or "faces"; see `contributions`.

    Raises:
        ValueError: If the engine is unknown.
        BackendError: On first use, if Open3D was asked for and is missing; says what to install.
    """

    def __init__(self, proxies: EllipsoidProxies, engine: str | None = None, search: str = "hierarchy") -> None:
        self.search = _check.one_of("search", search, _SEARCHES)
        self.engine = fastest_engine() if engine is None else _check.one_of("engine", engine, tuple(ENGINES))
        self.proxies = proxies

    @classmethod
    def named(cls, name: str, proxies: EllipsoidProxies) -> Tracer:
        """Return the tracer with a name.

        Args:
            name: One of `TRACERS`: "hierarchy", our own over ellipsoids; or "embree", Open3D's over the meshes of the
                proxies, which lists every face on a ray and is many times slower.
            proxies: Proxies of the scene.
        """
        if _check.one_of("tracer", name, TRACERS) == "embree":
            return cls(proxies, engine="open3d", search="faces")
        return cls(proxies)

    def __repr__(self) -> str:
        return f"Tracer({self.proxies!r}, engine={self.engine!r})"

    @cached_property
    def hierarchy(self) -> Hierarchy:
        """The hierarchy over the ellipsoids."""
        return Hierarchy.from_proxies(self.proxies)

    @cached_property
    def embree(self) -> Engine:
        """The engine's scene of all proxy triangles."""
        return ENGINES[self.engine](*self.proxies.meshes(), bodies=len(self.proxies))

    @property
    def limits(self) -> tuple[float, float, float]:
        """(min_alpha, max_alpha, min_transmittance), as the kernels take them."""
        return self.proxies.min_alpha, MAX_ALPHA, MIN_TRANSMITTANCE

    def check_ids(self, ids: ArrayLike | None) -> NDArray[np.int64]:
        """Return checked ids of Gaussians; None means all.

        Raises:
            ValueError: If an id is not in [0, N).
        """
        n = len(self.proxies.gaussians)
        if ids is None:
            return np.arange(n)
        picked = _check.integers("ids", ids, ("M",))
        if len(picked) and not 0 <= picked.min() <= picked.max() < n:
            raise ValueError(f"ids: expected values in [0, {n}), got {picked.min()}..{picked.max()}")
        return picked

    def first_hit(self, rays_o: ArrayLike, rays_d: ArrayLike) -> FirstHits:
        """Return the first proxy each ray meets.

        Args:
            rays_o: (R, 3) origins, world frame.
            rays_d: (R, 3) directions, any non-zero length.

        Raises:
            ValueError: If shapes differ or values are not finite.
        """
        rays_o, rays_d = _rays(rays_o, rays_d)
        t_hit, faces = self.embree.first_face(rays_o, rays_d)
        owners = faces // self.proxies.faces_per_proxy
        ids = np.where(faces < 0, -1, self.proxies.ids[owners] if len(self.proxies) else -1)
        return FirstHits(t_hit, ids)

    def contributions(
        self, rays_o: ArrayLike, rays_d: ArrayLike, *, search: str | None = None, max_memory: int = 256 << 20
    ) -> Contributions:
        """Return all Gaussians that contribute to each ray, front to back.

        Args:
            rays_o: (R, 3) origins, world frame.
            rays_d: (R, 3) directions, any non-zero length.
            search: "hierarchy" traverses the ellipsoids and stops where light is spent; "faces" first lists every
                proxy face by the engine (engine "open3d"). Both give the same result; the second is the slower twin.
                None takes that of the tracer.
            max_memory: Working memory in bytes, beside the result; rays are traced in chunks that fit.

        Raises:
            ValueError: If shapes differ or values are not finite.
            BackendError: If the engine cannot list faces.
        """
        chunks = self.iter_contributions(rays_o, rays_d, search=search, max_memory=max_memory)
        return Contributions.concatenate([part for _, part in chunks])

    def iter_contributions(
        self, rays_o: ArrayLike, rays_d: ArrayLike, *, search: str | None = None, max_memory: int = 256 << 20
    ) -> Iterator[tuple[int, Contributions]]:
        """Return `contributions` chunk by chunk, for results larger than memory.

        Yields:
            The index of the chunk's first ray, and the contributions of its rays.
        """
        search = _check.one_of("search", search or self.search, _SEARCHES)
        _check.positive_int("max_memory", max_memory)
        rays_o, rays_d = _rays(rays_o, rays_d)
        step = min(_CHUNK_RAYS, max(64, max_memory // (2 * _ROW * _BYTES_A_HIT)))
        rows = _columns((min(step, len(rays_o)), _ROW))
        for start in range(0, len(rays_o), step):
            chunk = rays_o[start : start + step], rays_d[start : start + step]
            traced = self._trace_faces(*chunk) if search == "faces" else self._trace_hierarchy(*chunk, rows, max_memory)
            yield start, traced

    def _trace_hierarchy(self, rays_o: F64, rays_d: F64, rows: Columns, max_memory: int) -> Contributions:
        """Return the contributions of a chunk of rays, found by the hierarchy."""
        arrays = self.hierarchy.arrays
        counts = np.empty(len(rays_o), np.int64)
        _kernels.trace_rays(*arrays, rays_o, rays_d, self.limits, counts, *rows)
        offsets = np.concatenate([[0], np.cumsum(counts)])
        total = int(offsets[-1])
        packed = np.empty(total, np.int64), *_columns((total,))[1:]
        _kernels.pack(self.hierarchy.ids, offsets, np.arange(len(rays_o)), *rows, *packed)
        long = np.flatnonzero(counts > _ROW)
        while len(long):  # rays with more hits than their rows can hold
            room = int(counts[long].max())
            some, long = np.split(long, [max(1, max_memory // (2 * room * _BYTES_A_HIT))])
            rows = _columns((len(some), room))
            _kernels.trace_rays(*arrays, rays_o[some], rays_d[some], self.limits, np.empty(len(some), np.int64), *rows)
            _kernels.pack(self.hierarchy.ids, offsets, some, *rows, *packed)
        return Contributions(offsets, *packed)

    def contributions_by_parts(self, rays_o: ArrayLike, rays_d: ArrayLike, *, proxies: int = _PART) -> Contributions:
        """Return the same as `contributions(search="faces")`, in little memory; meant for few rays.

        The engine holds the triangles of a few proxies at a time, and only of those near a ray. They are built again at
        each call.

        Args:
            rays_o: (R, 3) origins, world frame.
            rays_d: (R, 3) directions, any non-zero length.
            proxies: Number of proxies that the engine holds at a time.

        Raises:
            ValueError: If shapes differ or values are not finite.
            BackendError: If the engine cannot list faces.
        """
        _check.positive_int("proxies", proxies)
        rays_o, rays_d = _rays(rays_o, rays_d)
        pairs = [np.zeros(0, np.int64)]
        near = np.flatnonzero(self.proxies.near(rays_o, rays_d))
        for start in range(0, len(near), proxies):
            some = near[start : start + proxies]
            part = ENGINES[self.engine](*self.proxies[some].meshes(), bodies=len(some))
            ray_ids, faces = part.all_faces(rays_o, rays_d)
            pairs.append(self._pairs(ray_ids, some[faces // self.proxies.faces_per_proxy]))
        return self._weigh(np.unique(np.concatenate(pairs)), rays_o, rays_d)

    def _trace_faces(self, rays_o: F64, rays_d: F64) -> Contributions:
        """Return the contributions of a chunk of rays, found by the engine."""
        ray_ids, faces = self.embree.all_faces(rays_o, rays_d)
        return self._weigh(self._pairs(ray_ids, faces // self.proxies.faces_per_proxy), rays_o, rays_d)

    def _pairs(self, ray_ids: NDArray[np.int64], met: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return ray * M + proxy for each proxy that a ray meets, ascending. A ray meets a convex proxy twice."""
        return np.unique(ray_ids * max(1, len(self.proxies)) + met)

    def _weigh(self, pairs: NDArray[np.int64], rays_o: F64, rays_d: F64) -> Contributions:
        """Return the contributions among (ray, proxy) pairs; see `_pairs`."""
        m = max(1, len(self.proxies))
        positions = self.hierarchy.positions[self.proxies.ids[pairs % m]] if len(self.proxies) else pairs
        offsets = np.searchsorted(pairs // m, np.arange(len(rays_o) + 1))
        values = [np.empty(len(pairs), np.float32) for _ in range(3)]
        counts = np.empty(len(rays_o), np.int64)
        table = self.hierarchy.table
        _kernels.weigh_candidates(table, rays_o, rays_d, self.limits, offsets, positions, counts, *values)
        kept = np.arange(len(pairs)) - np.repeat(offsets[:-1], np.diff(offsets)) < np.repeat(counts, np.diff(offsets))
        ends = np.concatenate([[0], np.cumsum(counts)])
        return Contributions(ends, self.hierarchy.ids[positions[kept]], *(value[kept] for value in values))


def _columns(shape: tuple[int, ...]) -> Columns:
    """Allocate ids, alphas, weights and depths."""
    floats = [np.empty(shape, np.float32) for _ in range(3)]
    return np.empty(shape, np.int32), floats[0], floats[1], floats[2]


def _rays(rays_o: ArrayLike, rays_d: ArrayLike) -> tuple[F64, F64]:
    """Return checked origins and unit directions."""
    origins = _check.floats("rays_o", rays_o, ("R", 3), np.float64)
    directions = _check.unit_vectors("rays_d", rays_d)
    _check.same_length(rays_o=origins, rays_d=directions)
    return origins, directions
