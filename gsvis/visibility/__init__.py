"""Visibility of a whole scene: what views need, what each cell sees, and from how many directions each can be seen.

    space = NavigableSpace.from_scene(scene)
    grid = CellGrid.over(space, max_cells=256)
    with build_pvs(scene, grid, space, "scene.pvs") as store:
        ids = store.visible_ids(store.cell_at(eye))

Names are imported when first used: workers that look from cells need no ray tracer.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gsvis.visibility._corridor import corridor
    from gsvis.visibility.active_terms import ActiveShare, ActiveTerms, build_active_terms
    from gsvis.visibility.analysis import (
        FACE_LIMITS,
        PAPER,
        Agreement,
        Analysis,
        AnalysisConfig,
        DirectionCdf,
        Settling,
        analyze,
    )
    from gsvis.visibility.build import Estimate, Workers, build_pvs, estimate_pvs
    from gsvis.visibility.cells import CellGrid
    from gsvis.visibility.cluster import connect
    from gsvis.visibility.color_quality import ColorQuality, ColorQualityConfig, measure_colors
    from gsvis.visibility.colors import ColorConfig, ColorPreparation, ViewSampling, prepare_colors
    from gsvis.visibility.fitted_colors import FittedColors
    from gsvis.visibility.pvs import PvsConfig
    from gsvis.visibility.quality import Quality, QualityConfig, measure_quality
    from gsvis.visibility.store import CellSet, StoreInfo, VisibilityStore, write_store
    from gsvis.visibility.viewpoints import CellViewpoints
    from gsvis.visibility.walk import WalkConfig, WalkVisibility, seen_over_walk
    from gsvis.visibility.walk_terms import PAPER_TERMS, WalkTerms, terms_over_walk
    from gsvis.visibility.why import Why

__all__ = [
    "FACE_LIMITS",
    "PAPER",
    "PAPER_TERMS",
    "ActiveShare",
    "ActiveTerms",
    "Agreement",
    "Analysis",
    "AnalysisConfig",
    "CellGrid",
    "CellSet",
    "CellViewpoints",
    "ColorConfig",
    "ColorPreparation",
    "ColorQuality",
    "ColorQualityConfig",
    "DirectionCdf",
    "Estimate",
    "FittedColors",
    "PvsConfig",
    "Quality",
    "QualityConfig",
    "Settling",
    "StoreInfo",
    "ViewSampling",
    "VisibilityStore",
    "WalkConfig",
    "WalkTerms",
    "WalkVisibility",
    "Why",
    "Workers",
    "analyze",
    "build_active_terms",
    "build_pvs",
    "connect",
    "corridor",
    "estimate_pvs",
    "measure_colors",
    "measure_quality",
    "prepare_colors",
    "seen_over_walk",
    "terms_over_walk",
    "write_store",
]

_HOMES = {
    "_corridor": ("corridor",),
    "active_terms": ("ActiveShare", "ActiveTerms", "build_active_terms"),
    "analysis": (
        "FACE_LIMITS",
        "PAPER",
        "Agreement",
        "Analysis",
        "AnalysisConfig",
        "DirectionCdf",
        "Settling",
        "analyze",
    ),
    "build": ("Estimate", "Workers", "build_pvs", "estimate_pvs"),
    "cells": ("CellGrid",),
    "cluster": ("connect",),
    "color_quality": ("ColorQuality", "ColorQualityConfig", "measure_colors"),
    "colors": ("ColorConfig", "ColorPreparation", "ViewSampling", "prepare_colors"),
    "fitted_colors": ("FittedColors",),
    "pvs": ("PvsConfig",),
    "quality": ("Quality", "QualityConfig", "measure_quality"),
    "store": ("CellSet", "StoreInfo", "VisibilityStore", "write_store"),
    "viewpoints": ("CellViewpoints",),
    "walk": ("WalkConfig", "WalkVisibility", "seen_over_walk"),
    "walk_terms": ("PAPER_TERMS", "WalkTerms", "terms_over_walk"),
    "why": ("Why",),
}


def __getattr__(name: str) -> Any:
    for home, names in _HOMES.items():
        if name in names:
            value = globals()[name] = getattr(import_module(f"{__name__}.{home}"), name)
            return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
