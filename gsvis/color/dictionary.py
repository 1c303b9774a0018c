"""Build a dictionary of spherical radial basis functions: every center with every decay, as values along directions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.color.srbf import srbf

__all__ = ["Dictionary", "srbf_dictionary"]

F64 = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Dictionary:
    """A atoms along D directions.

    Attributes:
        centers: (A, 3) float64, unit.
        decays: (A,) float64, ascending: all centers with the first decay, then all with the next.
        values: (D, A) float64, 1 at the center, falling to 0.
    """

    centers: F64
    decays: F64
    values: F64

    def __len__(self) -> int:
        return len(self.decays)


def srbf_dictionary(directions: ArrayLike, centers: ArrayLike, decays: ArrayLike) -> Dictionary:
    """Evaluate G(x; c, lambda) = exp(lambda (x . c - 1)) for every center c and every decay lambda.

    Args:
        directions: (D, 3), any length > 0.
        centers: (V, 3), any length > 0; for example the vertices of an icosphere.
        decays: (L,) not negative; for example a geometric grid. They are sorted in ascending order, so that the
            widest of equally good atoms comes first.

    Returns:
        A = V * L atoms.

    Raises:
        ValueError: If a direction or a center is zero, or a decay negative.

    References:
        SRBF-Gaussian, equation 3.
    """
    along = _check.unit_vectors("directions", directions)
    around = _check.unit_vectors("centers", centers)
    rising = np.sort(_check.floats("decays", decays, ("L",), np.float64))
    _check.in_range("decays", rising, 0.0, np.inf)
    places = np.tile(around, (len(rising), 1))
    widths = np.repeat(rising, len(around))
    return Dictionary(places, widths, srbf(along[:, None], places, widths))
