"""Measure what each cell of a package needs: the light of each Gaussian it sees.

The light of a Gaussian is its blending weight times its solid angle. Each Gaussian is seen from a place of its own in
the cell, so sums over many hold for all of the cell.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gsvis.abr.index import extents
from gsvis.package.package import Package
from gsvis.render import view_weights
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.stream.source import class_weights

__all__ = ["CellLight", "DrawnLight", "Lights", "areas_of"]

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]

SPHERE = 4.0 * np.pi
"""Largest solid angle."""

_EYES = 4  # eyes in a cell around which pictures are drawn
_REACH = 0.35  # sides of a cell from its center, at most, along each axis
_SIZE = 96  # pixels along a side of the six pictures around an eye
_STATED = 0.4  # weight of the light that classes tell, beside what is drawn
_GOLDEN = np.array([0.8191725133961645, 0.6710436067037893, 0.5497004779019703])  # steps of a low-discrepancy sequence


class CellLight(NamedTuple):
    """What a cell sees.

    Attributes:
        ids: (V,) ids of the Gaussians.
        lights: (V,) weight times solid angle of each.
    """

    ids: I64
    lights: F64


class DrawnLight(NamedTuple):
    """What a cell sees, and how much of it pictures around eyes in the cell show.

    Attributes:
        light: What the cell sees.
        drawn: (V,) the part of `light.lights` that pictures add: the mean over eyes.
        eyes: (E, 3) the eyes of the pictures.
        by_eye: (E, V) the light that the pictures around each of them show.
    """

    light: CellLight
    drawn: F64
    eyes: F64
    by_eye: F64


class Lights:
    """The light in the cells of a package with visible sets.

    Args:
        package: The package.
        g: Its N decoded Gaussians.
    """

    def __init__(self, package: Package, g: Gaussians) -> None:
        self.grid = package.visibility.grid
        self._g = g
        self._sets = package.visibility
        self._weights = class_weights(package.visibility)
        self._areas = areas_of(g)
        self._means = g.means.astype(np.float64)
        self._apart = np.mod(np.arange(1, len(g) + 1)[:, None] * _GOLDEN, 1.0) - 0.5

    def __len__(self) -> int:
        """Return the number of cells."""
        return len(self._sets)

    def brightest(self) -> F64:
        """Return (N,) the light of each Gaussian in the cell where it is brightest, 0 if no cell sees it."""
        found = np.zeros(len(self._means))
        for cell in range(len(self)):
            ids, lights = self.of_cell(cell)
            found[ids] = np.maximum(found[ids], lights)
        return found

    def of_cell(self, cell: int) -> CellLight:
        """Return what a cell sees."""
        ids, classes = self._sets.classes(cell)
        size = self.grid.cell_size
        eyes = self.grid.centers[cell] + size * self._apart[ids]
        return self._seen(ids, classes, eyes, size / 2.0)

    def drawn_in(self, cell: int, shown: NDArray[np.bool_]) -> DrawnLight:
        """Return what a cell sees, in part as pictures around a few eyes in the cell show it.

        The weight classes of a cell are largest weights, so alone they count what hardly shows as if it were in view;
        pictures alone would leave out what other eyes in the cell see.

        Args:
            cell: The cell.
            shown: (N,) bool, the Gaussians of one level, which are drawn together.
        """
        ids, lights = self.of_cell(cell)
        kept = np.flatnonzero(shown[ids])
        spread = np.random.default_rng(cell).uniform(-_REACH, _REACH, (_EYES, 3))
        eyes = self.grid.centers[cell] + self.grid.cell_size * spread
        faces = view_weights(self._g[ids[kept]], Cameras.cubemap(eyes, _SIZE)).summed
        by_eye = np.zeros((_EYES, len(ids)))
        by_eye[:, kept] = faces.reshape(_EYES, 6, len(kept)).sum(axis=1, dtype=np.float64) * 4.0 / (_SIZE * _SIZE)
        drawn = by_eye.mean(axis=0)
        return DrawnLight(CellLight(ids, _STATED * lights + drawn), drawn, eyes, by_eye)

    def of_eye(self, eye: F64) -> CellLight:
        """Return what the cell of an eye sees, from this eye."""
        ids, classes = self._sets.classes(self.grid.nearest(eye))
        return self._seen(ids, classes, eye, self.grid.cell_size / 8.0)

    def _seen(self, ids: I64, classes: U8, eyes: F64, near: float) -> CellLight:
        away = self._means[ids] - eyes
        squared = np.maximum(np.square(away).sum(axis=1), near * near)
        lights = self._weights[classes] * np.minimum(self._areas[ids] / squared, SPHERE)
        return CellLight(ids, lights.astype(np.float64))


def areas_of(g: Gaussians) -> F64:
    """Return (N,) mean cross-sections, none so large that sums overflow."""
    return np.minimum(extents(g)[1].astype(np.float64), 1e30)
