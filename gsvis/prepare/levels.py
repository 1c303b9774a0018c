"""Train and measure the quality levels of a scene; an interrupted run resumes."""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.files.mapped import release_mapped
from gsvis.jobs.resume import folder_beside
from gsvis.progress import Progress, silent
from gsvis.render.judges import count_views
from gsvis.scene.content import scene_hash
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.judged import Judged
from gsvis.scene.levels import Levels
from gsvis.scene.view_sampling import ViewSampling
from gsvis.train.config import decisive_options
from gsvis.train.history import Record
from gsvis.train.level_quality import LevelQuality, judge_levels, measure_levels
from gsvis.train.level_views import LevelViews
from gsvis.train.levels import LevelsConfig, TrainedLevels, train_levels

__all__ = ["MadeLevels", "count_eyes", "find_levels_work", "judge", "make_levels"]


_WITHOUT_REUSE = "without-reuse"  # folder of the work on levels that reuse nothing
_USUAL = 12  # held-out views from which there are as many to judge as elsewhere
# pixels and degrees of these views
_WIDTH = 160
_FOV = 75.0
_STREAM = 7  # of the seed


@dataclass(frozen=True, eq=False)
class MadeLevels:
    """Levels and their quality.

    Attributes:
        trained: The levels.
        quality: Quality in held-out views; None without held-out views.
        judged: For each level below the highest, the quality at independent eyes; empty without held-out views.
        without_reuse: Quality of levels of the same sizes that reuse nothing; None if nobody asked.
    """

    trained: TrainedLevels
    quality: LevelQuality | None
    judged: tuple[Judged, ...] = ()
    without_reuse: LevelQuality | None = None

    @property
    def warning(self) -> str | None:
        """The warning of the first level that has one."""
        return next((each.warning for each in self.judged if each.warning), None)

    def record(self, g: Gaussians, views: LevelViews, config: LevelsConfig) -> dict[str, Any]:
        """Return how the levels were made and how good they are, for JSON; equal runs give equal records.

        Args:
            g: The scene.
            views: Images for training and for measurement.
            config: Sizes and training of the levels.
        """
        levels = self.trained.levels
        # Renders to train on are smaller than what was asked for.
        cameras = views.views.cameras if views.choose_by is None else views.choose_by
        rows = []
        for k, name in enumerate(levels.names):
            row: dict[str, Any] = {
                "name": name,
                "gaussians": levels.counts[k],
                "share": levels.counts[k] / len(g),
                "reuse": levels.reuse[k] if k < len(levels.reuse) else None,
            }
            if self.quality is not None:
                row["psnr"] = _spread(self.quality.scene_psnr[k]) if k < len(levels.reuse) else None
                row["psnr_photographs"] = (
                    None if self.quality.photo_psnr is None else _spread(self.quality.photo_psnr[k])
                )
                row["brightness"] = float(self.quality.brightness[k])
                if self.without_reuse is not None and k < len(levels.reuse):
                    row["reuse_costs"] = _price(self.quality.scene_psnr[k], self.without_reuse.scene_psnr[k])
            if k < len(self.judged):
                row["judged"] = self.judged[k].as_dict()
            if name in self.trained.histories:
                row["curve"] = [_step(record) for record in self.trained.histories[name]]
            rows.append(row)
        return {
            "scene_sha256": scene_hash(g),
            "gaussians": len(g),
            "union": len(levels.union),
            "overhead": levels.overhead,
            "views": {
                "from": views.cameras_from,
                "photographs": views.photographs,
                "trained_on": len(views.views),
                "held_out": 0 if views.held_out is None else len(views.held_out),
                "width": cameras.width,
                "height": cameras.height,
            },
            "config": decisive_options(config),
            "levels": rows,
        }


