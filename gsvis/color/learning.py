"""Evaluate colors that are learned: the RGB of the Gaussians of one view, and the gradients of a loss by their terms.

Arrays hold all Gaussians and terms, so that a step copies none of them. Directions, frame and clipping are those of
`gsvis.color.evaluate`; `gsvis.color.evaluate_torch` is the plain twin.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.color._kernels import learned
from gsvis.color.srbf import MAX_DECAY, SrbfColors

__all__ = ["LearnedValues", "RowsOfView", "SeenColors", "see_rgb"]

LearnedValues = Mapping[str, NDArray[np.float32]]
"""Arrays by name: base (N, 3), centers (T, 2), growth (T, 1: logarithms of factors on decays), intensities (T, 3)."""


@dataclass(frozen=True, eq=False)
class RowsOfView:
    """Gaussians of a view, and their terms.

    Attributes:
        gaussians: (M,) their numbers, ascending.
        terms: (S,) numbers of their terms.
        starts: (M + 1,) where those of each Gaussian begin.
    """

    gaussians: NDArray[np.int64]
    terms: NDArray[np.int64]
    starts: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class SeenColors:
    """Colors of the Gaussians of a view.

    Attributes:
        rows: The Gaussians.
        colors: (M, 3) RGB, >= 0.
        gradients: Function from the gradient (M, 3) of a loss by the colors to those by base, centers, growth and
            intensities, by name.
    """

    rows: RowsOfView
    colors: NDArray[np.float32]
    gradients: Callable[[NDArray[np.float32]], dict[str, NDArray[np.float32]]]


def see_rgb(
    begun: SrbfColors, values: LearnedValues, rows: RowsOfView, means: NDArray[np.float32], eye: NDArray[np.float64]
) -> SeenColors:
    """Return the colors of some Gaussians, of a variant whose terms add RGB.

    Args:
        begun: Colors before learning; its decays are those that grow.
        values: What is learned.
        rows: The Gaussians.
        means: (N, 3) centers of all Gaussians.
        eye: (3,) viewpoint, world frame.
    """
    count = len(rows.gaussians)
    units = np.empty((count, 3), np.float32)
    kept = np.empty((len(rows.terms), learned.KEPT), np.float32)
    raw = np.empty((count, 3), np.float32)
    lists = rows.gaussians, rows.starts, begun.offsets
    lobes = begun.decays, values["growth"], values["intensities"], MAX_DECAY
    places = _check.read_only(means)[0], eye, values["base"], values["centers"]
    learned.rgb_of_terms(*lists, *places, *lobes, units, kept, raw)

    def gradients(by_colors: NDArray[np.float32]) -> dict[str, NDArray[np.float32]]:
        """Return the gradients; clipped colors have none."""
        shown = np.where(raw >= 0.0, by_colors, np.float32(0.0))
        by_terms = {
            name: np.empty((len(rows.terms), values[name].shape[1]), np.float32)
            for name in ("centers", "growth", "intensities")
        }
        learned.gradients_of_rgb(*lists, *lobes, units, kept, shown, tuple(by_terms.values()))
        return {"base": shown, **by_terms}

    return SeenColors(rows, np.maximum(raw, np.float32(0.0)), gradients)
