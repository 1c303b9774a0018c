"""Measure quantities for painting a scene: how often, from where and how strongly each Gaussian is seen.

They are measured from random places and views in navigable space, or read from a store of visible sets. Scene frame.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.errors import SceneError
from gsvis.progress import Progress, silent
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.look import Look
from gsvis.pvs.store import VisibilityStore
from gsvis.pvs.viewpoints import CellViewpoints
from gsvis.raycast import TAU
from gsvis.raycast.directions import NUM_FACES, direction_fractions, seen_directions
from gsvis.render.removal import removal_effects
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.solid import Solid
from gsvis.scene.view_sampling import ViewSampling

__all__ = ["QUANTITIES", "Quantity", "QuantityConfig", "measure_quantity", "stored_quantity"]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

QUANTITIES = ("visibility", "directions", "weight", "importance", "cell")

_TRIES = 32  # draws of places until enough lie outside everything solid
# random streams of the seed
_PLACES = 1
_OF_CELLS = 2
_VIEWS = ViewSampling(96, 480, 360, 90.0, stream=7)
# colors of importance span this many powers of ten below this quantile
_TOP = 0.999
_DECADES = 6

_LABELS = {
    "visibility": "share of the eyes that see it",
    "directions": f"number of {NUM_FACES} directions from which it is seen",
    "weight": "largest weight in a pixel",
    "importance": "mean squared change of a view without it",
    "cell": "cell that sees it best",
}


@dataclass(frozen=True, kw_only=True)
class QuantityConfig:
    """Options of a measurement.

    Attributes:
        eyes: Number of places that look all around; for "cell", the largest number of cells.
        views: Views for "importance".
        size: Pixels along a side of the six faces around an eye.
        tau: Least weight of a visible Gaussian.
        seed: Seed of all random numbers.
    """

    eyes: int = 64
    views: ViewSampling = _VIEWS
    size: int = 512
    tau: float = TAU
    seed: int = 0

    def __post_init__(self) -> None:
        for name, least in (("eyes", 1), ("size", 4), ("seed", 0)):
            _check.positive_int(name, getattr(self, name), at_least=least)
        if not 1e-6 <= self.tau <= 0.5:
            raise ValueError(f"tau: expected a weight in [1e-6, 0.5], got {self.tau!r}")


@dataclass(frozen=True, eq=False)
class Quantity:
    """A value for each of N Gaussians, and the range that colors span.

    Attributes:
        name: One of `QUANTITIES`.
        values: (N,) float32; the number of a cell for "cell"; 0 for unseen Gaussians.
        seen: (N,) True for seen Gaussians; the others get no color of the ramp.
        low: Value of the first color.
        high: Value of the last color, above `low`.
        logarithmic: Whether equal steps in color are equal ratios instead of equal differences.
        cells: Number of cells for "cell"; 0 for other quantities, which are continuous.
        label: Description of the values.
        unseen: Description of unseen Gaussians.
    """

    name: str
    values: F32
    seen: Mask
    low: float
    high: float
    logarithmic: bool
    cells: int
    label: str
    unseen: str = "never seen"

    def __len__(self) -> int:
        return len(self.values)

    def parts(self, values: NDArray[np.floating[Any]]) -> F64:
        """Return the positions of values (M,) between `low` and `high`, in [0, 1]."""
        some = np.clip(values.astype(np.float64), self.low, self.high)
        if self.logarithmic:
            return np.asarray(np.clip(np.log(some / self.low) / np.log(self.high / self.low), 0.0, 1.0))
        return np.asarray((some - self.low) / (self.high - self.low))

    def value_at(self, part: float) -> float:
        """Return the value at a share in [0, 1] of the way from `low` to `high`."""
        if self.logarithmic:
            return float(self.low * (self.high / self.low) ** part)
        return self.low + part * (self.high - self.low)


def measure_quantity(
    g: Gaussians,
    name: str,
    space: NavigableSpace,
    config: QuantityConfig | None = None,
    *,
    progress: Progress = silent,
) -> Quantity:
    """Measure a quantity of each Gaussian from navigable space.

    Args:
        g: The scene, N Gaussians.
        name: "visibility": share of random eyes that see it. "directions": number of 80 directions from which some eye
            sees it. "weight": its largest weight in a pixel. "importance": mean squared change of random views without
            it, per pixel. "cell": the box of the space whose eye sees it best.
        space: Allowed viewpoints.
        config: Options; None means `QuantityConfig()`.
        progress: Called with stage "viewpoints", or "importance".

    Raises:
        ValueError: If the name is unknown.
        SceneError: If all eyes lie inside something solid, or see nothing.
    """
    _check.one_of("name", name, QUANTITIES)
    config = config or QuantityConfig()
    if name == "importance":
        return _from_views(g, space, config, progress)
    eyes, cells = _cell_eyes(g, space, config) if name == "cell" else (_random_eyes(g, space, config), 0)
    return _from_eyes(g, name, eyes, cells, config, progress)


def stored_quantity(store: VisibilityStore, name: str, *, progress: Progress = silent) -> Quantity:
    """Return a quantity of each Gaussian from visible sets.

    Args:
        store: Sets of C cells; ids are those of the scene, or of the union of levels.
        name: "visibility": share of cells that see it. "directions": directions found by the build. "weight": least
            weight of its highest class. "cell": the first cell that sees it with the highest class.
        progress: Called with stage "cells".

    Raises:
        ValueError: If the name is unknown, or is "importance", which sets do not hold.
        SceneError: If no cell sees anything.
    """
    known = tuple(each for each in QUANTITIES if each != "importance")
    _check.one_of("name", name, known)
    count = store.gaussians
    cells = len(store)
    seen_by = np.zeros(count, np.int64)
    best = np.full(count, -1)
    owner = np.zeros(count, np.int64)
    progress("cells", 0, cells)
    for cell in range(cells):
        ids, classes = store.classes(cell)
        seen_by[ids] += 1
        better = ids[classes.astype(np.int64) > best[ids]]
        best[ids] = np.maximum(best[ids], classes)
        owner[better] = cell
        progress("cells", cell + 1, cells)
    seen = seen_by > 0
    if name == "cell":
        return _finish(name, owner, seen, (0.0, max(1.0, cells - 1.0)), cells=cells)
    if name == "visibility":
        return _finish(name, seen_by / cells, seen, (0.0, 1.0), label="share of the cells that see it")
    if name == "directions":
        return _finish(name, NUM_FACES * direction_fractions(store.direction_sets), seen, (0.0, float(NUM_FACES)))
    lows = np.array([store.class_interval(k)[0] for k in range(int(best.max(initial=0)) + 1)])
    return _finish(name, lows[np.maximum(best, 0)], seen, (store.tau, 1.0), logarithmic=True)


def _from_eyes(g: Gaussians, name: str, eyes: F64, cells: int, config: QuantityConfig, progress: Progress) -> Quantity:
    """Return a quantity from the Gaussians that eyes (V, 3) see; eye k belongs to cell k."""
    look = Look(g, "hybrid", config.size, config.tau)
    times = np.zeros(len(g), np.int64)
    best = np.zeros(len(g), np.float32)
    owner = np.zeros(len(g), np.int64)
    sets = np.zeros((len(g), NUM_FACES // 8), np.uint8)
    progress("viewpoints", 0, len(eyes))
    for k, eye in enumerate(eyes):
        if not np.isnan(eye).any():
            ids, weights = look(eye)
            times[ids] += 1
            owner[ids[weights > best[ids]]] = k
            best[ids] = np.maximum(best[ids], weights)
            if name == "directions":
                sets[ids] |= seen_directions(g[ids], weights[None], eye[None], config.tau)
        progress("viewpoints", k + 1, len(eyes))
    seen = times > 0
    if name == "cell":
        return _finish(name, owner, seen, (0.0, max(1.0, cells - 1.0)), cells=cells)
    if name == "visibility":
        return _finish(name, times / len(eyes), seen, (0.0, 1.0))
    if name == "directions":
        return _finish(name, NUM_FACES * direction_fractions(sets), seen, (0.0, float(NUM_FACES)))
    return _finish(name, best, seen, (config.tau, 1.0), logarithmic=True)


def _from_views(g: Gaussians, space: NavigableSpace, config: QuantityConfig, progress: Progress) -> Quantity:
    """Return the mean squared change of random views by the removal of each Gaussian."""
    cameras = config.views.cameras(g, space)

    def report(stage: str, done: int, total: int) -> None:
        """Report progress as stage "importance"."""
        progress("importance", done, total)

    effects = removal_effects(g, cameras, progress=report)
    values = effects.squared / (len(cameras) * cameras.width * cameras.height)
    high = float(np.quantile(values[values > 0.0], _TOP)) if (values > 0.0).any() else 1.0
    low = high * 10.0**-_DECADES
    found = _finish("importance", values, values >= low, (low, high), logarithmic=True)
    return replace(found, unseen="next to no change")


def _finish(
    name: str,
    values: NDArray[Any],
    seen: Mask,
    span: tuple[float, float],
    *,
    logarithmic: bool = False,
    cells: int = 0,
    label: str = "",
) -> Quantity:
    """Return the quantity with its range of colors."""
    if not seen.any():
        raise SceneError("no eye sees any of the scene: there is nothing to paint; say where eyes belong")
    shown = np.where(seen, values, 0).astype(np.float32)
    return Quantity(name, shown, seen, *span, logarithmic, cells, label or _LABELS[name])


def _random_eyes(g: Gaussians, space: NavigableSpace, config: QuantityConfig) -> F64:
    """Return random places (V, 3) in a space, outside everything solid."""
    rng = np.random.default_rng([config.seed, _PLACES])
    solid = Solid.from_scene(g)
    found = np.zeros((0, 3))
    for _ in range(_TRIES):
        drawn = space.sample_viewpoints(config.eyes, rng)
        found = np.concatenate([found, drawn[~solid.buries(drawn)]])
        if len(found) >= config.eyes:
            break
    if len(found) == 0:
        raise SceneError("all eyes drawn lie inside something solid; say where eyes belong")
    return found[: config.eyes]


def _cell_eyes(g: Gaussians, space: NavigableSpace, config: QuantityConfig) -> tuple[F64, int]:
    """Return one place (C, 3) for each box of a space, NaN if all tried places lie inside something solid, and C."""
    viewpoints = CellViewpoints(CellGrid.over(space, max_cells=config.eyes), space)
    rng = np.random.default_rng([config.seed, _OF_CELLS])
    solid = Solid.from_scene(g)
    eyes = np.full((len(viewpoints.grid), 3), np.nan)
    for cell in range(len(eyes)):
        drawn = viewpoints.draw(cell, _TRIES, rng)
        drawn = drawn[~solid.buries(drawn)]
        if len(drawn):
            eyes[cell] = drawn[0]
    if np.isnan(eyes).all():
        raise SceneError("all eyes drawn lie inside something solid; say where eyes belong")
    return eyes, len(eyes)
