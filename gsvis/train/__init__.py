"""Train Gaussians from photos or a finished scene, and quality levels that share them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from gsvis.train.choosing import choose_subsets
from gsvis.train.config import DensifyConfig, TrainConfig
from gsvis.train.history import Record
from gsvis.train.images import PosedImages, render_views
from gsvis.train.importance import importance, most_important, prune
from gsvis.train.initial import gaussians_from_points, random_points
from gsvis.train.level_quality import LevelQuality, measure_levels
from gsvis.train.levels import LevelsConfig, TrainedLevels, train_levels
from gsvis.train.likeness import ViewLikeness, measure_views
from gsvis.train.merge import merge_gaussians
from gsvis.train.photos import Photos, load_photos

if TYPE_CHECKING:
    from gsvis.train.colors import LearnConfig, learn_colors, learn_sh
    from gsvis.train.trainer import Trainer, TrainResult, train

__all__ = [
    "DensifyConfig",
    "LearnConfig",
    "LevelQuality",
    "LevelsConfig",
    "Photos",
    "PosedImages",
    "Record",
    "TrainConfig",
    "TrainResult",
    "TrainedLevels",
    "Trainer",
    "ViewLikeness",
    "choose_subsets",
    "gaussians_from_points",
    "importance",
    "learn_colors",
    "learn_sh",
    "load_photos",
    "measure_levels",
    "measure_views",
    "merge_gaussians",
    "most_important",
    "prune",
    "random_points",
    "render_views",
    "train",
    "train_levels",
]


_NEED_TORCH = {
    "LearnConfig": "colors",
    "TrainResult": "trainer",
    "Trainer": "trainer",
    "learn_colors": "colors",
    "learn_sh": "colors",
    "train": "trainer",
}  # name: module


def __getattr__(name: str) -> Any:
    """Import names that need torch on first use."""
    if name in _NEED_TORCH:
        from importlib import import_module

        from gsvis._extras import require

        require(f"gsvis.train.{name}", "torch")
        return getattr(import_module(f"gsvis.train.{_NEED_TORCH[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
