"""Write glances: for each cell and each eighth of its horizon, a small file with what pictures show most of there.

A page that comes into a cell of which it has little fetches those that its view covers before any part. They rank
Gaussians one by one, as the server does, where parts are fetched whole. Directions are those of the horizon, scene
frame: looks that are steeper than `_STEEP` count for none.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis.export.first import FirstViews
from gsvis.export.lights import DrawnLight
from gsvis.pvs.floor import level_axes

__all__ = ["SECTORS", "Glances", "glance_bytes"]

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

SECTORS = 8
"""Sectors of the horizon."""

_MOST = 1500  # bytes of a glance, as its Gaussians are counted in `first`
_LEAST = 750  # fewer are of no use
_SPARSE = 1.35  # bytes of a glance over these: few of its Gaussians share a chunk
_STEEP = np.tan(np.radians(50.0))  # slope


def glance_bytes(cells: int, most: int) -> int:
    """Return the bytes of each glance of `cells` cells, so that all have `most` at most; 0 for no glances."""
    each = min(_MOST, int(most / (_SPARSE * max(SECTORS * cells, 1))))
    return each if each >= _LEAST else 0


@dataclass(frozen=True, eq=False)
class Glances:
    """Makes the glances of the cells of a package.

    Attributes:
        files: Encodes Gaussians that are chosen one by one.
        axes: (3, 3) two axes of the horizon and the one that points upwards, scene frame.
        most: Bytes of a glance, about.
    """

    files: FirstViews
    axes: F64
    most: int

    @classmethod
    def from_up(cls, files: FirstViews, up: ArrayLike, most: int) -> Glances:
        """Return the glances over the horizon of an axis (3,) that points upwards."""
        upward = np.asarray(up, np.float64)
        return cls(files, np.stack([*level_axes(upward), upward]), most)

    def as_dict(self) -> dict[str, Any]:
        """Return what `scene.json` says of glances."""
        return {"sectors": SECTORS, "axes": self.axes.tolist()}

    def of_cell(self, cell: int, found: DrawnLight) -> list[bytes]:
        """Return the file of each sector of a cell, empty where pictures show nothing there."""
        ids = found.light.ids
        useful = self.files.useful_terms(cell, self.files.lights.grid.centers[cell], found.light)
        glances = []
        for shown in self._by_sector(ids, found):
            some = np.flatnonzero(shown)
            placed = self.files.placing.placed[ids[some]]
            order = np.argsort(-shown[some], kind="stable")
            glances.append(self.files.encode_some(found.light, placed[order], shown[some][order], useful, self.most))
        return glances

    def _by_sector(self, ids: I64, found: DrawnLight) -> F64:
        """Return (SECTORS, V) the light of each Gaussian that pictures show in each sector."""
        sums = np.zeros(SECTORS * len(ids))
        means = self.files.g.means[ids].astype(np.float64)
        for eye, shown in zip(found.eyes, found.by_eye, strict=True):
            east, north, up = ((means - eye) @ self.axes.T).T
            sector = np.floor((np.arctan2(north, east) / (2.0 * np.pi) + 0.5) * SECTORS).astype(np.int64) % SECTORS
            level = np.abs(up) <= _STEEP * np.hypot(east, north)
            sums += np.bincount(sector * len(ids) + np.arange(len(ids)), shown * level, minlength=len(sums))
        return sums.reshape(SECTORS, len(ids)) / len(found.eyes)
