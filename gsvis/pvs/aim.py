"""Find the directions in which eyes of a cell can meet a Gaussian; around an object these are few.

A ray in another direction meets nothing, so it has no weight. To leave it out changes no share of light and no bound.
Scene frame and units.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.pvs._kernels.aim import mark_centers, mark_directions
from gsvis.raycast import Tracer

__all__ = ["Aim", "share_of_centers"]

F64 = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Aim:
    """Directions that may meet something, as pixels of a cube.

    Attributes:
        marked: (6, S, S) bool: pixels of the faces +x, -x, +y, -y, +z, -z. Columns run along the first, rows along the
            second of the other two axes.
        share: Part of the pixels that is marked.
    """

    marked: NDArray[np.bool_]
    share: float

    @classmethod
    def of_box(cls, tracer: Tracer, low: ArrayLike, high: ArrayLike, size: int, *, enough: float = 1.0) -> Aim:
        """Return the directions of eyes in a box or at a point; all if an eye may be inside a Gaussian's box.

        Args:
            tracer: The scene.
            low: (3,) lowest corner of the box.
            high: (3,) highest corner.
            size: S, pixels along a side of the faces.
            enough: Share of the pixels that is enough: once so many are marked, the others stay as they are.
        """
        marked = np.zeros((6, size, size), bool)
        hierarchy = tracer.hierarchy
        corners = np.asarray(low, np.float64), np.asarray(high, np.float64)
        stop = enough * marked.size
        if len(hierarchy.ids) and not mark_directions(hierarchy.boxes, hierarchy.children, *corners, stop, marked):
            marked[:] = True
        return cls(marked, float(marked.mean()))

    def draw(self, count: int, rng: np.random.Generator) -> F64:
        """Return (count, 3) unit vectors, uniform over the marked directions; over the sphere if none is marked."""
        if self.share in (0.0, 1.0):
            vectors = rng.normal(size=(count, 3))
            return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))
        size = self.marked.shape[1]
        places = np.argwhere(self.marked)
        found: list[F64] = []
        left = count
        while left > 0:
            some = places[rng.integers(len(places), size=2 * left + 16)]
            u, v = (2.0 * (some[:, axis] + rng.random(len(some))) / size - 1.0 for axis in (2, 1))
            lengths = np.sqrt(1.0 + u * u + v * v)
            # A pixel toward a corner of the cube takes up less of the sphere.
            kept = np.flatnonzero(rng.random(len(some)) * lengths**3 < 1.0)[:left]
            found.append(_directions(some[kept, 0], u[kept] / lengths[kept], v[kept] / lengths[kept]))
            left -= len(kept)
        return np.concatenate(found or [np.zeros((0, 3))])


def share_of_centers(centers: ArrayLike, eye: F64, size: int, *, enough: float = 1.0) -> float:
    """Return the share of all directions in which centers (P, 3) lie from an eye (3,), with a pixel around each.

    Args:
        centers: (P, 3) points; points at the eye are ignored.
        eye: (3,) the eye.
        size: Pixels along a side of the faces of a cube.
        enough: Share that is enough: once it is reached, the other centers are ignored.
    """
    marked = np.zeros((6, size, size), bool)
    points = _check.read_only(np.ascontiguousarray(centers, np.float32))
    mark_centers(*points, np.asarray(eye, np.float64), enough * marked.size, marked)
    return float(marked.mean())


def _directions(faces: NDArray[np.int64], u: F64, v: F64) -> F64:
    """Return unit vectors (K, 3) of places on the faces."""
    out = np.empty((len(faces), 3))
    axes = faces >> 1
    toward = 1.0 - 2.0 * (faces & 1)
    rows = np.arange(len(faces))
    out[rows, axes] = toward * np.sqrt(np.maximum(1.0 - u * u - v * v, 0.0))
    out[rows, np.where(axes == 0, 1, 0)] = u
    out[rows, np.where(axes == 2, 1, 2)] = v
    return out
