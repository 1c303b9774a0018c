"""A scene made into a package that can be served, step by step, each step kept for the next time.

prepared = prepare_package(load_scene("scene.ply"), "scene.gsvis", space)
"""

from gsvis.prepare.config import PrepareConfig
from gsvis.prepare.estimate import PreparationEstimate, StageEstimate, estimate_preparation
from gsvis.prepare.prepare import Prepared, prepare_package
from gsvis.prepare.stages import StageRecord

__all__ = [
    "PreparationEstimate",
    "PrepareConfig",
    "Prepared",
    "StageEstimate",
    "StageRecord",
    "estimate_preparation",
    "prepare_package",
]


def __dir__() -> list[str]:
    return sorted(__all__)
