"""Round a bare scene, Gaussians that were never prepared, of SH degree 0 to 3, to records.

Geometry and the constant color become the records of a package, higher harmonics a palette (`gsvis.export.harmonics`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsvis.color import grids as tables
from gsvis.color.records import PRECISIONS, Grids
from gsvis.export.harmonics import Harmonics, Palette
from gsvis.export.lights import areas_of
from gsvis.package.codec import build_chunks, encode_records
from gsvis.package.contents import Contents
from gsvis.package.layout import RecordLayout, TermLayout
from gsvis.package.order import PackageOrder
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels
from gsvis.scene.sh import SH_C0

__all__ = ["BareScene", "base_grids", "base_places", "encode_scene"]

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class BareScene:
    """N Gaussians of the highest level as records.

    Attributes:
        contents: The records, in the order of a package.
        ranges: Ranges of the higher coefficients; None in degree 0.
        palette: Sets of higher coefficients; None in degree 0.
    """

    contents: Contents
    ranges: Harmonics | None
    palette: Palette | None


def encode_scene(scene: Levels | Gaussians, most_sets: int | None = None) -> BareScene:
    """Return the records of a scene, or of its highest level.

    Args:
        scene: Gaussians or levels.
        most_sets: Largest number of sets of higher coefficients; None gives each Gaussian its own.

    Raises:
        ValueError: If it is empty.
    """
    union = scene.level(len(scene) - 1) if isinstance(scene, Levels) else scene
    if len(union) == 0:
        raise ValueError("scene: expected at least one Gaussian, got none; name another scene")
    levels = Levels.single(union)
    order = PackageOrder.from_levels(levels)
    ids = order.permutation
    g = union.without_harmonics()[ids]
    layout = RecordLayout.from_variant("rgb")
    table = build_chunks(g, layout, starts=order.chunks, lattices=order.lattices)
    grids = base_grids(g.sh0[:, 0])
    contents = Contents(
        levels.names,
        table,
        np.zeros((len(table), 2), np.uint8),
        encode_records(g, base_places(g.sh0[:, 0], grids), table, layout),
        np.zeros(len(g), np.uint8),
        np.zeros((0, TermLayout.from_grids(grids).nbytes), np.uint8),
        grids,
        order.starts,
        g.facts,
    )
    if not union.sh_degree:
        return BareScene(contents, None, None)
    ranges = Harmonics.from_coefficients(union.shN, union.sh_degree)
    palette = Palette.from_scene(union.shN[ids], areas_of(g) * g.opacities, ranges, most_sets)
    return BareScene(contents, ranges, palette)


def base_grids(sh0: F32) -> Grids:
    """Return the tables for constant coefficients (N, 3)."""
    rgb = _rgb_of(np.stack([sh0.min(axis=0), sh0.max(axis=0)]))
    low = rgb.min(axis=0).tolist()
    high = rgb.max(axis=0).tolist()
    base = (low[0], high[0]), (low[1], high[1]), (low[2], high[2])
    return Grids("rgb", PRECISIONS["wire"], base, (1.0, 1.0), (1.0, 1.0), 0.0)


def base_places(sh0: F32, grids: Grids) -> U8:
    """Return the (N, 3) places in the tables of the colors of constant coefficients (N, 3)."""
    rgb = _rgb_of(sh0)
    places = [tables.nearest(rgb[:, k], grids.base_table(k)) for k in range(3)]
    return np.stack(places, axis=1).astype(np.uint8)


def _rgb_of(sh0: F32) -> F32:
    """Return the colors (N, 3) of constant coefficients."""
    return (0.5 + SH_C0 * sh0.astype(np.float64)).astype(np.float32)
