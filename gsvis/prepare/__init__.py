"""Prepare a package from a scene: all stages, their cost and their quality.

    prepared = prepare_package(load_scene("scene.ply"), "scene.gsvis", space)

Names are imported on first use.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gsvis.prepare.active_terms import build_active_terms
    from gsvis.prepare.approximations import Approximations, flip_difference
    from gsvis.prepare.color_quality import ColorQuality, ColorQualityConfig, measure_colors
    from gsvis.prepare.colors import ColorConfig, ColorPreparation, prepare_colors
    from gsvis.prepare.config import PrepareConfig
    from gsvis.prepare.estimate import PreparationEstimate, StageEstimate, estimate_preparation
    from gsvis.prepare.fitted_colors import FittedColors
    from gsvis.prepare.levels import MadeLevels, make_levels
    from gsvis.prepare.prepare import Prepared, prepare_package
    from gsvis.prepare.scene_colors import ColorOutputs, color_scene
    from gsvis.prepare.stages import StageRecord

__all__ = [
    "Approximations",
    "ColorConfig",
    "ColorOutputs",
    "ColorPreparation",
    "ColorQuality",
    "ColorQualityConfig",
    "FittedColors",
    "MadeLevels",
    "PreparationEstimate",
    "PrepareConfig",
    "Prepared",
    "StageEstimate",
    "StageRecord",
    "build_active_terms",
    "color_scene",
    "estimate_preparation",
    "flip_difference",
    "make_levels",
    "measure_colors",
    "prepare_colors",
    "prepare_package",
]

_HOMES = {
    "active_terms": ("build_active_terms",),
    "approximations": ("Approximations", "flip_difference"),
    "color_quality": (
        "ColorQuality",
        "ColorQualityConfig",
        "measure_colors",
    ),
    "scene_colors": ("ColorOutputs", "color_scene"),
    "colors": (
        "ColorConfig",
        "ColorPreparation",
        "prepare_colors",
    ),
    "config": ("PrepareConfig",),
    "estimate": (
        "PreparationEstimate",
        "StageEstimate",
        "estimate_preparation",
    ),
    "fitted_colors": ("FittedColors",),
    "levels": ("MadeLevels", "make_levels"),
    "prepare": (
        "Prepared",
        "prepare_package",
    ),
    "stages": ("StageRecord",),
}


def __getattr__(name: str) -> Any:
    for home, names in _HOMES.items():
        if name in names:
            value = globals()[name] = getattr(import_module(f"{__name__}.{home}"), name)
            return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
