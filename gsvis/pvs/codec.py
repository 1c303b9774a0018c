"""Encode the set of a cell and its weight classes as bytes; docs/design/006 has the measurements.

A set is packed words (see `gsvis._kernels.bits`) in stored order. Gaussians that the same cells see are adjacent in
this order, so zstd finds long runs. Weight classes are coded in separate streams, one for each class that the parent
cell gives the same Gaussian. This module knows no file and no grid.
"""

from __future__ import annotations

import threading
from functools import cache
from typing import Any

import numpy as np
import zstandard
from numpy.typing import NDArray
from pyroaring import BitMap

from gsvis import _check
from gsvis._kernels.bits import count
from gsvis._kernels.blank import blank
from gsvis.pvs._kernels import store as kernels

__all__ = [
    "CodecError",
    "bitmap_of",
    "compress",
    "decode_classes",
    "decode_labels",
    "decode_set",
    "decompress",
    "encode_classes",
    "encode_labels",
    "encode_set",
    "ids_in",
    "ids_of",
    "pack",
    "pack_some",
    "portable",
    "used_words",
    "word_count",
]

Words = NDArray[np.uint64]
U8 = NDArray[np.uint8]

LEVEL = 12  # of zstd; level 19 saves 3% and takes ten times as long
_CHUNK = 1024  # words of a roaring container
_COOKIE = 12346  # roaring: no run containers
_ARRAY = 4096

_local = threading.local()  # a zstd context must stay in one thread


class CodecError(ValueError):
    """Bytes that do not decode; the message says what was expected and what was found."""


