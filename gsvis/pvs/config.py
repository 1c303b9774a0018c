"""Define the options of a build of visible sets: the method of looking, and when a cell is finished."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.pvs.look import METHODS
from gsvis.raycast.tracer import TAU, TRACERS

__all__ = ["PvsConfig"]

F64 = NDArray[np.float64]


@dataclass(frozen=True)
class PvsConfig:
    """Options of a build of visible sets.

    Attributes:
        method: "hybrid" (z-buffer and hidden point removal), "raster" (weights of cubemap images) or "raycast".
        tau: Weight in (0, 1) from which a Gaussian is visible.
        size: Pixels or rays along a side of the six faces around a viewpoint; up to half of the shared viewpoints of a
            cell use half of it. Coarse pixels close gaps through which finer pixels see. So do not make it
            much coarser than the images that a viewer shows.
        lower_size: The same on lower levels, whose Gaussians are larger, if it is below `size`.
        limit: A cell is finished when the upper 95% confidence bound of the share of light that its set misses is at
            most this.
        tile_limit: A finished cell also has no tile of 16 x 16 pixels around the worst rays that misses more light than
            this.
        rays: Most rays of a certificate. 0 certifies nothing: sets stay as viewpoints found them.
        tracer: What traces these rays: one of `TRACERS`.
        max_inner: Largest number of times that a set is repaired and certified again. A set that is still above the
            limits is kept, with its bound.
        probes: Largest number of coarse looks at the highest level, from the tips of a cell and from points far from
            its viewpoints. If one finds missing light, its eye looks at `size`. 0 for none.
        class_ratio: Lowest weight of a class over that of the class below. The lowest class begins at tau.
    """

    method: str = "hybrid"
    tau: float = TAU
    size: int = 768
    lower_size: int = 320
    limit: float = 0.0015
    tile_limit: float = 0.1
    rays: int = 8192
    tracer: str = "hierarchy"
    max_inner: int = 16
    probes: int = 16
    class_ratio: float = 4.0

    def __post_init__(self) -> None:
        _check.one_of("method", self.method, METHODS)
        _check.one_of("tracer", self.tracer, TRACERS)
        for name, value, low, high in (
            ("tau", self.tau, 1e-6, 0.5),
            ("size", self.size, 4, 4096),
            ("lower_size", self.lower_size, 4, 4096),
            ("limit", self.limit, 1e-6, 1.0),
            ("tile_limit", self.tile_limit, 1e-6, 1.0),
            ("class_ratio", self.class_ratio, 1.25, 1e6),
        ):
            if not low <= value <= high:
                raise ValueError(f"{name}: expected a value in [{low:g}, {high:g}], got {value!r}")
        for name, least in (("size", 1), ("lower_size", 1), ("rays", 0), ("max_inner", 0), ("probes", 0)):
            _check.positive_int(name, getattr(self, name), at_least=least)

    @property
    def class_edges(self) -> F64:
        """(K,) lowest weight of each class, ascending from tau."""
        count = max(1, math.ceil(math.log(1.0 / self.tau) / math.log(self.class_ratio) - 1e-9))
        return np.asarray(self.tau * self.class_ratio ** np.arange(min(count, 16)))

    def as_dict(self) -> dict[str, Any]:
        """Return the options as plain numbers and strings."""
        return asdict(self)
