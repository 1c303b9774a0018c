"""The set of a cell as bytes. Workers send these bytes, and a build keeps them until its store is complete."""

from __future__ import annotations

import struct

import numpy as np
import zstandard

from gsvis.files.resume import KeptWork
from gsvis.pvs.cell_view import CellView
from gsvis.pvs.codec import CodecError, decompress

__all__ = ["find_kept_cells", "name_entry", "pack_view", "read_view", "unpack_view"]

_HEAD = struct.Struct("<IIf")
_BYTES = 15  # for each Gaussian: difference to the previous id, class, directions that it is seen from
_MOST_PACKED = _BYTES + 1  # most bytes for each Gaussian in an entry: zstd adds little to data that does not compress
_FREE = 1 << 12


def pack_view(view: CellView) -> bytes:
    """Return the set of one cell as bytes. `unpack_view` reads them."""
    deltas = np.diff(view.ids, prepend=np.int32(0)).astype("<i4")
    body = deltas.view(np.uint8).reshape(-1, 4).T.tobytes() + view.classes.tobytes() + view.directions.T.tobytes()
    packed = zstandard.ZstdCompressor(level=1).compress(body)
    return _HEAD.pack(len(view.ids), view.viewpoints, view.growth) + packed


def unpack_view(data: bytes, gaussians: int) -> CellView | None:
    """Return the packed view; None if the bytes are not a valid view.

    Args:
        data: Bytes from `pack_view`.
        gaussians: N, the number of Gaussians in the scene. A view with more ids, or with an id outside [0, N), is
            damaged. So the size of the scene bounds the memory.
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
    """Return the kept view of a cell; None if it is missing or damaged. The scene has N Gaussians."""
    data = work.read(name_entry(cell), at_most=_HEAD.size + _MOST_PACKED * gaussians + _FREE)
    return None if data is None else unpack_view(data, gaussians)


def find_kept_cells(work: KeptWork, count: int, gaussians: int) -> list[int]:
    """Return the cells below `count` whose views are kept and undamaged."""
    names = work.names()
    return [cell for cell in range(count) if name_entry(cell) in names and read_view(work, cell, gaussians) is not None]
