"""BATCH: what is sent at once, as one Arrow record batch whose rows are sections.

Records travel as they are; ids rise and travel as their distances. A batch can be read on its own by whoever has the
rows of the chunks that came before.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from gsvis.errors import ProtocolError
from gsvis.package.layout import RECORD_BYTES
from gsvis.stream.header import HEAD, SCHEMA, SceneHeader
from gsvis.stream.wire import BATCH

__all__ = ["CHUNK_ROW", "Sections"]

I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]

CHUNK_ROW = np.dtype(
    [
        ("origin", "<f4", 3), ("step", "<f4", 3), ("low", "<i2"), ("count", "<u2"), ("stride", "u1"),
        ("first_level", "u1"), ("last_level", "u1"),
    ]
)  # fmt: skip
"""Row of a chunk, 31 bytes."""

_MOST_BYTES = 1 << 28


@dataclass(frozen=True, eq=False)
class Sections:
    """What a BATCH says.

    Attributes:
        sequence: Its number, from 1.
        chunks: (C,) rising first ids of the chunks whose rows are here.
        rows: (C,) of `CHUNK_ROW`.
        gaussians: (G,) rising ids.
        records: (G, 16) uint8.
        terms: (M,) rising ids.
        owners: (M,) the Gaussian of each, never falling.
        term_records: (M, B) uint8.
        axes: (K, 2 A) uint8 of the owners whose first terms these are, rising.
        gone: (D,) rising ids of those that have been replaced since the last batch, whether they were sent or not.
    """

    sequence: int
    chunks: I64
    rows: NDArray[Any]
    gaussians: I64
    records: U8
    terms: I64
    owners: I64
    term_records: U8
    axes: U8
    gone: I64

    def to_message(self) -> bytes:
        """BATCH."""
        ids = (self.chunks, self.gaussians, self.terms, self.owners, self.gone)
        sections = [array.astype("<u4").tobytes() for array in ids]
        sections += [array.tobytes() for array in (self.rows, self.records, self.term_records, self.axes)]
        batch = pa.record_batch([pa.array(sections, pa.binary())], schema=SCHEMA)
        return HEAD.pack(BATCH, 0, 0, self.sequence) + bytes(batch.serialize())

    @classmethod
    def parse(cls, data: bytes, about: SceneHeader) -> Sections:
        """What a BATCH says.

        Args:
            data: The message.
            about: Of the scene.

        Raises:
            ProtocolError: If it is none, or does not fit the scene.
        """
        if len(data) < HEAD.size or len(data) > _MOST_BYTES or data[0] != BATCH:
            raise ProtocolError(f"message: expected BATCH, got {len(data):,} bytes of another kind")
        sequence = HEAD.unpack_from(data)[3]
        try:
            batch = pa.ipc.read_record_batch(pa.py_buffer(data[HEAD.size :]), SCHEMA)
            batch.validate(full=True)
            parts = batch.column(0).to_pylist()
        except (pa.ArrowException, OSError, ValueError) as error:
            raise ProtocolError(f"BATCH {sequence}: {str(error)[:200]}") from error
        if len(parts) != 9 or None in parts:
            raise ProtocolError(f"BATCH {sequence}: expected 9 sections, got {len(parts)}")
        widths = 4, 4, 4, 4, 4, CHUNK_ROW.itemsize, RECORD_BYTES, about.term_bytes, max(about.axis_bytes, 1)
        for part, width in zip(parts, widths, strict=True):
            if len(part) % width:
                raise ProtocolError(f"BATCH {sequence}: expected a multiple of {width} bytes, got {len(part)}")
        chunks, gaussians, terms, owners, gone = (np.frombuffer(p, "<u4").astype(np.int64) for p in parts[:5])
        rows = np.frombuffer(parts[5], CHUNK_ROW)
        records, term_records = (
            np.frombuffer(p, np.uint8).reshape(-1, w) for p, w in zip(parts[6:8], widths[6:8], strict=True)
        )
        axes = np.frombuffer(parts[8], np.uint8).reshape(-1, widths[8])[:, : about.axis_bytes]
        return cls(sequence, chunks, rows, gaussians, records, terms, owners, term_records, axes, gone)
