"""What a viewer outside of all cells may be sent: what the nearest cell sees, widened by the distance.

No cell says what such an eye sees. The farther it is outside, the less the nearest cell tells, so weights fall to plain
importance: what nearby cells see comes first, then all Gaussians, at a share that rises with the distance. Distances
are in sides of the nearest cell, and a few steps of them share what is computed. Step 0 is inside: nothing changes.
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

__all__ = ["STEPS", "Widened", "near_cells", "share_of", "step_of", "weights_of", "widen"]

F32 = NDArray[np.float32]

_BORDERS = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)  # of the steps, in sides of a cell; the last step has none
_INSIDE = 1e-6  # sides of a cell by which rounding may move an eye out of it
_CLASSES = 254  # of a cell, so that two more are numbers of 8 bits
_SHELLS = 8  # whose cells are near: their sets may all have to be read while a viewer waits

STEPS = len(_BORDERS) + 2
"""Number of steps, that of inside among them."""


class Widened(NamedTuple):
    """The Gaussians of a widened cell.

    Attributes:
        members: The Gaussians.
        classes: (V,) uint8 class of each, in rising order of ids.
        weights: (K + 2,) weight of each class: those of the scene, of what nearby cells see, of all others.
    """

    members: Seen
    classes: NDArray[np.uint8]
    weights: F32


def step_of(index: SceneIndex, cell: int, position: NDArray[np.float64]) -> int:
    """Return how far a position (3,) is outside of a cell, as one of `STEPS` steps; 0 inside."""
    low, side = index.grid.box_of(cell)
    away = [max(first - at, at - first - side, 0.0) for first, at in zip(low, position.tolist(), strict=True)]
    sides = math.hypot(*away) / side
    return 0 if sides <= _INSIDE else 1 + bisect_left(_BORDERS, sides)


def share_of(step: int) -> float:
    """Return how much of what the nearest cell tells is not true of an eye: 0 inside, 1 far outside."""
    if step == 0:
        return 0.0
    return 1.0 if step > len(_BORDERS) else _BORDERS[step - 1] / (1.0 + _BORDERS[step - 1])


def weights_of(class_weights: F32, step: int) -> F32:
    """Return the weights (K + 2,) of classes (K,) at a step, of what nearby cells see, and of all others."""
    share = share_of(step)
    mean = float(np.mean(class_weights))
    weights = class_weights[:_CLASSES]
    own = weights + share * share * (mean - weights)
    return np.append(own, [share * mean, share * share * mean]).astype(np.float32)


def near_cells(index: SceneIndex, shells: Shells, cell: int, step: int) -> list[int]:
    """Return the cells that are about as near to a cell as an eye is, the nearest first; of many, the nearest ones."""
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
        step: How far outside the eye is, at least 1.
        every: All Gaussians; None leaves out what none of these cells sees, in a large scene.
    """
    near = seen.join([[seen.of_cell(cell) for cell in cells]])[1]
    members = near if every is None else every
    ids = ids_in(*members)
    kinds = min(len(index.class_weights), _CLASSES)
    classes = np.full(len(ids), kinds + 1, np.uint8)
    classes[np.searchsorted(ids, ids_in(*near))] = kinds
    own, of_own = index.sets.classes(cells[0])
    classes[np.searchsorted(ids, own)] = np.minimum(of_own, kinds - 1)
    return Widened(members, classes, weights_of(index.class_weights, step))
