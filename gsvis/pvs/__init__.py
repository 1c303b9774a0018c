"""Potentially visible sets: cells of a space, the set of each cell, the store of all sets, and their quality.

    space = NavigableSpace.from_scene(scene)
    grid = CellGrid.over(space, max_cells=256)
    with build_pvs(scene, grid, space, "scene.pvs") as store:
        ids = store.visible_ids(store.cell_at(eye))

This room knows no color. Names are imported on first use, so that workers need no ray tracer.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gsvis.pvs.bound import staged_bound, upper_bound
    from gsvis.pvs.build import build_pvs
    from gsvis.pvs.cells import CellGrid
    from gsvis.pvs.certificate import Certificate, CertificateConfig, Certifier
    from gsvis.pvs.config import PvsConfig
    from gsvis.pvs.estimate import Estimate, estimate_pvs
    from gsvis.pvs.quality import Quality, QualityConfig, measure_quality
    from gsvis.pvs.store import CellSet, StoreInfo, VisibilityStore, write_store
    from gsvis.pvs.viewpoints import CellViewpoints, FreeVoxels, SharedViewpoints
    from gsvis.pvs.why import Why

__all__ = [
    "CellGrid",
    "CellSet",
    "CellViewpoints",
    "Certificate",
    "CertificateConfig",
    "Certifier",
    "Estimate",
    "FreeVoxels",
    "PvsConfig",
    "Quality",
    "QualityConfig",
    "SharedViewpoints",
    "StoreInfo",
    "VisibilityStore",
    "Why",
    "build_pvs",
    "estimate_pvs",
    "measure_quality",
    "staged_bound",
    "upper_bound",
    "write_store",
]

_HOMES = {
    "bound": (
        "staged_bound",
        "upper_bound",
    ),
    "build": ("build_pvs",),
    "cells": ("CellGrid",),
    "certificate": (
        "Certificate",
        "CertificateConfig",
        "Certifier",
    ),
    "config": ("PvsConfig",),
    "estimate": (
        "Estimate",
        "estimate_pvs",
    ),
    "quality": (
        "Quality",
        "QualityConfig",
        "measure_quality",
    ),
    "store": (
        "CellSet",
        "StoreInfo",
        "VisibilityStore",
        "write_store",
    ),
    "viewpoints": (
        "CellViewpoints",
        "FreeVoxels",
        "SharedViewpoints",
    ),
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
