"""Split colors of a slice of Gaussians into a base and weighted functions of direction, which are then fitted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsvis.color._kernels import split as kernels
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
        functions: The functions, in the order of the variant.
    """

    base: F32
    scales: F32
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
    if kind.space == "hsl":
        planes = [np.empty((n, directions), np.float32) for _ in range(4)]
        kernels.split_hsl(colors, weights, scales, base, *planes)
        saturation = Function(planes[0][:, None], planes[1], base[:, 1])
        lightness = Function(planes[2][:, None], planes[3], base[:, 2])
        return Split(base, scales, (saturation, lightness))
    kernels.split_linear(colors, weights, base)
    return Split(base, scales, (Function(colors, weights, np.ones(n, np.float32)),))
