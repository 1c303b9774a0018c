"""Read the `.splat` format of antimatter15's viewer: 32 bytes per Gaussian, no header, SH degree 0.

Position and scale as six floats (scale activated), color and opacity as four bytes, quaternion wxyz as four bytes
around 128. The frame is the file's own. Without a magic number the suffix alone decides the format.
"""

from __future__ import annotations

import os

import numpy as np

from gsvis.errors import FormatError
from gsvis.files.limits import read_whole
from gsvis.io._build import LEAST_SCALE, gaussians_from, sh0_from_rgb
from gsvis.scene.gaussians import Gaussians

__all__ = ["decode_splat", "load_splat"]

_RECORD = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)])


def load_splat(path: str | os.PathLike[str]) -> Gaussians:
    """Read a `.splat` file.

    Args:
        path: The file.

    Returns:
        The scene, in the file's order and frame.

    Raises:
        FormatError: If the size is no multiple of 32 bytes or a value is invalid.
        OSError: If it cannot be opened.
    """
    return decode_splat(path, read_whole(path))


def decode_splat(path: str | os.PathLike[str], data: bytes) -> Gaussians:
    """Return the scene of the bytes of a `.splat` file.

    Args:
        path: The file that holds them, for error messages.
        data: The bytes.

    Raises:
        FormatError: As `load_splat`.
    """
    size = len(data)
    if size == 0 or size % _RECORD.itemsize:
        raise FormatError(
            path, f"byte {size:,}", "whole records of 32 bytes, at least one", f"{size:,} bytes", "is it truncated?"
        )
    records = np.frombuffer(data, _RECORD)
    rgba = records["rgba"].astype(np.float32) / np.float32(255.0)
    scales = records["scales"].astype(np.float32)
    scales[scales == 0.0] = LEAST_SCALE  # the writer's exponential underflowed
    return gaussians_from(
        path,
        records["means"].astype(np.float32),
        (records["quats"].astype(np.float32) - 128.0) / 128.0,
        scales,
        rgba[:, 3],
        sh0_from_rgb(rgba[:, :3]),
    )
