"""Training: from photographs or a finished scene to Gaussians, and to quality levels that share them."""

from __future__ import annotations

from gsvis.train.densify import DensifyConfig
from gsvis.train.history import Record
from gsvis.train.images import PosedImages
from gsvis.train.initial import gaussians_from_points, random_points
from gsvis.train.likeness import ViewLikeness, measure_views
from gsvis.train.photos import Photos, load_photos
from gsvis.train.trainer import TrainConfig, Trainer, TrainResult, train

__all__ = [
    "DensifyConfig",
    "Photos",
    "PosedImages",
    "Record",
    "TrainConfig",
    "TrainResult",
    "Trainer",
    "ViewLikeness",
    "gaussians_from_points",
    "load_photos",
    "measure_views",
    "random_points",
    "train",
]
