"""The client's side: messages in, Gaussians and colours to draw out. No socket, no clock."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsvis.abr.classes import FieldOfView
from gsvis.abr.holdings import Holdings
from gsvis.color.records import QuantisedColors
from gsvis.color.srbf import SrbfColors
from gsvis.errors import ProtocolError
from gsvis.package.codec import ChunkTable, base_colors, decode_records
from gsvis.package.contents import base_rgb
from gsvis.package.layout import RECORD_BYTES, RecordLayout
from gsvis.package.terms import decode_terms
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.sh import SH_C0
from gsvis.stream.batch import CHUNK_ROW, Sections
from gsvis.stream.header import SceneHeader
from gsvis.stream.wire import Hello

__all__ = ["Received", "Receiver"]

I64 = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Received:
    """What a batch has brought.

    Attributes:
        sequence: Its number, to be acknowledged.
        gaussians: (G,) rising ids.
        terms: (M,) rising ids.
        dropped: (D,) rising ids of those that are not shown any more.
        nbytes: Bytes of the message.
    """

    sequence: int
    gaussians: I64
    terms: I64
    dropped: I64
    nbytes: int


class Receiver:
    """What one client has.

    Args:
        welcome: The first message.

    Attributes:
        about: What WELCOME says of the scene.
        holdings: What has come.

    Raises:
        ProtocolError: If it is no WELCOME.
    """

    def __init__(self, welcome: bytes) -> None:
        self.about = SceneHeader.parse(welcome)
        self.holdings = Holdings(self.about.gaussians, self.about.terms)
        self._rows = np.zeros(0, CHUNK_ROW)
        self._starts = np.zeros(0, np.int64)
        self._ids, self._records = np.zeros(0, np.int64), np.zeros((0, RECORD_BYTES), np.uint8)
        self._terms, self._owners = np.zeros(0, np.int64), np.zeros(0, np.int64)
        self._term_records = np.zeros((0, self.about.term_bytes), np.uint8)
        self._axes = np.zeros((self.about.gaussians, self.about.axis_bytes), np.uint8)
        self._has_axes = np.zeros(self.about.gaussians, bool)

    def hello(self, view: FieldOfView) -> Hello:
        """What to say to a server: the view, and what is held already."""
        if not len(self._ids):
            return Hello(view)
        return Hello(view, bytes.fromhex(self.about.identity), self.holdings.to_bytes())

    def resume(self, welcome: bytes) -> bool:
        """Take the WELCOME of a new connection.

        Returns:
            Whether it is the same scene, so that everything is kept; where it is another, nothing has changed and a
            new receiver is needed.
        """
        return SceneHeader.parse(welcome).identity == self.about.identity

    def receive(self, data: bytes) -> Received:
        """Take a BATCH.

        Raises:
            ProtocolError: If it does not fit the scene or what came before; nothing has changed then.
        """
        s = Sections.parse(data, self.about)
        starts = np.concatenate([self._starts, s.chunks])
        order = np.argsort(starts, kind="stable")
        rows = np.concatenate([self._rows, s.rows])[order]
        starts = starts[order]
        if len(np.unique(starts)) != len(starts) or len(s.chunks) != len(s.rows):
            raise ProtocolError(f"BATCH {s.sequence}: expected chunks that are new, got one again")
        place = np.searchsorted(starts, s.gaussians, side="right") - 1
        if len(place) and (place.min() < 0 or (s.gaussians - starts[place] >= rows["count"][place]).any()):
            raise ProtocolError(f"BATCH {s.sequence}: expected the row of each Gaussian's chunk, got none")
        try:
            held = set(self.holdings.shown.tolist())
            self.holdings.add(s.gaussians, s.terms, s.gone)
        except ValueError as error:
            raise ProtocolError(f"BATCH {s.sequence}: {error}") from error
        self._rows, self._starts = rows, starts
        fresh = np.unique(s.owners)
        fresh = fresh[~self._has_axes[fresh]]
        self._has_axes[fresh] = True
        if self.about.axis_bytes:
            self._axes[fresh] = s.axes
        self._ids, self._records = np.append(self._ids, s.gaussians), np.concatenate([self._records, s.records])
        self._terms, self._owners = np.append(self._terms, s.terms), np.append(self._owners, s.owners)
        self._term_records = np.concatenate([self._term_records, s.term_records])
        dropped = np.array([k for k in s.gone.tolist() if k in held or k in set(s.gaussians.tolist())], np.int64)
        return Received(s.sequence, s.gaussians, s.terms, dropped, len(data))

    def shown(self) -> I64:
        """(M,) ids of the Gaussians that are drawn, in the order of `scene`."""
        return self.holdings.shown

    def scene(self) -> tuple[Gaussians, SrbfColors]:
        """What is drawn: Gaussians in SH degree 0 with their base colours, and colours with the terms that came.

        An eye sees `gsvis.color.evaluate.evaluate(colors, gaussians.means, eye)`.
        """
        grids, shown = self.about.grids, self.shown()
        layout = RecordLayout.of(grids.variant)
        order = np.argsort(self._ids)
        records = self._records[order[np.searchsorted(self._ids[order], shown)]]
        chunks = np.searchsorted(self._starts, shown, side="right") - 1
        rows = self._rows
        table = ChunkTable(
            rows["origin"].copy(), rows["step"].copy(), rows["low"].copy(), rows["stride"].copy(), rows["count"].copy()
        )
        geometry = decode_records(records, table, layout, chunks=chunks)
        sh0 = ((base_rgb(records, grids).astype(np.float64) - 0.5) / SH_C0)[:, None]
        base = base_colors(records, layout).astype(np.uint16)
        kept = np.flatnonzero(np.isin(self._owners, shown))
        kept = kept[np.argsort(self._terms[kept])]
        counts = np.bincount(np.searchsorted(shown, self._owners[kept]), minlength=len(shown))
        offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        axes = self._axes[shown].astype(np.uint16).reshape(len(shown), grids.kind.num_axes, 2)
        scales = base[:, 3] if layout.color_scale else np.zeros(0, np.uint16)
        terms = decode_terms(self._term_records[kept], grids)
        colors = QuantisedColors(grids, base[:, :3], scales, axes, offsets, *terms)
        return Gaussians(*geometry, sh0), colors.dequantised()
