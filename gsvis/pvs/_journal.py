"""The journal of a build: one small file for each finished cell, so that a killed build goes on where it stood.

It is a folder beside the result, named after the plan, so that builds of different plans never meet in one. A file
that is damaged or half-written counts as missing.
"""

from __future__ import annotations

import json
import shutil
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import zstandard

from gsvis.errors import FormatError
from gsvis.files.atomic import atomic_path, remove_all_partials
from gsvis.files.limits import read_whole
from gsvis.files.locks import locked
from gsvis.pvs.codec import CodecError, decompress
from gsvis.pvs.config import CellView

__all__ = ["Journal", "pack_view", "unpack_view"]

_HEAD = struct.Struct("<4sIIIf")
_MAGIC = b"gvc2"  # gvc1 had a checksum of the packed bytes alone
_BYTES = 15  # a Gaussian: what changes from the id before, its class and the directions that it is seen from
_MOST_PACKED = _BYTES + 1  # bytes a Gaussian that a file may have: zstd adds little to what it cannot compress
_FREE = 1 << 12
_CHECKED = 8  # from this byte on, all of it is under the checksum


def pack_view(view: CellView) -> bytes:
    """What one cell sees, as bytes that `unpack_view` can check."""
    deltas = np.diff(view.ids, prepend=np.int32(0)).astype("<i4")
    body = deltas.view(np.uint8).reshape(-1, 4).T.tobytes() + view.classes.tobytes() + view.directions.T.tobytes()
    packed = zstandard.ZstdCompressor(level=1).compress(body)
    data = bytearray(_HEAD.pack(_MAGIC, 0, len(view.ids), view.viewpoints, view.growth) + packed)
    struct.pack_into("<I", data, 4, zlib.crc32(data[_CHECKED:]))
    return bytes(data)


def unpack_view(data: bytes, gaussians: int) -> CellView | None:
    """What was packed; None if the bytes are damaged.

    Args:
        data: Of `pack_view`.
        gaussians: Of the scene. A view of more of them, or of one that is not among them, is damaged; so memory is
            bounded by the size of the scene, and a cell may see all of it.
    """
    if len(data) < _HEAD.size:
        return None
    magic, check, count, viewpoints, growth = _HEAD.unpack_from(data)
    packed = data[_HEAD.size :]
    if magic != _MAGIC or zlib.crc32(data[_CHECKED:]) != check:
        return None
    if count > gaussians:
        return None
    try:
        body = np.frombuffer(decompress(packed, _BYTES * count), np.uint8)
    except CodecError:
        return None
    deltas = np.ascontiguousarray(body[: 4 * count].reshape(4, count).T).view("<i4")[:, 0]
    directions = np.ascontiguousarray(body[5 * count :].reshape(10, count).T)
    ids = np.cumsum(deltas, dtype=np.int64)
    if count and (ids[0] < 0 or ids[-1] >= gaussians or (deltas[1:] <= 0).any()):
        return None
    return CellView(ids.astype(np.int32), body[4 * count : 5 * count].copy(), directions, viewpoints, growth)


class Journal:
    """Finished cells of one plan.

    Args:
        folder: Where they are kept; there may be none yet.
        plan: What is being built, written there for people to read.
        gaussians: Of the scene; what says that a cell sees more is damaged.
    """

    def __init__(self, folder: Path, plan: dict[str, Any], gaussians: int) -> None:
        self.folder, self._plan, self._gaussians = folder, plan, gaussians

    @contextmanager
    def opened(self) -> Iterator[None]:
        """The folder made and kept from other processes; it goes with the last cell in it, or if it never had one.

        Raises:
            ValueError: If another process builds the same.
            OSError: If the folder cannot be written.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        with (self.folder / "lock").open("a+") as lock:
            if not locked(lock):
                raise ValueError(
                    f"path: expected a build that no other process is busy with, got one that is, in {self.folder};"
                    " wait for it or stop it"
                )
            try:
                remove_all_partials(self.folder)  # of a build that was killed
                if not (self.folder / "plan.json").exists():
                    with atomic_path(self.folder / "plan.json", sweep=False) as partial:
                        partial.write_text(json.dumps(self._plan, indent=1) + "\n", encoding="utf-8")
                yield
            finally:
                if not any(self.folder.glob("cell-*.bin")):
                    self.remove()

    def keep(self, cell: int, data: bytes) -> None:
        """Keep the packed view of a cell."""
        with atomic_path(self._path(cell), sweep=False) as partial:  # to list all cells for each takes too long
            partial.write_bytes(data)

    def view(self, cell: int) -> CellView | None:
        """The view of a cell, if it was kept and is whole."""
        try:
            data = read_whole(self._path(cell), _HEAD.size + _MOST_PACKED * self._gaussians + _FREE)
            return unpack_view(data, self._gaussians)
        except (FileNotFoundError, IsADirectoryError, FormatError):
            return None

    def finished(self, count: int) -> list[int]:
        """Those of the first `count` cells that were kept and are whole."""
        kept = {path.name for path in self.folder.glob("cell-*.bin")} if self.folder.is_dir() else ()
        return [cell for cell in range(count) if self._path(cell).name in kept and self.view(cell) is not None]

    def remove(self) -> None:
        """Delete the journal."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def _path(self, cell: int) -> Path:
        return self.folder / f"cell-{cell:06d}.bin"
