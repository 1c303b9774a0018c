"""Find the Gaussians that one viewpoint sees, by rays, cubemap images, or the hybrid of paper section 6.2.

Each method gives the largest weight of each Gaussian over six faces of `size` x `size` pixels or rays around the
viewpoint. World frame, scene units.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.errors import SceneError
from gsvis.raycast.proxies import MIN_ALPHA
from gsvis.scene.gaussians import Gaussians

__all__ = ["METHODS", "Look", "Sight"]

METHODS = ("hybrid", "raster", "raycast")

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

Sight = tuple[I64, F32]
"""Ids (K,) of the Gaussians found, ascending, and their largest weights (K,)."""

_See = Callable[[F64, int, float, float, bool], Sight]


class Look:
    """A scene prepared for one method of finding what viewpoints see.

    Args:
        g: The scene.
        method: "hybrid", "raster" or "raycast".
        size: Pixels or rays along a side of the faces.
        floor: Least weight; Gaussians below it are left out.

    Raises:
        SceneError: If no Gaussian has an opacity of at least 1/255.
        ValueError: If the method is unknown.
    """

    def __init__(self, g: Gaussians, method: str, size: int, floor: float) -> None:
        _check.one_of("method", method, METHODS)
        if not (g.opacities >= MIN_ALPHA).any():
            raise SceneError("the scene has no Gaussian with an opacity of at least 1/255: there is nothing to see")
        self.gaussians = g
        self.size = size
        self.floor = floor
        see: dict[str, Callable[[Gaussians], _See]] = {"hybrid": _Hybrid, "raster": _Raster, "raycast": _Raycast}
        self._see = see[method](g)

    def __call__(
        self,
        viewpoint: F64,
        *,
        size: int | None = None,
        floor: float | None = None,
        faint: float | None = None,
        hull: bool = True,
    ) -> Sight:
        """Return the Gaussians that an eye at `viewpoint` (3,) sees; `size` and `floor` replace the defaults.

        Gaussians fainter than `floor` are returned too if they have a weight of `faint` or more. Without `hull`, the
        hybrid decides by the z-buffer alone.
        """
        floor = floor or self.floor
        return self._see(viewpoint, size or self.size, floor, faint or floor, hull)


class _Hybrid:
    def __init__(self, g: Gaussians) -> None:
        from gsvis.hpr import Splats

        self.gaussians = g
        self.splats = Splats.from_gaussians(g)

    def __call__(self, viewpoint: F64, size: int, floor: float, faint: float, hull: bool) -> Sight:
        from gsvis.hpr import hybrid

        seen = hybrid(self.gaussians, self.splats, viewpoint, size=size, tau=floor, faint=faint, hull=hull)
        return seen.ids, seen.weights


class _Raster:
    def __init__(self, g: Gaussians) -> None:
        self.gaussians = g

    def __call__(self, viewpoint: F64, size: int, floor: float, faint: float, hull: bool) -> Sight:
        from gsvis.render import view_weights
        from gsvis.scene.cameras import Cameras

        largest = view_weights(self.gaussians, Cameras.cubemap(viewpoint[None], size)).largest.max(axis=0)
        ids = np.flatnonzero(largest >= min(floor, faint))
        return ids, largest[ids]


class _Raycast:
    def __init__(self, g: Gaussians) -> None:
        from gsvis.raycast import EllipsoidProxies, Tracer

        self.tracer = Tracer(EllipsoidProxies.from_scene(g))

    def __call__(self, viewpoint: F64, size: int, floor: float, faint: float, hull: bool) -> Sight:
        from gsvis.raycast import visible_from

        largest = visible_from(self.tracer, viewpoint[None], size=size)[0]
        ids = np.flatnonzero(largest >= min(floor, faint))
        return ids, largest[ids]
