"""Write the index of a static scene: the places of its chunks, and the bytes of each block.

A page reads it whole before the first block, so it is coarse: a sphere around each chunk, in steps that grow with the
distance from the middle of the scene. Spheres hold all that their chunk draws.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.export.columns import column, compress, differences
from gsvis.package.codec import ChunkTable
from gsvis.scene.gaussians import Gaussians

__all__ = ["Spheres", "index_of"]

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]

STEPS = 64
"""Steps of a center: its distance from the middle, over the scale, is sinh(steps / 64) on each axis."""

OCTAVE = 4
"""Steps of a radius for each doubling."""

REACH = 3.0
"""Reach of a Gaussian in standard deviations, as on a server, because wide Gaussians outreach their centers."""

_MOST = (1 << 15) - 1


@dataclass(frozen=True, eq=False)
class Spheres:
    """Spheres around C chunks.

    Attributes:
        middle: (3,) point where steps are finest.
        scale: Radius of byte 128.
        places: (C, 3) steps of each center.
        radii: (C,) 0 to 255.
    """

    middle: F64
    scale: float
    places: I64
    radii: I64

    @classmethod
    def from_chunks(cls, table: ChunkTable, g: Gaussians) -> Spheres:
        """Return spheres that hold the centers of all Gaussians of a chunk and three times the largest deviation."""
        starts = table.starts[:-1]
        means = g.means.astype(np.float64)
        lows = np.minimum.reduceat(means, starts)
        highs = np.maximum.reduceat(means, starts)
        centers = (lows + highs) / 2
        halves = np.linalg.norm(highs - lows, axis=1) / 2
        # Decoders read both numbers from text; numbers of few digits are read exactly.
        middle = np.median(centers, axis=0).astype(np.float32).astype(np.float64)
        least = 1e-6 * float(max(halves.max(initial=0.0), np.ptp(centers, axis=0).max(initial=0.0))) or 1e-6
        scale = float(np.float32(max(np.median(halves), least)))
        places = np.clip(np.rint(STEPS * np.arcsinh((centers - middle) / scale)), -_MOST, _MOST).astype(np.int64)
        decoded = middle + scale * np.sinh(places / STEPS)
        away = np.linalg.norm(means - np.repeat(decoded, table.counts, axis=0), axis=1)
        reach = np.maximum.reduceat(away, starts) + REACH * np.maximum.reduceat(g.scales.max(axis=1), starts)
        radii = np.ceil(OCTAVE * np.log2(np.maximum(reach, 1e-300) / scale) + 1e-6) + 128
        return cls(middle, scale, places, np.clip(radii, 0, 255).astype(np.int64))

    def as_dict(self) -> dict[str, Any]:
        """Return middle and scale, ready for JSON."""
        return {"middle": self.middle.tolist(), "scale": self.scale}


def index_of(spheres: Spheres, table: ChunkTable, levels: U8, units: I64) -> bytes:
    """Return the content of `index`.

    Args:
        spheres: The spheres of the C chunks.
        table: The chunks.
        levels: (C, 2) first and last level of each.
        units: (B,) size of each block in `records`.
    """
    return compress(
        *(column(differences(spheres.places[:, axis]), 3) for axis in range(3)),
        column(spheres.radii, 1),
        column(table.counts.astype(np.int64) - 1, 1),
        column(levels[:, 0], 1),
        column(levels[:, 1], 1),
        column(units, 2),
    )
