"""Blocks of a static scene as they lie in its files: the row of the chunk, and the records, coded as on the wire.

Each block is coded by itself, with the tables of the scene. So a reader decodes any of them without the others.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from gsvis.export.blocks import Blocks
from gsvis.package.codec import ChunkTable, packed_bits
from gsvis.package.contents import Contents
from gsvis.stream.coding import Coding, chunks_of

__all__ = ["HEAD", "UNIT", "Coded", "code_records", "code_terms", "in_order", "pack_records"]

U8 = NDArray[np.uint8]
I64 = NDArray[np.int64]

HEAD = np.dtype(
    [
        ("origin", "<f4", 3), ("step", "<f4", 3), ("low", "<i2"), ("bits", "<u2"), ("words", "<u2"), ("stride", "u1"),
        ("zero", "u1"),
    ]
)  # fmt: skip
"""Type of the head of a block, 32 bytes: the row of its chunk, and how many words of u16 its records take."""

UNIT = 16
"""Blocks take a multiple of this many bytes, so that their sizes compress."""


@dataclass(frozen=True, eq=False)
class Coded:
    """Blocks behind each other.

    Attributes:
        data: The content of the file.
        sizes: (B,) how much each block takes: units of records, words of coded terms.
    """

    data: bytes
    sizes: I64


def in_order(contents: Contents, ids: I64) -> Contents:
    """Return a package whose Gaussian i is that with the id `ids[i]`. Chunks keep their members.

    Args:
        contents: A package of N Gaussians.
        ids: (N,) ids.
    """
    counts = contents.term_counts[ids]
    before = np.cumsum(counts, dtype=np.int64) - counts
    rows = np.repeat(contents.term_offsets[ids] - before, counts) + np.arange(len(contents.term_records))
    return Contents(
        contents.names, contents.table, contents.chunk_levels, contents.records[ids], counts,
        contents.term_records[rows], contents.grids, contents.starts,
    )  # fmt: skip


def code_records(contents: Contents, blocks: Blocks, coding: Coding) -> Coded:
    """Return the records of all blocks, coded.

    Args:
        contents: The package, with the ids of the static form.
        blocks: Its blocks.
        coding: The code of its records.
    """
    parts, chunks = coding.split_records(contents), chunks_of(contents.table)
    bodies = []
    for chunk, first, count in zip(blocks.chunks.tolist(), blocks.firsts.tolist(), blocks.counts.tolist(), strict=True):
        ids = np.arange(first, first + count, dtype=np.int32)
        bodies.append(coding.encode_some(parts, ids, np.full(count, chunk, np.int32), chunks).tobytes())
    return _join(contents.table, blocks, bodies)


def pack_records(table: ChunkTable, blocks: Blocks, records: U8) -> Coded:
    """Return the records (N, 16), by place, of all blocks, as they are."""
    starts = blocks.starts.tolist()
    bodies = [records[low:high].tobytes() for low, high in pairwise(starts)]
    return _join(table, blocks, bodies)


def _join(table: ChunkTable, blocks: Blocks, bodies: list[bytes]) -> Coded:
    heads = np.zeros(len(blocks), HEAD)
    for name, values in (
        ("origin", table.origins), ("step", table.steps), ("low", table.lows), ("stride", table.strides),
        ("bits", packed_bits(table.bits)),
    ):  # fmt: skip
        heads[name] = values[blocks.chunks]
    heads["words"] = [len(body) // 2 for body in bodies]
    rows = heads.tobytes()
    pieces: list[bytes] = []
    units: list[int] = []
    for k, body in enumerate(bodies):
        whole = HEAD.itemsize + len(body)
        pieces += (rows[k * HEAD.itemsize : (k + 1) * HEAD.itemsize], body, bytes(-whole % UNIT))
        units.append(-(-whole // UNIT))
    return Coded(b"".join(pieces), np.array(units, np.int64))


def code_terms(contents: Contents, blocks: Blocks, coding: Coding) -> Coded:
    """Return the terms of all blocks: a byte for each Gaussian, the number of its terms, and their records, coded.

    Args:
        contents: The package, with the ids of the static form.
        blocks: Its blocks.
        coding: The code of its records.
    """
    offsets, words = contents.term_offsets, list[int]()
    pieces: list[bytes] = []
    for first, count in zip(blocks.firsts.tolist(), blocks.counts.tolist(), strict=True):
        counts = contents.term_counts[first : first + count]
        rows = contents.term_records[offsets[first] : offsets[first + count]]
        coded = coding.encode_terms(rows.copy(), np.repeat(np.arange(count, dtype=np.int32), counts)).tobytes()
        pieces += (counts.tobytes(), coded)
        words.append(len(coded) // 2)
    return Coded(b"".join(pieces), np.array(words, np.int64))