def make_levels(
    g: Gaussians,
    views: LevelViews,
    config: LevelsConfig,
    *,
    work: str | os.PathLike[str],
    with_curve: bool = True,
    price_reuse: bool = False,
    progress: Progress = silent,
) -> MadeLevels:
    """Train levels, and measure them in held-out views.

    Args:
        g: The scene.
        views: Images for training and for measurement.
        config: Sizes and training of the levels.
        work: Folder for unfinished work, such as `find_levels_work`; the caller deletes it.
        with_curve: Also measure during training.
        price_reuse: Also train and measure levels that reuse nothing, which takes as long again; with held-out views.
        progress: Called with the stages of `train_levels`, `measure_levels` and `judge_levels`.

    Raises:
        FormatError: If the kept work is damaged.
        ValueError: If the scene is too small for its levels, or the folder holds the work of another run.
    """
    held_out = views.held_out
    trained = train_levels(
        g,
        views.views,
        config,
        held_out=held_out if with_curve else None,
        choose_by=views.choose_by,
        space=views.space,
        work=work,
        progress=progress,
    )
    release_mapped(vars(g).values())  # levels are copies
    quality = None
    judged = tuple[Judged, ...]()
    if held_out is not None:
        quality = measure_levels(trained.levels, held_out, photographs=views.photographs, progress=progress)
        judged = judge(trained.levels, views, config.seed, progress)
    without_reuse = None
    if price_reuse and held_out is not None:
        free = train_levels(
            g,
            views.views,
            replace(config, reuse=(0.0,) * len(config.reuse)),
            choose_by=views.choose_by,
            space=views.space,
            work=Path(work) / _WITHOUT_REUSE,
            progress=progress,
        )
        without_reuse = measure_levels(free.levels, held_out, photographs=views.photographs, progress=progress)
    return MadeLevels(trained, quality, judged, without_reuse)


def count_eyes(held_out: int) -> int:
    """Return the number of eyes of each rule that judge levels, for a number of held-out views."""
    return count_views(held_out, _USUAL)


def judge(levels: Levels, views: LevelViews, seed: int, progress: Progress = silent) -> tuple[Judged, ...]:
    """Return the quality of levels at builder's and judge's eyes; uses few eyes if few views are held out."""
    assert views.held_out is not None
    held_out = views.held_out.cameras
    count = count_eyes(len(held_out))
    width = min(_WIDTH, held_out.width)
    small = ViewSampling(count, width, max(1, round(held_out.height * width / held_out.width)), _FOV, seed, _STREAM)
    if views.space is None:
        chosen = np.linspace(0, len(held_out) - 1, min(count, len(held_out))).astype(int)
        mine = held_out[chosen].resize(small.width, small.height)
    else:
        mine = small.cameras(levels, views.space)
    return judge_levels(levels, mine, small, views.space, progress=progress)


def find_levels_work(out: str | os.PathLike[str], g: Gaussians, views: LevelViews, config: LevelsConfig) -> Path:
    """Return the hidden work folder of a run, beside its result; it depends on scene, views and settings.

    It does not depend on the device, since views are drawn on the CPU whatever trains on them.
    """
    digest = hashlib.sha256()
    for array in (views.views.images, views.views.cameras.viewmats, views.views.cameras.Ks):
        digest.update(np.ascontiguousarray(array).data)
    return folder_beside(out, [scene_hash(g), decisive_options(config), digest.hexdigest()], hidden=True)


def _spread(values: NDArray[np.float64]) -> dict[str, float]:
    """Return the mean and the least of the values (C,) of views."""
    return {"mean": float(values.mean()), "worst": float(values.min())}


def _price(reusing: NDArray[np.float64], free: NDArray[np.float64]) -> dict[str, float]:
    """Return what reuse costs in dB, by the PSNR (C,) of a level with and without it: of the mean and of the worst."""
    return {"mean": float(free.mean() - reusing.mean()), "worst": float(free.min() - reusing.min())}


def _step(record: Record) -> dict[str, Any]:
    """Return one point of a curve, without times, which differ from run to run."""
    point = record.as_json()
    return {"step": point["step"], "loss": point["loss"], "gaussians": point["count"], "psnr": point["psnr"]}
