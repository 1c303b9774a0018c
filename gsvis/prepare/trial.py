"""Try a little of each stage of a preparation on the very scene: a view, a look, a few steps, a thousand colors.

Stages are sums over views, steps and Gaussians, so a few of these say what all take. Nothing is kept.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.color import quantize
from gsvis.color.evaluate import Evaluator
from gsvis.color.fit import SrbfFit, fit_srbf, fitted_for_price
from gsvis.jobs.in_order import in_order
from gsvis.package import Contents, ExactLevel, PackageOrder, measure_cost, measure_fidelity
from gsvis.prepare.config import PrepareConfig
from gsvis.prepare.importance import direction_weights, importance_from_views
from gsvis.prepare.learned_colors import RENDERS
from gsvis.prepare.levels import count_eyes
from gsvis.render.removal import removal_effects
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.in_sight import InSight
from gsvis.scene.levels import Levels
from gsvis.scene.navigable import NavigableSpace
from gsvis.train.choosing import count_looks
from gsvis.train.fill_in import fit_opacities, views_used
from gsvis.train.images import PosedImages, render_views
from gsvis.train.level_quality import measure_levels
from gsvis.train.level_views import views_to_choose, views_to_train
from gsvis.train.levels import LevelsConfig, frozen_sizes
from gsvis.train.pairs import merge_pairs

__all__ = ["StageTrial"]

_VIEWS = 3  # views and steps that are timed
_BESIDE = 4  # views and looks that are timed side by side
_FITTED = 2048  # Gaussians whose colors are fitted; fewer keep threads busy only in part
_FEW = 8  # Gaussians that load the kernels of colors
_FITTED_IN = 2  # views in which opacities are fitted
_MERGED = 1 << 15  # most Gaussians that are merged
_MERGED_INTO = 32  # of these, merged into one
_MERGE_POWER = 1.1  # of the number of Gaussians, as which the time of merging grows: more of them miss the caches
_POLLED = 16  # cameras from which the number of looks is found
_FAINT = 0.02  # presence of Gaussians that hardly stand in a look that chooses; half of them do
_STEPS_OF_CLIENT = 5 / 4  # images of a view with visible sets, over those without


class StageTrial:
    """Seconds of the stages of a preparation.

    Args:
        levels: The levels, or stand-ins for them.
        space: The navigable space.
        config: The options.
        clock: Returns the seconds that are measured.
    """

    def __init__(
        self, levels: Levels, space: NavigableSpace, config: PrepareConfig, clock: Callable[[], float]
    ) -> None:
        order = PackageOrder.from_levels(levels)
        self._levels = order.sort(levels)
        self._order = order.of_sorted()
        self._fits_warm = False
        self._scene = levels.level(len(levels) - 1)
        self._space = space
        self._config = config
        self._clock = clock

    def training(self, levels: LevelsConfig, *, photos: bool, chosen: bool) -> float:
        """Return the seconds to train levels.

        Args:
            levels: Their sizes and training.
            photos: Whether they are trained on photos, taken to be as many as views.
            chosen: Whether the frozen Gaussians are known.
        """
        views = self._config.level_views
        levels = levels.fit_to(len(self._scene))
        cameras = self._cameras(replace(views_to_train(views), count=_VIEWS + 1))
        tried, of_render = self._render(cameras)
        seconds = views.count * of_render
        if self._config.level_held_out:
            seconds += self._measuring()
        if not chosen:
            seconds += self._choice(levels, photos)
        order = np.argsort(-self._scene.opacities * self._scene.scales.max(axis=1), kind="stable")
        for total, frozen, begun in levels.sizes(len(self._scene)):
            if begun > frozen:
                stays = self._scene[np.sort(order[:frozen])]
                rest = np.sort(order[frozen:])
                merged = _stand_in_of(self._scene, rest, (begun + total) // 2 - frozen)
                seconds += self._merge_rate * float(len(rest) ** _MERGE_POWER)
                if not photos:
                    seconds += self._fitting(merged, stays, tried[:_FITTED_IN], views.count)
                seconds += self._steps(levels, total, merged, stays, tried)
        return seconds

    def _render(self, cameras: Cameras) -> tuple[PosedImages, float]:
        """Return images of cameras and the seconds of each; the first is drawn twice, to load the kernels."""
        render_views(self._scene, cameras[0])
        began = self._clock()
        images = render_views(self._scene, cameras)
        return images, (self._clock() - began) / len(cameras)

    @cached_property
    def _merge_rate(self) -> float:
        """Seconds of merging N Gaussians, over N to the power of `_MERGE_POWER`."""
        first = self._levels.first
        some = np.flatnonzero(first == first.max())  # neighbors are near each other there
        begin = max(0, (len(some) - _MERGED) // 2)
        block = self._levels.union[some[begin : begin + _MERGED]]
        count = max(1, len(block) // _MERGED_INTO)
        merge_pairs(block[:_FITTED], max(1, min(_FITTED, len(block)) // 2))  # loads the kernels
        seconds = self._seconds(partial(merge_pairs, block, count))
        return seconds / float(len(block) ** _MERGE_POWER)

    def _fitting(self, merged: Gaussians, stays: Gaussians, tried: PosedImages, views: int) -> float:
        """Return the seconds to fit the opacities of a level in some of `views` views."""
        if not self._fits_warm:
            fit_opacities(merged[:1], stays[:_FITTED], tried[:1])  # loads the kernels
            self._fits_warm = True
        fit = self._seconds(partial(fit_opacities, merged, stays, tried))
        return fit * views_used(views) / views_used(len(tried))

    def _measuring(self) -> float:
        """Return the seconds to render held-out views, and to measure levels in them and at other eyes.

        At each other eye, a builder's or a judge's, levels are drawn in half the pixels. To find these eyes takes
        little, and is not counted.
        """
        cameras = self._cameras(replace(self._config.level_views, count=_VIEWS))
        held_out, of_render = self._render(cameras)
        measured = self._seconds(partial(measure_levels, self._levels, held_out)) / len(cameras)
        asked = self._config.level_held_out
        return asked * (of_render + measured) + count_eyes(asked) * measured

    def _choice(self, levels: LevelsConfig, photos: bool) -> float:
        """Return the seconds of all looks that choose the frozen Gaussians."""
        views = self._config.level_views
        counts = frozen_sizes(levels.sizes(len(self._scene)))
        if photos:
            left = counts[-1] / len(self._scene)
            looks = views.count * math.ceil(math.log(left) / math.log(1.0 - levels.prune_share))
            sight = None
        else:
            many = views_to_choose(views)
            polled = self._cameras(replace(many, count=_POLLED))
            asked = levels.looks_to_choose
            looks, _ = count_looks(self._scene, polled, counts, of=many.count, looks=asked, space=self._space)
            sight = InSight.from_scene(self._scene, self._space)
        presence = np.where(np.random.default_rng(0).random(len(self._scene)) < 0.5, 1.0, _FAINT)

        def look(camera: Cameras) -> None:
            """Look once, as the choice does."""
            some = np.arange(len(self._scene)) if sight is None else np.flatnonzero(sight.of(camera))
            removal_effects(self._scene[some], camera, presence=presence[some])

        def look_from(cameras: Cameras) -> None:
            """Look from cameras side by side."""
            for _ in in_order(look, (cameras[c] for c in range(len(cameras)))):
                pass

        return looks * self._each(look_from, self._cameras(replace(views_to_choose(views), count=_BESIDE + 2)))

    def _steps(
        self, levels: LevelsConfig, total: int, merged: Gaussians, stays: Gaussians, tried: PosedImages
    ) -> float:
        """Return the seconds of the training of a level, the loading of torch included."""
        began = self._clock()
        from gsvis.train.trainer import Trainer

        trainer = Trainer(tried, merged, levels.training(total, stays.sh_degree), frozen=stays, space=self._space)
        trainer.advance()
        first = self._clock() - began
        each = np.median([self._seconds(trainer.advance) for _ in range(_VIEWS)])
        return first + float(each) * (levels.iterations - 1)

    def colors(self, count: int) -> float:
        """Return the seconds to find and fit the colors of `count` Gaussians."""
        fit = self._config.colors.fit
        views = self._config.colors.views
        seconds = self._fitted[1] * (count + fitted_for_price(count, fit))
        if self._scene.sh_degree and views.count:
            cameras = self._cameras(replace(views, count=_BESIDE + 2))
            seconds += views.count * self._each(partial(importance_from_views, self._levels), cameras)
        return seconds

    def learning(self, steps: int, *, photos: bool) -> float:
        """Return the seconds to learn colors, the loading of torch included.

        Args:
            steps: Steps of learning, at least 1.
            photos: Whether from photos, taken to be as large as the views of levels.
        """
        began = self._clock()
        from gsvis.train.colors import LearnConfig, learn_colors

        cameras = self._cameras(replace(self._config.level_views if photos else RENDERS, count=_VIEWS))
        tried = render_views(self._scene, cameras) if photos else cameras
        config = LearnConfig() if photos else LearnConfig.for_renders()
        colors = self._fitted[0].colors
        many = colors[np.arange(len(self._scene)) % len(colors)]
        ends = [began]

        def note(stage: str, done: int, of: int) -> None:
            """Note when a step ends."""
            if done:
                ends.append(self._clock())

        config = replace(config, steps=_VIEWS + 1)
        learn_colors(self._scene, many, tried, config, backend=self._config.colors.backend, progress=note)
        first, *others = np.diff(ends).tolist()
        return float(first + np.median(others) * (steps - 1))

    @cached_property
    def _fitted(self) -> tuple[SrbfFit, float]:
        """The fit of some colors, as if they were seen from everywhere, and the seconds of each Gaussian."""
        union = self._levels.union
        some = union[np.linspace(0, len(union) - 1, min(_FITTED, len(union))).astype(int)]
        fit = self._config.colors.fit if union.sh_degree else replace(self._config.colors.fit, max_terms=0)
        weights = direction_weights(np.full((len(some), 10), 255, np.uint8), None)
        fit_srbf(some[:8], weights[:8], fit)  # loads the kernels
        began = self._clock()
        found = fit_srbf(some, weights, fit)
        return found, (self._clock() - began) / (len(some) + fitted_for_price(len(some), fit))

    def cost(self) -> float:
        """Return the seconds to measure the cost of rounding."""
        views = self._config.cost_views
        levels, exact, packed = self._rounded
        _, encoding = self._encoded
        cameras = self._cameras(replace(views, count=_VIEWS))
        Evaluator(exact[:_FEW]).colors(levels.union.means[:_FEW], cameras.viewpoints[0])  # loads the kernels
        measured = self._seconds(partial(measure_cost, levels, exact, packed, cameras, order=self._order))
        return encoding + views.count * max(0.0, measured - encoding) / len(cameras)

    def fidelity(self) -> float:
        """Return the seconds to measure what a client gets, without sets."""
        views = self._config.fidelity_views
        levels, exact, _ = self._rounded
        contents, encoding = self._encoded
        member = levels.member(len(levels) - 1)
        level = ExactLevel(levels.union[member], exact[member])
        cameras = self._cameras(replace(views, count=_VIEWS))
        measured = self._seconds(partial(measure_fidelity, self._scene, contents, cameras, exact=level))
        return encoding + _STEPS_OF_CLIENT * views.count * measured / len(cameras)

    @cached_property
    def _rounded(self) -> tuple[Levels, Any, Any]:
        """The levels with colors like those that were fitted, before and after rounding."""
        found = self._fitted[0].colors
        colors = found[np.arange(len(self._levels.union)) % len(found)]
        return self._levels, colors, quantize(colors, self._config.colors.precision)

    @cached_property
    def _encoded(self) -> tuple[Contents, float]:
        """The records of these levels, and the seconds to encode them."""
        levels, _, packed = self._rounded
        began = self._clock()
        contents = Contents.from_levels(levels, packed, self._order)
        return contents, self._clock() - began

    def _cameras(self, views: Any) -> Cameras:
        cameras: Cameras = views.cameras(self._scene, self._space)
        return cameras

    def _each(self, work: Callable[[Cameras], object], cameras: Cameras) -> float:
        """Return the seconds of work with a camera beside others; the first two load kernels, and memory of threads."""
        work(cameras[:2])
        return self._seconds(partial(work, cameras[2:])) / (len(cameras) - 2)

    def _seconds(self, work: Callable[[], object]) -> float:
        """Return how long some work takes."""
        began = self._clock()
        work()
        return self._clock() - began


def _stand_in_of(scene: Gaussians, ids: NDArray[np.int64], count: int) -> Gaussians:
    """Return `count` of the Gaussians of a scene, as much larger as fewer: they take as long to draw as merged ones.

    Args:
        scene: N Gaussians.
        ids: (M,) those that would be merged.
        count: Size of the result, 1 to M.
    """
    some = scene[ids[np.linspace(0, len(ids) - 1, count).astype(int)]]
    return replace(some, scales=some.scales * np.float32(math.sqrt(len(ids) / count)))
