"""Define two deliveries that ignore the viewer: the whole file, and records along a Morton curve.

Both fill the link from the start, without waiting for poses or acknowledgements, which is the best that they can do.
The caller gives measured sizes.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.package.contents import Contents
from gsvis.package.layout import RECORD_BYTES
from gsvis.scene.morton import morton_order
from gsvis.simulate.delivery import Parcel

__all__ = ["CHUNK", "MortonProgressive", "WholeFile", "morton_order", "terms_of"]

I64 = NDArray[np.int64]

CHUNK = 1 << 14
"""Bytes of a parcel of a download."""


class _Unaware:
    """Send a fixed list of parcels, independent of the viewer."""

    name: str
    exact: bool

    def __init__(self, parcels: list[Parcel]) -> None:
        self._parcels = parcels
        self._sent = 0

    def on_pose(self, t: float, position: ArrayLike, quat: ArrayLike) -> None:
        """Ignore the pose."""

    def on_ack(self, t: float, sequence: int) -> None:
        """Ignore the acknowledgement."""

    def next(self, t: float) -> Parcel | None:
        """Return the next parcel; it never waits."""
        if self._sent == len(self._parcels):
            return None
        self._sent += 1
        return self._parcels[self._sent - 1]


class WholeFile(_Unaware):
    """One file of the scene, loaded like SOG: nothing is shown until it has arrived completely.

    The client then shows the full scene itself, as if the file were lossless.

    Args:
        contents: The package; the last parcel names its ids.
        nbytes: Measured size of the file.
        measured: How the size was measured, for reports.
        ids: Gaussians of the file; None means those of the highest level.
    """

    name = "whole file"
    exact = True

    def __init__(self, contents: Contents, nbytes: int, measured: str = "", *, ids: I64 | None = None) -> None:
        self.nbytes = _check.positive_int("nbytes", nbytes)
        self.measured = measured
        none = np.zeros(0, np.int64)
        cuts = [*range(0, nbytes, CHUNK), nbytes]
        parcels = [Parcel(k + 1, cuts[k + 1] - cuts[k], none, none, none) for k in range(len(cuts) - 1)]
        last = parcels[-1]
        ids = _highest(contents) if ids is None else ids
        parcels[-1] = Parcel(last.sequence, last.nbytes, ids, terms_of(contents, ids), none)
        super().__init__(parcels)

    def describe(self) -> dict[str, Any]:
        """Return the size and its source."""
        return {"bytes": self.nbytes, "measured": self.measured}


class MortonProgressive(_Unaware):
    """Records of the highest level along a Morton curve, each with all its terms, shown as they arrive.

    With the sizes of the package's own records it differs from gsvis only in the order and the selection of the bytes.

    Args:
        contents: The package.
        gaussian_bytes: Bytes of a Gaussian with its base color.
        term_bytes: Bytes of a term; None means those of the package's records.
        measured: How the sizes were measured, for reports.
        ids: Gaussians that are sent; None means those of the highest level.
    """

    name = "Morton order"
    exact = False

    def __init__(
        self,
        contents: Contents,
        gaussian_bytes: float = float(RECORD_BYTES),
        term_bytes: float | None = None,
        measured: str = "records of the package",
        *,
        ids: I64 | None = None,
    ) -> None:
        self.measured = measured
        size = float(contents.term_records.shape[1]) if term_bytes is None else term_bytes
        for name, value in (("gaussian_bytes", gaussian_bytes), ("term_bytes", size)):
            if not (np.isfinite(value) and value > 0):
                raise ValueError(f"{name}: expected a finite number > 0, got {value!r}")
        members = _highest(contents) if ids is None else ids
        ids = members[morton_order(contents.gaussians(members).means)]
        counts = contents.term_counts[ids].astype(np.int64)
        ends = np.cumsum(gaussian_bytes + size * counts)
        self.nbytes = int(np.ceil(ends[-1])) if len(ends) else 0
        cuts = np.unique(np.searchsorted(ends, np.arange(CHUNK, self.nbytes + CHUNK, CHUNK), side="right"))
        cuts = np.unique(np.concatenate([[0], cuts, [len(ids)]]))
        sizes = np.diff(np.concatenate([[0.0], np.ceil(ends)])[cuts]).astype(np.int64)
        none = np.zeros(0, np.int64)
        parcels = []
        for k, nbytes in enumerate(sizes.tolist()):
            some = ids[cuts[k] : cuts[k + 1]]
            parcels.append(Parcel(k + 1, nbytes, some, terms_of(contents, some), none))
        super().__init__(parcels)

    def describe(self) -> dict[str, Any]:
        """Return the sizes and their source."""
        return {"bytes": self.nbytes, "measured": self.measured}


def _highest(contents: Contents) -> I64:
    """Return the ids of the Gaussians of the highest level."""
    return np.flatnonzero(contents.last == len(contents.names) - 1)


def terms_of(contents: Contents, ids: I64) -> I64:
    """Return the ids of all terms of these Gaussians, in their order."""
    counts = contents.term_counts[ids].astype(np.int64)
    starts = contents.term_offsets[ids]
    total = int(counts.sum())
    within = np.arange(total) - np.repeat(np.cumsum(counts) - counts, counts)
    return np.asarray(np.repeat(starts, counts) + within)
