"""What the cells of a tile see outside it: ids in the packages of other nodes, read cell by cell from a store."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsvis.errors import FormatError
from gsvis.files.limits import DAMAGED, digest_of
from gsvis.pvs.store import VisibilityStore
from gsvis.world.manifest import BeyondTable, Piece

__all__ = ["Beyond", "SeenNode"]

I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class SeenNode:
    """The Gaussians of one node that a cell sees.

    Attributes:
        node: Number of the node.
        level: Highest level of the node that is used there; ids belong to this level and lower ones.
        ids: (V,) ids in the package of the node, ascending.
        classes: (V,) uint8, class of the largest weight of each, as in a store of visible sets.
    """

    node: int
    level: int
    ids: I64
    classes: U8


class Beyond:
    """The open table of a tile. Its cells are those of the visible sets of the tile's package.

    Args:
        path: The store.
        table: Its entry in the manifest.

    Raises:
        FormatError: If the store is damaged, or its number of ids differs from that of the pieces.
        OSError: If it cannot be opened.
    """

    def __init__(self, path: Path, table: BeyondTable) -> None:
        self.table = table
        try:
            self.store = VisibilityStore.open(path)
        except FileNotFoundError as error:
            remedy = "prepare the world again"
            raise FormatError(path, "", "a table of the world", "no such file", remedy) from error
        if self.store.gaussians != table.count:
            found = f"{self.store.gaussians:,}"
            self.store.close()
            raise FormatError(path, "gaussians", f"{table.count:,} as the pieces have", found, DAMAGED)

    def close(self) -> None:
        """Close the store."""
        self.store.close()

    def __len__(self) -> int:
        """Number of cells."""
        return len(self.store)

    @cached_property
    def _starts(self) -> I64:
        """(P + 1,) first id of each piece in the store, and the number of ids."""
        return np.concatenate([[0], np.cumsum([piece.count for piece in self.table.pieces])]).astype(np.int64)

    @cached_property
    def _runs(self) -> tuple[I64, I64]:
        """(R,) first id of each run in the store, and (R,) what to add to its ids to get ids of its node."""
        first, counts = np.array([run for piece in self.table.pieces for run in piece.runs], np.int64).reshape(-1, 2).T
        starts = np.cumsum(counts) - counts
        return starts, first - starts

    def of_cell(self, cell: int) -> list[SeenNode]:
        """Return what a cell sees of each node, in the order of the pieces; nodes that it does not see are skipped.

        Raises:
            ValueError: If there is no such cell.
            FormatError: If the store is damaged there.
        """
        ids, classes = self.store.classes(cell)
        return [SeenNode(piece.node, piece.level, places, classes[some]) for piece, places, some in self._split(ids)]

    def ids_of_cell(self, cell: int) -> list[tuple[int, I64]]:
        """Return pairs of a node and the ids that a cell sees of it; faster than `of_cell`, as classes are not read.

        Raises:
            ValueError: If there is no such cell.
            FormatError: If the store is damaged there.
        """
        return [(piece.node, places) for piece, places, _ in self._split(self.store.visible_ids(cell))]

    def _split(self, ids: I64) -> Iterator[tuple[Piece, I64, slice]]:
        """Yield each piece that has some of the ids, these as ids of its node, and their slice of `ids`."""
        starts, more = self._runs
        places = ids + more[np.searchsorted(starts, ids, side="right") - 1] if len(ids) else ids
        cuts = np.searchsorted(ids, self._starts)
        for k, piece in enumerate(self.table.pieces):
            some = slice(cuts[k], cuts[k + 1])
            if some.start < some.stop:
                yield piece, places[some], some

    def verify(self) -> None:
        """Read and decode the whole store.

        Raises:
            FormatError: If it is damaged, or its content does not fit its name.
        """
        digest = digest_of(self.store.path)
        if digest != self.table.digest:
            got = f"SHA-256 {digest[:12]}..."
            raise FormatError(self.store.path, "", "content that fits its name", got, DAMAGED)
        self.store.verify()
