"""The client's side: messages in, Gaussians and colors to draw out. No socket, no clock.

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
from gsvis.scene.gaussians import Gaussians
from gsvis.stream.batch import Sections
from gsvis.stream.coding import chunks_of
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
        most_bytes: Most bytes that sets and tables of the scene may take before the first Gaussian arrives. Without a
            limit, a WELCOME of a kilobyte could claim billions of Gaussians.
        memory: Bytes of records that the server may expect this client to hold; 0 means no limit.

    Attributes:
        about: The content of WELCOME.
        holdings: What the client has received, and what has been replaced.

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
        """Return the HELLO for a new connection: the view, and what this client holds already."""
        if not len(self._starts):
            return Hello(view, memory=self.memory)
        return Hello(view, bytes.fromhex(self.about.identity), self.holdings.to_bytes(), memory=self.memory)

    def resume(self, welcome: bytes) -> bool:
        """Accept the WELCOME of a new connection, which numbers its batches from 1 again.

        Returns:
            True if the scene is the same; everything is kept. False if it is another scene; nothing changes, and the
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
            chunks = _chunks_of(s.gaussians, starts, rows, table)
            records, terms = self._decode(s, chunks, table)
            dropped = self._enter(s)
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
        """Return what to draw: M Gaussians in SH degree 0 with their base colors, and colors with the received terms.

        `gsvis.color.evaluate.evaluate(colors, gaussians.means, eye)` gives the colors seen from a viewpoint. The arrays
        are views of the receiver's memory, valid until the next `receive`; copy what must last longer.
        """
        return self._drawn.scene()

    def _with_chunks(self, s: Sections) -> tuple[I64, NDArray[np.int32], ChunkTable]:
        """Return first ids of chunks, ascending, the row of each, and all rows, with the chunks of a batch added.

        Raises:
            ValueError: If chunks overlap, are more than the scene has, or their ids or levels are not of the scene.
        """
        fresh = self._are_new(s.chunks)
        if not fresh.any():
            return self._starts, self._rows, self._table
        r = s.rows[fresh]
        first = s.chunks[fresh]
        if len(self._table) + len(first) > self.about.chunks:
            raise ValueError(f"chunks: expected at most {self.about.chunks:,}, got more")
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
            got = f"{row['first_level']} to {row['last_level']}"
            raise ValueError(f"chunks: expected levels in order and below {levels}, got {got}")
        return starts, rows, table

    def _are_new(self, chunks: I64) -> NDArray[np.bool_]:
        """Return a mask: of which chunks there is no row yet. One comes again when all of its chunk was evicted."""
        if not len(self._starts):
            return np.ones(len(chunks), np.bool_)
        places = np.minimum(np.searchsorted(self._starts, chunks), len(self._starts) - 1)
        return np.asarray(self._starts[places] != chunks, np.bool_)

    def _decode(self, s: Sections, of: NDArray[np.int32], table: ChunkTable) -> tuple[U8, U8]:
        """Return the records of the Gaussians and of the terms of a batch.

        Raises:
            ValueError: If its bytes are no such records.
        """
        coding = self.about.coding
        records = coding.decode_records(s.records, s.gaussians, of, chunks_of(table))
        if records is None:
            raise ValueError(f"records: expected those of {len(s.gaussians):,} Gaussians, got other bytes")
        terms = coding.decode_terms(s.term_records, s.owners)
        if terms is None:
            raise ValueError(f"term_records: expected those of {len(s.terms):,} terms, got other bytes")
        return records, terms

    def _enter(self, s: Sections) -> I64:
        """Add a batch to the holdings; return the ids of Gaussians that are no longer drawn.

        Raises:
            ValueError: If the client has an id already, a term comes before its Gaussian, a Gaussian comes after it was
                replaced or is replaced twice, or something is evicted though there is no limit of memory.
        """
        held = self.holdings.copy()
        if len(s.evicted):
            if self.memory == 0:
                raise ValueError("evicted: expected none without a limit of memory, got some")
            held.evict(s.evicted, self._drawn.terms_of(s.evicted))
        was_gone = held.gone.copy()
        held.add(s.gaussians, s.terms, s.gone)
        came = _are_in(held.sent, s.owners)
        if not came.all():
            owner = int(s.owners[int(np.argmin(came))])
            raise ValueError(f"terms: expected those of Gaussians that have come, got one of Gaussian {owner:,}")
        if np.any(_are_in(was_gone, s.gaussians)):
            raise ValueError("gaussians: expected none that is replaced, got one")
        if np.any(_are_in(was_gone, s.gone)):
            raise ValueError("gone: expected each once, got one again")
        self.holdings = held
        return s.gone[_are_in(held.sent, s.gone)]


def _chunks_of(ids: I64, starts: I64, rows: NDArray[np.int32], table: ChunkTable) -> NDArray[np.int32]:
    """Return (G,) for each Gaussian, the row of its chunk.

    Raises:
        ValueError: If the row of a chunk is missing.
    """
    if not len(ids):
        return np.zeros(0, np.int32)
    places = np.searchsorted(starts, ids, side="right") - 1
    found = rows[places] if len(rows) else rows
    if places[0] < 0 or np.any(ids - starts[places] >= table.counts[found]):
        raise ValueError("chunks: expected the row of each Gaussian's chunk, got none")
    return found


def _are_in(words: NDArray[np.uint64], ids: I64) -> NDArray[np.bool_]:
    """Return a mask: which ids are in a packed set."""
    return np.asarray((words[ids >> 6] >> (ids & 63).astype(np.uint64)) & np.uint64(1), np.bool_)
