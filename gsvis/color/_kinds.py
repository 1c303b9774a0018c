"""Dispatch on the array kind of color arguments: one formula serves NumPy and torch.

Colors have three channels on the last axis. NumPy arguments are checked in full. Tensors are checked by shape and type
only, because reading values would wait for the device. Nothing here imports torch: a caller with a tensor has imported
it.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np

from gsvis import _check
from gsvis._check import is_tensor

__all__ = ["channels", "is_tensor", "numbers"]


def numbers(name: str, value: Any) -> tuple[Any, Any]:
    """Return the module that computes with the value (numpy or torch), and the value as finite floats of any shape."""
    if is_tensor(value):
        if not value.is_floating_point():
            raise ValueError(f"{name}: expected a float tensor, got {value.dtype}; convert it, bytes divided by 255")
        return sys.modules["torch"], value
    array = np.asarray(value)
    if array.dtype == np.uint8:
        raise ValueError(f"{name}: expected floats, got bytes; divide them by 255")
    dtype = np.float64 if array.dtype == np.float64 else np.float32
    return np, _check.floats(name, value, array.shape, dtype)


def channels(name: str, value: Any, least: tuple[float, ...], most: tuple[float, ...], remedy: str) -> Any:
    """Return the module and the three channels as (..., 1); check the ranges of NumPy arrays."""
    xp, array = numbers(name, value)
    if array.ndim == 0 or array.shape[-1] != 3:
        raise ValueError(f"{name}: expected shape (..., 3), got {tuple(array.shape)}")
    parts = [array[..., k : k + 1] for k in range(3)]
    if xp is np:
        for part, low, high in zip(parts, least, most, strict=True):
            if (low, high) == (-np.inf, np.inf):
                continue
            try:
                _check.in_range(name, part, low, high)
            except ValueError as error:
                raise ValueError(f"{error}; {remedy}") from None
    return xp, *parts
