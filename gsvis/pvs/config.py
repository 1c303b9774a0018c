"""Potentially visible sets: for each cell the Gaussians that some viewpoint in it sees (paper, section 6.2).

Viewpoints are added to a cell, its rim first, until the set has stopped growing, so that the stopping rule and not
luck decides how much is found. Here is what one cell sees; `build.py` does it for all cells. Scene frame and units.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.pvs._kernels import cell as kernels
from gsvis.pvs.look import METHODS, Look
from gsvis.raycast.directions import NUM_FACES, face_planes
from gsvis.raycast.tracer import TAU
from gsvis.scene.solid import buried

__all__ = ["CellView", "PvsConfig", "see_cell"]

F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]
I32 = NDArray[np.int32]


@dataclass(frozen=True)
class PvsConfig:
    """How visible sets are found.

    Attributes:
        method: "hybrid" (z-buffer and hidden point removal), "raster" (weights of cubemap images) or "raycast".
        tau: Weight in (0, 1) from which a Gaussian is visible.
        size: Pixels or rays along a side of the six faces around a viewpoint. Coarse pixels close the gaps through
            which finer ones see, so it should not be much coarser than the images that will be shown.
        growth: A cell is done when each of the last `patience` viewpoints made its set grow by at most this share.
        patience: Viewpoints that must bring little.
        min_viewpoints: Viewpoints of a cell that are always looked from.
        max_viewpoints: Viewpoints after which a cell is done in any case.
        class_ratio: Each weight class begins at this many times the weight of the one below; the lowest at tau.
    """

    method: str = "hybrid"
    tau: float = TAU
    size: int = 320
    growth: float = 0.01
    patience: int = 2
    min_viewpoints: int = 6
    max_viewpoints: int = 24
    class_ratio: float = 4.0

    def __post_init__(self) -> None:
        _check.one_of("method", self.method, METHODS)
        for name, value, low, high in (
            ("tau", self.tau, 1e-6, 0.5),
            ("size", self.size, 4, 4096),
            ("growth", self.growth, 0.0, 1.0),
            ("class_ratio", self.class_ratio, 1.25, 1e6),
        ):
            if not low <= value <= high:
                raise ValueError(f"{name}: expected a value in [{low:g}, {high:g}], got {value!r}")
        for name in ("size", "patience", "min_viewpoints", "max_viewpoints"):
            _check.positive_int(name, getattr(self, name))
        if self.max_viewpoints < self.min_viewpoints:
            raise ValueError(
                f"max_viewpoints: expected at least min_viewpoints, {self.min_viewpoints}, got {self.max_viewpoints}"
            )

    @property
    def class_edges(self) -> F64:
        """(K,) lowest weight of each class, rising from tau."""
        count = max(1, math.ceil(math.log(1.0 / self.tau) / math.log(self.class_ratio) - 1e-9))
        return np.asarray(self.tau * self.class_ratio ** np.arange(min(count, 16)))

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers and strings."""
        return asdict(self)


@dataclass(frozen=True, eq=False)
class CellView:
    """What one cell sees.

    Attributes:
        ids: (V,) int32, visible Gaussians, rising.
        classes: (V,) uint8, class of the largest weight found.
        directions: (V, 10) uint8, directions toward the viewpoints that saw each.
        viewpoints: Viewpoints looked from; 0 if all were buried in something solid.
        growth: Share by which the last of them made the set grow.
    """

    ids: I32
    classes: U8
    directions: U8
    viewpoints: int
    growth: float


def see_cell(look: Look, viewpoints: F64, config: PvsConfig) -> CellView:
    """The set of one cell.

    Args:
        look: The scene, ready.
        viewpoints: (V, 3) in the order in which they are added; those buried in something solid are left out.
        config: When to stop.
    """
    g = look.gaussians
    best = np.zeros(len(g), np.float32)
    sets = np.zeros((len(g), NUM_FACES // 8), np.uint8)
    tau = np.float32(config.tau)
    planes = face_planes()
    used, visible, calm, share = 0, 0, 0, 0.0
    for viewpoint in viewpoints[~buried(g, viewpoints)][: config.max_viewpoints]:
        ids, weights = look(viewpoint)
        new = kernels.add_viewpoint(ids, weights, tau, g.means, viewpoint, *planes, best, sets)
        used, visible = used + 1, visible + new
        share = new / visible if visible else 0.0
        calm = calm + 1 if share <= config.growth else 0
        if used >= config.min_viewpoints and calm >= config.patience:
            break
    found = np.flatnonzero(best >= tau)
    edges = config.class_edges.astype(np.float32)
    classes = np.searchsorted(edges, best[found], side="right") - 1
    return CellView(found.astype(np.int32), classes.astype(np.uint8), sets[found], used, float(share))
