"""The client's side of a stream: decode messages to Gaussians and colors. No socket, no clock.

A batch is checked in full before any of it is stored, then decoded once. A scene is a view of the decoded arrays. Scene
frame and units.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gsvis.abr.classes import FieldOfView
from gsvis.abr.holdings import Holdings
from gsvis.color.srbf import SrbfColors
from gsvis.errors import ProtocolError
from gsvis.package.codec import ChunkTable, unpack_bits
from gsvis.package.rounding import chunks_of
from gsvis.scene.gaussians import Gaussians
from gsvis.stream.batch import Sections
from gsvis.stream.drawn import Drawn
from gsvis.stream.header import SceneHeader
from gsvis.stream.wire import FAULTS, Hello

__all__ = ["Received", "Receiver"]

I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]

MOST_BYTES = 1 << 29
"""Default memory limit for sets and tables of a scene, in bytes: about 90 million Gaussians with four terms each."""


@dataclass(frozen=True, eq=False)
class Received:
    """What a batch added and removed.

    Attributes:
        sequence: Number of the batch, to acknowledge.
        gaussians: (G,) ids of new Gaussians, ascending.
        terms: (M,) ids of new terms, ascending.
        dropped: (D,) ids, ascending, of Gaussians that were held and are no longer drawn: replaced, or evicted.
        nbytes: Bytes of the message.
    """

    sequence: int
    gaussians: I64
    terms: I64
    dropped: I64
    nbytes: int


class Receiver:
    """The state of one client.

    Args:
        welcome: The first message from the server.
        most_bytes: Most bytes of memory for sets and tables before the first Gaussian arrives. Without a limit, a
            WELCOME of one kilobyte could claim billions of Gaussians.
        memory: Bytes of records that the server may expect this client to hold; 0 means no limit.

    Attributes:
        about: The content of WELCOME.
        holdings: The records that the client has received, and the Gaussians that have been replaced.

    Raises:
        ProtocolError: If the first message is not a WELCOME, or its scene needs more than `most_bytes`.
    """

    def __init__(self, welcome: bytes, *, most_bytes: int = MOST_BYTES, memory: int = 0) -> None:
        self.memory = memory
        self.about = SceneHeader.parse(welcome)
        needed = 5 * self.about.gaussians + self.about.terms // 4  # a table of int32, and packed sets twice
        if needed > most_bytes:
            expected = f"a scene for {most_bytes:,} bytes of memory"
            got = f"one for {needed:,}"
            raise ProtocolError(f"WELCOME: expected {expected}, got {got}", FAULTS["too-large"], "raise most_bytes")
        self.holdings = Holdings(self.about.gaussians, self.about.terms)
        self._drawn = Drawn(self.about)
        self._table = ChunkTable.concatenate([])
        self._starts = np.zeros(0, np.int64)
        self._rows = np.zeros(0, np.int32)
        self._sequence = 0

    def __repr__(self) -> str:
        return f"Receiver({self.holdings!r}, {len(self._drawn):,} shown)"

    def hello(self, view: FieldOfView) -> Hello:
        """Return the HELLO for a new connection: the field of view, and the holdings of this client."""
        if not len(self._starts):
            return Hello(view, memory=self.memory)
        return Hello(view, bytes.fromhex(self.about.identity), self.holdings.to_bytes(), memory=self.memory)

    def resume(self, welcome: bytes) -> bool:
        """Accept the WELCOME of a new connection, which numbers its batches from 1 again.

        Returns:
            True if the scene is the same; everything is kept. False if the scene is different; nothing changes, and the
            client needs a new receiver.

        Raises:
            ProtocolError: If the message is not a WELCOME.
        """
        if SceneHeader.parse(welcome).identity != self.about.identity:
            return False
        self._sequence = 0
        return True

    def receive(self, data: bytes) -> Received:
        """Decode a BATCH and add its content.

        Raises:
            ProtocolError: If the batch does not fit the scene or the batches before. Nothing changes then.
        """
        s = Sections.parse(data, self.about)
        if s.sequence != self._sequence + 1:
            raise ProtocolError(f"BATCH {s.sequence}: expected number {self._sequence + 1}")
        try:
            starts, rows, table = self._with_chunks(s)
            chunks = _find_rows(s.gaussians, starts, rows, table)
            records, terms = self._decode(s, chunks, table)
            dropped = self._hold(s)
        except ValueError as error:
            raise ProtocolError(f"BATCH {s.sequence}: {error}") from error
        self._starts = starts
        self._rows = rows
        self._table = table
        self._sequence = s.sequence
        evicted = self._drawn.forget(s.evicted)
        self._drawn.add(replace(s, records=records, term_records=terms), chunks, table)
        if len(dropped):
            self._drawn.drop(dropped)
        left = np.union1d(dropped, evicted) if len(evicted) else dropped
        return Received(s.sequence, s.gaussians, s.terms, left, len(data))

    def shown(self) -> I64:
        """Return the (M,) ids of the Gaussians that are drawn, in the order of `scene`."""
        return self._drawn.ids.astype(np.int64)

    def scene(self) -> tuple[Gaussians, SrbfColors]:
        """Return M Gaussians with their base colors in SH degree 0, and colors with the received terms.

        `gsvis.color.evaluate.evaluate(colors, gaussians.means, eye)` gives the colors seen from a viewpoint. The arrays
        are views of the receiver's memory, valid until the next `receive`; copy what must last longer.
        """
        return self._drawn.scene()

    def _with_chunks(self, s: Sections) -> tuple[I64, NDArray[np.int32], ChunkTable]:
        """Return the chunks with those of a batch added: first ids, ascending, the row of each, and all rows.

        Raises:
            ValueError: If chunks overlap, are more than the scene has, or have ids or levels that the scene lacks.
        """
        fresh = self._are_new(s.chunks)
        if not fresh.any():
            return self._starts, self._rows, self._table
        r = s.rows[fresh]
        first = s.chunks[fresh]
        if len(self._table) + len(first) > self.about.chunks:
            got = len(self._table) + len(first)
            raise ValueError(f"chunks: expected at most {self.about.chunks:,}, got {got:,}")
        origins, steps, lows, strides, counts = (
            np.ascontiguousarray(r[name]) for name in ("origin", "step", "low", "stride", "count")
        )
        bits = unpack_bits(r["bits"], self.about.coding.layout.position)
        table = ChunkTable.concatenate([self._table, ChunkTable(origins, steps, lows, strides, counts, bits)])
        places = np.searchsorted(self._starts, first)
        starts = np.insert(self._starts, places, first)
        rows = np.insert(self._rows, places, np.arange(len(self._table), len(table), dtype=np.int32))
        ends = starts + table.counts[rows]
        if (ends[:-1] > starts[1:]).any():
            k = int(np.argmax(ends[:-1] > starts[1:]))
            raise ValueError(
                f"chunks: expected none that overlap, got one to id {ends[k]:,} and one from {starts[k + 1]:,}"
            )
        if ends[-1] > self.about.gaussians:
            raise ValueError(f"chunks: expected ids below {self.about.gaussians:,}, got {ends[-1] - 1:,}")
        levels = len(self.about.names)
        wrong = (r["first_level"] > r["last_level"]) | (r["last_level"] >= levels)
        if wrong.any():
            row = r[int(np.argmax(wrong))]
            got_levels = f"{row['first_level']} to {row['last_level']}"
            raise ValueError(f"chunks: expected levels in order and below {levels}, got {got_levels}")
        return starts, rows, table

    def _are_new(self, chunks: I64) -> NDArray[np.bool_]:
        """Return whether each chunk has no row yet: a row comes again after all Gaussians of its chunk were evicted."""
        if not len(self._starts):
            return np.ones(len(chunks), np.bool_)
        places = np.minimum(np.searchsorted(self._starts, chunks), len(self._starts) - 1)
        return np.asarray(self._starts[places] != chunks, np.bool_)

    def _decode(self, s: Sections, of: NDArray[np.int32], table: ChunkTable) -> tuple[U8, U8]:
        """Return the records of the Gaussians and of the terms of a batch.

        Raises:
            ValueError: If its bytes are not records of these Gaussians and terms.
        """
        coding = self.about.coding
        records = coding.decode_records(s.records, s.gaussians, of, chunks_of(table))
        if records is None:
            got = f"{len(s.records):,} bytes that hold none"
            raise ValueError(f"records: expected those of {len(s.gaussians):,} Gaussians, got {got}")
        terms = coding.decode_terms(s.term_records, s.owners)
        if terms is None:
            got = f"{len(s.term_records):,} bytes that hold none"
            raise ValueError(f"term_records: expected those of {len(s.terms):,} terms, got {got}")
        return records, terms

    def _hold(self, s: Sections) -> I64:
        """Add a batch to the holdings; return the ids of Gaussians that are no longer drawn.

        Raises:
            ValueError: If an id is held already, a term comes before its Gaussian, a Gaussian comes after it was
                replaced or is replaced twice, or something is evicted although the memory has no limit.
        """
        held = self.holdings.copy()
        if len(s.evicted):
            if self.memory == 0:
                raise ValueError(f"evicted: expected none without a limit of memory, got {len(s.evicted):,} ids")
            held.evict(s.evicted, self._drawn.terms_of(s.evicted))
        was_gone = held.gone.copy()
        held.add(s.gaussians, s.terms, s.gone)
        is_held = _are_in(held.sent, s.owners)
        if not is_held.all():
            owner = int(s.owners[int(np.argmin(is_held))])
            raise ValueError(f"terms: expected terms of Gaussians that are held, got one of Gaussian {owner:,}")
        replaced = s.gaussians[_are_in(was_gone, s.gaussians)]
        if len(replaced):
            raise ValueError(f"gaussians: expected none that was replaced, got {replaced[0]:,}")
        again = s.gone[_are_in(was_gone, s.gone)]
        if len(again):
            raise ValueError(f"gone: expected each Gaussian once, got {again[0]:,} again")
        self.holdings = held
        return s.gone[_are_in(held.sent, s.gone)]


def _find_rows(ids: I64, starts: I64, rows: NDArray[np.int32], table: ChunkTable) -> NDArray[np.int32]:
    """Return the row of the chunk of each Gaussian, (G,).

    Raises:
        ValueError: If the row of a chunk is missing.
    """
    if not len(ids):
        return np.zeros(0, np.int32)
    places = np.searchsorted(starts, ids, side="right") - 1
    found = rows[places] if len(rows) else rows
    without = (places < 0) | (ids - starts[places] >= table.counts[found]) if len(rows) else ids >= 0
    if without.any():
        raise ValueError(f"chunks: expected the row of each Gaussian's chunk, got none for {ids[without][0]:,}")
    return found


def _are_in(words: NDArray[np.uint64], ids: I64) -> NDArray[np.bool_]:
    """Return whether each id (M,) is in a packed set."""
    return np.asarray((words[ids >> 6] >> (ids & 63).astype(np.uint64)) & np.uint64(1), np.bool_)
