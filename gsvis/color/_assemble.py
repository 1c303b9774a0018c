"""Convert lobes of a slice of Gaussians to terms: one order over all functions, units of the variant, RGB errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gsvis.color._kernels.order import measure_shown_errors, order_lobes
from gsvis.color._kernels.rgb import SPACES
from gsvis.color._pursuit import LobeFit, SplitFit
from gsvis.color.srbf import spherical_coordinates
from gsvis.color.variants import VARIANTS, Variant

if TYPE_CHECKING:
    from gsvis.color.fit import FitConfig

__all__ = ["Terms", "assemble"]

F32 = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Terms:
    """Colors of n Gaussians as in `SrbfColors`, with counts instead of offsets, and their errors."""

    base: F32
    scales: F32
    counts: NDArray[np.int64]
    functions: NDArray[np.uint8]
    centers: F32
    decays: F32
    intensities: F32
    base_errors: F32
    errors: F32

    @classmethod
    def empty(cls, kind: Variant) -> Terms:
        """Return the terms of no Gaussians."""
        z = np.zeros
        f32 = np.float32
        return cls(
            z((0, 3), f32), z(0, f32), z(0, np.int64), z(0, np.uint8), z((0, 2), f32),
            z(0, f32), z((0, kind.intensities), f32), z(0, f32), z(0, f32),
        )  # fmt: skip


def assemble(config: FitConfig, fitted: SplitFit, directions: F32) -> Terms:
    """Return the terms of n Gaussians, in sending order.

    Args:
        config: Config of the fit.
        fitted: The lobes of all functions.
        directions: (3, D) eye to Gaussian.
    """
    kind = VARIANTS[config.variant]
    split = fitted.split
    lobes = fitted.lobes
    n, most = lobes[0].v.shape[:2]
    counts = np.stack([lobe.counts for lobe in lobes])
    v = np.stack([lobe.v for lobe in lobes])
    order = np.tile(np.arange(most), (n, 1))
    kept = counts[0]
    amplitudes = np.stack([_amplitudes(kind, f, lobe) for f, lobe in enumerate(lobes)])
    if kind.space != "rgb":
        order = np.zeros((n, len(lobes) * most), np.int64)
        kept = np.zeros(n, np.int64)
        order_lobes(
            SPACES[kind.space], directions, fitted.colors, fitted.weights, split.base, split.scales, v, amplitudes,
            counts, order, kept,
        )  # fmt: skip
    rows = np.repeat(np.arange(n), kept)
    places = np.arange(len(rows)) - np.repeat(np.cumsum(kept) - kept, kept)
    chosen = order[rows, places]
    function = chosen // max(most, 1)
    k = chosen % max(most, 1)
    moved = v[function, rows, k].astype(np.float64)
    decays = np.linalg.norm(moved, axis=1)
    intensities = np.stack([lobe.intensities for lobe in lobes])[function, rows, k]
    units = np.stack([f.unit for f in split.functions])[function, rows]
    base_errors = np.empty(n, np.float32)
    errors = np.empty(n, np.float32)
    measure_shown_errors(
        SPACES[kind.space], directions, fitted.colors, fitted.weights, split.base, split.scales, v, amplitudes,
        order, kept, base_errors, errors,
    )  # fmt: skip
    return Terms(
        split.base, split.scales, kept.astype(np.int64), function.astype(np.uint8),
        spherical_coordinates(moved).astype(np.float32), decays.astype(np.float32),
        np.asarray(intensities / units[:, None], np.float32), base_errors, errors,
    )  # fmt: skip


def _amplitudes(kind: Variant, function: int, lobe: LobeFit) -> F32:
    """Return (n, K, 3), the amounts that each lobe adds in the variant's space."""
    if not kind.components:
        return lobe.intensities
    added = np.zeros((*lobe.intensities.shape[:2], 3), np.float32)
    added[:, :, kind.components[function]] = lobe.intensities[:, :, 0]
    return added
