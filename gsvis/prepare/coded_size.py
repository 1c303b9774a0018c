"""How many bytes the records of a scene take in a package: code a part of it, as a package does. Keeps nothing."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gsvis.color import quantize
from gsvis.files.temporary import temporary_folder
from gsvis.package import in_package_order, write_package
from gsvis.package.manifest import MANIFEST
from gsvis.prepare.colors import prepare_colors
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels

__all__ = ["bytes_of_record"]


def bytes_of_record(levels: Levels, most: int) -> float:
    """Return the bytes of a Gaussian in a package without sets and terms, its share of the table of chunks included.

    Args:
        levels: Levels in any order, with at least one Gaussian.
        most: Most Gaussians that are coded: neighbors, from the middle of the longest side.
    """
    g = levels.union
    axis = int(np.ptp(g.means, axis=0).argmax())
    begin = max(0, (len(g) - most) // 2)
    some = np.sort(np.argsort(g.means[:, axis], kind="stable")[begin : begin + most])
    part = Gaussians(*(getattr(g, name)[some] for name in ("means", "quats", "scales", "opacities", "sh0")))
    try:
        cut = Levels(part, levels.first[some], levels.last[some], levels.names)
    except ValueError:  # a level has nothing there
        cut = Levels.single(part)
    ordered = in_package_order(cut)
    colors = quantize(prepare_colors(ordered, None).fit.colors, "wire")
    with (
        temporary_folder() as folder,
        write_package(Path(folder) / "package", ordered, colors) as package,
    ):
        nbytes = sum(each.nbytes for each in package.manifest.parts()) + (package.path / MANIFEST).stat().st_size
    return nbytes / len(some)
