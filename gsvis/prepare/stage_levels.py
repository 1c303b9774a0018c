"""The stage of the levels: trained once, then read back from the working folder."""

from __future__ import annotations

import shutil
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from gsvis.errors import FormatError
from gsvis.io.levels import MAP, levels_info, load_levels, save_levels
from gsvis.package import in_package_order
from gsvis.prepare.levels import make_levels
from gsvis.prepare.stages import Stages
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels
from gsvis.train.config import decisive_options
from gsvis.train.level_views import LevelViews, draw_views, load_photograph_views

__all__ = ["name_levels", "reuse_levels", "run_levels"]


def name_levels(stages: Stages) -> str:
    """Return the name of the folder of the levels; levels of any device are the same stage."""
    assert isinstance(stages.scene, Gaussians)
    config = stages.config
    if stages.photos is None:
        views: dict[str, Any] = {
            "drawn": asdict(config.level_views),
            "held_out": config.level_held_out,
            "space": stages.space_hash,
        }
    else:
        views = {"photographs": stages.photos_hash, "size": config.level_size}
    training = None if config.levels is None else decisive_options(config.levels)
    return "levels-" + stages.key("levels", scene=stages.scene_hash, training=training, views=views)


def reuse_levels(stages: Stages) -> Levels | None:
    """Return the levels, in the order of a package, if no training is needed; None otherwise."""
    if isinstance(stages.scene, Levels) or stages.config.levels is None:
        stages.progress("order", 0, 1)
        given = stages.scene if isinstance(stages.scene, Levels) else Levels.single(stages.scene)
        found = in_package_order(given)
        stages.progress("order", 1, 1)
        return found
    folder = stages.work.at(name_levels(stages))
    try:
        return load_levels(folder) if (folder / MAP).exists() else None
    except FormatError:
        return None


def run_levels(stages: Stages) -> tuple[Levels, dict[str, Any] | None]:
    """Return the levels in the order of a package, and the record of their quality; None if none were trained.

    Large levels lie in files, see `Stages.shelve`.
    """
    with stages.stage("levels") as done:
        found = reuse_levels(stages)
        if found is None:
            done.append(True)
            folder = stages.work.at(name_levels(stages))
            _train(stages, folder)
            stages.rest()
            found = load_levels(folder)
        extra = levels_info(stages.work.at(name_levels(stages))).extra if stages.trains else None
    judged = (extra or {}).get("judged") or []
    stages.remarks += [each["warning"] for each in judged if each["warning"]][:1]
    return stages.shelve(found), extra


def _train(stages: Stages, folder: Path) -> None:
    """Train, measure and save levels."""
    assert isinstance(stages.scene, Gaussians)
    assert stages.config.levels is not None
    shutil.rmtree(folder, ignore_errors=True)
    begun = stages.work.at(f"{folder.name}.begun")
    views = _views(stages)
    stages.rest()
    stages.remarks += views.remarks
    for last in (False, True):
        try:
            made = make_levels(
                stages.scene, views, stages.config.levels, work=begun, with_curve=False, progress=stages.progress
            )
            break
        except FormatError:  # the kept work of an earlier run is damaged
            shutil.rmtree(begun, ignore_errors=True)
            if last:
                raise
    record: dict[str, Any] = {"cameras": views.cameras_from}
    quality = made.quality
    if views.held_out is not None and quality is not None:
        record |= {
            "views": len(views.held_out),
            "width": views.held_out.cameras.width,
            "height": views.held_out.cameras.height,
            "psnr": _spreads(quality.scene_psnr),
        }
        if quality.photo_psnr is not None:
            record["psnr_photographs"] = _spreads(quality.photo_psnr)
    record["judged"] = [each.as_dict() for each in made.judged]
    levels = in_package_order(made.trained.levels)
    del made, views
    stages.rest()
    save_levels(levels, folder, record)
    shutil.rmtree(begun, ignore_errors=True)


def _views(stages: Stages) -> LevelViews:
    """Return the views for training."""
    assert isinstance(stages.scene, Gaussians)
    config = stages.config
    if stages.photos is not None:
        return load_photograph_views(stages.scene, stages.photos, config.level_size, progress=stages.progress)
    return draw_views(stages.scene, stages.space, config.level_views, config.level_held_out, progress=stages.progress)


def _spreads(values: np.ndarray[Any, np.dtype[np.float64]]) -> list[dict[str, float]]:
    """Return the mean and the least value of each row of (L, C) values."""
    return [{"mean": float(row.mean()), "worst": float(row.min())} for row in values]
