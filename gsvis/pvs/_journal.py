"""What cells see as bytes: as workers send it and as a build keeps it until its store is whole."""

from __future__ import annotations

import struct

import numpy as np
import zstandard

from gsvis.files.resume import KeptWork
from gsvis.pvs.cell_view import CellView
from gsvis.pvs.codec import CodecError, decompress

__all__ = ["find_kept_cells", "name_entry", "pack_view", "read_view", "unpack_view"]

_HEAD = struct.Struct("<IIf")
_BYTES = 15  # a Gaussian: what changes from the id before, its class and the directions that it is seen from
_MOST_PACKED = _BYTES + 1  # bytes a Gaussian that an entry may have: zstd adds little to what it cannot compress
_FREE = 1 << 12


def pack_view(view: CellView) -> bytes:
    """Return what one cell sees as bytes that `unpack_view` reads."""
    deltas = np.diff(view.ids, prepend=np.int32(0)).astype("<i4")
    body = deltas.view(np.uint8).reshape(-1, 4).T.tobytes() + view.classes.tobytes() + view.directions.T.tobytes()
    packed = zstandard.ZstdCompressor(level=1).compress(body)
    return _HEAD.pack(len(view.ids), view.viewpoints, view.growth) + packed


def unpack_view(data: bytes, gaussians: int) -> CellView | None:
    """Return what was packed; None if the bytes are no view.

    Args:
        data: Of `pack_view`.
        gaussians: Of the scene. A view of more of them, or of one that is not among them, is damaged; so memory is
            bounded by the size of the scene, and a cell may see all of it.
    """
    if len(data) < _HEAD.size:
        return None
    count, viewpoints, growth = _HEAD.unpack_from(data)
    if count > gaussians:
        return None
    try:
        body = np.frombuffer(decompress(data[_HEAD.size :], _BYTES * count), np.uint8)
    except CodecError:
        return None
    deltas = np.ascontiguousarray(body[: 4 * count].reshape(4, count).T).view("<i4")[:, 0]
    directions = np.ascontiguousarray(body[5 * count :].reshape(10, count).T)
    ids = np.cumsum(deltas, dtype=np.int64)
    if count and (ids[0] < 0 or ids[-1] >= gaussians or (deltas[1:] <= 0).any()):
        return None
    return CellView(ids.astype(np.int32), body[4 * count : 5 * count].copy(), directions, viewpoints, growth)


def name_entry(cell: int) -> str:
    """Return the name under which the view of a cell is kept."""
    return f"cell-{cell:06d}.bin"


def read_view(work: KeptWork, cell: int, gaussians: int) -> CellView | None:
    """Return the view of a cell of a scene of N Gaussians, if it was kept and is whole."""
    data = work.read(name_entry(cell), at_most=_HEAD.size + _MOST_PACKED * gaussians + _FREE)
    return None if data is None else unpack_view(data, gaussians)


def find_kept_cells(work: KeptWork, count: int, gaussians: int) -> list[int]:
    """Return those of the first `count` cells that were kept and are whole."""
    names = work.names()
    return [cell for cell in range(count) if name_entry(cell) in names and read_view(work, cell, gaussians) is not None]
