"""Leave out Gaussians until views hold a budget: those first whose loss changes pictures least for what they cost.

The cost of a Gaussian is the share of the budget that it takes in views that are over it: of the splats one each, of
the fill the pixels that it covers. Its worth is the squared change of pictures without it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from gsvis.errors import SceneError
from gsvis.progress import Progress, silent
from gsvis.render.fill import view_fill
from gsvis.render.removal import removal_effects
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians

__all__ = ["Limits", "Load", "Pictures", "excess", "look", "shares", "shed"]

F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

_STEP = 0.2  # most of the cost that goes at a time; then the worth of what is left is measured again
_STAY = 0.25  # share of what goes of which the worth of others knows
_AROUND = 0.1  # weight of pictures all around
_TURNS = 3  # later measures take every third view


class Limits(Protocol):
    """What a view may have at most."""

    def share(self, splats: F64, mean: F64) -> F64:
        """Return the share of the budget that views take; above 1 it does not hold."""
        ...

    def cost(self, covered: NDArray[np.float32]) -> F64:
        """Return the share of the budget of a view that each splat takes, from the share of pixels that it covers."""
        ...


class Pictures(NamedTuple):
    """Cameras of the pictures that count: views as visitors have them, and views all around, which count less."""

    views: Cameras
    around: Cameras


class Load(NamedTuple):
    """The Gaussians that cover a pixel of one view, and the share of the pixels that each covers."""

    ids: NDArray[np.int32]
    covered: NDArray[np.float32]


def look(g: Gaussians, cameras: Cameras, progress: Progress = silent) -> list[Load]:
    """Return what each of C views has; progress has stage "fill"."""
    loads = []
    progress("fill", 0, len(cameras))
    for c in range(len(cameras)):
        found = view_fill(g, cameras[c])
        loads.append(Load(found.ids.astype(np.int32), (found.covered / found.fill.size).astype(np.float32)))
        progress("fill", c + 1, len(cameras))
    return loads


def shares(loads: Sequence[Load], limits: Limits) -> F64:
    """Return the share of the budget that each view takes."""
    splats = np.array([len(each.ids) for each in loads], np.float64)
    return limits.share(splats, np.array([each.covered.sum() for each in loads], np.float64))


def excess(loads: Sequence[Load], limits: Limits, most: float) -> float:
    """Return the share that has to go from the heaviest view until it takes `most` of the budget; 0 if none has to."""
    largest = float(shares(loads, limits).max(initial=0.0))
    return max(0.0, 1.0 - most / largest) if largest > most else 0.0


def shed(
    g: Gaussians,
    loads: list[Load],
    limits: Limits,
    most: float,
    pictures: Pictures,
    progress: Progress = silent,
) -> tuple[Gaussians, list[Load]]:
    """Return a scene of which each view takes at most a share of its budget, and what its views have.

    Args:
        g: N Gaussians.
        loads: What its views have.
        limits: The budget.
        most: The share of it.
        pictures: Cameras whose pictures say what a Gaussian is worth.
        progress: Called with stage "removal", in views.

    Raises:
        SceneError: If nothing would be left.
    """
    turn = 0
    while (too_much := excess(loads, limits, most)) > 0.0:
        goes = min(_STEP, too_much)
        worth = _worth(g, pictures, turn, goes, progress)
        kept = _choose(worth, loads, limits, most, goes)
        if not kept.any():
            raise SceneError("budget: no Gaussian would be left; allow more splats or more fill")
        g = g[kept]
        loads = _keep(loads, kept)
        turn += 1
    return g, loads


def _worth(g: Gaussians, pictures: Pictures, turn: int, goes: float, progress: Progress) -> F64:
    """Return the squared change of pictures without each Gaussian, while others are there as far as they will stay."""
    presence = np.full(len(g), 1.0 - (1.0 - _STAY) * goes, np.float32)
    worth = np.zeros(len(g))
    for cameras, weight in ((pictures.views, 1.0), (pictures.around, _AROUND)):
        some = cameras if turn == 0 else cameras[np.arange(turn % _TURNS, len(cameras), _TURNS)]
        effects = removal_effects(g, some, presence=presence, progress=progress)
        worth += weight * effects.squared / max(len(some), 1)
    return worth


def _choose(worth: F64, loads: Sequence[Load], limits: Limits, most: float, goes: float) -> Mask:
    """Return which Gaussians stay when a share of the cost of views over the budget goes, and one at least."""
    cost = np.zeros(len(worth))
    for share, load in zip(shares(loads, limits), loads, strict=True):
        if share > most:
            cost[load.ids] += limits.cost(load.covered)
    paying = np.flatnonzero(cost)
    order = paying[np.argsort(worth[paying] / cost[paying], kind="stable")]
    paid = np.cumsum(cost[order])
    kept = np.ones(len(worth), np.bool_)
    kept[order[: 1 + int(np.searchsorted(paid, goes * paid[-1]))]] = False
    return kept


def _keep(loads: Sequence[Load], kept: Mask) -> list[Load]:
    """Return what views have of the Gaussians that stay, by their new numbers."""
    numbers = (np.cumsum(kept) - 1).astype(np.int32)
    left = []
    for load in loads:
        own = kept[load.ids]
        left.append(Load(numbers[load.ids[own]], load.covered[own]))
    return left
