"""Edit a scene by what can be seen: cut it to what some eyes need, or paint it by what they see.

eyes = EyesInSpace(NavigableSpace.from_box((0, 0, 1), (4, 3, 2)))
found = cut(scene, eyes)
smaller = scene[found.kept]

space = NavigableSpace.from_scene(scene)
painted = paint(scene, measure_quantity(scene, "visibility", space))
"""

from gsvis.edit.cut import Cut, CutConfig, HeldOut, cut
from gsvis.edit.eyes import Eyes, EyesInSpace, EyesOfCameras
from gsvis.edit.paint import Band, bands_of, colors_of, draw_legend, paint
from gsvis.edit.quantities import QUANTITIES, Quantity, QuantityConfig, measure_quantity, stored_quantity

__all__ = [
    "QUANTITIES",
    "Band",
    "Cut",
    "CutConfig",
    "Eyes",
    "EyesInSpace",
    "EyesOfCameras",
    "HeldOut",
    "Quantity",
    "QuantityConfig",
    "bands_of",
    "colors_of",
    "cut",
    "draw_legend",
    "measure_quantity",
    "paint",
    "stored_quantity",
]


def __dir__() -> list[str]:
    return sorted(__all__)
