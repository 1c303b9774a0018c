"""Edit scenes by visibility: clean, cut and paint them, and convert their navigable space to meshes."""

from gsvis.edit.budget import Budget, Budgeted, fit_budget
from gsvis.edit.classes import CLASSES, HIDDEN, KEPT, CleanConfig, class_of, classify
from gsvis.edit.cleaning import Cleaning, clean, core_of, held_out_cameras
from gsvis.edit.cut import Cut, CutConfig, HeldOut, cut
from gsvis.edit.evidence import Evidence, gather_evidence
from gsvis.edit.eyes import Eyes, EyesInSpace, EyesOfCameras
from gsvis.edit.guard import Cost, guard, measure_cost
from gsvis.edit.large import LargeCleaning, clean_large
from gsvis.edit.opening import Opening
from gsvis.edit.outside import OutsideCut, cut_from_outside
from gsvis.edit.paint import Band, bands_of, colors_of, draw_legend, paint
from gsvis.edit.places import find_in_parcels
from gsvis.edit.quantities import QUANTITIES, Quantity, QuantityConfig, measure_quantity, stored_quantity
from gsvis.edit.shape import Shape
from gsvis.edit.space import SpaceMeshes, mesh_space, solid_voxels

__all__ = [
    "CLASSES",
    "HIDDEN",
    "KEPT",
    "QUANTITIES",
    "Band",
    "Budget",
    "Budgeted",
    "CleanConfig",
    "Cleaning",
    "Cost",
    "Cut",
    "CutConfig",
    "Evidence",
    "Eyes",
    "EyesInSpace",
    "EyesOfCameras",
    "HeldOut",
    "LargeCleaning",
    "Opening",
    "OutsideCut",
    "Quantity",
    "QuantityConfig",
    "Shape",
    "SpaceMeshes",
    "bands_of",
    "class_of",
    "classify",
    "clean",
    "clean_large",
    "colors_of",
    "core_of",
    "cut",
    "cut_from_outside",
    "draw_legend",
    "find_in_parcels",
    "fit_budget",
    "gather_evidence",
    "guard",
    "held_out_cameras",
    "measure_cost",
    "measure_quantity",
    "mesh_space",
    "paint",
    "solid_voxels",
    "stored_quantity",
]


def __dir__() -> list[str]:
    return sorted(__all__)
