"""Draw judge's eyes: views around the densest detail of a scene, independent of navigable space.

Visible sets are made for builder's eyes; judge's eyes check them. Frame and units are the scene's own. A function that
renders small images tests what an eye sees, so no voxel grid is involved. If the detail of a scene is seen from within
its walls (`gsvis.scene._enclosed`), eyes stand within them. Known limit: in other scenes an eye may lie behind a wall.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from gsvis._sorting import stable_order
from gsvis.scene._enclosed import Enclosure
from gsvis.scene.cameras import Cameras
from gsvis.scene.drawn_by_content import draw_by_content
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.solid import Solid
from gsvis.scene.thinned import thin

__all__ = ["draw_judges", "find_detail"]

F64 = NDArray[np.float64]
Look = Callable[[Cameras], tuple[NDArray[np.float32], NDArray[np.float32]]]
_Sights = tuple[F64, F64]  # eyes and their targets, (P, 3) each

_MIN_OPACITY = 0.1
_SAMPLE = 20_000  # Gaussians from which density is measured
_NEIGHBORS = 8
_CORE = 0.8  # share of the detail that lies in the core
_STEPS = (0.15, 0.3, 0.6, 1.0)  # distances of eyes from the detail, radii of the core
_SHARE_OUTSIDE = 0.25  # share of the eyes outside of the core that look in at it, or at its middle that look out
_FILLED = 0.5  # alpha at the middle of an image from which something is there
_NEAREST = 0.75  # share of the distance to the detail that has to be free
_FEW = 3000  # Gaussians that hide an eye from its detail, before an image tells
_CLEAR = 0.3  # share of light that has to pass between them
_AT_ONCE = 1 << 20  # pairs of rays and Gaussians
_TRIES = 12  # proposed eyes, for each that is asked for
_SMALL = (24, 18)
_VOTERS = 24  # eyes that tell whether the scene is rooms


def draw_judges(
    g: Gaussians,
    count: int,
    look: Look,
    *,
    seed: int = 0,
    width: int = 160,
    height: int = 120,
    fov: float = 60.0,
    up: NDArray[np.float64] | None = None,
) -> Cameras:
    """Return up to `count` views of the densest detail, none inside something solid, all with a free line of sight.

    The result follows rotation, translation and scale of the scene, and is independent of navigable space and of the
    order of the Gaussians.

    Args:
        g: The scene.
        count: Number of views.
        look: Function from cameras to their alphas (C, H, W) and depths (C, H, W).
        seed: Seed of the random numbers.
        width: Pixels.
        height: Pixels.
        fov: Horizontal field of view, degrees.
        up: (3,) up direction of the images; None takes the axis along which the core is thinnest.

    Returns:
        The views; fewer than `count` if too few eyes are free, none in a scene without detail.
    """
    rng = np.random.default_rng([seed, 8191])
    detail, numbers = _sample_detail(g, seed)
    if len(detail) <= _NEIGHBORS or count == 0:
        return _no_cameras(width, height, fov)
    middle, radius, axes, core = _find_core(detail)
    points = detail[core]
    if not radius > 0.0:
        return _no_cameras(width, height, fov)
    above = axes[2] if up is None else np.asarray(up, np.float64)
    rolled = np.searchsorted(numbers[core], rng.random(_TRIES * count)) % len(points)
    some, aims = _propose(points[rolled], middle, radius, axes, rng)
    few = thin(g, _FEW, seed=seed)[1]
    proposed = _step_back(few, some, aims, radius, rng)
    outside = _leave_solid(Solid.from_scene(g), proposed)
    eyes, targets = _choose(outside, count, above, radius, look, Enclosure(look, points, radius, axes))
    if len(eyes) == 0:
        return _no_cameras(width, height, fov)
    return Cameras.look_at(eyes, targets, up=above, width=width, height=height, fov=fov)


def find_detail(g: Gaussians, *, seed: int = 0) -> tuple[F64, float]:
    """Return the middle (3,) and the radius of the densest detail of a scene; radius 0 in a scene without detail."""
    detail, _ = _sample_detail(g, seed)
    if len(detail) <= _NEIGHBORS:
        return np.zeros(3), 0.0
    middle, radius, _, _ = _find_core(detail)
    return middle, radius


def _sample_detail(g: Gaussians, seed: int) -> tuple[F64, F64]:
    """Return centers (M, 3) of Gaussians that are not faint, small ones more often, and ascending random numbers (M,).

    A Gaussian keeps its number whichever others are there. So one that drops out by a rounding error changes no more
    than what was chosen by its own number.
    """
    ids = np.flatnonzero(g.opacities >= _MIN_OPACITY)
    if len(ids) == 0:
        return np.zeros((0, 3)), np.zeros(0)
    drawn = draw_by_content(g.without_harmonics()[ids], seed)
    order = stable_order(drawn)[: 4 * _SAMPLE]
    ids = ids[order]
    size = np.maximum(g.scales[ids].astype(np.float64).max(axis=1), 1e-300)
    chance = np.minimum(np.median(size) / size, 1.0)
    kept = np.flatnonzero(draw_by_content(g[ids], seed + 1) < chance)[:_SAMPLE]
    return np.asarray(g.means[ids[kept]], np.float64), drawn[order[kept]]


def _find_core(detail: F64) -> tuple[F64, float, F64, NDArray[np.int64]]:
    """Return the middle (3,), radius and axes (3, 3) of the core, the longest axis first, and its densest points."""
    from scipy.spatial import cKDTree  # slow to import, and seldom needed

    near = cKDTree(detail).query(detail, k=_NEIGHBORS + 1)[0][:, -1]
    chosen = np.flatnonzero(near <= np.median(near))
    dense = detail[chosen]
    middle = dense.mean(axis=0)
    for _ in range(32):  # geometric median, which follows rotations of the scene
        apart = np.linalg.norm(dense - middle, axis=1)
        weights = 1.0 / np.maximum(apart, 1e-9 * max(float(np.median(apart)), 1e-300))
        middle = weights @ dense / weights.sum()
    apart = np.linalg.norm(dense - middle, axis=1)
    radius = float(np.quantile(apart, _CORE))
    points = dense[apart <= radius]
    _, _, axes = np.linalg.svd(points - middle, full_matrices=False)
    skew = ((points - middle) @ axes.T) ** 3
    signs = np.where(skew.sum(axis=0) < 0.0, -1.0, 1.0)
    return middle, radius, axes * signs[:, None], chosen[apart <= radius]


def _propose(points: F64, middle: F64, radius: float, axes: F64, rng: np.random.Generator) -> tuple[F64, F64]:
    """Return eyes and their targets: around points of detail, and along the axes of the core, inward and outward."""
    count = len(points)
    chosen = points.copy()
    local = rng.normal(size=(count, 3)) * np.array([1.0, 1.0, 0.5])  # few look straight along the thinnest axis
    ahead = local @ axes / np.linalg.norm(local, axis=1, keepdims=True)
    eyes = chosen + radius * np.array(_STEPS)[rng.integers(len(_STEPS), size=count)][:, None] * ahead
    along = rng.random(count) < _SHARE_OUTSIDE
    inward = along & (rng.random(count) < 0.5)
    sides = np.sign(rng.normal(size=count))[:, None] * axes[rng.integers(2, size=count)]
    eyes[along] = middle + 0.05 * radius * ahead[along]
    eyes[inward] = (middle + radius * (1.2 * sides + 0.1 * ahead))[inward]
    chosen[inward] = middle
    return eyes, chosen


def _step_back(few: Gaussians, eyes: F64, aims: F64, radius: float, rng: np.random.Generator) -> Iterator[_Sights]:
    """Yield eyes and targets, each eye at a distance from which it likely sees its target.

    An eye moves along its line of sight to one of `_STEPS`, or stays. Eyes without such a distance are dropped. Eyes
    come in blocks, because most callers need few of them and light takes long.
    """
    back = eyes - aims
    apart = np.linalg.norm(back, axis=1)
    steps = np.concatenate([radius * np.tile(_STEPS, (len(eyes), 1)), apart[:, None]], axis=1)
    back = back[apart > 0.0]
    aims = aims[apart > 0.0]
    steps = steps[apart > 0.0]
    back /= np.linalg.norm(back, axis=1, keepdims=True)
    outward = ~np.isclose(steps[:, -1:], steps[:, :-1]).any(axis=1)  # looks in or out along an axis: stays
    rolled = rng.random(steps.shape)
    many = max(1, _AT_ONCE // max(1, len(few)))
    for start in range(0, len(aims), many):
        some = slice(start, start + many)
        free = _pass(few, aims[some], back[some], steps[some]) >= _CLEAR
        free[outward[some], :-1] = False
        chosen = np.where(free, rolled[some], -1.0).argmax(axis=1)
        kept = free.any(axis=1)
        moved = aims[some] + np.take_along_axis(steps[some], chosen[:, None], axis=1) * back[some]
        yield moved[kept], aims[some][kept]


def _leave_solid(solid: Solid, proposed: Iterable[_Sights]) -> Iterator[_Sights]:
    """Yield those of the eyes, with their targets, that lie inside nothing solid."""
    for eyes, aims in proposed:
        free = ~solid.buries(eyes)
        yield eyes[free], aims[free]


def _pass(few: Gaussians, aims: F64, back: F64, steps: F64) -> F64:
    """Return the share (P, S) of light that passes from near each target to each step (P, S) back along a direction."""
    turn = np.swapaxes(few.rotations(), 1, 2) / np.maximum(few.scales.astype(np.float64), 1e-300)[:, :, None]
    means = np.einsum("gij,gj->gi", turn, few.means.astype(np.float64))
    begin = np.einsum("gij,pj->pgi", turn, aims) - means
    along = np.einsum("gij,pj->pgi", turn, back)
    squared = np.maximum(np.einsum("pgi,pgi->pg", along, along), 1e-300)
    nearest = -np.einsum("pgi,pgi->pg", begin, along) / squared
    power = np.einsum("pgi,pgi->pg", begin, begin) - squared * nearest**2
    dark = np.log1p(-np.minimum(few.opacities * np.exp(-0.5 * np.maximum(power, 0.0)), 0.99))
    found = np.empty(steps.shape)
    for k in range(steps.shape[1]):
        end = steps[:, k, None]
        between = (nearest > (1.0 - _NEAREST) * end) & (nearest < end)
        found[:, k] = np.exp(np.where(between, dark, 0.0).sum(axis=1))
    return found


def _choose(
    proposed: Iterator[_Sights], count: int, up: F64, radius: float, look: Look, enclosure: Enclosure
) -> tuple[F64, F64]:
    """Return the first `count` eyes that see their targets, and these targets; in rooms only eyes within walls."""
    eyes = np.zeros((0, 3))
    targets = np.zeros((0, 3))
    some = np.zeros((0, 3))
    aims = np.zeros((0, 3))
    voters = min(_VOTERS, count)
    asked = False
    rooms = False
    for start in range(0, _TRIES * count, voters):
        if len(eyes) >= count:
            break
        while len(some) <= start + voters:
            more = next(proposed, None)
            if more is None:
                break
            some = np.concatenate([some, more[0]])
            aims = np.concatenate([aims, more[1]])
        if start >= len(some):
            break
        part = slice(start, start + voters)
        good = _are_free(some[part], aims[part], up, radius, look)
        if rooms:
            good[good] = enclosure.holds(some[part][good])
        eyes = np.concatenate([eyes, some[part][good]])
        targets = np.concatenate([targets, aims[part][good]])
        is_last = start + voters >= len(some)
        if asked or (len(eyes) < voters and not is_last):
            continue
        asked = True
        within = enclosure.choose(eyes)
        if within is not None:
            rooms = True
            eyes = eyes[within]
            targets = targets[within]
    return eyes[:count], targets[:count]


def _are_free(eyes: F64, aims: F64, up: F64, radius: float, look: Look) -> NDArray[np.bool_]:
    """Return which eyes see their target: something is there, and nothing is close in front of it."""
    apart = np.linalg.norm(aims - eyes, axis=1)
    good: NDArray[np.bool_] = np.asarray(apart > 1e-6 * radius)
    if not good.any():
        return good
    views = Cameras.look_at(eyes[good], aims[good], up=up, width=_SMALL[0], height=_SMALL[1])
    alphas, depths = look(views)
    rows = slice(_SMALL[1] // 2 - 2, _SMALL[1] // 2 + 2)
    columns = slice(_SMALL[0] // 2 - 2, _SMALL[0] // 2 + 2)
    there = alphas[:, rows, columns].mean(axis=(1, 2)) >= _FILLED
    sight = np.median(depths[:, rows, columns], axis=(1, 2))
    free = sight >= _NEAREST * apart[good]
    close = ((depths < 0.02 * radius) & (alphas >= _FILLED)).mean(axis=(1, 2))
    good[good] = there & free & (close < 0.25)
    return good


def _no_cameras(width: int, height: int, fov: float) -> Cameras:
    """Return an empty set of cameras."""
    one = Cameras.look_at([[0.0, 0.0, -1.0]], [0.0, 0.0, 0.0], up=(0.0, 1.0, 0.0), width=width, height=height, fov=fov)
    return one[:0]
