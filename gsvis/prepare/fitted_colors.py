"""Store fitted and rounded colors of a scene, with the figures for reports.

Sizes are of records as they travel, before any entropy coding. Nothing here draws or writes.
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
from gsvis.raycast.directions import direction_fractions
from gsvis.scene.gaussians import Gaussians

__all__ = ["PRECISION_NAMES", "FittedColors", "rounded"]

F64 = NDArray[np.float64]

PRECISION_NAMES = (*PRECISIONS, "exact")
"""What records can be rounded to; "exact" keeps float32."""


def rounded(colors: SrbfColors, precision: str) -> SrbfColors:
    """The colors as records of a precision say them, ready to be saved with `quantize(colors, precision)`.

    Args:
        colors: As fitted.
        precision: One of `PRECISION_NAMES`.
    """
    return colors if precision == "exact" else quantize(colors, precision).dequantize()


@dataclass(frozen=True, eq=False)
class FittedColors:
    """Colors of N Gaussians and what is known of them.

    Attributes:
        gaussians: The scene, or the union of its levels, with its SH colors.
        colors: As the file holds them.
        preparation: The fit, and what it was fitted to.
        precision: One of `PRECISION_NAMES`.
        file_bytes: Size of the file, geometry included.
        epsilon: Contribution from which a term is active; None if nobody asked.
        calibration: How it was found; None if it was given.
        quality: Comparison with SH; None if nobody asked.
        cell_shares: (C,) share of all terms that each cell of the visible sets needs; None if nobody asked.
        shown: (N,) bool, Gaussians of the highest of several levels, which pictures show; None for a scene.
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

    @property
    def drawn(self) -> tuple[Gaussians, SrbfColors]:
        """What pictures show: a scene, which a union of levels is not, and its colors."""
        whole = self.gaussians, self.colors
        return whole if self.shown is None else (whole[0][self.shown], whole[1][self.shown])

    @property
    def by_count(self) -> F64:
        """(K + 1,) share of Gaussians with 0, 1, ... K terms."""
        counts = self.colors.counts
        return np.asarray(np.bincount(counts, minlength=1) / max(1, len(counts)))

    @property
    def importance_by_count(self) -> F64:
        """(K + 1,) share of the importance of all that Gaussians with 0, 1, ... K terms have."""
        weights = self.preparation.importance
        found = np.bincount(self.colors.counts, weights, minlength=1)
        return np.asarray(found / max(float(weights.sum()), 1e-300))

    @property
    def mean_terms(self) -> float:
        """Terms a Gaussian, over all its functions."""
        return self.colors.num_terms / max(1, len(self.colors))

    def sizes(self) -> dict[str, float]:
        """Bytes a Gaussian of its color as records and as SH, and of a term and a base."""
        bits = None if self.precision == "exact" else self.precision
        name, degree = self.colors.variant, self.gaussians.sh_degree
        return {
            "records": record_bytes(self.colors, bits) / max(1, len(self.colors)),
            "base": bytes_per_base(name, bits),
            "term": bytes_per_term(name, bits),
            **{f"sh_{width}": sh_bytes(degree, width) for width in (32, 16, 8)},
        }

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers, strings and lists, ready for JSON."""
        found, shares = self.preparation, self.by_count
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
        }

    def _epsilon_of(self, epsilon: float) -> dict[str, Any]:
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
    array = np.asarray(values, np.float64)
    return {"mean": float(array.mean()), "min": float(array.min()), "max": float(array.max())}
