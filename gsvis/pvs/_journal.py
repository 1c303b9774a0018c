"""What cells see as bytes: as workers send it and as a build keeps it until its store is whole."""

from __future__ import annotations

import struct

import numpy as np
import zstandard

from gsvis.files.limits import MAX_EXPANSION, MIN_BUDGET
from gsvis.files.resume import KeptWork
from gsvis.pvs.codec import CodecError, decompress
from gsvis.pvs.config import CellView

__all__ = ["entry_of", "kept_cells", "kept_view", "pack_view", "unpack_view"]

_HEAD = struct.Struct("<IIf")


def pack_view(view: CellView) -> bytes:
    """Return what one cell sees as bytes that `unpack_view` reads."""
    deltas = np.diff(view.ids, prepend=np.int32(0)).astype("<i4")
    body = deltas.view(np.uint8).reshape(-1, 4).T.tobytes() + view.classes.tobytes() + view.directions.T.tobytes()
    packed = zstandard.ZstdCompressor(level=1).compress(body)
    return _HEAD.pack(len(view.ids), view.viewpoints, view.growth) + packed


def unpack_view(data: bytes) -> CellView | None:
    """Return what was packed; None if the bytes are none of a view."""
    if len(data) < _HEAD.size:
        return None
    count, viewpoints, growth = _HEAD.unpack_from(data)
    packed = data[_HEAD.size :]
    try:
        if 15 * count > MIN_BUDGET + MAX_EXPANSION * len(data):  # promises more than such a file can hold
            return None
        body = np.frombuffer(decompress(packed, 15 * count), np.uint8)
    except CodecError:
        return None
    deltas = np.ascontiguousarray(body[: 4 * count].reshape(4, count).T).view("<i4")[:, 0]
    directions = np.ascontiguousarray(body[5 * count :].reshape(10, count).T)
    ids = np.cumsum(deltas, dtype=np.int64)
    if count and (ids[0] < 0 or ids[-1] >= 1 << 31 or (deltas[1:] <= 0).any()):
        return None
    return CellView(ids.astype(np.int32), body[4 * count : 5 * count].copy(), directions, viewpoints, growth)


def entry_of(cell: int) -> str:
    """Return the name under which the view of a cell is kept."""
    return f"cell-{cell:06d}.bin"


def kept_view(work: KeptWork, cell: int) -> CellView | None:
    """Return the view of a cell, if it was kept and is whole."""
    data = work.read(entry_of(cell))
    return None if data is None else unpack_view(data)


def kept_cells(work: KeptWork, count: int) -> list[int]:
    """Return those of the first `count` cells that were kept and are whole."""
    names = work.names()
    return [cell for cell in range(count) if entry_of(cell) in names and kept_view(work, cell) is not None]
