"""Code the blocks of a static scene for its files: the row of the chunk, and the records, coded as on the wire.

Each block is coded separately, with the tables of the scene, so a reader can decode any block without the others.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from gsvis.export.blocks import Blocks
from gsvis.export.layers import LAYERS
from gsvis.package.codec import ChunkTable, packed_bits
from gsvis.package.contents import Contents
from gsvis.stream.coding import Coding, chunks_of

__all__ = ["HEAD", "UNIT", "Coded", "code_records", "code_terms", "in_order", "pack_records"]

U8 = NDArray[np.uint8]
I64 = NDArray[np.int64]

HEAD = np.dtype(
    [
        ("origin", "<f4", 3),
        ("step", "<f4", 3),
        ("low", "<i2"),
        ("bits", "<u2"),
        ("words", "<u2"),
        ("stride", "u1"),
        ("zero", "u1"),
    ]
)
"""Type of the head of a block, 32 bytes: the row of its chunk, and the size of its records in words of u16."""

UNIT = 16
"""Blocks take a multiple of this many bytes, so that their sizes compress."""


@dataclass(frozen=True, eq=False)
class Coded:
    """Coded blocks, one after the other.

    Attributes:
        data: The content of the file.
        sizes: (B,) size of each block: in units for records, in words for coded terms.
    """

    data: bytes
    sizes: I64


def in_order(contents: Contents, ids: I64) -> Contents:
    """Return a package whose Gaussian i is the one with the id `ids[i]`. Chunks keep their members.

    Args:
        contents: A package of N Gaussians.
        ids: (N,) ids.
    """
    counts = contents.term_counts[ids]
    before = np.cumsum(counts, dtype=np.int64) - counts
    rows = np.repeat(contents.term_offsets[ids] - before, counts) + np.arange(len(contents.term_records))
    return Contents(
        contents.names,
        contents.table,
        contents.chunk_levels,
        contents.records[ids],
        counts,
        contents.term_records[rows],
        contents.grids,
        contents.starts,
        contents.facts,
    )


def code_records(contents: Contents, blocks: Blocks, coding: Coding, replaced: list[bytes]) -> Coded:
    """Return the records of all blocks, coded.

    Args:
        contents: The package, with the ids of the static form.
        blocks: Its B blocks.
        coding: The code of its records.
        replaced: (B,) rows to append to the records of each block, from `replaced_rows`.
    """
    parts = coding.split_records(contents)
    chunks = chunks_of(contents.table)
    bodies = []
    for chunk, first, count in zip(blocks.chunks.tolist(), blocks.firsts.tolist(), blocks.counts.tolist(), strict=True):
        ids = np.arange(first, first + count, dtype=np.int32)
        bodies.append(coding.encode_some(parts, ids, np.full(count, chunk, np.int32), chunks).tobytes())
    return _join(contents.table, blocks, bodies, replaced)


def pack_records(table: ChunkTable, blocks: Blocks, records: U8, replaced: list[bytes]) -> Coded:
    """Return the records (N, 16), by place, of all blocks, as they are; `replaced` is as in `code_records`."""
    starts = blocks.starts.tolist()
    bodies = [records[low:high].tobytes() for low, high in pairwise(starts)]
    return _join(table, blocks, bodies, replaced)


def _join(table: ChunkTable, blocks: Blocks, bodies: list[bytes], replaced: list[bytes]) -> Coded:
    """Return the blocks of bodies, with heads and replaced rows."""
    heads = np.zeros(len(blocks), HEAD)
    for name, values in (
        ("origin", table.origins),
        ("step", table.steps),
        ("low", table.lows),
        ("stride", table.strides),
        ("bits", packed_bits(table.bits)),
    ):
        heads[name] = values[blocks.chunks]
    heads["words"] = [len(body) // 2 for body in bodies]
    rows = heads.tobytes()
    pieces: list[bytes] = []
    units: list[int] = []
    for k, (body, behind) in enumerate(zip(bodies, replaced, strict=True)):
        whole = HEAD.itemsize + len(body) + len(behind)
        pieces += (rows[k * HEAD.itemsize : (k + 1) * HEAD.itemsize], body, behind, bytes(-whole % UNIT))
        units.append(-(-whole // UNIT))
    return Coded(b"".join(pieces), np.array(units, np.int64))


def code_terms(contents: Contents, blocks: Blocks, coding: Coding, items: I64) -> Coded:
    """Return the terms of all items, coded; sizes are in words of u16.

    An item is a layer of the terms of a block. It begins with a bit 1 for each term and a bit 0 after the terms of each
    Gaussian. An item without terms has no bytes.

    Args:
        contents: A package of T terms.
        blocks: Its blocks.
        coding: The code of its records.
        items: (T,) item of each term, from `items_of`.
    """
    places = np.empty(len(contents), np.int64)
    places[blocks.order] = np.arange(len(contents)) - np.repeat(blocks.starts[:-1], blocks.counts)
    owners = np.repeat(places, contents.term_counts)
    order = np.lexsort((owners, items))
    counts = np.bincount(items, minlength=LAYERS * len(blocks))
    ends = np.cumsum(counts)
    words = np.zeros(len(counts), np.int64)
    pieces: list[bytes] = []
    for item in np.flatnonzero(counts).tolist():
        some = order[ends[item] - counts[item] : ends[item]]
        of = owners[some]
        bits = np.zeros(-(-(len(some) + int(blocks.counts[item % len(blocks)])) // 16) * 16, np.uint8)
        bits[np.arange(len(some)) + of] = 1
        coded = coding.encode_terms(contents.term_records[some], of.astype(np.int32)).tobytes()
        pieces += (np.packbits(bits, bitorder="little").tobytes(), coded)
        words[item] = (len(bits) // 8 + len(coded)) // 2
    return Coded(b"".join(pieces), words)
