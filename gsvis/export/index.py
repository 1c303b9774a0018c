"""Write the index of a static scene: how many Gaussians and bytes each part has, and a sphere around it.

A page reads it whole before the first part. Centers are in steps that grow with the distance from the middle of the
scene. A sphere says where the light of its part is, not how far the part reaches: few Gaussians lie far away.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis.export.columns import column, compress, differences

__all__ = ["Spheres", "index_of"]

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

STEPS = 64
"""Steps of a center: its distance from the middle, over the scale, is sinh(steps / 64) on each axis."""

OCTAVE = 4
"""Steps of a radius for each doubling."""

_MOST = (1 << 15) - 1


@dataclass(frozen=True, eq=False)
class Spheres:
    """Spheres in which the light of P parts is.

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
    def from_parts(cls, parts: list[I64], means: ArrayLike, gains: F64) -> Spheres:
        """Return the mean place of the light of each part, and the root of the mean squared distance from it.

        Args:
            parts: Ids of the Gaussians of each part.
            means: (N, 3) centers of all Gaussians.
            gains: (N,) how bright each one is.
        """
        starts = np.cumsum([0] + [len(part) for part in parts[:-1]])
        ids = np.concatenate(parts)
        counts = np.diff(np.append(starts, len(ids)))
        points = np.asarray(means, np.float64)[ids]
        weights = gains[ids] + 1e-9 * max(
            float(gains.max(initial=0.0)), 1e-300
        )  # parts without light have a sphere too
        sums = np.add.reduceat(weights, starts)
        centers = np.add.reduceat(points * weights[:, None], starts) / sums[:, None]
        # Decoders read both numbers from text; numbers of few digits are read exactly.
        middle = np.median(centers, axis=0).astype(np.float32).astype(np.float64)
        spread = cls._spread(points, centers, weights / np.repeat(sums, counts), counts)
        least = 1e-6 * float(max(spread.max(initial=0.0), np.ptp(centers, axis=0).max(initial=0.0))) or 1e-6
        scale = float(np.float32(max(np.median(spread), least)))
        places = np.clip(np.rint(STEPS * np.arcsinh((centers - middle) / scale)), -_MOST, _MOST).astype(np.int64)
        rounded = middle + scale * np.sinh(places / STEPS)
        spread = cls._spread(points, rounded, weights / np.repeat(sums, counts), counts)
        radii = np.rint(OCTAVE * np.log2(np.maximum(spread, 1e-300) / scale)) + 128
        return cls(middle, scale, places, np.clip(radii, 0, 255).astype(np.int64))

    @staticmethod
    def _spread(points: F64, centers: F64, shares: F64, counts: I64) -> F64:
        """Return the root of the mean squared distance (P,) of the points of each part from its center."""
        squared = np.square(points - np.repeat(centers, counts, axis=0)).sum(axis=1)
        return np.asarray(np.sqrt(np.bincount(np.repeat(np.arange(len(counts)), counts), squared * shares)), np.float64)

    @property
    def centers(self) -> F64:
        """(P, 3) the centers that a reader finds."""
        return np.asarray(self.middle + self.scale * np.sinh(self.places / STEPS))

    @property
    def lengths(self) -> F64:
        """(P,) the radii that a reader finds, scene units."""
        return np.asarray(self.scale * 2.0 ** ((self.radii - 128) / OCTAVE))

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
