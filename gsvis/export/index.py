"""Write the index of a static scene: how many Gaussians and bytes each part has, and a sphere around it.

A page reads it whole before the first part. Centers are in steps that grow with the distance from the middle of the
scene; spheres hold all that their part draws.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.export.columns import column, compress, differences
from gsvis.scene.gaussians import Gaussians

__all__ = ["Spheres", "index_of"]

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

STEPS = 64
"""Steps of a center: its distance from the middle, over the scale, is sinh(steps / 64) on each axis."""

OCTAVE = 4
"""Steps of a radius for each doubling."""

REACH = 3.0
"""Reach of a Gaussian in standard deviations, as on a server, because wide Gaussians outreach their centers."""

_MOST = (1 << 15) - 1


@dataclass(frozen=True, eq=False)
class Spheres:
    """Spheres around P parts.

    Attributes:
        middle: (3,) point where steps are finest.
        scale: Radius of byte 128.
        places: (P, 3) steps of each center.
        radii: (P,) 0 to 255.
    """

    middle: F64
    scale: float
    places: I64
    radii: I64

    @classmethod
    def from_parts(cls, parts: list[I64], g: Gaussians) -> Spheres:
        """Return spheres that hold the centers of all Gaussians of a part and three times the largest deviation."""
        starts = np.cumsum([0] + [len(part) for part in parts[:-1]])
        ids = np.concatenate(parts)
        means = g.means[ids].astype(np.float64)
        counts = np.diff(np.append(starts, len(ids)))
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
        away = np.linalg.norm(means - np.repeat(decoded, counts, axis=0), axis=1)
        reach = np.maximum.reduceat(away, starts) + REACH * np.maximum.reduceat(g.scales[ids].max(axis=1), starts)
        radii = np.ceil(OCTAVE * np.log2(np.maximum(reach, 1e-300) / scale) + 1e-6) + 128
        return cls(middle, scale, places, np.clip(radii, 0, 255).astype(np.int64))

    def as_dict(self) -> dict[str, Any]:
        """Return middle and scale, ready for JSON."""
        return {"middle": self.middle.tolist(), "scale": self.scale}


def index_of(spheres: Spheres, counts: I64, sizes: I64, term_sizes: I64) -> bytes:
    """Return the content of `index`.

    Args:
        spheres: The spheres of the P parts.
        counts: (P,) Gaussians of each.
        sizes: (P,) bytes of the file of each.
        term_sizes: (P,) bytes of the file with its terms, 0 if it has none.
    """
    return compress(
        *(column(differences(spheres.places[:, axis]), 3) for axis in range(3)),
        column(spheres.radii, 1),
        column(counts, 4),
        column(sizes, 4),
        column(term_sizes, 4),
    )
