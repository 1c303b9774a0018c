"""Round a bare scene, Gaussians that were never prepared, of SH degree 0 to 3, to records.

Geometry and the constant color become the records of a package. Higher harmonics become bytes between a low and a high
end for each coefficient. Ends hold all but a few values in ten thousand and make zero exact; the rest is clipped.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.color import grids as tables
from gsvis.color.records import PRECISIONS, Grids
from gsvis.package.codec import build_chunks, encode_records
from gsvis.package.contents import Contents
from gsvis.package.layout import RecordLayout, TermLayout
from gsvis.package.order import PackageOrder
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels
from gsvis.scene.sh import SH_C0

__all__ = ["BareScene", "Harmonics", "encode_scene"]

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]
I64 = NDArray[np.int64]

ZERO = 128
"""The byte that stands for 0."""

_SAMPLE = 1 << 16  # Gaussians from which the ends of coefficients are found
_TAIL = 2e-4  # share of these that lie beyond the ends
_ROWS = 1 << 15


@dataclass(frozen=True, eq=False)
class Harmonics:
    """Ranges of K coefficients, the same for R, G and B.

    Attributes:
        degree: 1 to 3.
        high: (K,) value of byte 255; byte 128 is 0 and byte 0 is -128/127 of it.
    """

    degree: int
    high: F32

    @classmethod
    def from_coefficients(cls, coefficients: F32, degree: int) -> Harmonics:
        """Return the ranges of coefficients (N, K, 3)."""
        some = np.abs(coefficients[:: max(1, len(coefficients) // _SAMPLE)])
        high = np.quantile(some, 1.0 - _TAIL, axis=(0, 2), method="higher")
        return cls(degree, np.maximum(high, 1e-6).astype(np.float32))

    @property
    def low(self) -> F32:
        """(K,) value of byte 0."""
        return np.asarray(self.high.astype(np.float64) * -(ZERO / (255.0 - ZERO)), np.float32)

    def encode(self, coefficients: F32, ids: I64) -> U8:
        """Return (M, 3 K) uint8, the coefficients (N, K, 3) of ids (M,): for each coefficient R, G, B."""
        k = len(self.high)
        out = np.empty((len(ids), k, 3), np.uint8)
        factors = ((255 - ZERO) / self.high)[:, None]
        for start in range(0, len(ids), _ROWS):
            some = coefficients[ids[start : start + _ROWS]] * factors
            np.rint(some, out=some)
            out[start : start + _ROWS] = np.clip(some + np.float32(ZERO), 0, 255)
        return out.reshape(len(ids), 3 * k)

    def decode(self, data: U8) -> F32:
        """Return (M, K, 3) coefficients of bytes (M, 3 K)."""
        low = self.low.astype(np.float64)
        high = self.high.astype(np.float64)
        places = data.reshape(len(data), len(self.high), 3) / 255.0
        return np.asarray(low[:, None] + places * (high - low)[:, None], np.float32)

    def as_dict(self) -> dict[str, Any]:
        """Return degree and ends, ready for JSON."""
        return {"degree": self.degree, "low": self.low.tolist(), "high": self.high.tolist()}


@dataclass(frozen=True, eq=False)
class BareScene:
    """N Gaussians of the highest level as records.

    Attributes:
        contents: The records, in the order of a package.
        harmonics: (N, H) bytes of harmonics; H is 0 in degree 0.
        ranges: Ranges of the higher coefficients; None in degree 0.
    """

    contents: Contents
    harmonics: U8
    ranges: Harmonics | None


def encode_scene(scene: Levels | Gaussians) -> BareScene:
    """Return the records of a scene, or of its highest level.

    Raises:
        ValueError: If it is empty.
    """
    union = scene.level(len(scene) - 1) if isinstance(scene, Levels) else scene
    if len(union) == 0:
        raise ValueError("scene: expected at least one Gaussian, got none; name another scene")
    levels = Levels.single(union)
    order = PackageOrder.from_levels(levels)
    ids = order.permutation
    some = union[ids]
    g = Gaussians(some.means, some.quats, some.scales, some.opacities, some.sh0, facts=union.facts)
    layout = RecordLayout.from_variant("rgb")
    table = build_chunks(g, layout, starts=order.chunks, lattices=order.lattices)
    grids, places = _base_colors(g.sh0[:, 0])
    contents = Contents(
        levels.names,
        table,
        np.zeros((len(table), 2), np.uint8),
        encode_records(g, places, table, layout),
        np.zeros(len(g), np.uint8),
        np.zeros((0, TermLayout.from_grids(grids).nbytes), np.uint8),
        grids,
        order.starts,
        g.facts,
    )
    if not union.sh_degree:
        return BareScene(contents, np.zeros((len(g), 0), np.uint8), None)
    ranges = Harmonics.from_coefficients(union.shN, union.sh_degree)
    return BareScene(contents, ranges.encode(union.shN, ids), ranges)


def _base_colors(sh0: F32) -> tuple[Grids, U8]:
    """Return the tables for constant coefficients (N, 3), and the (N, 3) indices of their colors."""
    rgb = (0.5 + SH_C0 * sh0.astype(np.float64)).astype(np.float32)
    low = rgb.min(axis=0).tolist()
    high = rgb.max(axis=0).tolist()
    base = (low[0], high[0]), (low[1], high[1]), (low[2], high[2])
    grids = Grids("rgb", PRECISIONS["wire"], base, (1.0, 1.0), (1.0, 1.0), 0.0)
    places = [tables.nearest(rgb[:, k], grids.base_table(k)) for k in range(3)]
    return grids, np.stack(places, axis=1).astype(np.uint8)
