"""Find points of a cell that may see past edges: its tips, and points far from its viewpoints.

A tip is a point of the free voxels that lies farthest in some direction. Through a door or past a corner, most is
seen from there, and merged viewpoints may stand two voxels beside it. Held-out eyes inside whose images had holes
stood about half a cell from the nearest viewpoint (docs/design/053). Scene frame and units.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from gsvis.pvs.viewpoints import FreeVoxels, squared_distances

__all__ = ["Tips", "farthest_points"]

F64 = NDArray[np.float64]

_SKIPPED = 16  # most points inside something solid
_NEAR = 1.5  # voxels within which an eye stands for a tip
_SHORTER = 0.5  # times that, of an eye that found something
_WAYS = np.array([way for way in itertools.product((-1, 0, 1), repeat=3) if any(way)])
_OUT = 0.45  # voxels from the center of a voxel to its tip, along each axis of a way

Buries = Callable[[F64], NDArray[np.bool_]]
"""Returns which points (P, 3) lie inside something solid."""


class Tips:
    """The tips of a cell, its farthest points in 26 directions, from which to look if no eye was nearby.

    An eye covers the tips within one and a half voxels of it; half as far if it found something.

    Args:
        voxels: Where eyes may be in the cell.
        viewpoints: (V, 3) viewpoints so far.
        buries: Function that returns which points lie inside something solid; these are left out.
    """

    def __init__(self, voxels: FreeVoxels, viewpoints: F64, buries: Buries) -> None:
        x, y, z = np.ascontiguousarray(voxels.voxels.T)  # a product of matrices of integers is slow
        first = [int((a * x + b * y + c * z).argmax()) for a, b, c in _WAYS.tolist()]
        farthest = voxels.voxels[first]
        points = voxels.origin + voxels.voxel_size * (farthest + 0.5 + _OUT * _WAYS)
        self._points = points[~buries(points)]
        self._near = _NEAR * voxels.voxel_size
        self._apart = np.full(len(self._points), np.inf)
        for each in viewpoints:
            self.stand(each)

    def farthest(self) -> F64 | None:
        """Return the tip (3,) that is farthest from all eyes; None if eyes cover all."""
        if len(self._points) == 0 or self._apart.max() <= self._near:
            return None
        return np.asarray(self._points[int(self._apart.argmax())])

    def stand(self, eye: F64, *, found: bool = False) -> None:
        """Record an eye (3,) that looked, and whether it found something."""
        apart = np.linalg.norm(self._points - eye, axis=1)
        np.minimum(self._apart, apart / _SHORTER if found else apart, out=self._apart)


def farthest_points(voxels: FreeVoxels, viewpoints: F64, buries: Buries) -> Iterator[F64]:
    """Yield points (3,) of a cell, each as far as possible from the viewpoints and the points before it.

    Args:
        voxels: Where eyes may be in the cell.
        viewpoints: (V, 3) viewpoints so far; without any, the first point is on the rim of the cell.
        buries: Function that returns which points (P, 3) lie inside something solid; these are skipped.
    """
    points = voxels.rim()
    near = viewpoints if len(viewpoints) else points.mean(axis=0, keepdims=True)
    apart = np.full(len(points), np.inf)
    for each in near:
        apart = np.minimum(apart, squared_distances(points, each))
    skipped = 0
    while apart.max() > 0.0 and skipped <= _SKIPPED:
        first = int(apart.argmax())
        point = points[first]
        if buries(point[None])[0]:
            skipped += 1
        else:
            yield point
        apart = np.minimum(apart, squared_distances(points, point))
        apart[first] = 0.0
