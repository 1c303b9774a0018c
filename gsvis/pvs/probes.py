"""Points of a cell that are farthest from its viewpoints: from there an eye sees past edges that hid light before.

Held-out eyes whose images had holes stood about half a cell from the nearest viewpoint. Eight such points
find nearly all of what eight random points leave (docs/design/053). Scene frame and units.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from gsvis.pvs.viewpoints import FreeVoxels

__all__ = ["farthest_points"]

F64 = NDArray[np.float64]

_SKIPPED = 16  # most points inside something solid


def farthest_points(voxels: FreeVoxels, viewpoints: F64, buries: Callable[[F64], NDArray[np.bool_]]) -> Iterator[F64]:
    """Yield points (3,) of a cell, each as far as possible from the viewpoints and the points before it.

    Args:
        voxels: Where eyes may be in the cell.
        viewpoints: (V, 3) what was looked from; without any, the first point is on the rim of the cell.
        buries: Returns which points (P, 3) lie inside something solid; these are left out.
    """
    points = voxels.rim()
    near = viewpoints if len(viewpoints) else points.mean(axis=0, keepdims=True)
    apart = np.full(len(points), np.inf)
    for each in near:
        apart = np.minimum(apart, np.sum((points - each) ** 2, axis=1))
    skipped = 0
    while apart.max() > 0.0 and skipped <= _SKIPPED:
        first = int(apart.argmax())
        point = points[first]
        if buries(point[None])[0]:
            skipped += 1
        else:
            yield point
        apart = np.minimum(apart, np.sum((points - point) ** 2, axis=1))
        apart[first] = 0.0
