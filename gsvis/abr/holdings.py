"""What a client holds: the Gaussians and terms that it received, and the Gaussians that were replaced.

Held records are never sent again. The sets are packed 64-bit words for the kernels, and portable roaring bitmaps for a
client that reconnects.
"""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyroaring import BitMap

from gsvis import _check
from gsvis._kernels.bits import count
from gsvis._kernels.blank import blank
from gsvis.abr._kernels.plan import Held
from gsvis.pvs.codec import bitmap_of, ids_in, ids_of, pack, pack_some, word_count

__all__ = ["Holdings"]

Words = NDArray[np.uint64]
I64 = NDArray[np.int64]

_HEAD = struct.Struct("<4sIIIII")
_MAGIC = b"GVH1"
_CONTAINER = 1 << 16  # ids of a container of a roaring bitmap
_CONTAINER_BYTES = 8192  # most bytes of one: a bit for each id, or 2 bytes for each of at most 4,096


class Holdings:
    """The records that one client has received.

    Args:
        gaussians: N, number of Gaussians of the scene.
        terms: T, number of terms of the scene.

    Attributes:
        gaussians: N, number of Gaussians of the scene.
        terms: T, number of terms of the scene.
        sent: Packed set of the Gaussians received.
        sent_terms: Packed set of the terms received.
        gone: Packed set of the replaced Gaussians, which are neither shown nor sent.
    """

    def __init__(self, gaussians: int, terms: int = 0) -> None:
        self.gaussians = _check.positive_int("gaussians", gaussians, at_least=0)
        self.terms = _check.positive_int("terms", terms, at_least=0)
        self.sent: Words = blank(word_count(gaussians), np.uint64)  # tiles that no viewer comes near take no memory
        self.gone: Words = blank(word_count(gaussians), np.uint64)
        self.sent_terms: Words = blank(word_count(terms), np.uint64)

    def __repr__(self) -> str:
        held = (
            f"{count(self.sent):,} of {self.gaussians:,} Gaussians, {count(self.sent_terms):,} of {self.terms:,} terms"
        )
        return f"Holdings({held})"

    @property
    def words(self) -> Held:
        """The three packed sets, for the kernels, which change them."""
        return Held(self.sent, self.sent_terms, self.gone)

    @property
    def shown(self) -> I64:
        """Ascending ids of the Gaussians that the client shows: received and not replaced."""
        some = np.flatnonzero(self.sent)
        return ids_in(some, self.sent[some] & ~self.gone[some])

    @property
    def received(self) -> I64:
        """Ascending ids of all Gaussians received, replaced or not."""
        some = np.flatnonzero(self.sent)
        return ids_in(some, self.sent[some])

    @property
    def replaced(self) -> I64:
        """Ascending ids of all Gaussians replaced, received or not."""
        some = np.flatnonzero(self.gone)
        return ids_in(some, self.gone[some])

    @property
    def received_terms(self) -> I64:
        """Ascending ids of the terms received."""
        return ids_of(self.sent_terms)

    def copy(self) -> Holdings:
        """Return an independent copy."""
        other = Holdings(self.gaussians, self.terms)
        for mine, theirs in zip(self.words, other.words, strict=True):
            some = np.flatnonzero(mine)
            theirs[some] = mine[some]
        return other

    def add(self, gaussians: NDArray[Any], terms: NDArray[Any], dropped: NDArray[Any]) -> None:
        """Add the ids of a batch, on the client's side.

        Args:
            gaussians: (G,) ids of the Gaussians received.
            terms: (M,) ids of the terms received.
            dropped: (D,) ids of replaced Gaussians.

        Raises:
            ValueError: If an id is out of range, or a Gaussian or term is held already.
        """
        for name, ids, words, size in (
            ("gaussians", gaussians, self.sent, self.gaussians),
            ("terms", terms, self.sent_terms, self.terms),
            ("dropped", dropped, self.gone, self.gaussians),
        ):
            values = _check.integers(name, ids, ("M",))
            _check.in_range(name, values, 0, size - 1)
            some, fresh = pack_some(np.sort(values))
            if name != "dropped":
                if count(fresh) != len(values):
                    raise ValueError(f"{name}: expected each id once, got {len(values)} ids, {count(fresh)} different")
                if np.any(fresh & words[some]):
                    first = _first_id(some, fresh & words[some])
                    raise ValueError(f"{name}: expected new ids, got {first:,}, which is held already")
            words[some] |= fresh

    def evict(self, gaussians: NDArray[Any], terms: NDArray[Any]) -> None:
        """Remove evicted Gaussians and terms, on the client's side. The Gaussians no longer count as replaced either.

        Args:
            gaussians: (E,) ids of Gaussians, each held or replaced.
            terms: (M,) ids of the terms of these Gaussians that are held.

        Raises:
            ValueError: If an id is out of range, or neither held nor replaced. Nothing changes then.
        """
        found = []
        for name, ids, sets, size in (
            ("gaussians", gaussians, (self.sent, self.gone), self.gaussians),
            ("terms", terms, (self.sent_terms,), self.terms),
        ):
            values = _check.integers(name, ids, ("M",))
            _check.in_range(name, values, 0, size - 1)
            some, masks = pack_some(np.sort(values))
            lost = masks & ~np.bitwise_or.reduce([words[some] for words in sets])
            if np.any(lost):
                raise ValueError(f"{name}: expected ids that are held, got {_first_id(some, lost):,}, which is not")
            found += [(words, some, masks) for words in sets]
        for words, some, masks in found:
            words[some] &= ~masks

    def to_bytes(self) -> bytes:
        """Return a header (magic GVH1, N, T, the bytes of three bitmaps: little-endian uint32) and the bitmaps.

        The bitmaps are roaring, portable format: Gaussians received, terms received, Gaussians replaced.
        """
        parts = []
        for words in self.words:
            bitmap = bitmap_of(words)
            bitmap.run_optimize()
            parts.append(bytes(bitmap.serialize()))
        return _HEAD.pack(_MAGIC, self.gaussians, self.terms, *(len(part) for part in parts)) + b"".join(parts)

    @staticmethod
    def most_bytes(gaussians: int, terms: int) -> int:
        """Return an upper bound on the length of `to_bytes`, for N Gaussians and T terms."""
        return _HEAD.size + 2 * _most_bitmap_bytes(gaussians) + _most_bitmap_bytes(terms)

    @classmethod
    def from_bytes(cls, data: bytes, gaussians: int, terms: int) -> Holdings:
        """Return the holdings that a client sent.

        Args:
            data: Bytes from `to_bytes`.
            gaussians: N, number of Gaussians of the scene.
            terms: T, number of terms of the scene.

        Raises:
            ValueError: If the bytes are malformed, or their numbers of Gaussians or terms are not those of the scene.
        """
        out = cls(gaussians, terms)
        if len(data) < _HEAD.size or data[:4] != _MAGIC:
            raise ValueError(f"data: expected holdings that begin with {_MAGIC!r}, got {data[:4]!r}")
        _, n, t, *lengths = _HEAD.unpack_from(data)
        if (n, t) != (gaussians, terms):
            raise ValueError(
                f"data: expected holdings of {gaussians} Gaussians and {terms} terms, got of {n} and {t};"
                " begin with nothing"
            )
        if _HEAD.size + sum(lengths) != len(data):
            raise ValueError(f"data: expected {_HEAD.size + sum(lengths)} bytes, got {len(data)}")
        start = _HEAD.size
        found = []
        for length, size in zip(lengths, (n, t, n), strict=True):
            found.append(_parse_bitmap(data[start : start + length], size))
            start += length
        out.sent, out.sent_terms, out.gone = found
        return out


