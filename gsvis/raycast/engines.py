"""Wrap the two Embree engines in one small interface: the first face of a ray, and all faces if the engine lists them.

Both trace the same float32 triangles. Distances are in scene units along unit directions; a miss is inf and face -1.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Protocol

import numpy as np
from numba import get_num_threads
from numpy.typing import NDArray

from gsvis._extras import has, require
from gsvis.errors import BackendError
from gsvis.scene.repeats import hash_columns

__all__ = ["ENGINES", "EmbreexEngine", "Engine", "Open3dEngine", "fastest_engine"]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


_GEOMETRIES = 1024  # geometries among which Open3D's engine spreads the bodies


class Engine(Protocol):
    """Interface between a tracer and an engine."""

    def first_face(self, rays_o: F64, rays_d: F64) -> tuple[F64, I64]:
        """Return distance (R,) and face (R,) of the first hit of each ray; inf and -1 for a miss."""
        ...

    def all_faces(self, rays_o: F64, rays_d: F64) -> tuple[I64, I64]:
        """Return ray (H,) and face (H,) of every hit, rays in order."""
        ...


@dataclass(frozen=True, eq=False)
class _Repeats:
    """Groups of bodies with the same vertices.

    Attributes:
        first: (U,) the first body of each group, ascending.
        kinds: (M,) int64 group of each body.
        order: (M,) the bodies, group by group.
        starts: (U + 1,) start of each group in `order`.
    """

    first: I64
    kinds: I64
    order: I64
    starts: I64

    @classmethod
    def from_bodies(cls, corners: F32) -> _Repeats:
        """Find the bodies that repeat others bit for bit, by a 64-bit hash of their vertices (M, V, 3)."""
        columns = tuple(corners.reshape(len(corners), -1).T)
        _, first, numbers = np.unique(hash_columns(columns), return_index=True, return_inverse=True)
        rank = np.argsort(np.argsort(first))  # kinds in the order of their first body
        kinds = np.asarray(rank[numbers], np.int64)
        starts = np.concatenate([[0], np.cumsum(np.bincount(kinds, minlength=len(first)))])
        return cls(np.sort(first), kinds, np.argsort(kinds, kind="stable"), starts)

    def expand(self, bodies: I64) -> tuple[I64, I64]:
        """Return, for H bodies that are each the first of a group, the index of the hit and every body of the group."""
        kinds = self.kinds[bodies]
        counts = np.diff(self.starts)[kinds]
        hits = np.repeat(np.arange(len(bodies)), counts)
        within = np.arange(len(hits)) - np.repeat(np.cumsum(counts) - counts, counts)
        return hits, self.order[self.starts[kinds][hits] + within]


class Open3dEngine:
    """Use Embree through Open3D's RaycastingScene, on all cores.

    Open3D 0.20 omits a hit at the same distance as the previous hit in the same geometry. Therefore equal bodies are
    traced once, and the hit counts for all of them. Bodies are also spread at random over many geometries, because
    those that touch, such as discs of one wall, are hit at equal distances. Two that touch share a geometry with
    probability 1/1,024: on `two_rooms` 1 of 20,000 rays still loses a hit, of weight 0.0005.

    Args:
        vertices: (M * V, 3) vertices of M bodies.
        faces: (M * F, 3) their triangles; the faces of a body have only vertices of that body.
        bodies: M.
    """

    def __init__(self, vertices: F32, faces: NDArray[np.uint32], bodies: int = 1) -> None:
        get_num_threads()  # start numba's threads first: open3d loads a TBB that numba would warn about
        require("engine 'open3d'", "open3d")
        try:
            import open3d as o3d
        except ImportError as error:
            raise BackendError(
                f"engine 'open3d': expected an importable open3d, got '{error}'; install the system's libraries that it"
                " links (Debian: libusb-1.0-0 libgl1 libegl1 libx11-6 libudev1), or use engine='embreex'"
            ) from error
        self._scene = o3d.t.geometry.RaycastingScene()
        if len(faces) == 0:
            return
        self._faces_per_body = len(faces) // bodies
        corners = vertices.reshape(bodies, -1, 3)
        triangles = faces.reshape(bodies, -1, 3)
        self._repeats = _Repeats.from_bodies(corners)
        traced = self._repeats.first
        dealt = np.random.default_rng(0).integers(_GEOMETRIES, size=len(traced))
        self._bodies = traced[np.argsort(dealt, kind="stable")]  # by geometry
        counts = np.bincount(dealt, minlength=_GEOMETRIES)
        counts = counts[counts > 0]
        self._starts = np.concatenate([[0], np.cumsum(counts)])
        for start, stop in pairwise(self._starts):
            some = self._bodies[start:stop]
            shift = np.arange(len(some)) * corners.shape[1] - some * corners.shape[1]
            moved = (triangles[some].astype(np.int64) + shift[:, None, None]).astype(np.uint32)
            self._scene.add_triangles(
                o3d.core.Tensor(corners[some].reshape(-1, 3)), o3d.core.Tensor(moved.reshape(-1, 3))
            )
        self.first_face(np.zeros((1, 3)), np.ones((1, 3)))  # the first query builds the tree

    def first_face(self, rays_o: F64, rays_d: F64) -> tuple[F64, I64]:
        """Return first hits; see `Engine`."""
        answer = self._scene.cast_rays(_rays32(rays_o, rays_d))
        return _hits(answer["t_hit"].numpy(), self._faces(answer))

    def all_faces(self, rays_o: F64, rays_d: F64) -> tuple[I64, I64]:
        """Return all hits; see `Engine`."""
        answer = self._scene.list_intersections(_rays32(rays_o, rays_d))
        ray_ids = answer["ray_ids"].numpy().astype(np.int64)
        faces = self._faces(answer)
        if len(faces) == 0:
            return ray_ids, faces
        hits, bodies = self._repeats.expand(faces // self._faces_per_body)
        return ray_ids[hits], bodies * self._faces_per_body + faces[hits] % self._faces_per_body

    def _faces(self, answer: Any) -> I64:
        """Return the face of each hit, as numbered by the caller; -1 for a miss."""
        geometries, inner = (answer[name].numpy().astype(np.int64) for name in ("geometry_ids", "primitive_ids"))
        hit = inner != self._scene.INVALID_ID
        faces = np.full(inner.shape, -1, np.int64)
        if hit.any():
            body = self._bodies[self._starts[geometries[hit]] + inner[hit] // self._faces_per_body]
            faces[hit] = body * self._faces_per_body + inner[hit] % self._faces_per_body
        return faces


class EmbreexEngine:
    """Use Embree through embreex: one core, first hits only."""

    def __init__(self, vertices: F32, faces: NDArray[np.uint32], bodies: int = 1) -> None:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self._scene: Any = EmbreeScene()
        self._mesh = TriangleMesh(self._scene, vertices, faces.astype(np.int32)) if len(faces) else None
        self.first_face(np.zeros((1, 3)), np.ones((1, 3)))  # the first query builds the tree

    def first_face(self, rays_o: F64, rays_d: F64) -> tuple[F64, I64]:
        """Return first hits; see `Engine`."""
        if self._mesh is None:
            return np.full(len(rays_o), np.inf), np.full(len(rays_o), -1, np.int64)
        answer = self._scene.run(rays_o.astype(np.float32), rays_d.astype(np.float32), output=True)
        return _hits(answer["tfar"], answer["primID"].astype(np.int64))

    def all_faces(self, rays_o: F64, rays_d: F64) -> tuple[I64, I64]:
        """Raise: embreex returns one hit per ray, and restarting behind it loses coincident faces."""
        raise BackendError("engine 'embreex' lists first hits only; use engine='open3d' or search='hierarchy'")


ENGINES: dict[str, type[Open3dEngine] | type[EmbreexEngine]] = {"open3d": Open3dEngine, "embreex": EmbreexEngine}


def fastest_engine() -> str:
    """Return the name of the fastest engine that is installed: "open3d", or "embreex", which always is."""
    return "open3d" if has("open3d") else "embreex"


def _rays32(rays_o: F64, rays_d: F64) -> F32:
    return np.concatenate([rays_o, rays_d], axis=1).astype(np.float32)


def _hits(t_hit: NDArray[Any], faces: I64) -> tuple[F64, I64]:
    return np.where(faces < 0, np.inf, t_hit.astype(np.float64)), faces
