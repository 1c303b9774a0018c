"""Values as images of integers, and images as JPEG XL without loss.

Quantization is linear between the least and the largest value of each channel.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis.errors import BackendError

__all__ = ["decode_jpeg_xl", "dequantize", "encode_jpeg_xl", "quantize"]

F32 = NDArray[np.float32]


def quantize(values: ArrayLike, bits: int) -> tuple[NDArray[np.uint16], F32]:
    """Return integers (N, F) of some bits, and the (2, F) least and largest value of each column."""
    array = np.asarray(values, np.float32)
    ends = np.stack([array.min(axis=0), array.max(axis=0)])
    width = np.maximum(ends[1] - ends[0], 1e-12)
    return np.rint((array - ends[0]) / width * (2**bits - 1)).astype(np.uint16), ends


def dequantize(integers: NDArray[np.integer[Any]], ends: F32, bits: int) -> F32:
    """Return the values of `quantize`, each within half a step."""
    share = integers.astype(np.float32) / np.float32(2**bits - 1)
    return np.asarray(ends[0] + share * (ends[1] - ends[0]), np.float32)


def encode_jpeg_xl(image: NDArray[np.integer[Any]]) -> bytes:
    """Return an image (H, W) or (H, W, 3) as JPEG XL, without loss.

    Raises:
        BackendError: If `imagecodecs` is not installed.
    """
    return bytes(_codecs().jpegxl_encode(np.ascontiguousarray(image), lossless=True))


def decode_jpeg_xl(data: bytes) -> NDArray[np.integer[Any]]:
    """Return the image of JPEG XL.

    Raises:
        BackendError: If `imagecodecs` is not installed.
        ValueError: If the data are damaged.
    """
    codecs = _codecs()
    try:
        return np.asarray(codecs.jpegxl_decode(data))
    except (RuntimeError, ValueError) as error:
        raise ValueError(f"expected an image in JPEG XL, got {len(data):,} damaged bytes: {error}") from None


def _codecs() -> Any:
    try:
        return import_module("imagecodecs")
    except ImportError:
        raise BackendError("SOGG needs JPEG XL: pip install -r benchmarks/arena/requirements.txt") from None
