"""Make a lighter version of a scene that holds a budget of splats and of fill in every view of its eyes.

A view is square and 90 degrees wide; the six of a cube around an eye see all of it. Fill is that of
`gsvis.render.fill`. Gaussians are merged until the heaviest views hold the budget, after the faintest are left out if
pictures are better for it. Other eyes check the result, and where they see too much, more is merged.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gsvis.errors import SceneError
from gsvis.progress import Progress, silent
from gsvis.render import measure_fill, psnr, rasterize
from gsvis.render.fill import SIDE, view_fill
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.view_sampling import ViewSampling
from gsvis.train.merge import merge_gaussians

__all__ = ["Budget", "Budgeted", "fit_budget"]

F64 = NDArray[np.float64]

_ROOM = 0.95  # share of the budget that is aimed at: other eyes see a little more
_ROUNDS = 3  # times that other eyes check, and more is removed where they see too much
_STEPS = 40  # removals until a budget holds, at most
_FAINT = (0.0, 0.002)  # shares of the light of all views, tried, that is left out before the rest is merged
_HEAVY = 8  # views with most that decide how far Gaussians are merged
_MERGES = 4  # sizes tried
_CAP = 100.0  # dB of equal pictures
_BUILD, _JUDGE, _CHECK = range(3)  # random streams of eyes; checks take those from the last on


@dataclass(frozen=True)
class Budget:
    """What a view may have at most.

    Attributes:
        splats: Gaussians that cover a pixel of a view; None is no limit.
        fill: Mean number of Gaussians that cover a pixel of a view; None is no limit.
        eyes: Eyes for which the version is made, and that check it.
        seed: Seed of all eyes.

    Raises:
        ValueError: If there is no limit, or one is not positive.
    """

    splats: int | None = None
    fill: float | None = None
    eyes: int = 12
    seed: int = 0

    def __post_init__(self) -> None:
        if self.splats is None and self.fill is None:
            raise ValueError("budget: expected splats or fill, got neither; give one")
        for name in ("splats", "fill", "eyes"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ValueError(f"{name}: expected more than 0, got {value!r}")

    def share(self, splats: F64, mean: F64) -> F64:
        """Return the share of the budget that views take: the larger of both; above 1 it does not hold."""
        return np.maximum(splats / (self.splats or np.inf), mean / (self.fill or np.inf))


@dataclass(frozen=True, eq=False)
class Budgeted:
    """A version of a scene.

    Attributes:
        scene: The version.
        before: Largest figures of a view of the checking eyes in the scene; see `Fill.largest`.
        after: The same in the version.
        held: Whether every view of the last checking eyes holds the budget.
        mean_db: Mean PSNR of views of other eyes against the scene, dB; at most 100.
        worst_db: PSNR of the worst of them.
    """

    scene: Gaussians
    before: dict[str, float]
    after: dict[str, float]
    held: bool
    mean_db: float
    worst_db: float


class _Seen(NamedTuple):
    """The Gaussians of one view, the share of pixels that each covers, and its light in the view."""

    ids: NDArray[np.int32]
    covered: NDArray[np.float32]
    light: NDArray[np.float32]


def fit_budget(g: Gaussians, space: NavigableSpace, budget: Budget, progress: Progress = silent) -> Budgeted:
    """Return a version of a scene that holds a budget at every eye of a space.

    Args:
        g: N Gaussians.
        space: Where eyes may be.
        budget: The limits.
        progress: Called with stage "budget", in views.

    Raises:
        SceneError: If the space has no eyes outside of solid parts, or nothing would be left.
    """
    views = Cameras.cubemap(_eyes(g, space, budget, _BUILD), SIDE)
    before = measure_fill(g, _checking(g, space, budget, 0), progress=progress)
    most = budget.share(before.splats, before.mean).max()
    version = g if most <= _ROOM else _lighten(g, space, views, budget, progress)
    for k in range(_ROUNDS):
        others = _checking(g, space, budget, k)
        after = measure_fill(version, others, progress=progress)
        held = bool((budget.share(after.splats, after.mean) <= 1.0).all())
        if held or k + 1 == _ROUNDS:
            break
        version = _merge(version, others, budget, progress)
    found = _likeness(g, version, _cameras(g, space, budget, _JUDGE))
    return Budgeted(version, before.largest(), after.largest(), held, float(found.mean()), float(found.min()))


def _lighten(g: Gaussians, space: NavigableSpace, views: Cameras, budget: Budget, progress: Progress) -> Gaussians:
    """Return the version that looks best: some faint Gaussians are left out, then the rest is merged."""
    seen = _look(g, views, progress)
    light = np.zeros(len(g))
    for view in seen:
        light[view.ids] += view.light
    heavy = views[np.argsort(-budget.share(*_loads(seen)), kind="stable")[:_HEAVY]]
    cameras = _cameras(g, space, budget, _BUILD)
    order = np.argsort(light, kind="stable")
    lost = np.cumsum(light[order]) / max(float(light.sum()), 1e-30)
    versions = []
    for share in _FAINT:
        kept = np.sort(order[lost >= share])
        versions.append(_merge(g[kept], heavy, budget, progress))
    return max(versions, key=lambda version: float(_likeness(g, version, cameras).mean()))


def _merge(g: Gaussians, views: Cameras, budget: Budget, progress: Progress) -> Gaussians:
    """Return a scene merged until views hold the budget; what merging does not reach is left out."""
    version = g
    count = len(g)
    for _ in range(_MERGES):
        found = measure_fill(version, views, progress=progress)
        most = float(budget.share(found.splats, found.mean).max())
        if most <= _ROOM:
            return version
        count = max(1, int(0.99 * count * _ROOM / most))
        version = merge_gaussians(g, count)
    return _drop(version, _look(version, views, progress), budget)


def _look(g: Gaussians, views: Cameras, progress: Progress) -> list[_Seen]:
    """Return what each view sees."""
    seen = []
    progress("budget", 0, len(views))
    for c in range(len(views)):
        found = view_fill(g, views[c])
        covered = (found.covered / found.fill.size).astype(np.float32)
        seen.append(_Seen(found.ids.astype(np.int32), covered, found.light.astype(np.float32)))
        progress("budget", c + 1, len(views))
    return seen


def _loads(seen: list[_Seen]) -> tuple[F64, F64]:
    """Return the splats and the mean fill of views."""
    return np.array([len(each.ids) for each in seen], float), np.array([each.covered.sum() for each in seen], float)


def _drop(g: Gaussians, seen: list[_Seen], budget: Budget) -> Gaussians:
    """Return a scene without the Gaussians that give least light for their share of the budget in views over it.

    Raises:
        SceneError: If nothing would be left.
    """
    kept = np.ones(len(g), np.bool_)
    light = np.zeros(len(g))
    for view in seen:
        light[view.ids] += view.light
    for _ in range(_STEPS):
        cost = np.zeros(len(g))
        excess = 0.0
        for view in seen:
            own = kept[view.ids]
            share = float(budget.share(np.array(float(own.sum())), np.array(float(view.covered[own].sum()))))
            if share > _ROOM:
                excess = max(excess, 1.0 - _ROOM / share)
                cost[view.ids[own]] += _cost_of(view.covered[own], budget)
        if excess == 0.0:
            break
        worth = np.where(cost > 0.0, light / np.maximum(cost, 1e-30), np.inf)
        order = np.argsort(worth, kind="stable")[: np.count_nonzero(cost)]
        paid = np.cumsum(cost[order])
        kept[order[: 1 + int(np.searchsorted(paid, 0.5 * excess * paid[-1]))]] = False
    if not kept.any():
        raise SceneError("budget: no Gaussian would be left; allow more splats or more fill")
    return g[kept]


def _cost_of(covered: NDArray[np.float32], budget: Budget) -> F64:
    """Return the share of the budget of a view that each splat takes: of the splats and of the fill."""
    each = 1.0 / budget.splats if budget.splats else 0.0
    return np.asarray(each + covered / budget.fill if budget.fill else np.full(len(covered), each), np.float64)


def _cameras(g: Gaussians, space: NavigableSpace, budget: Budget, stream: int) -> Cameras:
    """Return views as visitors have them, small, to compare pictures."""
    return ViewSampling(2 * budget.eyes, 320, 240, 75.0, budget.seed, stream).cameras(g, space)


def _eyes(g: Gaussians, space: NavigableSpace, budget: Budget, stream: int) -> F64:
    """Return (E, 3) eyes in the space, outside of solid parts."""
    return ViewSampling(budget.eyes, 8, 8, 90.0, budget.seed, stream).cameras(g, space).viewpoints


def _checking(g: Gaussians, space: NavigableSpace, budget: Budget, number: int) -> Cameras:
    """Return the six views around other eyes, each turned at random."""
    eyes = _eyes(g, space, budget, _CHECK + number)
    cube = Cameras.cubemap(eyes, SIDE)
    turns = np.linalg.qr(np.random.default_rng([budget.seed, number]).normal(size=(len(eyes), 3, 3)))[0]
    turns *= np.sign(np.linalg.det(turns))[:, None, None]
    poses = cube.viewmats.copy()
    poses[:, :3, :3] = poses[:, :3, :3] @ np.repeat(turns, 6, axis=0)
    poses[:, :3, 3] = -np.einsum("cij,cj->ci", poses[:, :3, :3], np.repeat(eyes, 6, axis=0))
    return Cameras(poses, cube.Ks, SIDE, SIDE)


def _likeness(g: Gaussians, version: Gaussians, cameras: Cameras) -> F64:
    """Return the PSNR of each view of a version against the scene."""
    out = []
    for c in range(len(cameras)):
        pictures = [np.clip(rasterize(each, cameras[c], backend="cpu").images[0], 0.0, 1.0) for each in (g, version)]
        out.append(min(float(psnr(pictures[1], pictures[0])), _CAP))
    return np.array(out)
