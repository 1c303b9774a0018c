"""Subdivide the icosahedron: unit vertices, outward triangles, and the 80 faces of direction sets.

Vertices are (0, ±1, ±phi) and cyclic permutations, scaled to length 1. Each subdivision splits every face into four at
its edge midpoints, which move to the unit sphere. The order of vertices and faces is part of the file formats: never
change it.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from gsvis import _check

__all__ = ["NUM_FACES", "face_directions", "face_shares", "icosphere"]

NUM_FACES = 80
"""Number of faces of the once-subdivided icosahedron."""


@lru_cache(maxsize=8)
def icosphere(subdivisions: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return a unit sphere of 20 * 4^subdivisions triangles.

    Args:
        subdivisions: 0 gives the icosahedron, 1 the 80 faces of the direction sets.

    Returns:
        vertices: (V, 3) unit vectors, read-only; the vertices of a coarser sphere come first.
        faces: (F, 3) int64, counter-clockwise seen from outside, read-only; the four parts of face f are 4f..4f+3.

    Raises:
        ValueError: If `subdivisions` is negative.
    """
    _check.positive_int("subdivisions", subdivisions, at_least=0)
    phi = (1.0 + 5.0**0.5) / 2.0
    signs = [(s, t) for s in (1.0, -1.0) for t in (phi, -phi)]
    corners = [(0.0, s, t) for s, t in signs] + [(s, t, 0.0) for s, t in signs] + [(t, 0.0, s) for s, t in signs]
    vertices = np.array(corners) / np.hypot(1.0, phi)
    edge = np.min(np.linalg.norm(vertices[0] - vertices[1:], axis=1))
    near = np.linalg.norm(vertices[:, None] - vertices[None], axis=2) < 1.01 * edge
    triangles = [
        (a, b, c)
        for a in range(12)
        for b in range(a + 1, 12)
        for c in range(b + 1, 12)
        if near[a, b] and near[b, c] and near[a, c]
    ]
    faces = np.array([t if np.linalg.det(vertices[list(t)]) > 0 else (t[0], t[2], t[1]) for t in triangles], np.int64)
    for _ in range(subdivisions):
        vertices, faces = _subdivide(vertices, faces)
    vertices.flags.writeable = False
    faces.flags.writeable = False
    return vertices, faces


def _subdivide(
    vertices: NDArray[np.float64], faces: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return vertices and faces with each face split into four."""
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]], axis=2).reshape(-1, 2)
    unique, inverse = np.unique(edges, axis=0, return_inverse=True)
    midpoints = vertices[unique].sum(axis=1)
    midpoints /= np.linalg.norm(midpoints, axis=1, keepdims=True)
    a, b, c = faces.T
    ab, bc, ca = (inverse.reshape(-1, 3) + len(vertices)).T
    parts = np.stack([np.stack(part, axis=1) for part in ((a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca))], axis=1)
    return np.concatenate([vertices, midpoints]), parts.reshape(-1, 3)


def face_directions(rays_per_face: int = 1) -> NDArray[np.float64]:
    """Return directions spread over each of the 80 faces of the once-subdivided icosahedron.

    Args:
        rays_per_face: 1, 4, 16 or 64: the face is split into that many parts, one direction through the center of each.

    Returns:
        (80, rays_per_face, 3) unit vectors.

    Raises:
        ValueError: If `rays_per_face` is not one of these.
    """
    centers = _corners(rays_per_face).mean(axis=1)
    centers /= np.linalg.norm(centers, axis=1, keepdims=True)
    return np.asarray(centers.reshape(NUM_FACES, rays_per_face, 3))


def face_shares(rays_per_face: int = 1) -> NDArray[np.float64]:
    """Return (80, rays_per_face) shares of the sphere, one for each part of `face_directions`; they sum to 1.

    Raises:
        ValueError: If `rays_per_face` is not 1, 4, 16 or 64.

    References:
        Van Oosterom and Strackee, "The solid angle of a plane triangle", IEEE Trans. Biomed. Eng. 1983.
    """
    a, b, c = np.swapaxes(_corners(rays_per_face), 0, 1)
    volume = np.einsum("fi,fi->f", a, np.cross(b, c))
    flat = 1.0 + np.einsum("fi,fi->f", a, b) + np.einsum("fi,fi->f", b, c) + np.einsum("fi,fi->f", c, a)
    return np.asarray(2.0 * np.arctan2(volume, flat).reshape(NUM_FACES, rays_per_face) / (4.0 * np.pi))


def _corners(rays_per_face: int) -> NDArray[np.float64]:
    """Return (80 * rays_per_face, 3, 3) unit corners; the parts of a face are consecutive."""
    if rays_per_face not in (1, 4, 16, 64):
        raise ValueError(f"rays_per_face: expected 1, 4, 16 or 64, got {rays_per_face!r}")
    vertices, faces = icosphere(1 + (1, 4, 16, 64).index(rays_per_face))
    return np.asarray(vertices[faces])
