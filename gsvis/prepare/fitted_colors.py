"""Hold the fitted and rounded colors of a scene, with the figures for reports.

Sizes are those of records before any entropy coding. This module draws nothing and writes nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.color.epsilon import EpsilonCalibration
from gsvis.color.records import PRECISIONS, bytes_per_base, bytes_per_term, quantize, record_bytes, sh_bytes
from gsvis.color.srbf import SrbfColors
from gsvis.prepare.color_quality import ColorQuality
from gsvis.prepare.colors import ColorPreparation
from gsvis.prepare.learned_colors import Learned
from gsvis.raycast.directions import direction_fractions
from gsvis.scene.gaussians import Gaussians

__all__ = ["PRECISION_NAMES", "FittedColors", "round_colors"]

F64 = NDArray[np.float64]

PRECISION_NAMES = (*PRECISIONS, "exact")
"""Precisions that records can be rounded to; "exact" keeps float32."""


def round_colors(colors: SrbfColors, precision: str) -> SrbfColors:
    """Return the colors rounded to a precision. Save them with `quantize(colors, precision)`.

    Args:
        colors: Fitted colors.
        precision: One of `PRECISION_NAMES`.
    """
    return colors if precision == "exact" else quantize(colors, precision).dequantize()


@dataclass(frozen=True, eq=False)
class FittedColors:
    """Colors of N Gaussians and their figures.

    Attributes:
        gaussians: The scene, or the union of its levels, with its SH colors.
        colors: The colors, rounded as in the file.
        preparation: The fit and its data.
        precision: One of `PRECISION_NAMES`.
        file_bytes: Size of the file, geometry included.
        epsilon: Contribution above which a term is active; None if it was not asked for.
        calibration: The calibration of epsilon; None if epsilon was given.
        quality: Comparison with SH; None if it was not measured.
        cell_shares: (C,) share of all terms that each cell of the visible sets needs; None if it was not measured.
        shown: (N,) bool, Gaussians of the highest of several levels, which pictures show; None for a scene.
        learned: What learning gained; None if the colors are those of the fit.
    """

    gaussians: Gaussians
    colors: SrbfColors
    preparation: ColorPreparation
    precision: str
    file_bytes: int
    epsilon: float | None = None
    calibration: EpsilonCalibration | None = None
    quality: ColorQuality | None = None
    cell_shares: F64 | None = None
    shown: NDArray[np.bool_] | None = None
    learned: Learned | None = None

    @property
    def drawn(self) -> tuple[Gaussians, SrbfColors]:
        """The scene that pictures show and its colors: with levels, the highest level."""
        whole = self.gaussians, self.colors
        return whole if self.shown is None else (whole[0][self.shown], whole[1][self.shown])

    @property
    def by_count(self) -> F64:
        """(K + 1,) share of Gaussians with 0, 1, ... K terms."""
        counts = self.colors.counts
        return np.asarray(np.bincount(counts, minlength=1) / max(1, len(counts)))

    @property
    def importance_by_count(self) -> F64:
        """(K + 1,) share of the total importance that belongs to Gaussians with 0, 1, ... K terms."""
        weights = self.preparation.importance
        found = np.bincount(self.colors.counts, weights, minlength=1)
        return np.asarray(found / max(float(weights.sum()), 1e-300))

    @property
    def mean_terms(self) -> float:
        """Mean number of terms of a Gaussian."""
        return self.colors.num_terms / max(1, len(self.colors))

    def sizes(self) -> dict[str, float]:
        """Return sizes in bytes: a Gaussian's color as records and as SH, a base color, and a term."""
        bits = None if self.precision == "exact" else self.precision
        name = self.colors.variant
        degree = self.gaussians.sh_degree
        return {
            "records": record_bytes(self.colors, bits) / max(1, len(self.colors)),
            "base": bytes_per_base(name, bits),
            "term": bytes_per_term(name, bits),
            **{f"sh_{width}": sh_bytes(degree, width) for width in (32, 16, 8)},
        }

    def as_dict(self) -> dict[str, Any]:
        """Return the figures as plain numbers, strings and lists for JSON."""
        found = self.preparation
        shares = self.by_count
        seen = direction_fractions(found.sets)
        cells = self.cell_shares
        active = None
        if cells is not None:
            active = {"cells": len(cells), "share_of_all": _spread(cells)}
        return {
            "gaussians": len(self.colors),
            "sh_degree": self.gaussians.sh_degree,
            "variant": self.colors.variant,
            "precision": self.precision,
            "directions": {
                "from": found.sets_from,
                "mean_share": float(seen.mean()) if len(seen) else 0.0,
                "without_any": found.fit.unseen,
            },
            "terms": {
                "total": self.colors.num_terms,
                "mean": self.mean_terms,
                "gaussians_by_count": shares.tolist(),
                "importance_by_count": self.importance_by_count.tolist(),
                "share_none": float(shares[0]),
                "share_1_to_4": float(shares[1:5].sum()),
                "share_more": float(shares[5:].sum()),
            },
            "bytes_per_gaussian": self.sizes(),
            "file_bytes": self.file_bytes,
            "epsilon": None if self.epsilon is None else self._epsilon_of(self.epsilon),
            "active_in_cells": active,
            "quality": None if self.quality is None else self.quality.as_dict(),
            "learned": None if self.learned is None else self.learned.as_dict(),
        }

    def _epsilon_of(self, epsilon: float) -> dict[str, Any]:
        """Return epsilon and its source for JSON."""
        found = self.calibration
        if found is None:
            return {"value": epsilon, "from": "given"}
        low, high = found.interval
        return {
            "value": epsilon,
            "from": "calibrated",
            "converged": found.converged,
            "reason": found.reason,
            "interval": [low, high] if np.isfinite(low) else None,
            "trials": len(found.epsilons),
            "provenance": dict(found.provenance),
        }


def _spread(values: Sequence[float] | F64) -> dict[str, float]:
    """Return mean, least and largest value."""
    array = np.asarray(values, np.float64)
    return {"mean": float(array.mean()), "min": float(array.min()), "max": float(array.max())}
