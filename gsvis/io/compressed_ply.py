"""Read PlayCanvas compressed PLY: 16 bytes per Gaussian, in chunks of 256 with their own value ranges.

Elements are `chunk` (float minima and maxima), `vertex` (four packed uints) and optionally `sh` (one byte per
coefficient, channel by channel as in INRIA PLY). Older files have no color range; their colors lie in [0, 1].
"""

from __future__ import annotations

from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.errors import FormatError
from gsvis.io._build import exp_scales, gaussians_from, sh0_from_rgb
from gsvis.io._kernels.spz import spread_8888, spread_111011, unpack_quats
from gsvis.io._ply_comments import facts_of
from gsvis.io._ply_header import Element, PlyHeader
from gsvis.scene.gaussians import Gaussians

__all__ = ["is_compressed", "read_compressed"]

F32 = NDArray[np.float32]
_CHUNK = 256
_VERTEX = ("packed_position", "packed_rotation", "packed_scale", "packed_color")


def is_compressed(header: PlyHeader) -> bool:
    """Return whether the header belongs to a compressed PLY: packed vertices."""
    vertex = header.element("vertex")
    return vertex is not None and any(name in vertex.properties for name in _VERTEX)


def read_compressed(header: PlyHeader, stream: BinaryIO) -> Gaussians:
    """Decode a compressed PLY.

    Args:
        header: Its header, for which `is_compressed` holds.
        stream: The opened file.

    Returns:
        The scene, in the file's order and frame.

    Raises:
        FormatError: If elements or properties are missing, the file is truncated, or values are invalid.
    """
    vertex = _require(header, "vertex", _VERTEX, "u4")
    bounds = tuple(f"{end}_{axis}" for end in ("min", "max") for axis in "xyz")
    chunk = _require(header, "chunk", (*bounds, *(b.replace("_", "_scale_") for b in bounds)), "f4")
    if header.encoding == "ascii":
        raise FormatError(header.path, "header", "binary rows in a compressed PLY", "ascii")
    chunks = -(-vertex.count // _CHUNK)
    if chunk.count != chunks:
        raise FormatError(
            header.path, "element chunk", f"{chunks:,} chunks for {vertex.count:,} Gaussians", f"{chunk.count:,}"
        )
    rows = _rows(header, vertex, stream)
    ranges = _rows(header, chunk, stream)
    position, rotation, scale, color = (np.ascontiguousarray(rows[name], np.uint32) for name in _VERTEX)
    means, log_scales, rgb = (np.empty((vertex.count, 3), np.float32) for _ in range(3))
    position, rotation, scale, color = _check.read_only(position, rotation, scale, color)
    spread_111011(position, *_ends(ranges, "min_", "max_", "xyz"), _CHUNK, means)
    spread_111011(scale, *_ends(ranges, "min_scale_", "max_scale_", "xyz"), _CHUNK, log_scales)
    opacities = np.empty(vertex.count, np.float32)
    quats = np.empty((vertex.count, 4), np.float32)
    colored = all(f"{end}_{c}" in chunk.properties for end in ("min", "max") for c in "rgb")
    whole = np.zeros((chunks, 3), np.float32), np.ones((chunks, 3), np.float32)
    spread_8888(color, *(_ends(ranges, "min_", "max_", "rgb") if colored else whole), _CHUNK, rgb, opacities)
    table = (np.arange(1024, dtype=np.float32) / np.float32(1023.0) - 0.5) * np.float32(np.sqrt(2.0))
    unpack_quats(rotation, table, np.arange(4), np.ones(4, np.float32), quats)
    scales = exp_scales(log_scales, out=log_scales)
    higher = _higher(header, vertex.count, stream)
    facts = facts_of(header.comments)
    return gaussians_from(header.path, means, quats, scales, opacities, sh0_from_rgb(rgb), higher, facts)


def _ends(ranges: NDArray[Any], low: str, high: str, axes: str) -> tuple[F32, F32]:
    """Return the (C, 3) lowest and highest values of chunks."""
    ends = [np.stack([ranges[end + axis] for axis in axes], axis=1).astype(np.float32) for end in (low, high)]
    return ends[0], ends[1]


def _require(header: PlyHeader, name: str, properties: tuple[str, ...], kind: str) -> Element:
    """Return the element with that name; raise unless it has all those properties, each of that numpy type."""
    element = header.element(name)
    if element is None or element.row is None:
        raise FormatError(header.path, "header", f"an element {name} of scalar properties", "none")
    wrong = [p for p in properties if p not in element.properties or element.row[p].str[1:] != kind]
    if wrong:
        spelled = {"f4": "float", "u4": "uint", "u1": "uchar"}[kind]
        raise FormatError(header.path, f"element {name}", f"{spelled} properties", f"none named {', '.join(wrong)}")
    return element


def _rows(header: PlyHeader, element: Element, stream: BinaryIO) -> NDArray[Any]:
    """Return all rows of an element."""
    row, offset = header.rows_of(element)
    stream.seek(offset)
    rows = np.frombuffer(stream.read(element.count * row.itemsize), np.uint8)
    if len(rows) != element.count * row.itemsize:
        raise FormatError(
            header.path, f"element {element.name}", "a file that does not change while it is read", "its end"
        )
    return rows.view(row)


def _higher(header: PlyHeader, count: int, stream: BinaryIO) -> F32 | None:
    """Return (N, K-1, 3) coefficients of the optional `sh` element: bytes over [-4, 4], with exact ends."""
    sh = header.element("sh")
    if sh is None:
        return None
    columns = len(sh.properties)
    if columns not in (9, 24, 45) or sh.count != count:
        raise FormatError(
            header.path,
            "element sh",
            f"9, 24 or 45 properties and {count:,} rows",
            f"{columns} properties and {sh.count:,} rows",
        )
    _require(header, "sh", tuple(f"f_rest_{i}" for i in range(columns)), "u1")
    rows = _rows(header, sh, stream)
    levels = (np.arange(256, dtype=np.float32) + 0.5) / 256.0
    levels[[0, 255]] = 0.0, 1.0
    levels = (levels - 0.5) * 8.0
    out = np.empty((count, columns // 3, 3), np.float32)
    for channel in range(3):
        for k in range(columns // 3):
            out[:, k, channel] = levels[rows[f"f_rest_{channel * (columns // 3) + k}"]]
    return out
