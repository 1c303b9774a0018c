"""Certify many cells together: bound the light that their sets miss, and compare two tracers on a sample of rays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis.progress import Progress, silent
from gsvis.pvs.bound import upper_bound
from gsvis.pvs.certificate import Certificate, CertificateConfig, Certifier
from gsvis.pvs.viewpoints import FreeVoxels
from gsvis.raycast import CrossCheck, cross_check

__all__ = ["CertifiedCells", "certify_cells"]

F64 = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class CertifiedCells:
    """The certificates of M cells, which all have the same number of rays.

    Attributes:
        certificates: One for each cell.
        check: Comparison of two tracers on a sample of the rays; None if the second one is not installed.
        error: Probability that a bound is too low.
    """

    certificates: tuple[Certificate, ...]
    check: CrossCheck | None
    error: float

    def __len__(self) -> int:
        return len(self.certificates)

    @property
    def rays(self) -> int:
        """Rays of all cells."""
        return sum(map(len, self.certificates))

    @property
    def missed_by_cell(self) -> F64:
        """(M,) estimated share of the light that the set of each cell misses."""
        return np.array([each.missed for each in self.certificates])

    @property
    def bound_by_cell(self) -> F64:
        """(M,) upper confidence bound of the light that the set of each cell misses; each holds alone."""
        return np.array([each.bound for each in self.certificates])

    @property
    def missed(self) -> float:
        """Estimated share of the light that the sets miss, over all cells."""
        missed, weights = self._samples
        return float(missed.sum() / weights.sum()) if weights.any() else 0.0

    @cached_property
    def bound(self) -> float:
        """Upper confidence bound of the light that the sets miss, over all these cells."""
        return upper_bound(*self._samples, error=self.error)

    @property
    def heavy(self) -> float:
        """Share of the rays that miss a weight of more than a hundredth."""
        return float(np.mean([each.heavy for each in self.certificates]))

    @property
    def _samples(self) -> tuple[F64, F64]:
        """Return the missed weights and the weights of all rays of all certificates."""
        parts = [(each.missed_weights, each.weights) for each in self.certificates]
        return np.concatenate([missed for missed, _ in parts]), np.concatenate([weights for _, weights in parts])

    def as_dict(self) -> dict[str, Any]:
        """Return the figures of all cells together as plain numbers for JSON."""
        check = self.check
        return {
            "rays": self.rays,
            "error": self.error,
            "missed": self.missed,
            "bound": self.bound,
            "worst_cell": float(self.missed_by_cell.max()),
            "worst_bound": float(self.bound_by_cell.max()),
            "heavy_rays": self.heavy,
            "rays_traced_twice": 0 if check is None else check.rays,
            "rays_agreeing": 0 if check is None else check.agreeing,
            "largest_difference": None if check is None else check.largest_difference,
        }


def certify_cells(
    certifier: Certifier,
    sets: Sequence[tuple[FreeVoxels, ArrayLike]],
    config: CertificateConfig,
    *,
    progress: Progress = silent,
) -> CertifiedCells | None:
    """Certify the sets of some cells with the same number of rays each, and trace a sample of the rays twice.

    Args:
        certifier: The scene, N Gaussians.
        sets: Free voxels of each cell, with the Gaussians (V,) of its set.
        config: Options; its `limit` is not used.
        progress: Called with stage "certificate".

    Returns:
        The certificates; None if some cell has too few points outside everything solid.
    """
    fixed = CertificateConfig(**{**vars(config), "limit": 0.0})
    steps = len(sets) + 1
    progress("certificate", 0, steps)
    found = []
    for done, (voxels, ids) in enumerate(sets, 1):
        certificate = certifier.certify(voxels, ids, fixed)
        if certificate is None:
            return None
        found.append(certificate)
        progress("certificate", done, steps)
    rays_o, rays_d = (np.concatenate([getattr(each, name) for each in found]) for name in ("checked_o", "checked_d"))
    check = cross_check(certifier.tracer, rays_o, rays_d) if len(rays_o) else None
    progress("certificate", steps, steps)
    return CertifiedCells(tuple(found), check, config.error)
