"""Give terms of rounded colors fewer bits: places in tables become multiples of powers of two, intensities fit again.

The tables stay the same, so any reader of colors reads the result. What a term lacks is chosen by the caller.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.color import grids as _grids
from gsvis.color._kernels import records as kernels
from gsvis.color.records import Grids, QuantizedColors
from gsvis.color.srbf import unit_vectors

__all__ = ["coarsen_terms"]

F64 = NDArray[np.float64]
U16 = NDArray[np.uint16]
I64 = NDArray[np.int64]

_NARROW = 0.7  # sine of a polar angle below which the azimuth may lack another bit


def coarsen_terms(
    colors: QuantizedColors, centers: ArrayLike, decays: ArrayLike, intensities: ArrayLike
) -> QuantizedColors:
    """Return colors whose terms lack bits; intensities are fitted to the rounded lobes, as by `quantize`.

    Args:
        colors: Rounded colors of N Gaussians with T terms.
        centers: (T,) bits that both angles of the center lack. Near a pole the azimuth lacks one more if it lacks any.
        decays: (T,) bits that the decay lacks.
        intensities: (N,) bits that each intensity of a Gaussian lacks.

    Raises:
        ValueError: If a length is wrong.
    """
    t = colors.num_terms
    of_centers = _check.integers("centers", centers, (t,))
    of_decays = _check.integers("decays", decays, (t,))
    of_gaussians = _check.integers("intensities", intensities, (len(colors),))
    if t == 0:
        return colors
    g = colors.grids
    exact = colors.dequantize()
    places = _round_centers(colors.centers.astype(np.int64), of_centers, g)
    widths = _round_places(colors.decays.astype(np.int64), of_decays, (1 << g.precision.decay) - 1)
    before = _lobes(exact.centers.astype(np.float64), exact.decays)
    angles = np.stack([g.theta_table()[places[:, 0]], g.phi_table()[places[:, 1]]], axis=1)
    lobes = _lobes(angles, g.decay_table()[widths])
    given = exact.intensities.astype(np.float64)
    values = np.empty_like(given)
    kernels.project(colors.offsets, colors.functions, before, lobes, given, values)
    found = np.empty(values.shape, np.uint16)
    table = g.intensity_table()
    owners = np.repeat(np.arange(len(colors)), np.diff(colors.offsets))
    for lacking in np.unique(of_gaussians).tolist():
        step = 1 << lacking
        some = np.flatnonzero(of_gaussians[owners] == lacking)
        kept = np.arange((len(table) // 2) % step, len(table), step)
        counts = np.diff(colors.offsets)[of_gaussians == lacking]
        offsets = np.concatenate([[0], np.cumsum(counts)])
        part = np.empty((len(some), values.shape[1]), np.uint16)
        entries = table[kept].astype(np.float64)
        middles = _grids.middles(table[kept])
        kernels.round_jointly(offsets, colors.functions[some], lobes[some], values[some], entries, middles, part)
        found[some] = kept[part]
    return replace(colors, centers=places.astype(np.uint16), decays=widths.astype(np.uint16), intensities=found)


def _round_places(values: I64, bits: NDArray[np.int64], most: int) -> I64:
    """Return values as multiples of 2^bits, at most `most`."""
    step = np.int64(1) << bits
    found = (values + (step >> 1)) >> bits << bits
    return np.asarray(np.where(found > most, found - step, found), np.int64)


def _round_centers(centers: I64, bits: NDArray[np.int64], g: Grids) -> I64:
    """Return the places (T, 2) of centers that lack bits (T,)."""
    polar = _round_places(centers[:, 0], bits, (1 << g.precision.center) - 1)
    narrow = np.sin(g.theta_table()[polar]) < _NARROW
    around = bits + (narrow & (bits > 0))
    turn = 2 << g.precision.center
    azimuth = _round_places(centers[:, 1], around, turn) % turn
    return np.stack([polar, azimuth], axis=1)


def _lobes(angles: NDArray[np.floating], decays: NDArray[np.floating]) -> F64:
    """Return (T, 4) decay times center, and decay."""
    lengths = decays.astype(np.float64)[:, None]
    return np.concatenate([unit_vectors(angles) * lengths, lengths], axis=1)
