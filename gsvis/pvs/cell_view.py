"""Find the visible set of one cell: the Gaussians that some viewpoint in it sees (paper, section 6.2).

Viewpoints are added, the rim of the cell first, until the set stops growing. The stopping rule decides how complete
the set is. `build.py` does this for all cells. Scene frame and units.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsvis.pvs._kernels import cell as kernels
from gsvis.pvs.config import PvsConfig
from gsvis.pvs.look import Look
from gsvis.raycast.directions import NUM_FACES, face_planes
from gsvis.scene.solid import buried

__all__ = ["CellView", "see_cell"]

F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]
I32 = NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class CellView:
    """The visible set of one cell, with its direction sets.

    Attributes:
        ids: (V,) int32, visible Gaussians, ascending.
        classes: (V,) uint8, class of the largest weight found.
        directions: (V, 10) uint8, direction set of each Gaussian: toward the viewpoints that saw it.
        viewpoints: Number of viewpoints used; 0 if all lay inside something solid.
        growth: Share by which the last viewpoint made the set grow.
    """

    ids: I32
    classes: U8
    directions: U8
    viewpoints: int
    growth: float


def see_cell(look: Look, viewpoints: F64, config: PvsConfig) -> CellView:
    """Return the view of one cell.

    Args:
        look: The prepared scene.
        viewpoints: (V, 3) in the order in which they are added; viewpoints inside something solid are skipped.
        config: The stopping rule, tau and the weight classes.
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