def word_count(n: int) -> int:
    """Return the number of words that hold N Gaussians: whole roaring containers."""
    return -(-n // (64 * _CHUNK)) * _CHUNK


def pack(ids: NDArray[Any], n: int) -> Words:
    """Return the set of the given ids as packed words.

    Raises:
        ValueError: If an id is not in [0, n): the kernel would write outside of the words.
    """
    given = np.ascontiguousarray(ids)
    _check.in_range("ids", given, 0, n - 1)
    words: Words = blank(word_count(n), np.uint64)
    kernels.mark(given, words)
    return words


def pack_some(ids: NDArray[Any]) -> tuple[NDArray[np.int32], Words]:
    """Return the non-empty packed words of the set of ascending ids: their numbers, and masks."""
    words = np.empty(len(ids), np.int32)
    masks = np.empty(len(ids), np.uint64)
    count = kernels.mark_some(ids, words, masks)
    return words[:count].copy(), masks[:count].copy()


def used_words(words: Words, first: int = 0) -> tuple[NDArray[np.int32], Words]:
    """Return the non-empty words of a set: their numbers, counted from `first`, and masks."""
    size = kernels.used(words, first, np.empty(0, np.int32), words[:0])
    numbers = np.empty(size, np.int32)
    masks = np.empty(size, np.uint64)
    kernels.used(words, first, numbers, masks)
    return numbers, masks


def ids_of(words: Words) -> NDArray[np.int64]:
    """Return the ids in a set, ascending."""
    ids = np.empty(count(words), np.int64)
    kernels.positions(words, ids)
    return ids


def ids_in(words: NDArray[np.integer], masks: Words) -> NDArray[np.int64]:
    """Return the ascending ids of some words (S,) of a set."""
    places = ids_of(masks)
    ids: NDArray[np.int64] = 64 * words[places >> 6].astype(np.int64) + (places & 63)
    return ids


def bitmap_of(words: Words) -> BitMap:
    """Return the set as a roaring bitmap."""
    return BitMap.deserialize(portable(words))


def portable(words: Words) -> bytes:
    """Return the set in the portable format of roaring bitmaps, without run containers.

    References:
        Roaring bitmap format specification, https://github.com/RoaringBitmap/RoaringFormatSpec.
    """
    containers = len(words) // _CHUNK
    keys = np.empty(containers, np.int64)
    cards = np.empty(containers, np.int64)
    content = np.empty(4 * len(words), np.uint16)
    found, end = kernels.roaring(words, keys, cards, content)
    keys = keys[:found]
    cards = cards[:found]
    sizes = np.where(cards > _ARRAY, 8 * _CHUNK, 2 * cards)
    offsets = 8 + 8 * found + np.cumsum(sizes) - sizes
    head = np.array([_COOKIE, found], "<u4").tobytes()
    described = np.stack([keys, cards - 1], axis=1).astype("<u2").tobytes()
    body: bytes = offsets.astype("<u4").tobytes() + content[:end].astype("<u2", copy=False).tobytes()
    return head + described + body


def compress(data: bytes, level: int = LEVEL) -> bytes:
    """Return one zstd frame that states its content length; the same input gives the same bytes."""
    compressors = _local.__dict__.setdefault("compressors", {})
    if level not in compressors:
        compressors[level] = zstandard.ZstdCompressor(level=level, write_content_size=True, write_checksum=False)
    packed: bytes = compressors[level].compress(data)
    return packed


def decompress(data: bytes, length: int) -> bytes:
    """Return the content of one zstd frame, which must have `length` bytes.

    Raises:
        CodecError: If the data is no zstd frame, or its content has another length.
    """
    content = bytearray(length)
    _decompress_into(data, content)
    return bytes(content)


def _decompress_into(data: bytes, content: Any) -> None:
    """Fill a buffer with the content of one zstd frame, which must have the buffer's length."""
    if not hasattr(_local, "decompressor"):
        _local.decompressor = zstandard.ZstdDecompressor()
    length = len(content)
    try:
        stated = zstandard.frame_content_size(data)
        if stated != length:
            raise CodecError(f"expected a frame of {length} bytes, got one of {stated}")
        with _local.decompressor.stream_reader(data) as reader:
            found = reader.readinto(content) if length else 0
    except zstandard.ZstdError as error:
        raise CodecError(f"expected a zstd frame, got bytes that are none ({error})") from error
    if found != length:
        raise CodecError(f"expected a zstd frame of {length} bytes, got {found}")


def encode_set(words: Words) -> bytes:
    """Return the bytes of a set in stored order."""
    return compress(words.astype("<u8", copy=False).tobytes())


def decode_set(data: bytes, n: int, visible: int | None = None) -> Words:
    """Return the set that `encode_set` encoded.

    Args:
        data: Bytes from `encode_set`.
        n: N Gaussians.
        visible: Number of Gaussians that the set must hold; None skips this check.

    Raises:
        CodecError: If the bytes are not a set of N Gaussians with `visible` members.
    """
    length = word_count(n)
    stored = np.empty(length, "<u8")
    _decompress_into(data, stored.view(np.uint8))
    words = stored.astype(np.uint64, copy=False)
    found = count(words)
    if visible is not None and found != visible:
        raise CodecError(f"expected {visible} visible Gaussians, got {found}")
    last = n // 64
    spare = n % 64
    if last < length and (int(words[last]) >> spare or words[last + 1 :].any()):
        raise CodecError(f"expected ids below {n}, got higher ones")
    return words


def encode_classes(words: Words, levels: U8, parent: U8 | None, classes: int) -> bytes:
    """Return the bytes of the weight classes of a set.

    Args:
        words: The set, stored order.
        levels: (N,) class plus 1 of each Gaussian in the set, stored order; 0 elsewhere.
        parent: (N,) class plus 1 of each Gaussian in the parent cell's set, stored order; 0 elsewhere. None without
            a parent.
        classes: K, number of classes.
    """
    ids = ids_of(words)
    symbols = levels[ids].astype(np.int64) - 1
    contexts = np.zeros(len(ids), np.uint8) if parent is None else parent[ids]
    streams = []
    for context in range(1 if parent is None else classes + 1):
        own = symbols[contexts == context]
        streams.append(compress(_join_digits(own, classes)) if len(own) else b"")
    return np.array([len(s) for s in streams], "<u4").tobytes() + b"".join(streams)


def decode_classes(data: bytes, words: Words, n: int, parent: U8 | None, classes: int) -> U8:
    """Return the (N,) `levels` that `encode_classes` encoded.

    Raises:
        CodecError: If the bytes are not the classes of this set and parent.
    """
    streams = 1 if parent is None else classes + 1
    if len(data) < 4 * streams:
        raise CodecError(f"expected {streams} streams of classes, got {len(data)} bytes")
    ends = 4 * streams + np.cumsum(np.frombuffer(data[: 4 * streams], "<u4").astype(np.int64))
    if ends[-1] != len(data):
        raise CodecError(f"expected streams of {len(data)} bytes, got {ends[-1]}")
    before = np.zeros(n, np.uint8) if parent is None else parent
    counts = np.zeros(256, np.int64)
    kernels.count_contexts(words, before, counts)
    width = digits_a_byte(classes)
    sizes = -(-counts // width)
    places = np.cumsum(sizes) - sizes
    digits = np.empty(int(sizes.sum()), np.uint8)
    for context, (start, end) in enumerate(zip([4 * streams, *ends[:-1].tolist()], ends.tolist(), strict=True)):
        if sizes[context]:
            _decompress_into(data[start:end], digits[places[context] :][: sizes[context]])
    levels = np.zeros(n, np.uint8)
    kernels.place_classes(words, before, digits, places, _digits_of_bytes(classes), levels)
    return levels


def encode_labels(labels: NDArray[np.uint16], level: int = LEVEL) -> bytes:
    """Return the bytes of labels: the shorter of two layouts.

    Layout 1 keeps each label's low and high byte together; it suits runs of equal labels. Layout 2 has all low bytes,
    then all high bytes; it suits labels without order.
    """
    data = labels.astype("<u2").tobytes()
    return min((b"\1" + compress(data, level), b"\2" + compress(data[::2] + data[1::2], level)), key=len)


def decode_labels(data: bytes, n: int) -> NDArray[np.uint16]:
    """Return the N labels that `encode_labels` encoded.

    Raises:
        CodecError: If the bytes are not N labels.
    """
    if data[:1] not in (b"\1", b"\2"):
        raise CodecError(f"expected labels in planes of 1 or 2, got {data[:1]!r}")
    content = np.empty(2 * n, np.uint8)
    _decompress_into(data[1:], content)
    if data[:1] == b"\1":
        return content.view("<u2").astype(np.uint16, copy=False)
    labels = content[n:].astype(np.uint16)
    labels <<= np.uint16(8)
    labels |= content[:n]
    return labels


def digits_a_byte(classes: int) -> int:
    """Return how many class numbers fit in one byte: 8, 5, 4, 3, 3 for 2 to 6 classes."""
    count = 1
    while classes ** (count + 1) <= 256 and count < 8:
        count += 1
    return count


def _join_digits(symbols: NDArray[np.int64], classes: int) -> bytes:
    """Return the bytes of numbers below `classes`, several in each byte, the first one lowest."""
    width = digits_a_byte(classes)
    padded = np.zeros((-(-len(symbols) // width), width), np.int64)
    padded.reshape(-1)[: len(symbols)] = symbols
    return (padded @ (classes ** np.arange(width))).astype(np.uint8).tobytes()


@cache
def _digits_of_bytes(classes: int) -> U8:
    """Return (256, D) the numbers below `classes` that `_join_digits` put in each byte."""
    powers = classes ** np.arange(digits_a_byte(classes))
    return (np.arange(256)[:, None] // powers % classes).astype(np.uint8)
