"""What viewpoints see and the sets of cells, as bytes: workers send these, and a build keeps them."""

from __future__ import annotations

import struct
from dataclasses import astuple

import numpy as np
import zstandard
from numpy.typing import NDArray

from gsvis.jobs.resume import KeptWork
from gsvis.pvs.cell_view import CellView, Figures
from gsvis.pvs.codec import CodecError, decompress
from gsvis.pvs.sightings import Sighting

__all__ = [
    "find_kept",
    "name_cell",
    "name_viewpoint",
    "pack_sighting",
    "pack_view",
    "read_packed",
    "read_sighting",
    "read_view",
    "unpack_sighting",
    "unpack_view",
]

U8 = NDArray[np.uint8]

_SIGHTING = struct.Struct("<II3d")
_VIEW = struct.Struct("<II3I3d")
_ID = 4  # bytes of an id: difference to the previous one
_SEEN = _ID + 1  # and its class
_DIRECTIONS = 10
_CHECKED = 48  # bytes of each ray
_MOST_CHECKED = 1 << 10
_FREE = 1 << 17  # bytes that an entry may have beside its Gaussians, and what zstd adds to data that does not compress


def pack_sighting(sighting: Sighting) -> bytes:
    """Return what a viewpoint sees as bytes. `unpack_sighting` reads them."""
    head = _SIGHTING.pack(len(sighting.ids), sighting.looks, *sighting.viewpoint.tolist())
    return head + _compress(_pack_seen(sighting.ids, sighting.classes))


def unpack_sighting(data: bytes, gaussians: int) -> Sighting | None:
    """Return what a viewpoint sees; None if the bytes are not valid.

    Args:
        data: Bytes from `pack_sighting`.
        gaussians: N, the number of Gaussians in the scene. More ids, or an id outside [0, N), are damage. So the size
            of the scene bounds the memory.
    """
    if len(data) < _SIGHTING.size:
        return None
    count, looks, *viewpoint = _SIGHTING.unpack_from(data)
    if count > gaussians:
        return None
    body = _expand(data[_SIGHTING.size :], _SEEN * count)
    seen = None if body is None else _unpack_seen(body, count, gaussians)
    if seen is None:
        return None
    ids, classes = seen
    return Sighting(np.array(viewpoint), looks, ids, classes.view(np.int8))


def pack_view(view: CellView) -> bytes:
    """Return the set of one cell as bytes. `unpack_view` reads them."""
    head = _VIEW.pack(len(view.ids), len(view.checked), *astuple(view.figures))
    body = _pack_seen(view.ids, view.classes) + view.directions.T.tobytes() + view.checked.astype("<f8").tobytes()
    return head + _compress(body)


def unpack_view(data: bytes, gaussians: int) -> CellView | None:
    """Return the set of one cell; None if the bytes are not valid.

    Args:
        data: Bytes from `pack_view`.
        gaussians: N, as for `unpack_sighting`.
    """
    if len(data) < _VIEW.size:
        return None
    count, checked, *figures = _VIEW.unpack_from(data)
    if count > gaussians or checked > _MOST_CHECKED:
        return None
    first = _SEEN * count
    second = (_SEEN + _DIRECTIONS) * count
    body = _expand(data[_VIEW.size :], second + _CHECKED * checked)
    seen = None if body is None else _unpack_seen(body[:first], count, gaussians)
    if body is None or seen is None:
        return None
    directions = np.ascontiguousarray(body[first:second].reshape(_DIRECTIONS, count).T)
    rays = np.frombuffer(body[second:].tobytes(), "<f8").astype(np.float64).reshape(checked, 6)
    return CellView(*seen, directions, Figures(*figures), rays)


def name_viewpoint(number: int) -> str:
    """Return the name under which the sighting of a viewpoint is kept."""
    return f"viewpoint-{number:06d}.bin"


def name_cell(cell: int) -> str:
    """Return the name under which the view of a cell is kept."""
    return f"cell-{cell:06d}.bin"


def read_packed(work: KeptWork, number: int, gaussians: int) -> bytes | None:
    """Return the kept sighting of a viewpoint as it was packed; None if it is missing or its checksum is another."""
    return work.read(name_viewpoint(number), at_most=(_SEEN + 1) * gaussians + _FREE)


def read_sighting(work: KeptWork, number: int, gaussians: int) -> Sighting | None:
    """Return the kept sighting of a viewpoint; None if it is missing or damaged."""
    data = read_packed(work, number, gaussians)
    return None if data is None else unpack_sighting(data, gaussians)


def read_view(work: KeptWork, cell: int, gaussians: int) -> CellView | None:
    """Return the kept view of a cell; None if it is missing or damaged."""
    data = work.read(name_cell(cell), at_most=(_SEEN + _DIRECTIONS + 1) * gaussians + _FREE)
    return None if data is None else unpack_view(data, gaussians)


def find_kept(work: KeptWork, viewpoints: int, cells: int, gaussians: int) -> tuple[list[int], list[int]]:
    """Return the viewpoints below `viewpoints` and the cells below `cells` that are kept and undamaged."""
    names = work.names()
    seen = [
        k for k in range(viewpoints) if name_viewpoint(k) in names and read_sighting(work, k, gaussians) is not None
    ]
    found = [c for c in range(cells) if name_cell(c) in names and read_view(work, c, gaussians) is not None]
    return seen, found


def _pack_ids(ids: NDArray[np.int32]) -> bytes:
    """Return ascending ids as differences, byte plane by byte plane."""
    deltas = np.diff(ids, prepend=np.int32(0)).astype("<i4")
    return bytes(deltas.view(np.uint8).reshape(-1, _ID).T.tobytes())


def _pack_seen(ids: NDArray[np.int32], classes: U8 | NDArray[np.int8]) -> bytes:
    """Return packed ids with their classes."""
    return _pack_ids(ids) + classes.tobytes()


def _unpack_ids(body: U8, count: int, gaussians: int) -> NDArray[np.int32] | None:
    """Return the ids that `_pack_ids` packed; None if they are invalid."""
    deltas = np.ascontiguousarray(body[: _ID * count].reshape(_ID, count).T).view("<i4")[:, 0]
    ids = np.cumsum(deltas, dtype=np.int64)
    if count and (ids[0] < 0 or ids[-1] >= gaussians or (deltas[1:] <= 0).any()):
        return None
    return ids.astype(np.int32)


def _unpack_seen(body: U8, count: int, gaussians: int) -> tuple[NDArray[np.int32], U8] | None:
    """Return the ids and classes that `_pack_seen` packed; None if they are invalid."""
    ids = _unpack_ids(body, count, gaussians)
    return None if ids is None else (ids, body[_ID * count : _SEEN * count].copy())


def _compress(body: bytes) -> bytes:
    """Return bytes compressed with zstd."""
    return zstandard.ZstdCompressor(level=1).compress(body)


def _expand(data: bytes, length: int) -> U8 | None:
    """Return the decompressed bytes; None if they are damaged or do not have this length."""
    try:
        return np.frombuffer(decompress(data, length), np.uint8)
    except CodecError:
        return None
