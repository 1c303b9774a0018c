"""Explain why a cell sees a Gaussian or not, by its weight there or the Gaussians in front of it.

The store says whether a cell sees a Gaussian. Rays from viewpoints in the cell to the center of the Gaussian find the
Gaussians in front of it. World frame, scene units; weight and alpha as in docs/conventions.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.raycast.tracer import Tracer

if TYPE_CHECKING:
    from gsvis.pvs.store import VisibilityStore

__all__ = ["Why", "why"]

_SHOWN = 5
_INSET = 0.8  # share of the way to a corner; keeps the points inside the cell


@dataclass(frozen=True, eq=False)
class Why:
    """The answer to "does this cell see this Gaussian, and why?"; `str` gives a text for people.

    Attributes:
        gaussian: Id of the Gaussian, scene order.
        cell: Number of the cell.
        verdict: "visible"; "hidden" behind others; "missed": visible but not in the set, because a ray of `why` reaches
            it with a weight of at least tau; "faint": its opacity is too low to be visible from anywhere.
        interval: (least, most) weight from the cell: by its weight class if it is "visible"; (0, tau) if "hidden";
            (`weight`, 1) if "missed"; (0, least visible opacity) if "faint".
        weight: Largest weight over the rays of `why`; NaN if no ray was cast.
        rays: Number of rays cast.
        blockers: (B,) int64, Gaussians in front of it on these rays; the one that takes most light comes first.
        shares: (B,) float64, share of the light that each blocker takes, mean over the rays.
        nearest_cell: The nearest cell that sees it; -1 if none does.
        nearest_distance: Distance between the centers of the two cells, scene units; inf if no cell sees it.
    """

    gaussian: int
    cell: int
    verdict: str
    interval: tuple[float, float]
    weight: float
    rays: int
    blockers: NDArray[np.int64]
    shares: NDArray[np.float64]
    nearest_cell: int
    nearest_distance: float

    def __str__(self) -> str:
        name = f"Gaussian {self.gaussian}"
        if self.verdict == "visible":
            return f"{name} is visible from cell {self.cell}: its largest weight there is {_span(self.interval)}."
        if self.verdict == "faint":
            return f"{name} is too faint to be seen from anywhere: its opacity is below {self.interval[1]:.4g}."
        if self.verdict == "missed":
            lines = [
                f"{name} is visible from cell {self.cell} and missing in its set: a ray to its center finds weight"
                f" {self.weight:.4g}, and the views that made the set stepped over it."
            ]
            none = "No set holds it"
            nearest = "Nearest cell whose set holds it"
        else:
            lines = [
                f"{name} is not visible from cell {self.cell}: its largest weight there is {_span(self.interval)}."
            ]
            none = "No cell sees it"
            nearest = "Nearest cell that sees it"
        if self.rays:
            lines.append(self._in_front())
        lines.append(
            f"{none}."
            if self.nearest_cell < 0
            else f"{nearest}: {self.nearest_cell}, {self.nearest_distance:.4g} away."
        )
        return "\n".join(lines)

    def _in_front(self) -> str:
        """Return the text about the Gaussians in front."""
        rays = "one ray" if self.rays == 1 else f"{self.rays} rays"
        if len(self.blockers) == 0:
            return f"Nothing stands in front of it on {rays} from the cell."
        lines = [f"In front of it, with the mean share of light that each takes over {rays} from the cell:"]
        shown = zip(self.blockers[:_SHOWN], self.shares[:_SHOWN], strict=True)
        lines += [f"  Gaussian {blocker}: {share:.1%}" for blocker, share in shown]
        if len(self.blockers) > _SHOWN:
            rest = len(self.blockers) - _SHOWN
            lines.append(f"  {rest} more: {self.shares[_SHOWN:].sum():.1%} together")
        lines.append(f"  What is left for it and all behind it: {max(0.0, 1.0 - self.shares.sum()):.1%}")
        return "\n".join(lines)


def why(
    store: VisibilityStore, tracer: Tracer | None, gaussian: int, cell: int, *, viewpoints: ArrayLike | None = None
) -> Why:
    """Return whether a cell sees a Gaussian, with which weight, and what hides it.

    Args:
        store: The visible sets.
        tracer: Tracer of the store's scene; None casts no ray, and the result names no blockers.
        gaussian: Id of the Gaussian, scene order.
        cell: Number of the cell.
        viewpoints: (V, 3) start points of the rays, world frame; None means the center of the cell and eight points
            near its corners.

    Returns:
        The answer.

    Raises:
        ValueError: If `gaussian` or `cell` is out of range.
        FormatError: If the tracer is of another scene, or the store is damaged where it is read.
    """
    store.check_gaussian(gaussian)
    store.check_cell(cell)
    if tracer is not None:
        store.check_scene(tracer.proxies.gaussians)
    level = store.class_of(gaussian, cell)
    empty = np.zeros(0, np.int64), np.zeros(0)
    if level >= 0:
        interval = store.class_interval(level)
        return Why(gaussian, cell, "visible", interval, np.nan, 0, *empty, cell, 0.0)
    unseen = (0.0, store.tau)
    if tracer is None:
        return Why(gaussian, cell, "hidden", unseen, np.nan, 0, *empty, *store.nearest_seer(gaussian, cell))
    opacity = float(tracer.proxies.gaussians.opacities[gaussian])
    least = max(store.tau, tracer.proxies.min_alpha)
    if opacity < least:
        return Why(gaussian, cell, "faint", (0.0, least), np.nan, 0, *empty, -1, np.inf)
    points = _viewpoints(store, cell) if viewpoints is None else viewpoints
    eyes = _check.floats("viewpoints", points, ("V", 3), np.float64)
    blockers, shares, weight = _in_front_of(tracer, gaussian, eyes)
    verdict, interval = ("missed", (weight, 1.0)) if weight >= store.tau else ("hidden", unseen)
    seer = store.nearest_seer(gaussian, cell)
    return Why(gaussian, cell, verdict, interval, weight, len(eyes), blockers, shares, *seer)


def _viewpoints(store: VisibilityStore, cell: int) -> NDArray[np.float64]:
    """Return (9, 3) the center of a cell and points near its corners."""
    low, high = (np.asarray(corner, np.float64) for corner in store.grid.bounds(cell))
    signs = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3, indexing="ij"), axis=-1).reshape(8, 3)
    center = 0.5 * (low + high)
    half = 0.5 * (high - low)
    return np.asarray(np.concatenate([center[None], center + _INSET * signs * half]))


def _in_front_of(
    tracer: Tracer, gaussian: int, eyes: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64], float]:
    """Return the Gaussians in front of one on rays to its center, their mean shares of light, and its own weight."""
    rays = tracer.proxies.gaussians.means[gaussian].astype(np.float64) - eyes
    distances = np.linalg.norm(rays, axis=1)
    rays[distances == 0.0] = (1.0, 0.0, 0.0)  # the eye is at its center: any direction will do
    found = tracer.contributions(eyes, rays)
    ray_ids = found.ray_ids
    own = found.gaussian_ids == gaussian
    weight = float(found.weights[own].max()) if own.any() else 0.0
    ends = found.ray_offsets[1:].copy()
    met = np.zeros(len(eyes), bool)
    # front to back: earlier hits are in front
    ends[ray_ids[own]] = np.flatnonzero(own)
    met[ray_ids[own]] = True
    in_front = met[ray_ids] | (found.depths <= distances[ray_ids])
    before = in_front & (np.arange(len(own)) < ends[ray_ids])
    blockers, place = np.unique(found.gaussian_ids[before], return_inverse=True)
    shares = np.bincount(place.ravel(), weights=found.weights[before], minlength=len(blockers)) / max(1, len(eyes))
    order = np.argsort(-shares, kind="stable")
    return blockers[order], shares[order], weight


def _span(interval: tuple[float, float]) -> str:
    """Format an interval of weights in words."""
    least, most = interval
    if least <= 0.0:
        return f"below {most:.4g}"
    return f"at least {least:.4g}" if most >= 1.0 else f"between {least:.4g} and {most:.4g}"
