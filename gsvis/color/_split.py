"""Split colors of a slice of Gaussians into a base and weighted functions of direction, which are then fitted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsvis.color._kernels import split as kernels
from gsvis.color.spaces import rgb_to_yuv
from gsvis.color.variants import Variant

__all__ = ["Function", "Split", "split_colors"]

F32 = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Function:
    """One function of direction of n Gaussians, after subtraction of the base.

    Attributes:
        targets: (n, C, D); the C values of a direction share their lobes.
        weights: (n, D) weight of a squared error; 0 for directions that are not seen.
        unit: (n,) target value of an intensity of 1; 0 if no intensity is possible.
    """

    targets: F32
    weights: F32
    unit: F32


@dataclass(frozen=True, eq=False)
class Split:
    """Base colors and the functions to fit.

    Attributes:
        base: (n, 3) in the variant's space.
        scales: (n,).
        axes: (n, num_axes, 3).
        functions: The functions, in the order of the variant.
    """

    base: F32
    scales: F32
    axes: F32
    functions: tuple[Function, ...]


def split_colors(kind: Variant, colors: F32, weights: F32) -> Split:
    """Split RGB colors over directions.

    Args:
        kind: The variant.
        colors: (n, 3, D) RGB >= 0; overwritten.
        weights: (n, D) >= 0, some above 0 in each row.
    """
    n, _, directions = colors.shape
    base = np.empty((n, 3), np.float32)
    scales = np.ones(n, np.float32)
    axes = np.zeros((n, kind.num_axes, 3), np.float32)
    ones = np.ones(n, np.float32)
    if kind.space in ("hsl", "hsv"):
        planes = [np.empty((n, directions), np.float32) for _ in range(4)]
        if kind.space == "hsv":
            kernels.split_hsv(colors, weights, scales, base, *planes[:2])
            return Split(base, scales, axes, (Function(planes[0][:, None], planes[1], base[:, 2]),))
        kernels.split_hsl(colors, weights, scales, base, *planes)
        if len(kind.functions) == 1:
            kernels.hold_saturation(colors, weights, scales, base, *planes[2:])
        saturation = Function(planes[0][:, None], planes[1], base[:, 1])
        lightness = Function(planes[2][:, None], planes[3], base[:, 2])
        return Split(base, scales, axes, (saturation, lightness)[-len(kind.functions) :])
    covariance = np.empty((n, 3, 3))
    kernels.split_linear(colors, weights, base, covariance)
    if kind.space == "yuv":
        gray = colors.mean(axis=1)  # with U and V fixed, this step in Y is nearest in RGB, not that of luma
        base = np.asarray(rgb_to_yuv(base), np.float32)
        every_channel = np.float32(3.0)  # a step in Y changes R, G and B equally
        return Split(base, scales, axes, (Function(gray[:, None], every_channel * weights, base[:, 0]),))
    if kind.num_axes == 0:
        return Split(base, scales, axes, (Function(colors, weights, ones),))
    axes = _principal_axes(covariance, kind.num_axes)
    along = np.matmul(axes, colors)
    if len(kind.functions) == 1:
        return Split(base, scales, axes, (Function(along, weights, ones),))
    parts = (np.ascontiguousarray(along[:, k : k + 1]) for k in range(kind.num_axes))
    return Split(base, scales, axes, tuple(Function(part, weights, ones) for part in parts))


def _principal_axes(covariance: NDArray[np.float64], count: int) -> F32:
    """Return (n, count, 3) unit eigenvectors of the largest eigenvalues, each with its largest component positive."""
    vectors = np.swapaxes(np.linalg.eigh(covariance)[1], 1, 2)[:, ::-1][:, :count]
    largest = np.abs(vectors).argmax(axis=2)[:, :, None]
    signs = np.sign(np.take_along_axis(vectors, largest, axis=2))
    return np.ascontiguousarray(vectors * signs, np.float32)
