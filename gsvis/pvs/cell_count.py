"""Choose the number of cells: fewer where an eye sees most of a scene, or where larger cells hardly see more.

Smaller cells have smaller sets, and each costs looks and a certificate. Around an object and outdoors neighbors may see
nearly the same, so that a quarter of the cells have sets that are hardly larger (docs/design/053). World frame.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.look import Look
from gsvis.pvs.viewpoints import CellViewpoints
from gsvis.raycast.proxies import MIN_ALPHA
from gsvis.raycast.tracer import TAU
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace

__all__ = ["FEWER_CELLS", "MOST_CELLS", "fitting_cells"]

MOST_CELLS = 128  # most cells of a package, unless somebody asks for another number
FEWER_CELLS = {"object": 32, "open place": 64}  # most by kind of space, where sets hardly grow

_EYES = 8  # eyes whose cells are compared
_VIEWPOINTS = 4  # of each of these cells
_SIZE = 128  # pixels along a side of the faces around a viewpoint
_MUCH = {"object": 0.4, "open place": 0.5}  # share of a scene that an eye sees, mean, from which fewer are enough
_LARGER = 1.1  # size of the sets of fewer cells over that of four times as many, up to which fewer are enough


def fitting_cells(g: Gaussians, space: NavigableSpace, most: int, fewer: Mapping[str, int]) -> int:
    """Return the number of cells for a space: `most`, or fewer where more would hardly make sets smaller.

    Args:
        g: The scene, N Gaussians.
        space: Its navigable space. Rooms and spaces that were given keep all cells.
        most: Most cells, at least 1.
        fewer: Fewer cells for "object" and for "open place", each at least 1.

    Returns:
        Fewer in an open place of which one eye sees at least half, and around an object of which it sees 40%, or
        whose sets are at most a tenth larger than those of four times as many cells. Else `most`, as where fewer are
        not less.

    Raises:
        ValueError: If a number is below 1.
    """
    _check.positive_int("most", most)
    for each, count in fewer.items():
        _check.positive_int(f"fewer, {each}", count)
    kind = space.kind.kind
    few = fewer.get(kind, most)
    if few >= most:
        return most
    bright = np.count_nonzero(g.opacities >= MIN_ALPHA)
    if not bright:
        return most
    look = Look(g, "hybrid", _SIZE, TAU)
    if _count_seen_by_one(look, space) >= _MUCH[kind] * bright:
        return few
    if kind != "object":
        return most
    eyes = _spread_eyes(space)
    in_small, in_large = (
        _count_seen(look, CellGrid.over(space, max_cells=cells), space, eyes) for cells in (4 * few, few)
    )
    return few if in_large <= _LARGER * in_small else most


def _count_seen_by_one(look: Look, space: NavigableSpace) -> float:
    """Return the mean number of Gaussians that an eye sees, over a few eyes."""
    grid = CellGrid.over(space, max_cells=4 * _EYES)
    viewpoints = CellViewpoints(grid, space)
    some = np.unique(np.arange(_EYES) * len(grid) // _EYES).tolist()
    return float(np.mean([len(look(viewpoints.spread(cell, 1)[0])[0]) for cell in some]))


def _spread_eyes(space: NavigableSpace) -> NDArray[np.float64]:
    """Return (E, 3) eyes in free voxels, evenly spread along their order."""
    free = np.argwhere(space.free)
    some = free[(2 * np.arange(_EYES) + 1) * len(free) // (2 * _EYES)]
    return np.asarray(space.origin + space.voxel_size * (some + 0.5))


def _count_seen(look: Look, grid: CellGrid, space: NavigableSpace, eyes: NDArray[np.float64]) -> int:
    """Return the number of Gaussians that the cells of some eyes see from a few viewpoints, summed."""
    viewpoints = CellViewpoints(grid, space)
    total = 0
    for cell in grid.cell_at(eyes).tolist():
        seen = [look(each)[0] for each in viewpoints.spread(cell, _VIEWPOINTS)]
        total += len(np.unique(np.concatenate(seen)))
    return total
