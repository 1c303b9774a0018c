"""Find the Gaussians that one viewpoint sees, by rays, cubemap images, or the hybrid of paper section 6.2.

Each method gives the largest weight of each Gaussian over six faces of `size` x `size` pixels or rays around the
viewpoint. World frame, scene units.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.errors import SceneError
from gsvis.raycast.proxies import MIN_ALPHA
from gsvis.scene.gaussians import Gaussians

__all__ = ["METHODS", "Look", "LookOptions", "Sight"]

METHODS = ("hybrid", "raster", "raycast")

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Mask = NDArray[np.bool_]

_MARGIN = 0.1  # of the hull

Sight = tuple[I64, F32]
"""Ids (K,) of the Gaussians found, ascending, and their largest weights (K,)."""


@dataclass(frozen=True, eq=False, kw_only=True)
class LookOptions:
    """What an eye looks for in N Gaussians, and where.

    Attributes:
        size: Pixels or rays along a side of the faces.
        floor: Least weight of what is found.
        faint: Fainter ones are found too if they have a weight of at least this; None for none.
        hull: Whether the hybrid asks the hull where it is in doubt; without it, it decides by the z-buffer alone.
        squares: Squares of pixels in which the hybrid looks, from `Look.squares` of the same size, without a hull.
            Other methods look everywhere. None is everywhere.
        known: (N,) mask of Gaussians that need not be found, which saves the hybrid time: it leaves them out; None for
            none.
    """

    size: int
    floor: float
    faint: float | None = None
    hull: bool = True
    squares: Mask | None = None
    known: Mask | None = None

    @property
    def least(self) -> float:
        """Least weight of all that is found."""
        return self.floor if self.faint is None else min(self.floor, self.faint)


_See = Callable[[F64, LookOptions], Sight]


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
        self.options = LookOptions(size=size, floor=floor)
        see: dict[str, Callable[[Gaussians], _See]] = {"hybrid": _Hybrid, "raster": _Raster, "raycast": _Raycast}
        self._see = see[method](g)

    def __call__(self, viewpoint: F64, options: LookOptions | None = None) -> Sight:
        """Return the Gaussians that an eye at `viewpoint` (3,) sees; `options` replace the size and the floor."""
        return self._see(viewpoint, options or self.options)

    def squares(self, viewpoint: F64, ids: I64, size: int) -> Mask | None:
        """Return the squares of pixels around an eye (3,) that Gaussians (K,) may reach; None is everywhere."""
        return self._see.squares(viewpoint, ids, size) if isinstance(self._see, _Hybrid) else None


class _Hybrid:
    def __init__(self, g: Gaussians) -> None:
        from gsvis.hpr import Splats

        self.gaussians = g
        self.splats = Splats.from_gaussians(g)

    def squares(self, viewpoint: F64, ids: I64, size: int) -> Mask:
        """Return the squares that Gaussians may reach."""
        from gsvis.hpr import squares_around

        return squares_around(self.splats, viewpoint, ids, size)

    def __call__(self, viewpoint: F64, options: LookOptions) -> Sight:
        from gsvis.hpr import Search, hybrid

        seen = hybrid(
            self.gaussians,
            self.splats,
            viewpoint,
            size=options.size,
            tau=options.floor,
            faint=options.faint,
            margin=_MARGIN if options.hull else None,
            search=Search(squares=options.squares, known=options.known),
        )
        return seen.ids, seen.weights


class _Raster:
    def __init__(self, g: Gaussians) -> None:
        self.gaussians = g

    def __call__(self, viewpoint: F64, options: LookOptions) -> Sight:
        from gsvis.render import view_weights
        from gsvis.scene.cameras import Cameras

        cameras = Cameras.cubemap(viewpoint[None], options.size)
        largest = view_weights(self.gaussians, cameras).largest.max(axis=0)
        ids = np.flatnonzero(largest >= options.least)
        return ids, largest[ids]


class _Raycast:
    def __init__(self, g: Gaussians) -> None:
        from gsvis.raycast import EllipsoidProxies, Tracer

        self.tracer = Tracer(EllipsoidProxies.from_scene(g))

    def __call__(self, viewpoint: F64, options: LookOptions) -> Sight:
        from gsvis.raycast import visible_from

        largest = visible_from(self.tracer, viewpoint[None], size=options.size)[0]
        ids = np.flatnonzero(largest >= options.least)
        return ids, largest[ids]
