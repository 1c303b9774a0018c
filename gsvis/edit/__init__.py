"""Edit scenes by what can be seen: clean."""

from gsvis.edit.classes import CLASSES, HIDDEN, KEPT, CleanConfig, class_of, classify
from gsvis.edit.cleaning import Cleaning, clean, core_of, held_out_cameras
from gsvis.edit.evidence import Evidence, Shape, gather_evidence
from gsvis.edit.guard import Cost, guard, measure_cost

__all__ = [
    "CLASSES",
    "HIDDEN",
    "KEPT",
    "CleanConfig",
    "Cleaning",
    "Cost",
    "Evidence",
    "Shape",
    "class_of",
    "classify",
    "clean",
    "core_of",
    "gather_evidence",
    "guard",
    "held_out_cameras",
    "measure_cost",
]


def __dir__() -> list[str]:
    return sorted(__all__)
