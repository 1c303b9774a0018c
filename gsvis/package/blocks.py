"""Write and read the blocks of a package: the records of Gaussians and of their terms, in parts.

Since version 3 of the format, parts are coded. In version 2, each byte of the records is an Arrow column.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gsvis.errors import FormatError
from gsvis.files.limits import DAMAGED, Budget
from gsvis.package.codec import ChunkTable
from gsvis.package.coded import (
    TermsLack,
    decode_gaussians,
    decode_terms,
    encode_gaussians,
    encode_terms,
    memory_of,
)
from gsvis.package.contents import Contents
from gsvis.package.layout import RECORD_BYTES, RecordLayout, TermLayout
from gsvis.package.manifest import Block, Manifest
from gsvis.package.parts import MOST_BYTES, PartFolder
from gsvis.progress import Progress

__all__ = ["Rows", "bytes_of_blocks", "read_blocks", "write_blocks"]

U8 = NDArray[np.uint8]
Rows = tuple[U8, U8, U8]
"""The records (M, 16), the terms (T, B) and the numbers of terms (M,) of a block."""


def write_blocks(parts: PartFolder, contents: Contents, progress: Progress) -> Iterator[Block]:
    """Write the blocks of a scene, and yield each one.

    Args:
        parts: Folder of the parts.
        contents: Records of the scene.
        progress: Called with stage "package", in blocks.
    """
    total = len(contents.starts) - 1
    progress("package", 0, total)
    for k, block in enumerate(_encode_blocks(contents)):
        gaussians = parts.write_bytes(block.gaussians)
        terms = tuple((parts.write_bytes(data), count) for data, count in block.terms)
        yield Block(gaussians, terms, block.size, sum(count for _, count in terms))
        progress("package", k + 1, total)


def bytes_of_blocks(contents: Contents) -> int:
    """Return the bytes of the parts of a scene with records of Gaussians and of terms."""
    return sum(len(b.gaussians) + sum(len(data) for data, _ in b.terms) for b in _encode_blocks(contents))


class _Coded(NamedTuple):
    """A coded block: the part of its `size` Gaussians, and parts of terms with the number of terms in each."""

    gaussians: bytes
    terms: tuple[tuple[bytes, int], ...]
    size: int


def _encode_blocks(contents: Contents) -> Iterator[_Coded]:
    """Yield the coded blocks of a scene."""
    width = max(1, contents.term_records.shape[1])
    of_terms = TermLayout.from_grids(contents.grids)
    rows = MOST_BYTES // width
    chunks = contents.table.starts
    for begin, stop in pairwise(contents.starts.tolist()):
        records = contents.records[begin:stop]
        counts = contents.term_counts[begin:stop]
        table = contents.table[slice(*np.searchsorted(chunks, [begin, stop]).tolist())]
        gaussians = encode_gaussians(records, counts, table, contents.layout, contents.limits)
        low, high = contents.term_offsets[[begin, stop]].tolist()
        firsts = _firsts(counts)
        lacking = TermsLack.from_records(records, counts, table, contents.grids, contents.limits)
        terms = []
        for start in range(low, high, rows):
            end = min(start + rows, high)
            known = None if lacking is None else lacking.of(start - low, end - low)
            data = encode_terms(contents.term_records[start:end], firsts[start - low : end - low], of_terms, known)
            terms.append((data, end - start))
        yield _Coded(gaussians, tuple(terms), stop - begin)


def read_blocks(
    parts: PartFolder, manifest: Manifest, table: ChunkTable, starts: NDArray[np.int64], budget: Budget
) -> list[Rows]:
    """Return the records of all blocks, in order.

    Args:
        parts: The folder.
        manifest: The manifest.
        table: Rows of all chunks.
        starts: (B + 1,) first Gaussian of each block, and N.
        budget: Memory budget to claim from.

    Raises:
        FormatError: If a part is missing, damaged, or does not fit the table or the manifest.
    """
    layout = TermLayout.from_grids(manifest.grids)
    coded = manifest.version > 2
    for block in manifest.blocks if coded else ():
        budget.claim(memory_of(block.count, block.num_terms, layout.nbytes), "manifest")
    if int(table.starts[-1]) != manifest.gaussians:
        got = f"{int(table.starts[-1]):,}"
        raise FormatError(parts.folder, "chunks", f"{manifest.gaussians:,} Gaussians", got, DAMAGED)
    if not coded:
        return [_read_columns(parts, block, (RECORD_BYTES, layout.nbytes), budget) for block in manifest.blocks]
    heads = np.searchsorted(table.starts, starts)
    if not np.array_equal(table.starts[heads], starts):
        start = int(starts[int(np.argmax(table.starts[heads] != starts))])
        got = f"a block that begins inside a chunk, at Gaussian {start:,}"
        raise FormatError(parts.folder, "chunks", "chunks that end where blocks end", got, DAMAGED)

    def read(k: int) -> Rows:
        """Return the records of block k."""
        chunks = table[slice(int(heads[k]), int(heads[k + 1]))]
        return _read_coded(parts, manifest.blocks[k], chunks, manifest)

    with ThreadPoolExecutor(max(1, min(8, os.cpu_count() or 1))) as pool:  # kernels run without the GIL
        return list(pool.map(read, range(len(manifest.blocks))))


def _read_coded(parts: PartFolder, block: Block, chunks: ChunkTable, manifest: Manifest) -> Rows:
    """Return the records of a coded block; `chunks` are the rows of its chunks."""
    of_records = RecordLayout.from_variant(manifest.grids.variant)
    of_terms = TermLayout.from_grids(manifest.grids)
    part = block.gaussians
    try:
        records, counts = decode_gaussians(parts.content_of(part), block.count, chunks, of_records, manifest.limits)
        _check_terms(parts, block, counts)
        firsts = _firsts(counts)
        lacking = TermsLack.from_records(records, counts, chunks, manifest.grids, manifest.limits)
        terms = [np.zeros((0, of_terms.nbytes), np.uint8)]
        low = 0
        for part, count in block.terms:
            known = None if lacking is None else lacking.of(low, low + count)
            terms.append(decode_terms(parts.content_of(part), firsts[low : low + count], of_terms, known))
            low += count
    except FormatError:
        raise
    except ValueError as error:
        raise FormatError(parts.folder / part.name, "", "a coded part", str(error), DAMAGED) from error
    return records, np.concatenate(terms), counts


def _read_columns(parts: PartFolder, block: Block, widths: tuple[int, int], budget: Budget) -> Rows:
    """Return the records of a block of version 2; `widths` are the bytes of a Gaussian's and of a term's record."""
    wide, narrow = widths
    types: dict[str, type[np.generic]] = {**{f"r{k}": np.uint8 for k in range(wide)}, "terms": np.uint8}
    columns = parts.read_columns(block.gaussians, "gaussians", types, block.count, budget)
    counts: U8 = columns["terms"]
    _check_terms(parts, block, counts)
    terms = [np.zeros((0, narrow), np.uint8)]
    for part, count in block.terms:
        read = parts.read_columns(part, "terms", {f"t{b}": np.uint8 for b in range(narrow)}, count, budget)
        terms.append(_join_columns(read, "t", narrow))
    return _join_columns(columns, "r", wide), np.concatenate(terms), counts


def _check_terms(parts: PartFolder, block: Block, counts: U8) -> None:
    """Raise FormatError unless a block has as many terms as its Gaussians (`counts`) and its parts have."""
    found = int(counts.sum(dtype=np.int64))
    listed = sum(count for _, count in block.terms)
    if found != block.num_terms or listed != block.num_terms:
        path = parts.folder / block.gaussians.name
        got = f"{found:,}, and {listed:,} in parts"
        raise FormatError(path, "terms", f"{block.num_terms:,} terms", got, DAMAGED)


def _firsts(counts: U8) -> NDArray[np.bool_]:
    """Return whether each term (T,) is the first of its Gaussian, from the number of terms (M,) of each Gaussian."""
    ends = np.cumsum(counts, dtype=np.int64)
    firsts = np.zeros(int(ends[-1]) if len(ends) else 0, np.bool_)
    firsts[(ends - counts)[counts > 0]] = True
    return firsts


def _join_columns(columns: dict[str, Any], letter: str, width: int) -> U8:
    """Return records (M, width) from the columns that are named by a letter and the number of the byte."""
    if width == 0:
        return np.zeros((len(next(iter(columns.values()))), 0), np.uint8)
    return np.stack([columns[f"{letter}{k}"] for k in range(width)], axis=1)
