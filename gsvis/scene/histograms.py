"""Compute histograms of a scene: opacities, sizes, shapes, distances, and the color in each SH band.

Frame and units are the scene's own. Sizes, ratios and distances are binned by their decimal logarithm. Bins cover the
middle 99% of the values; values beyond are counted separately, so outliers change no bin.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.scene.gaussians import Gaussians

__all__ = ["Band", "Histogram", "measure_bands", "measure_histograms"]

F64 = NDArray[np.float64]
_MOST_BINS = 12
_STEPS = (0.1, 0.25, 0.5, 1.0, 2.0, 5.0, 10.0)  # of a decade
_TAIL = 0.005


@dataclass(frozen=True)
class Histogram:
    """Numbers of Gaussians by a value.

    Attributes:
        edges: B + 1 ascending edges of the bins; the last bin includes both of its edges.
        counts: B numbers of Gaussians.
        below: Number of Gaussians with a value below the first edge.
        above: Number of Gaussians with a value above the last edge.
        median: Median of all values; None for a scene without Gaussians, or if it is infinite.
    """

    edges: list[float]
    counts: list[int]
    below: int
    above: int
    median: float | None

    def as_dict(self) -> dict[str, Any]:
        """Return plain numbers and lists, ready for JSON."""
        return asdict(self)


@dataclass(frozen=True)
class Band:
    """The amount of color in a band of spherical harmonics, averaged over all Gaussians.

    Attributes:
        band: 0 to 3.
        energy: Sum of the squared coefficients of a Gaussian, its three channels together; the mean over Gaussians.
        share: Its share of the energy of all bands.
        rms: Root mean square of the band's part of a color channel, over directions and Gaussians, in [0, 1] units.
            Band 0 is counted from middle gray.
    """

    band: int
    energy: float
    share: float
    rms: float

    def as_dict(self) -> dict[str, Any]:
        """Return plain numbers, ready for JSON."""
        return asdict(self)


def measure_histograms(g: Gaussians) -> dict[str, Histogram]:
    """Return the histograms of a scene by name.

    Args:
        g: The scene; may be empty.

    Returns:
        opacity: of the opacities, ten bins from 0 to 1.
        log10_scale: of log10 of the largest standard deviation, scene units.
        log10_anisotropy: of log10 of the largest standard deviation over the smallest.
        log10_distance: of log10 of the distance of a center from the median of the centers on each axis, scene units.
    """
    logs = np.log10(np.sort(g.scales.astype(np.float64), axis=1))
    means = g.means.astype(np.float64)
    middle = np.median(means, axis=0) if len(g) else np.zeros(3)
    with np.errstate(divide="ignore"):
        distances = np.log10(np.linalg.norm(means - middle, axis=1))  # -inf for a center at the middle
    opacities = g.opacities.astype(np.float64)
    return {
        "opacity": _count(opacities, [round(0.1 * k, 1) for k in range(11)]),
        "log10_scale": _count(logs[:, 2], _log_edges(logs[:, 2])),
        "log10_anisotropy": _count(logs[:, 2] - logs[:, 0], _log_edges(logs[:, 2] - logs[:, 0])),
        "log10_distance": _count(distances, _log_edges(distances)),
    }


def measure_bands(g: Gaussians) -> list[Band]:
    """Return the color in each SH band of a scene, band 0 first.

    References:
        The harmonics are orthonormal over the sphere (Parseval): the mean square over directions is the sum of squared
        coefficients over 4 pi.
    """
    coefficients = np.concatenate([g.sh0, g.shN], axis=1).astype(np.float64)
    each = np.einsum("nkc->k", coefficients**2) / max(1, len(g))
    energies = [float(each[k * k : (k + 1) ** 2].sum()) for k in range(g.sh_degree + 1)]
    total = sum(energies) or 1.0
    return [Band(k, e, e / total, float(np.sqrt(e / (12.0 * np.pi)))) for k, e in enumerate(energies)]


def _log_edges(values: F64) -> list[float]:
    """Return edges at round steps around the middle 99% of logarithms."""
    finite = values[np.isfinite(values)]
    low, high = np.quantile(finite, [_TAIL, 1.0 - _TAIL]).tolist() if len(finite) else (0.0, 0.0)
    for step in _STEPS:
        first = int(np.floor(low / step))
        last = int(np.ceil(high / step))
        if last - first <= _MOST_BINS:
            break
    last = max(last, first + 1)
    return [round(k * step, 2) for k in range(first, last + 1)]


def _count(values: F64, edges: list[float]) -> Histogram:
    """Return the histogram of values."""
    below = int((values < edges[0]).sum())
    above = int((values > edges[-1]).sum())
    counts = np.histogram(values[(values >= edges[0]) & (values <= edges[-1])], bins=edges)[0]
    middle = float(np.median(values)) if len(values) else np.inf
    return Histogram(edges, counts.tolist(), below, above, middle if np.isfinite(middle) else None)
