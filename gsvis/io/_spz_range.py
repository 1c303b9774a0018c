"""Fit a scene into the ranges of SPZ: choose the fraction bits, move flyaways closer, and clip values.

Coordinates have 24 bits. The number of fraction bits depends on the Gaussians of the scene. A few flyaways must not
reduce the precision of all others. A scene far from (0, 0, 0) is moved there. This module writes no bytes.
"""

from __future__ import annotations

import os
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gsvis.io._origin import size_of_gaussians
from gsvis.io.losses import report_clipped, report_loss
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.sh import SH_C0

__all__ = ["COLOR_SCALE", "LOG_SCALES", "fit_coordinates", "report_spz_losses"]

COLOR_SCALE = 0.15
LOG_SCALES = (-10.0, 255.0 / 16.0 - 10.0)
"""Least and largest log scale."""

_SIDE = 2.0**23 - 1  # steps from 0 to the largest coordinate
_MOST_BITS = 23
_FINE = 0.02  # step that is not visible, as a share of a Gaussian's size
_MOVED_SHARE = 1e-3
"""Largest share of Gaussians that count as flyaways."""


def fit_coordinates(scene: Gaussians, usual_bits: int, path: str | os.PathLike[str]) -> tuple[Gaussians, int]:
    """Return a scene whose coordinates fit into 24 bits, and its number of fraction bits.

    Args:
        scene: The scene.
        usual_bits: Largest number of fraction bits, unless Gaussians are so small that more are visible.
        path: The file, for the log.

    Returns:
        The scene itself if it fits. Otherwise a few flyaways are moved toward (0, 0, 0) and shrunk, so that they look
        the same from there, or the origin changes.

    Raises:
        ValueError: If the scene is empty or extends beyond 2^23 units.
    """
    if len(scene) == 0:
        raise ValueError("scene: expected at least one Gaussian, got none")
    reaches = np.abs(scene.means).max(axis=1).astype(np.float64)
    size = size_of_gaussians(scene.scales)
    wanted = next((bits for bits in range(usual_bits, _MOST_BITS) if 2.0**-bits <= _FINE * size), _MOST_BITS)
    whole = _fraction_bits(float(reaches.max()), wanted)
    if whole is not None and 2.0**-whole <= _FINE * size:
        return scene, min(whole, wanted)
    flown = int(_MOVED_SHARE * len(scene)) if len(scene) >= 1000 else min(1, len(scene) // 20)
    most = float(np.partition(reaches, len(scene) - 1 - flown)[len(scene) - 1 - flown])
    bits = _fraction_bits(most, wanted)
    if bits is None or 2.0**-bits > 4.0 * _FINE * size:
        moved = _recentered(scene, most)
        if moved is not None:
            x, y, z = moved.facts.origin
            report_loss(
                path, "origin", f"centers are written relative to ({x:.12g}, {y:.12g}, {z:.12g}), for precision"
            )
            return fit_coordinates(moved, usual_bits, path)
    if bits is None:
        got = f"{float(reaches.max()):g}"
        raise ValueError(f"scene: expected coordinates within 2^23 for SPZ, got {got}; crop it or write a PLY")
    if whole is not None and whole >= bits:
        bits = whole
    if 2.0**-bits > _FINE * size:
        report_loss(path, "centers", f"centers are rounded to steps of {2.0**-bits:.3g}; Gaussians have {size:.3g}")
    return _with_flyaways_inside(scene, reaches, bits, path), bits


def _fraction_bits(reach: float, most: int) -> int | None:
    """Return how many fraction bits, at most `most`, coordinates up to a reach can have; None if they do not fit."""
    return next((bits for bits in range(most, -1, -1) if reach * 2.0**bits < _SIDE), None)


def _recentered(scene: Gaussians, reach: float) -> Gaussians | None:
    """Return the scene relative to an origin in its middle; None if that brings it not much closer."""
    middle = np.median(scene.means.astype(np.float64), axis=0)
    away = np.quantile(np.abs(scene.means - middle).max(axis=1), 1.0 - _MOVED_SHARE)
    if away > 0.25 * reach:
        return None
    unit = 10.0 ** np.floor(np.log10(max(float(away), 1e-6 * reach)) + 1.0)
    return scene.with_origin(np.asarray(scene.facts.origin) + np.round(middle / unit) * unit)


def _with_flyaways_inside(
    scene: Gaussians, reaches: NDArray[np.float64], bits: int, path: str | os.PathLike[str]
) -> Gaussians:
    """Return the scene with Gaussians beyond the range moved to its border."""
    border = (_SIDE - 1.0) / 2.0**bits
    beyond = reaches > border
    if not beyond.any():
        return scene
    share = np.where(beyond, border / np.maximum(reaches, border), 1.0)[:, None]
    count = int(beyond.sum())
    far = float(reaches.max())
    text = (
        f"{count:,} flyaways, up to {far:.4g} away, are moved to {border:.4g} and shrunk; others keep their precision"
    )
    report_loss(path, "centers", text, count)
    scales = np.maximum(scene.scales * share, np.finfo(np.float32).tiny)
    return Gaussians(
        (scene.means * share).astype(np.float32),
        scene.quats,
        scales.astype(np.float32),
        scene.opacities,
        scene.sh0,
        scene.shN,
        facts=replace(scene.facts),
    )


def report_spz_losses(scene: Gaussians, path: str | os.PathLike[str]) -> None:
    """Log the scales and colors that SPZ clips."""
    low, high = LOG_SCALES
    scales = scene.scales.astype(np.float64)
    thin = np.exp(low - 0.5 / 16.0)
    wide = np.exp(high + 0.5 / 16.0)
    limits = f"{np.exp(low):.2g} to {np.exp(high):.3g}"
    report_clipped(path, "scales", np.where(scales > wide, scales - np.exp(high), 0.0), limits)
    _report_thin(path, int((scales < thin).any(axis=1).sum()), float(np.exp(low)))
    most = 127.5 / (255.0 * COLOR_SCALE)
    step = 1.0 / (255.0 * COLOR_SCALE)
    over = np.maximum(np.abs(scene.sh0[:, 0].astype(np.float64)) - most, 0.0)
    limits = f"{0.5 - SH_C0 * most:.2f} to {0.5 + SH_C0 * most:.2f} of white"
    report_clipped(path, "colors", np.where(over > step / 2.0, SH_C0 * over, 0.0), limits, "of white")
    if scene.sh_degree:
        higher = scene.shN.reshape(len(scene), -1)
        over = np.maximum(np.maximum(-1.0 - higher, higher - 127.0 / 128.0), 0.0)
        report_clipped(path, "SH", np.where(over > 0.5 / 128.0, over, 0.0), "-1 to 1")


def _report_thin(path: str | os.PathLike[str], count: int, least: float) -> None:
    """Log how many Gaussians get thicker scales."""
    if count:
        text = f"scales of {count:,} Gaussians below {least:.2g} become {least:.2g}"
        report_loss(path, "scales", text, count)
