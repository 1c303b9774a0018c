"""Trace rays against the charts of the flat: whether they are blocked, and which chart they hit.

Every chart becomes triangles; a triangle knows its chart and the (u, v) of its corners.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.scene.flat.charts import Chart

__all__ = ["Rays"]

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Mask = NDArray[np.bool_]

BENDS = 8  # cells along each side of a curved chart
OFF = 0.004  # meters between a surface and the rays that start on it


class Rays:
    """Trace rays with Embree.

    Args:
        charts: The surfaces.
    """

    def __init__(self, charts: Sequence[Chart]) -> None:
        from embreex.mesh_construction import TriangleMesh  # slow to import, seldom needed
        from embreex.rtcore_scene import EmbreeScene

        corners = []
        owners = []
        places = []
        for i, chart in enumerate(charts):
            uv = _triangles(chart)
            flat = uv.reshape(-1, 2)
            corners.append(chart.place(flat[:, 0], flat[:, 1]).reshape(-1, 3, 3))
            owners.append(np.full(len(uv), i))
            places.append(uv)
        self._scene: Any = EmbreeScene()
        self._mesh = TriangleMesh(self._scene, np.concatenate(corners).astype(np.float32))
        self._owners: I64 = np.concatenate(owners)
        self._places: F64 = np.concatenate(places)

    def blocked(self, starts: F64, ends: F64) -> Mask:
        """Return a mask (n,): whether a surface lies between (n, 3) starts and (n, 3) ends."""
        way = (ends - starts).astype(np.float32)
        reach = np.full(len(way), 0.999, np.float32)
        return np.asarray(self._scene.run(starts.astype(np.float32), way, dists=reach, query="OCCLUDED") >= 0)

    def hits(self, starts: F64, directions: F64) -> tuple[I64, F64]:
        """Return the chart (n,) that each ray meets first, -1 for none, and (n, 2) the place on it."""
        found = self._scene.run(starts.astype(np.float32), directions.astype(np.float32), output=1)
        triangle = np.asarray(found["primID"], np.int64)
        met = triangle >= 0
        safe = np.where(met, triangle, 0)
        first = found["u"][:, None].astype(np.float64)
        second = found["v"][:, None].astype(np.float64)
        corners = self._places[safe]
        where = corners[:, 0] * (1.0 - first - second) + corners[:, 1] * first + corners[:, 2] * second
        return np.where(met, self._owners[safe], -1), where


def _triangles(chart: Chart) -> F64:
    """Return (T, 3, 2) corners in (u, v) of the triangles of a chart, its holes left out."""
    cells = BENDS if chart.bend > 0.0 else 1
    if not chart.holes:
        return _whole(cells)
    lines: list[F64] = []
    for axis in range(2):
        ends = [hole[axis + 2 * k] / chart.size[axis] for hole in chart.holes for k in range(2)]
        lines.append(np.unique(np.clip([*np.linspace(0.0, 1.0, cells + 1), *ends], 0.0, 1.0)))
    u, v = lines
    low = np.stack(np.meshgrid(u[:-1], v[:-1], indexing="ij"), axis=-1).reshape(-1, 2)
    high = np.stack(np.meshgrid(u[1:], v[1:], indexing="ij"), axis=-1).reshape(-1, 2)
    middle = 0.5 * (low + high) * np.array(chart.size)
    kept = np.ones(len(low), bool)
    for u0, v0, u1, v1 in chart.holes:
        kept &= ~((middle > (u0, v0)) & (middle < (u1, v1))).all(axis=1)
    return _halves(low[kept], high[kept])


@cache
def _whole(cells: int) -> F64:
    """Return (T, 3, 2) corners of the triangles of a chart without holes."""
    steps = np.linspace(0.0, 1.0, cells + 1)
    low = np.stack(np.meshgrid(steps[:-1], steps[:-1], indexing="ij"), axis=-1).reshape(-1, 2)
    return _halves(low, low + 1.0 / cells)


def _halves(low: F64, high: F64) -> F64:
    """Return (T, 3, 2) corners of two triangles for each rectangle."""
    other = np.stack([high[:, 0], low[:, 1]], axis=1)
    last = np.stack([low[:, 0], high[:, 1]], axis=1)
    return np.concatenate([np.stack([low, other, high], axis=1), np.stack([low, high, last], axis=1)])
