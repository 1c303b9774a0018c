"""BATCH: one message with records, as an Arrow record batch of four rows: ids, rows of chunks, records, terms.

Ids are sorted ascending and sent as differences, a few bits each. Records are coded together (`coding.py`). A client
can read a batch if it has the rows of the chunks sent before. The bytes around the rows are the same in every batch
except for two lengths and the ends of the rows, so this module writes them without an Arrow library. An Arrow library
can read a batch.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from gsvis.errors import ProtocolError
from gsvis.stream._kernels import ids as kernels
from gsvis.stream.header import HEAD, SceneHeader
from gsvis.stream.wire import BATCH, FAULTS

__all__ = ["CHUNK_ROW", "FIXED_BYTES", "Sections"]

I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]

CHUNK_ROW = np.dtype(
    [
        ("origin", "<f4", 3),
        ("step", "<f4", 3),
        ("low", "<i2"),
        ("count", "<u2"),
        ("stride", "u1"),
        ("first_level", "u1"),
        ("last_level", "u1"),
        ("bits", "<u2"),
    ]
)
"""Type of the row of a chunk, 33 bytes."""

MOST_BYTES = 1 << 28
"""Most bytes of a batch."""

_ARROW = bytes.fromhex(
    "ffffffff9800000014000000000000000c0016000600050008000c000c000000"
    "0003040018000000000000000000000000000a0018000c00040008000a000000"
    "4c00000010000000040000000000000000000000030000000000000000000000"
    "0000000000000000000000000000000014000000000000001800000000000000"
    "0000000000000000000000000100000004000000000000000000000000000000"
)  # marker, length, and metadata of a record batch of four rows of bytes, without the two numbers below
# int64: bytes of the body, and of the rows
_BODY_AT = 40
_DATA_AT = 128
_NUMBER = struct.Struct("<q")
_ENDS = struct.Struct("<5i4x")  # start of the first row, and end of each
_IDS = struct.Struct("<4I6B")  # numbers of Gaussians, terms, gone, evicted; code orders of the six lists
_ROWS_AT = HEAD.size + len(_ARROW) + _ENDS.size

FIXED_BYTES = _ROWS_AT + _IDS.size + 8
"""Most bytes of an empty batch, with the padding to a multiple of eight."""


@dataclass(frozen=True, eq=False)
class Sections:
    """The content of a BATCH.

    Attributes:
        sequence: Number of the batch, from 1.
        chunks: (C,) first ids, ascending, of the chunks whose rows are in this batch.
        rows: (C,) of `CHUNK_ROW`, one for each chunk.
        gaussians: (G,) ids of Gaussians, ascending.
        records: uint8, the coded records of the Gaussians.
        terms: (M,) ids of terms, ascending.
        owners: (M,) the Gaussian of each term, never decreasing.
        term_records: uint8, the coded records of the terms.
        gone: (D,) ids, ascending, of the Gaussians that were replaced since the last batch, sent or not.
        evicted: (E,) ids, ascending, that the client forgets before it adds the new records: it removes these Gaussians
            and their terms, and they no longer count as replaced.
    """

    sequence: int
    chunks: NDArray[Any]
    rows: NDArray[Any]
    gaussians: NDArray[Any]
    records: U8
    terms: NDArray[Any]
    owners: NDArray[Any]
    term_records: U8
    gone: NDArray[Any]
    evicted: NDArray[Any] = field(default_factory=lambda: np.zeros(0, np.int32))

    def to_message(self, about: SceneHeader) -> bytes:
        """Return the BATCH message.

        Args:
            about: Header of the scene.
        """
        arrays = self._encode_ids(about), self.rows, self.records, self.term_records
        rows = [np.ascontiguousarray(array).reshape(-1).view(np.uint8) for array in arrays]
        ends = [0]
        for row in rows:
            ends.append(ends[-1] + len(row))
        filled = -ends[-1] % 8
        head = bytearray(HEAD.pack(BATCH, 0, 0, self.sequence) + _ARROW + _ENDS.pack(*ends))
        _NUMBER.pack_into(head, HEAD.size + _BODY_AT, _ENDS.size + ends[-1] + filled)
        _NUMBER.pack_into(head, HEAD.size + _DATA_AT, ends[-1])
        return b"".join([head, *rows, bytes(filled)])  # type: ignore[list-item]

    def _encode_ids(self, about: SceneHeader) -> U8:
        """Return the row of ids: the lengths and code orders of the six lists, then their bits."""
        assert len(self.owners) == len(self.terms), "the kernel writes an owner for each term"
        types = np.int64, np.int32, np.uint32, np.int32, np.int32, np.int32
        given = self.chunks, self.gaussians, self.terms, self.owners, self.gone, self.evicted
        lists = [np.ascontiguousarray(ids, kind) for ids, kind in zip(given, types, strict=True)]
        most = sum(len(ids) for ids in lists) * kernels.MOST_BITS // 8 + 8
        out = np.empty(_IDS.size + most, np.uint8)
        orders = np.empty(6, np.uint8)
        bits = kernels.write_ids(*lists, _owner_step(about), orders, out[_IDS.size :])
        counts = len(self.gaussians), len(self.terms), len(self.gone), len(self.evicted)
        out[: _IDS.size] = np.frombuffer(_IDS.pack(*counts, *orders.tolist()), np.uint8)
        return out[: _IDS.size - (-bits // 8)]

    @classmethod
    def parse(cls, data: bytes, about: SceneHeader) -> Sections:
        """Return the content of a BATCH.

        Args:
            data: The message.
            about: Header of the scene.

        Raises:
            ProtocolError: If the message is not a BATCH, or does not fit the scene.
        """
        if len(data) < _ROWS_AT or data[0] != BATCH:
            kind = f" of kind {data[0]}" if data else ""
            raise ProtocolError(f"message: expected BATCH, got {len(data):,} bytes{kind}")
        if len(data) > MOST_BYTES:
            raise ProtocolError(f"BATCH: expected at most {MOST_BYTES:,} bytes, got {len(data):,}", FAULTS["too-large"])
        sequence = HEAD.unpack_from(data)[3]
        ends = _ENDS.unpack_from(data, HEAD.size + len(_ARROW))
        head = bytearray(HEAD.pack(BATCH, 0, 0, sequence) + _ARROW + _ENDS.pack(*ends))
        _NUMBER.pack_into(head, HEAD.size + _BODY_AT, len(data) - HEAD.size - len(_ARROW))
        _NUMBER.pack_into(head, HEAD.size + _DATA_AT, ends[-1])
        whole = _ROWS_AT + ends[-1] + -ends[-1] % 8 == len(data)
        if data[: len(head)] != head or ends[0] != 0 or any(b < a for a, b in pairwise(ends)) or not whole:
            _refuse(sequence, "four rows that fill the message", f"rows that end at {ends[1:]} of {len(data):,} bytes")
        rows = [np.frombuffer(data, np.uint8, stop - start, _ROWS_AT + start) for start, stop in pairwise(ends)]
        width = CHUNK_ROW.itemsize
        if len(rows[1]) % width:
            _refuse(sequence, f"a multiple of {width} bytes", f"{len(rows[1])}")
        chunks, gaussians, terms, owners, gone, evicted = _decode_ids(sequence, rows[0], len(rows[1]) // width, about)
        table = rows[1].view(CHUNK_ROW)
        return cls(sequence, chunks, table, gaussians, rows[2], terms, owners, rows[3], gone, evicted)


def _decode_ids(sequence: int, data: U8, chunks: int, about: SceneHeader) -> list[I64]:
    """Return six arrays of ids: chunks, Gaussians, terms, owners, replaced Gaussians, evicted Gaussians.

    Args:
        sequence: Number of the batch, for errors.
        data: The row of ids.
        chunks: Number of chunks whose rows are in the batch.
        about: Header of the scene.
    """
    if len(data) < _IDS.size:
        _refuse(sequence, f"at least {_IDS.size} bytes of ids", f"{len(data)}")
    gaussians, terms, gone, evicted, *orders = _IDS.unpack(data[: _IDS.size].tobytes())
    n = about.gaussians
    t = about.terms
    lengths = [chunks, gaussians, terms, terms, gone, evicted]
    limits = [n, n, t, n, n, n]
    if max(orders) > kernels.MOST_ORDER or sum(lengths) > 8 * len(data):
        _refuse(sequence, f"{sum(lengths):,} ids", f"{len(data):,} bytes")
    found: list[I64] = []
    bit = 8 * _IDS.size
    for k in range(6):
        if k != 3 and lengths[k] > limits[k]:
            _refuse(sequence, f"at most {limits[k]:,} ids", f"{lengths[k]:,}")
        values = np.empty(lengths[k], np.int64)
        ids = np.empty(lengths[k], np.int64)
        bit = kernels.read(data, bit, orders[k], values)
        if bit < 0:
            _refuse(sequence, f"{lengths[k]:,} ids", f"{len(data):,} bytes, which end before them")
        if k == 3:
            good = kernels.owners_from(values, found[2], _owner_step(about), n, ids)
        else:
            good = kernels.ids_from(values, limits[k], ids)
        if not good:
            _refuse(sequence, f"ids below {limits[k]:,} that rise", "an id that falls or is too high")
        found.append(ids)
    if -(-bit // 8) != len(data):
        _refuse(sequence, f"{-(-bit // 8)} bytes of ids", f"{len(data)}")
    return found


def _owner_step(about: SceneHeader) -> int:
    """Return Gaussians per term, times 2^16: the codec predicts from it the difference of the owners of two terms."""
    return (about.gaussians << 16) // max(about.terms, 1)


def _refuse(sequence: int, expected: str, got: str) -> NoReturn:
    """Raise a ProtocolError about a batch."""
    raise ProtocolError(f"BATCH {sequence}: expected {expected}, got {got}")