def _first_id(words: NDArray[Any], masks: Words) -> int:
    """Return the least id of a packed set: numbers of its words (S,), ascending, and their masks (S,), not all 0."""
    k = int(np.flatnonzero(masks)[0])
    mask = int(masks[k])
    return 64 * int(words[k]) + (mask & -mask).bit_length() - 1


def _most_bitmap_bytes(size: int) -> int:
    """Return an upper bound on the bytes of a roaring bitmap of ids below `size`.

    A bitmap has a head of 8 bytes, and for each container a head of 9 bytes and its body.
    """
    whole, rest = divmod(size, _CONTAINER)
    return 8 + 9 * -(-size // _CONTAINER) + whole * _CONTAINER_BYTES + min(2 * rest, _CONTAINER_BYTES)


def _parse_bitmap(data: bytes, size: int) -> Words:
    """Return the packed set of a roaring bitmap of ids below `size`; raise ValueError if it is malformed."""
    try:
        bitmap = BitMap.deserialize(data)
        if bitmap.serialize() != data:  # with extra bytes, or not in normal form
            raise ValueError("not as the reference libraries write it")
    except (ValueError, IndexError) as error:  # IndexError if there are no bytes
        raise ValueError(
            f"data: expected a roaring bitmap, got {len(data):,} bytes that are none ({str(error)[:60]})"
        ) from error
    if len(bitmap) and (bitmap.max() >= size or len(bitmap) > size):
        raise ValueError(f"data: expected ids below {size}, got {bitmap.max()}")
    return pack(np.array(bitmap.to_array(), np.int64), size)
