"""What may be sent to a viewer outside of all cells: more than the nearest cell sees, by the distance.

No visible set was computed for such an eye. The set of the nearest cell says less the farther the eye is outside. So
nearby cells and then all Gaussians are added, with weights that rise with the distance, and the weights of the nearest
cell move toward their mean. Distances are in sides of the nearest cell, rounded to a few steps, so that viewers at the
same step share what is computed. Step 0 is inside: nothing is added.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gsvis.abr._kernels.units import Seen
from gsvis.abr.index import SceneIndex
from gsvis.abr.rings import Shells
from gsvis.abr.seen import SeenSets
from gsvis.pvs.codec import ids_in

__all__ = ["STEPS", "Widened", "distance_step", "near_cells", "uncertainty", "widen", "widened_weights"]

F32 = NDArray[np.float32]

_BORDERS = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)  # upper borders of steps 1 to 6, in sides of a cell; step 7 has none
_INSIDE = 1e-6  # sides of a cell by which rounding may move an eye out of it
_CLASSES = 254  # of a cell, so that two more are numbers of 8 bits
_SHELLS = 8  # shells with nearby cells at most: a viewer may have to wait until all their sets are read

STEPS = len(_BORDERS) + 2
"""Number of steps, step 0 included."""


class Widened(NamedTuple):
    """The Gaussians of a widened cell.

    Attributes:
        members: The Gaussians.
        classes: (V,) uint8 class of each, in rising order of ids.
        weights: (K + 2,) weight of each class: the K classes of the scene, what only nearby cells see, the rest.
    """

    members: Seen
    classes: NDArray[np.uint8]
    weights: F32


def distance_step(index: SceneIndex, cell: int, position: NDArray[np.float64]) -> int:
    """Return the distance of a position (3,) from a cell as a step in [0, `STEPS`); 0 inside the cell."""
    low, side = index.grid.box_of(cell)
    away = [max(first - at, at - first - side, 0.0) for first, at in zip(low, position.tolist(), strict=True)]
    sides = math.hypot(*away) / side
    return 0 if sides <= _INSIDE else 1 + bisect_left(_BORDERS, sides)


def uncertainty(step: int) -> float:
    """Return how unsure the visible set of the nearest cell is for an eye at a step: 0 inside, 1 far outside."""
    if step == 0:
        return 0.0
    return 1.0 if step > len(_BORDERS) else _BORDERS[step - 1] / (1.0 + _BORDERS[step - 1])


def widened_weights(class_weights: F32, step: int) -> F32:
    """Return the weights (K + 2,) of a widened cell at a step; see `Widened.weights`."""
    share = uncertainty(step)
    mean = float(np.mean(class_weights))
    weights = class_weights[:_CLASSES]
    own = weights + share * share * (mean - weights)
    return np.append(own, [share * mean, share * share * mean]).astype(np.float32)


def near_cells(index: SceneIndex, shells: Shells, cell: int, step: int) -> list[int]:
    """Return the cells within about the distance of an eye from a cell, the nearest first, up to 8 shells."""
    reach = np.inf if step > len(_BORDERS) else (1.0 + _BORDERS[step - 1]) * index.grid.box_of(cell)[1]
    found = [other for k in range(min(_SHELLS, shells.count(cell))) for other in shells.cells(cell, k)]
    centers = index.grid.centers
    return [other for other in found if np.linalg.norm(centers[other] - centers[cell]) <= reach]


def widen(index: SceneIndex, seen: SeenSets, cells: list[int], step: int, every: Seen | None) -> Widened:
    """Return the Gaussians of a widened cell.

    Args:
        index: The scene.
        seen: Its visible sets.
        cells: The cell and those near it, see `near_cells`.
        step: Distance of the eye from the cell, a step >= 1.
        every: All Gaussians; None leaves out those that none of these cells sees, for a large scene.
    """
    near = seen.join([[seen.of_cell(cell) for cell in cells]])[1]
    members = near if every is None else every
    ids = ids_in(*members)
    kinds = min(len(index.class_weights), _CLASSES)
    classes = np.full(len(ids), kinds + 1, np.uint8)
    classes[np.searchsorted(ids, ids_in(*near))] = kinds
    own, of_own = index.sets.classes(cells[0])
    classes[np.searchsorted(ids, own)] = np.minimum(of_own, kinds - 1)
    return Widened(members, classes, widened_weights(index.class_weights, step))
