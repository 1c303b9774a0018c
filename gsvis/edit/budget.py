"""Make a lighter version of a scene that holds a budget of splats and of fill in every view of its eyes.

A view is square and 90 degrees wide; the six of a cube around an eye see all of it. Fill is that of
`gsvis.render.fill`. Round by round, Gaussians are left out (`shedding.py`) and the others are trained on pictures of
the whole scene, so that they close the gaps. Training makes Gaussians larger, so the last round leaves shapes as they
are. Where pictures of merged Gaussians are better, the rounds begin with these. Other eyes check the result, and where
they see too much, more is left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gsvis.edit.shedding import Load, Pictures, look, shares, shed
from gsvis.progress import Progress, silent
from gsvis.render import measure_fill, psnr, rasterize
from gsvis.render.fill import SIDE
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.view_sampling import ViewSampling
from gsvis.train.pairs import merge_pairs

if TYPE_CHECKING:
    from gsvis.train.images import PosedImages

__all__ = ["Budget", "Budgeted", "fit_budget"]

F64 = NDArray[np.float64]

_ROOM = 0.97  # share of the budget that is aimed at: other eyes see a little more
_CHECKS = 5  # times that other eyes check, and more is left out where they see too much
_ROUNDS = 4  # of leaving out and training, at most
_FALL = 1.3  # factor by which the heaviest view becomes lighter in a round
_HEAVY = 24  # views with most that are looked at again after training
_EVERY = 6  # of the pictures, compared to choose how to begin
_MERGES = 4  # sizes tried
_AROUND = 192  # pixels of a side of the views around eyes that say what Gaussians are worth
_CAP = 100.0  # dB of equal pictures
_BUILD, _JUDGE, _CHECK = range(3)  # random streams of eyes; checks take those from the last on


@dataclass(frozen=True)
class Budget:
    """What a view may have at most.

    Attributes:
        splats: Gaussians that cover a pixel of a view; None is no limit.
        fill: Mean number of Gaussians that cover a pixel of a view; None is no limit.
        eyes: Eyes for which the version is made, and that check it.
        steps: Training steps of a round; 0 leaves what stays as it is.
        seed: Seed of all eyes.

    Raises:
        ValueError: If there is no limit, or a value is not positive.
    """

    splats: int | None = None
    fill: float | None = None
    eyes: int = 12
    steps: int = 100
    seed: int = 0

    def __post_init__(self) -> None:
        if self.splats is None and self.fill is None:
            raise ValueError("budget: expected splats or fill, got neither; give one")
        for name in ("splats", "fill", "eyes"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ValueError(f"{name}: expected more than 0, got {value!r}")
        if self.steps < 0:
            raise ValueError(f"steps: expected at least 0, got {self.steps!r}")

    def share(self, splats: F64, mean: F64) -> F64:
        """Return the share of the budget that views take: the larger of both; above 1 it does not hold."""
        return np.maximum(splats / (self.splats or np.inf), mean / (self.fill or np.inf))

    def cost(self, covered: NDArray[np.float32]) -> F64:
        """Return the share of the budget of a view that each splat takes: of the splats and of the fill."""
        each = 1.0 / self.splats if self.splats else 0.0
        return np.asarray(each + covered / (self.fill or np.inf), np.float64)


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


def fit_budget(g: Gaussians, space: NavigableSpace, budget: Budget, progress: Progress = silent) -> Budgeted:
    """Return a version of a scene that holds a budget at every eye of a space.

    Args:
        g: N Gaussians.
        space: Where eyes may be.
        budget: The limits.
        progress: Called with stages "fill", "removal" and "views", in views, and "train", in steps.

    Raises:
        SceneError: If the space has no eyes outside of solid parts, or nothing would be left.
    """
    eyes = _eyes(g, space, budget, _BUILD)
    pictures = Pictures(_cameras(g, space, budget, _BUILD), Cameras.cubemap(eyes, _AROUND))
    before = measure_fill(g, _checking(g, space, budget, 0), progress=progress)
    lightening = _Lightening(g, Cameras.cubemap(eyes, SIDE), pictures, budget, progress)
    if budget.share(before.splats, before.mean).max() > _ROOM:
        lightening.run()
    aim = _ROOM
    for k in range(_CHECKS):
        others = _checking(g, space, budget, k)
        after = measure_fill(lightening.version, others, progress=progress)
        share = float(budget.share(after.splats, after.mean).max())
        if share <= 1.0 or k + 1 == _CHECKS:
            break
        aim /= np.sqrt(share)  # the next eyes see more, too, but less: these count from now on
        lightening.tighten(others, aim)
    version = lightening.version
    found = _likeness(g, version, _cameras(g, space, budget, _JUDGE))
    return Budgeted(version, before.largest(), after.largest(), share <= 1.0, float(found.mean()), float(found.min()))


class _Lightening:
    """A scene that becomes lighter.

    Attributes:
        version: The version so far.
    """

    def __init__(self, g: Gaussians, views: Cameras, pictures: Pictures, budget: Budget, progress: Progress) -> None:
        self.g = g
        self.version = g
        self.views = views
        self.pictures = pictures
        self.budget = budget
        self.progress = progress
        self._loads: list[Load] = []

    def run(self) -> None:
        """Leave out and train, round by round, until all views hold the budget."""
        self._loads = look(self.g, self.views, self.progress)
        if shares(self._loads, self.budget).max() <= _ROOM:
            return
        merged = self._try_merging()
        most = float(shares(self._loads, self.budget).max())
        falls = np.ceil(np.log(max(most / _ROOM, 1.0)) / np.log(_FALL))
        rounds = int(np.clip(falls, 2 if merged else 1, _ROUNDS))
        for k in range(rounds):
            self._shed(most * min(1.0, _ROOM / most) ** ((k + 1) / rounds))
            self._train(shapes=k + 1 < rounds)
        self._shed(1.0)

    def _try_merging(self) -> bool:
        """Begin with merged Gaussians, if pictures of them are better than of those that stay when others go."""
        heavy = self.views[np.argsort(-shares(self._loads, self.budget), kind="stable")[:_HEAVY]]
        merged = self._merge(heavy)
        rest = self.budget, _ROOM, self.pictures, self.progress
        merged, loads = shed(merged, look(merged, self.views, self.progress), *rest)
        left, _ = shed(self.g, self._loads, *rest)
        some = self.pictures.views[::_EVERY]
        if _likeness(self.g, merged, some).mean() <= _likeness(self.g, left, some).mean():
            return False
        self.version = merged
        self._loads = loads
        return True

    def _merge(self, views: Cameras) -> Gaussians:
        """Return merged Gaussians that hold the budget in views, or nearly."""
        version = self.g
        count = len(self.g)
        for _ in range(_MERGES):
            found = measure_fill(version, views, progress=self.progress)
            most = float(self.budget.share(found.splats, found.mean).max())
            if most <= 1.0:
                break
            count = max(1, int(0.99 * count * _ROOM / most))
            version = merge_pairs(self.g, count)
        return version

    def tighten(self, others: Cameras, most: float) -> None:
        """Leave out more until these views and all before take at most a share of the budget."""
        self._loads = [*self._loads, *look(self.version, others, self.progress)]
        self.views = _join(self.views, others)
        self._shed(most)
        self._train(shapes=False)

    def _shed(self, most: float) -> None:
        """Leave out until views take at most a share of the budget."""
        self.version, self._loads = shed(self.version, self._loads, self.budget, most, self.pictures, self.progress)

    def _train(self, *, shapes: bool) -> None:
        """Train the version on pictures of the scene; its scales stay nearly as they are without `shapes`."""
        from gsvis.train.trainer import TrainConfig, train  # slow to import

        if self.budget.steps == 0:
            return
        config = TrainConfig(
            iterations=self.budget.steps,
            sh_degree=self.version.sh_degree,
            sh_every=0,
            scales_rate=2e-3 if shapes else 1e-6,
            opacities_rate=2e-2 if shapes else 5e-3,
            rates_end=1.0 if shapes else 0.1,
            densify=None,
            evaluate_every=0,
            seed=self.budget.seed,
        )
        self.version = train(self._images, self.version, config, progress=self.progress).gaussians
        self._look_again()

    @cached_property
    def _images(self) -> PosedImages:
        """Pictures of the whole scene to train on."""
        from gsvis.train.images import render_views  # slow to import

        return render_views(self.g, self.pictures.views, progress=self.progress)

    def _look_again(self) -> None:
        """Measure what the heaviest views have after training; the others are taken as they were."""
        order = np.argsort(-shares(self._loads, self.budget), kind="stable")[:_HEAVY]
        found = look(self.version, self.views[order], self.progress)
        for c, load in zip(order.tolist(), found, strict=True):
            self._loads[c] = load


def _join(first: Cameras, second: Cameras) -> Cameras:
    """Return the cameras of both, of one size."""
    poses = np.concatenate([first.viewmats, second.viewmats])
    return Cameras(poses, np.concatenate([first.Ks, second.Ks]), first.width, first.height)


def _cameras(g: Gaussians, space: NavigableSpace, budget: Budget, stream: int) -> Cameras:
    """Return views as visitors have them, small: to train on, and others to compare."""
    count = 2 * budget.eyes if stream == _JUDGE else 6 * budget.eyes
    return ViewSampling(count, 320, 240, 75.0, budget.seed, stream).cameras(g, space)


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
