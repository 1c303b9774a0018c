"""Decode and encode one plane of a SOG scene: a lossless WebP image whose bytes are data, not color.

The size is read from the file's own header and checked before a pixel is decoded, so an image that would unpack to
gigabytes is rejected. This module knows no metadata.
"""

from __future__ import annotations

import io
import os
import struct

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from gsvis.errors import FormatError
from gsvis.io._wrapped import HEAD, check_pointer

__all__ = ["MAX_PIXELS", "decode_plane", "encode_plane", "plane_size"]

_LOSSLESS = "a lossless WebP image"
_ANIMATED = 0x02

MAX_PIXELS = 1 << 26
"""Largest number of pixels of a plane; files of streamed scenes have half a million Gaussians."""


def plane_size(path: str | os.PathLike[str], where: str, data: bytes) -> tuple[int, int]:
    """Return the width and height that a WebP file declares.

    Args:
        path: The scene, for error messages.
        where: The plane, for error messages.
        data: Content of the file.

    Raises:
        FormatError: If it is not a lossless, still WebP image.

    References:
        WebP container specification; WebP lossless bitstream specification, section 3.
    """
    if len(data) < 25 or data[:4] != b"RIFF" or data[8:12] != b"WEBP":
        check_pointer(path, data[:HEAD], where)
        raise FormatError(path, where, _LOSSLESS, f"{len(data):,} bytes in another format")
    at = 12
    canvas = None
    while at + 8 <= len(data):
        kind = data[at : at + 4]
        length = struct.unpack_from("<I", data, at + 4)[0]
        body = data[at + 8 : at + 18]
        if kind == b"VP8X" and len(body) == 10:
            if body[0] & _ANIMATED:
                raise FormatError(path, where, _LOSSLESS, "an animation")
            canvas = 1 + int.from_bytes(body[4:7], "little"), 1 + int.from_bytes(body[7:10], "little")
        if kind == b"VP8L" and len(body) >= 5 and body[0] == 0x2F:
            bits = int.from_bytes(body[1:5], "little")
            size = 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
            if canvas not in (None, size):
                raise FormatError(path, where, f"a canvas of the image's size {size}", f"{canvas}")
            if size[0] * size[1] > MAX_PIXELS:
                raise FormatError(path, where, f"at most {MAX_PIXELS:,} pixels in a plane", f"{size[0]} x {size[1]}")
            return size
        if kind == b"VP8 ":
            raise FormatError(path, where, _LOSSLESS, "a lossy one", "its values are not exact; write it losslessly")
        at += 8 + length + (length & 1)
    raise FormatError(path, where, _LOSSLESS, "a file without an image", "is it truncated?")


def decode_plane(path: str | os.PathLike[str], where: str, data: bytes) -> NDArray[np.uint8]:
    """Return the pixels of a plane; its size must have been checked with `plane_size`.

    Returns:
        (H, W, 4) uint8; the fourth channel is 255 if the file has none.

    Raises:
        FormatError: If the image is damaged.
    """
    width, height = plane_size(path, where, data)
    try:
        with Image.open(io.BytesIO(data), formats=["WEBP"]) as image:
            pixels = np.asarray(image.convert("RGBA"))
    except (OSError, EOFError, ValueError, SyntaxError, RuntimeError) as error:
        raise FormatError(path, where, _LOSSLESS, str(error) or type(error).__name__, "is it truncated?") from error
    if pixels.shape != (height, width, 4):
        raise FormatError(path, where, f"{width} x {height} pixels", f"{pixels.shape[1]} x {pixels.shape[0]}")
    return pixels


def encode_plane(pixels: NDArray[np.uint8]) -> bytes:
    """Return a lossless WebP file of (H, W, 4) uint8 pixels; every byte is kept, even where the fourth channel is 0."""
    out = io.BytesIO()
    Image.fromarray(pixels, "RGBA").save(out, "WEBP", lossless=True, exact=True, quality=80, method=4)
    return out.getvalue()
