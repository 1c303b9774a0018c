"""The cones of directions in which terms are active (equation 7 of the paper), for planners that test them for an eye.

A lobe decreases with the angle from its center, so a term is active in a cone: its change of the color is above epsilon
where the cosine between the center and the direction from the eye to the Gaussian is above a bound. If the change is
multiplied by w, such as the blending weight of the Gaussian, the bound decreases by ln(w) times the width of the lobe.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check

__all__ = ["TermCones"]

F32 = NDArray[np.float32]
I32 = NDArray[np.int32]


@dataclass(frozen=True, eq=False, repr=False)
class TermCones:
    """The cones of T terms.

    Args:
        centers: (D, 3) unit vectors, in the axes of the scene.
        places: (T,) index of the center of each term.
        cosines: (T,) least cosine between the center and the direction from an eye to the Gaussian at which the term is
            active. Above 1: never active; at most -1: always active.
        widths: (T,) > 0, 1 / decay of each term.

    Raises:
        ValueError: If a shape is wrong, a value is NaN, or an index is out of range.
    """

    centers: F32
    places: I32
    cosines: F32
    widths: F32

    def __post_init__(self) -> None:
        centers = _check.floats("centers", np.asarray(self.centers, np.float32), ("D", 3))
        places = _check.integers("places", self.places, ("T",), np.int32)
        cosines = np.asarray(self.cosines, np.float32)
        if cosines.shape != places.shape or np.isnan(cosines).any():
            got = f"shape {cosines.shape}" if cosines.shape != places.shape else "NaN"
            raise ValueError(f"cosines: expected ({len(places)},) numbers without NaN, got {got}")
        widths = _check.floats("widths", np.asarray(self.widths, np.float32), (len(places),))
        _check.in_range("widths", widths, 0.0, np.inf)
        cosines = np.clip(cosines, -1e30, 1e30)  # so that adding a multiple of a width gives a number
        if len(places):
            _check.in_range("places", places, 0, len(centers) - 1)
        for name, array in (("centers", centers), ("places", places), ("cosines", cosines), ("widths", widths)):
            view = array.view()
            view.flags.writeable = False
            object.__setattr__(self, name, view)

    @classmethod
    def none(cls) -> TermCones:
        """Return the cones of no terms."""
        nothing = np.zeros(0, np.float32)
        return cls(nothing.reshape(0, 3), np.zeros(0, np.int32), nothing, nothing)

    @classmethod
    def trusted(cls, centers: F32, places: I32, cosines: F32, widths: F32) -> TermCones:
        """Return cones without checks: the arrays were checked before they were written to a file."""
        made = object.__new__(cls)
        made.__dict__.update(centers=centers, places=places, cosines=cosines, widths=widths)
        return made

    def __len__(self) -> int:
        """Return T."""
        return len(self.places)

    def __repr__(self) -> str:
        return f"TermCones({len(self):,} terms, {len(self.centers):,} centers)"

    def active(self, terms: ArrayLike, mean: ArrayLike, eyes: ArrayLike, gain: float = 0.0) -> NDArray[np.bool_]:
        """Return (M,) bool: whether each term of a Gaussian is active for at least one eye.

        Args:
            terms: (M,) ids of the terms.
            mean: (3,) center of their Gaussian.
            eyes: (P, 3) positions.
            gain: Logarithm of the factor on the change of the color.
        """
        ids = np.asarray(terms, np.int64)
        toward = directions(mean, eyes)
        least = self.cosines[ids] - np.float32(gain) * self.widths[ids]
        found = self.centers[self.places[ids]] @ toward.T >= least[:, None]
        return np.asarray(found.any(axis=1))


def directions(mean: ArrayLike, eyes: ArrayLike) -> F32:
    """Return (P, 3) float32 unit vectors from eyes (P, 3) to a mean (3,); (0, 0, 1) where an eye equals the mean."""
    apart = np.asarray(mean, np.float32) - np.asarray(eyes, np.float32)
    lengths = np.sqrt((apart * apart).sum(axis=1, keepdims=True))
    safe = np.where(lengths > 0, lengths, np.float32(1.0))
    return np.asarray(np.where(lengths > 0, apart / safe, np.array([0.0, 0.0, 1.0], np.float32)), np.float32)
