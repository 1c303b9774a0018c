"""Edit scenes by what can be seen: clean, cut, paint; and turn the space from which they are seen into meshes."""

from gsvis.edit.classes import CLASSES, HIDDEN, KEPT, CleanConfig, class_of, classify
from gsvis.edit.cleaning import Cleaning, clean, core_of, held_out_cameras
from gsvis.edit.evidence import Evidence, Shape, gather_evidence
from gsvis.edit.guard import Cost, guard, measure_cost
from gsvis.edit.space import SpaceMeshes, mesh_space, solid_voxels

__all__ = [
    "CLASSES",
    "HIDDEN",
    "KEPT",
    "CleanConfig",
    "Cleaning",
    "Cost",
    "Evidence",
    "Shape",
    "SpaceMeshes",
    "class_of",
    "classify",
    "clean",
    "core_of",
    "gather_evidence",
    "guard",
    "held_out_cameras",
    "measure_cost",
    "mesh_space",
    "solid_voxels",
]


def __dir__() -> list[str]:
    return sorted(__all__)
