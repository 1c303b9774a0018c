"""Write the rows of the cells of a static scene: the parts that each cell sees, and what they are worth there.

A row has a bitmap of parts, lowest bit first; then a byte for the gain of each of these parts; where the scene has
active terms, a byte for what the terms of each are worth; four bytes for the sphere in which the light of each is, as
pictures in the cell show it; and the bytes of the glances of the cell. A scene without visible sets has one cell that
sees everything, from nowhere, without spheres and glances.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gsvis.color.activation import Activation
from gsvis.export.columns import GAIN_STEPS, column, compress, differences, quantize_gains
from gsvis.export.index import OCTAVE, Spheres
from gsvis.export.lights import SPHERE, CellLight, DrawnLight, Lights
from gsvis.package.package import Package
from gsvis.progress import Progress
from gsvis.pvs.cells import CellGrid
from gsvis.scene.gaussians import Gaussians

if TYPE_CHECKING:
    from gsvis.export.glances import Glances

__all__ = ["CellRows", "SeenSpheres", "TermWorth", "rows_of_package", "rows_of_scene"]

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]

_MOST_LIGHT = 1 << 16  # whole spheres of light from one part
_STEPS = 32  # of the center of a sphere for each radius of the part
_LEAST = 0.035  # sides of a cell, about, that add to each radius in quadrature: eyes of a cell differ


@dataclass(frozen=True, eq=False)
class CellRows:
    """The cells of a scene, as written.

    Attributes:
        grid: The cells; None for one cell that sees everything.
        top: Quarters of an octave of the gain that byte 255 stands for.
        active: Whether rows hold the worth of terms.
        rows: The row of each cell.
        glances: The files of all sectors of the first cell, then of the next; empty without glances.
    """

    grid: CellGrid | None
    top: int
    active: bool
    rows: tuple[bytes, ...]
    glances: tuple[bytes, ...] = ()

    def index(self) -> bytes:
        """Return the content of `grid`: the box of each cell, and the bytes of its row."""
        boxes = np.zeros((len(self.rows), 3), np.int64) if self.grid is None else self.grid.coords
        sizes = [len(row) for row in self.rows]
        return compress(*(column(differences(boxes[:, axis]), 4) for axis in range(3)), column(sizes, 4))


def rows_of_scene(gains: F64, part_of: I64) -> CellRows:
    """Return one row with all parts, whose gain is the sum over their Gaussians.

    Args:
        gains: (N,) what each Gaussian counts.
        part_of: (N,) its part.
    """
    table = np.asarray(np.bincount(part_of, gains, minlength=int(part_of.max()) + 1), np.float64)
    top = int(np.ceil(GAIN_STEPS * np.log2(max(table.max(), 1e-300))))
    return CellRows(None, top, False, (_row(table, np.ones(len(table), np.bool_), top),))


def rows_of_package(
    lights: Lights,
    worth: TermWorth | None,
    part_of: I64,
    spheres: SeenSpheres,
    glances: Glances | None,
    progress: Progress,
) -> CellRows:
    """Return a row for each cell.

    Args:
        lights: The light in the cells.
        worth: What terms are worth; None if cells do not choose terms.
        part_of: (N,) the part of each Gaussian, -1 for those that have none.
        spheres: Finds where the light of parts is.
        glances: Makes the glances of cells; None for none.
        progress: Called with stage "sets", in cells.
    """
    count = int(part_of.max()) + 1
    top = int(np.ceil(GAIN_STEPS * np.log2(_MOST_LIGHT * SPHERE)))
    rows = []
    files: list[bytes] = []
    progress("sets", 0, len(lights))
    for cell in range(len(lights)):
        found = lights.drawn_in(cell, part_of >= 0)
        gains = gains_of_parts(found.light, part_of, count)
        seen = gains > 0
        terms = b"" if worth is None else worth.of_parts(cell, found.light, part_of, count)[seen].tobytes()
        looks = [] if glances is None else glances.of_cell(cell, found)
        files += looks
        more = spheres.of_cell(found, part_of)[seen].T.tobytes() + column([len(look) for look in looks], 4)
        rows.append(_row(gains, seen, top, terms, more))
        progress("sets", cell + 1, len(lights))
    return CellRows(lights.grid, top, worth is not None, tuple(rows), tuple(files))


def gains_of_parts(light: CellLight, part_of: I64, count: int) -> F64:
    """Return (count,) the light of each part."""
    parts = part_of[light.ids]
    kept = parts >= 0
    return np.asarray(np.bincount(parts[kept], light.lights[kept], minlength=count), np.float64)


class SeenSpheres:
    """Where the light of parts is that a cell sees: a sphere for each part, beside that of all its light.

    Args:
        means: (N, 3) centers of the Gaussians of the package.
        spheres: The spheres of the P parts.
        cell_size: Side of a cell, scene units.
    """

    def __init__(self, means: NDArray[np.float32], spheres: Spheres, cell_size: float) -> None:
        self._means = means.astype(np.float64)
        self._centers = spheres.centers
        self._lengths = spheres.lengths
        self._least = _LEAST * cell_size

    def of_cell(self, found: DrawnLight, part_of: I64) -> U8:
        """Return (P, 4) bytes: x, y, z of the center in 1/32 radii from that of the part, and the radius, above it.

        All have 128 added: a part of which pictures show nothing has its own sphere.

        Args:
            found: What the cell sees.
            part_of: (N,) the part of each Gaussian, -1 for those that have none.
        """
        shown = np.flatnonzero(found.drawn > 0.0)
        ids = found.light.ids[shown]
        weights = found.drawn[shown]
        parts = part_of[ids]
        count = len(self._centers)
        sums = np.bincount(parts, weights, minlength=count)
        some = sums > 0.0
        shares = weights / sums[parts]
        points = self._means[ids]
        centers = self._centers.copy()
        for axis in range(3):
            middle = np.bincount(parts, shares * points[:, axis], minlength=count)
            centers[some, axis] = middle[some]
        away = np.square(points - centers[parts]).sum(axis=1)
        radii = np.sqrt(np.bincount(parts, shares * away, minlength=count) + self._least**2)
        steps = np.full((count, 4), 128.0)
        steps[:, :3] += np.rint(_STEPS * (centers - self._centers) / self._lengths[:, None])
        steps[some, 3] += np.rint(OCTAVE * np.log2(radii[some] / self._lengths[some]))
        return np.asarray(np.clip(steps, 0, 255), np.uint8)


class TermWorth:
    """What the terms of a package are worth in its cells.

    Args:
        package: A package with active terms.
        g: Its decoded Gaussians.

    Attributes:
        owners: (T,) the Gaussian of each term.
    """

    def __init__(self, package: Package, g: Gaussians) -> None:
        contents = package.contents
        self._active = package.active_terms
        self._grid = package.visibility.grid
        self._changes = Activation(contents.colors().dequantize(), g.means, self._active.epsilon)
        self.owners = np.repeat(np.arange(len(g)), contents.term_counts)
        self._offsets = contents.term_offsets
        self._count = len(g)

    def numbers(self, terms: I64) -> I64:
        """Return which of the terms of its Gaussian each term (M,) is."""
        return np.asarray(terms - self._offsets[self.owners[terms]])

    def of_terms(self, cell: int, eye: F64, light: CellLight) -> tuple[I64, F64]:
        """Return the terms (M,) that are active in a cell, and the squared change by each, times light, at an eye."""
        lights = np.zeros(self._count)
        lights[light.ids] = light.lights
        active = self._active.active_ids(cell)
        changes = np.maximum(self._changes.contributions(eye)[active], self._active.epsilon).astype(np.float64)
        return active, np.square(changes) * lights[self.owners[active]]

    def of_parts(self, cell: int, light: CellLight, part_of: I64, count: int) -> U8:
        """Return (count,) octaves above 2^-128 of the sums over the active terms of each part; 0 for none."""
        active, values = self.of_terms(cell, self._grid.centers[cell], light)
        parts = part_of[self.owners[active]]
        kept = parts >= 0
        found = np.bincount(parts[kept], values[kept], minlength=count)
        octaves = np.rint(np.log2(np.maximum(found, np.finfo(np.float64).tiny))) + 128
        return np.where(found > 0, np.clip(octaves, 1, 255), 0).astype(np.uint8)


def _row(gains: F64, seen: NDArray[np.bool_], top: int, terms: bytes = b"", more: bytes = b"") -> bytes:
    """Return the row of a cell, compressed."""
    bits = np.packbits(seen, bitorder="little")
    return compress(bits.tobytes(), quantize_gains(gains[seen], top).tobytes(), terms, more)
