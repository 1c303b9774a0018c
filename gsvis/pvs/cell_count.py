"""How many cells a space is worth: fewer where an eye sees much of a small scene from anywhere. World frame.

Smaller cells have smaller sets, and each costs a look and a certificate. From around an object neighbors see nearly the
same, so that a quarter of the cells have sets that are hardly larger (docs/design/053).
"""

from __future__ import annotations

import numpy as np

from gsvis import _check
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.look import Look
from gsvis.pvs.viewpoints import CellViewpoints
from gsvis.raycast.proxies import MIN_ALPHA
from gsvis.raycast.tracer import TAU
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace

__all__ = ["MOST_CELLS", "fitting_cells"]

MOST_CELLS = 256  # most cells of a space, unless somebody asks for another number

_EYES = 8
_SIZE = 128  # pixels along a side of the faces around an eye
_MUCH = 0.4  # share of a scene that an eye sees, mean, from which fewer cells are enough
_FEWER = 4


def fitting_cells(g: Gaussians, space: NavigableSpace, most: int) -> int:
    """Return how many cells to divide a space into: `most`, or a quarter where an eye around an object sees 40% of it.

    Args:
        g: The scene, N Gaussians.
        space: Its navigable space. Only where it was found to be around an object are there fewer cells.
        most: Most cells, at least 1.

    Raises:
        ValueError: If `most` is below 1.
    """
    _check.positive_int("most", most)
    if space.kind.kind != "object" or most < _FEWER:
        return most
    bright = np.count_nonzero(g.opacities >= MIN_ALPHA)
    if not bright:
        return most
    grid = CellGrid.over(space, max_cells=4 * _EYES)
    viewpoints, look = CellViewpoints(grid, space), Look(g, "hybrid", _SIZE, TAU)
    some = np.unique(np.arange(_EYES) * len(grid) // _EYES).tolist()
    seen = [len(look(viewpoints.spread(cell, 1)[0])[0]) for cell in some]
    return most // _FEWER if np.mean(seen) >= _MUCH * bright else most
