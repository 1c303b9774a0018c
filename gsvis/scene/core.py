"""Find the robust core of a scene, the region of detail, unaffected by outliers and skyboxes.

Large Gaussians count less, because training makes Gaussians small where cameras were near. Members are all
Gaussians within a distance whose doubling would add little. Scene frame and units. Everything is computed in float64
relative to the middle, so the result follows translation, rotation and scale of the scene.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsvis.scene.flyaways import find_flyaways
from gsvis.scene.gaussians import Gaussians

__all__ = ["Core", "find_ball", "find_core", "middle_scales"]

F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

_ASKED = 100_000  # centers that the middle of a ball is found from
_STEPS = 32  # of the search for the middle, at most
_CLOSE = 1e-3  # step that ends it, in median distances
_ADDED = 0.04  # least share that a doubling of the distance adds within the scene
_TAIL = 0.05  # of the weight, left out at each end of each axis of the detail
_GROWN = 2.0  # how many times as large Gaussians beyond the detail are if people stood inside of it
_GROWTH = 0.4  # least slope of the logarithm of their size over that of their distance; 1 where few cameras were
_VARIED = 0.5  # least logarithm of the ratio of large ones to small ones around a capture
_ALIKE = 0.2  # least correlation of these
_SMALLER = 0.75  # longest side of the detail in that of all members from which the two are different things
_HAZE = 0.03  # longest sides of the detail
_MOST_HAZE = 0.1  # share of the Gaussians; if more are that large, they are what the scene is made of
_MARGIN = 0.1  # of the longest side, around the detail


@dataclass(frozen=True, eq=False)
class Core:
    """The extent of a scene without outliers, and the extent of its detail.

    Attributes:
        center: (3,) weighted geometric median of the centers.
        members: (N,) True for Gaussians that are not outliers.
        low: (3,) lowest corner of the box of the members.
        high: (3,) highest corner.
        detail_low: (3,) lowest corner of the box of the detail; that of the members if detail is the same everywhere.
        detail_high: (3,) highest corner.
        beyond: Share of the members outside of the detail; 0 if detail is the same everywhere.
        widest: Middle standard deviation above which a Gaussian counts as haze; infinite if many are that large.
    """

    center: F64
    members: Mask
    low: F64
    high: F64
    detail_low: F64
    detail_high: F64
    beyond: float
    widest: float

    @property
    def has_surroundings(self) -> bool:
        """Whether Gaussians get larger away from the detail, as if people stood in or around it."""
        return self.beyond > 0.0

    @property
    def size(self) -> float:
        """Longest side of the detail."""
        return float((self.detail_high - self.detail_low).max())


def find_core(g: Gaussians, coverage: float = 0.98) -> Core:
    """Return the core of a scene.

    Args:
        g: The scene; at least one Gaussian.
        coverage: Share of the members' centers inside their box on each axis, in (0, 1].

    Raises:
        ValueError: If the scene is empty or `coverage` is out of range.
    """
    box = g.bounds(coverage)
    places = g.means.astype(np.float64)
    sizes = middle_scales(g)
    flown = find_flyaways(g.means, g.scales, g.opacities)
    weights = np.minimum(1.0, np.median(sizes) / sizes) * ~flown
    center = _middle(places, weights)
    distances = np.linalg.norm(places - center, axis=1)
    members = (distances <= _edge(distances, weights)) & ~flown
    if np.any(~members & ~flown):
        tail = 0.5 * (1.0 - coverage)
        box = np.quantile(places[members], [tail, 1.0 - tail], axis=0)
    low, high = _thicken_box(box, float(sizes.max()))
    detail_low, detail_high, beyond = _detail(places[members], sizes[members], low, high)
    widest = _HAZE * float((detail_high - detail_low).max())
    if np.count_nonzero(sizes[members] > widest) > _MOST_HAZE * len(g):
        widest = np.inf
    return Core(center, members, low, high, detail_low, detail_high, beyond, widest)


def find_ball(g: Gaussians, coverage: float = 0.98) -> tuple[F64, float]:
    """Return the middle (3,) of a scene, and the radius of the ball around it that holds a share of the centers.

    Unlike a box, it does not change with rotation. Flyaways are ignored, as in `Gaussians.bounds`.

    Args:
        g: The scene; at least one Gaussian.
        coverage: Share of the centers, in (0, 1].
    """
    places = g.means.astype(np.float64)[~find_flyaways(g.means, g.scales, g.opacities)]
    some = places[:: max(1, len(places) // _ASKED)]
    center = _middle(some, np.ones(len(some)))
    return center, float(np.quantile(np.linalg.norm(places - center, axis=1), coverage))


def middle_scales(g: Gaussians) -> F64:
    """Return (N,) the middle standard deviation of each Gaussian; for a disc this is its radius."""
    x, y, z = g.scales.T
    middle: F64 = np.maximum(np.minimum(x, y), np.minimum(np.maximum(x, y), z)).astype(np.float64)
    return middle


def _thicken_box(box: F64, size: float) -> tuple[F64, F64]:
    """Return the corners of a box; the box of a single point gets the size of a Gaussian."""
    low, high = box
    if (high - low).max() > 0.0:
        return low, high
    return low - 3.0 * size, high + 3.0 * size


def _middle(places: F64, weights: F64) -> F64:
    """Return the point (3,) with the least weighted sum of distances to the places (N, 3)."""
    start = np.median(places[weights > 0.0], axis=0)
    away = places - start
    point = np.zeros(3)
    scale = float(np.median(np.linalg.norm(away, axis=1)))
    if scale == 0.0:
        return start
    for _ in range(_STEPS):
        ways = away - point
        shares = weights / np.maximum(np.sqrt(np.einsum("ij,ij->i", ways, ways)), 1e-6 * scale)
        step = shares @ ways / shares.sum()
        point += step
        if float(np.linalg.norm(step)) < _CLOSE * scale:
            break
    return start + point


def _edge(distances: F64, weights: F64) -> float:
    """Return the greatest distance whose doubling still adds a share to the weight within."""
    order = np.argsort(distances)
    ordered = distances[order]
    total = np.cumsum(weights[order])
    inner = np.searchsorted(ordered, 0.5 * ordered, side="right") - 1
    within = np.where(inner >= 0, total[inner], 0.0)
    grows = total - within >= _ADDED * within
    if not grows.any():  # all are in one point
        return float(ordered[-1])
    last = int(np.flatnonzero(grows)[-1])
    # Between two Gaussians the share of the outer half falls as its inner end moves out.
    full = np.searchsorted(total, total[last] / (1.0 + _ADDED), side="left")
    return max(float(ordered[last]), 2.0 * float(ordered[min(int(full), len(ordered) - 1)]))


def _detail(places: F64, sizes: F64, low: F64, high: F64) -> tuple[F64, F64, float]:
    """Return the corners of the box where Gaussians are small, and the share of Gaussians outside of it.

    Returns the given box and 0 if Gaussians are equally small elsewhere.
    """
    finest = np.quantile(sizes, 0.2)
    weights = np.minimum(1.0, finest / sizes) ** 3
    corners = np.stack([_weighted_quantiles(places[:, i], weights, (_TAIL, 1.0 - _TAIL)) for i in range(3)], axis=1)
    margin = _MARGIN * float((corners[1] - corners[0]).max())
    inner_low = np.maximum(corners[0] - margin, low)
    inner_high = np.minimum(corners[1] + margin, high)
    if (inner_high - inner_low).max() > _SMALLER * (high - low).max():
        return low, high, 0.0
    beyond = ~np.all((places >= inner_low) & (places <= inner_high), axis=1)
    if beyond.all() or not beyond.any() or np.median(sizes[beyond]) < _GROWN * np.median(sizes[~beyond]):
        return low, high, 0.0
    away = np.log(np.maximum(np.linalg.norm(places[beyond] - 0.5 * (inner_low + inner_high), axis=1), 1e-30))
    if _growth(away, np.log(sizes[beyond])) < _GROWTH:
        return low, high, 0.0
    return inner_low, inner_high, float(np.mean(beyond))


def _growth(away: F64, sizes: F64) -> float:
    """Return the slope of the logarithms of sizes (K,) over those of distances; 0 if they correlate little.

    Scenes with only one or two sizes of Gaussians are synthetic, so cameras did not determine the sizes.
    """
    if np.diff(np.quantile(sizes, [0.1, 0.9]))[0] < _VARIED:
        return 0.0
    away = away - away.mean()
    sizes = sizes - sizes.mean()
    spread = float(away @ away)
    common = float(away @ sizes)
    if spread == 0.0 or common < _ALIKE * np.sqrt(spread * float(sizes @ sizes)):
        return 0.0
    return common / spread


def _weighted_quantiles(values: F64, weights: F64, at: tuple[float, ...]) -> F64:
    """Return the weighted quantiles of values."""
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    found: F64 = values[order][np.searchsorted(total, np.array(at) * total[-1]).clip(0, len(values) - 1)]
    return found
