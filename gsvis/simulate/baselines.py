"""Two ways to deliver a scene that know nothing of the viewer: the file as a whole, and records along a Morton curve.

Both fill the link from the start and wait for nothing, neither for poses nor for acknowledgements, which is the best
that they can do. Sizes are measured, not assumed: the caller states them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.package.contents import Contents
from gsvis.package.layout import RECORD_BYTES
from gsvis.package.order import morton_codes
from gsvis.simulate.delivery import Parcel

__all__ = ["MortonProgressive", "WholeFile", "morton_order"]

I64 = NDArray[np.int64]

_CHUNK = 1 << 14  # bytes of a parcel: what a download is cut into


class _Unaware:
    """A list of parcels that goes out as it is."""

    name: str
    exact: bool

    def __init__(self, parcels: list[Parcel]) -> None:
        self._parcels, self._sent = parcels, 0

    def on_pose(self, t: float, position: ArrayLike, quat: ArrayLike) -> None:
        """Nothing follows from it."""

    def on_ack(self, t: float, sequence: int) -> None:
        """Nothing follows from it."""

    def next(self, t: float) -> Parcel | None:
        """The next parcel, at any time."""
        if self._sent == len(self._parcels):
            return None
        self._sent += 1
        return self._parcels[self._sent - 1]


class WholeFile(_Unaware):
    """One file of the scene, as SOG is loaded: nothing to show until all of it has come, and then all.

    What is shown then is the full scene itself, as if the file had lost nothing of it.

    Args:
        contents: The package, whose ids the last parcel names.
        nbytes: Measured size of the file.
        measured: How the size was found, for reports.
    """

    name, exact = "whole file", True

    def __init__(self, contents: Contents, nbytes: int, measured: str = "") -> None:
        self.nbytes, self.measured = _check.positive_int("nbytes", nbytes), measured
        none = np.zeros(0, np.int64)
        cuts = [*range(0, nbytes, _CHUNK), nbytes]
        parcels = [Parcel(k + 1, cuts[k + 1] - cuts[k], none, none, none) for k in range(len(cuts) - 1)]
        last = parcels[-1]
        ids = np.flatnonzero(contents.last == len(contents.names) - 1)
        parcels[-1] = Parcel(last.sequence, last.nbytes, ids, _terms_of(contents, ids), none)
        super().__init__(parcels)

    def describe(self) -> dict[str, Any]:
        """Size and where it comes from."""
        return {"bytes": self.nbytes, "measured": self.measured}


class MortonProgressive(_Unaware):
    """The records of the highest level along a Morton curve, each with all its terms, shown as they come.

    With the sizes of the package's own records it differs from what gsvis serves in nothing but the order and the
    selection of the bytes.

    Args:
        contents: The package.
        gaussian_bytes: Bytes of a Gaussian with its base color.
        term_bytes: Bytes of a term; None: of the package's records.
        measured: How the sizes were found, for reports.
    """

    name, exact = "Morton order", False

    def __init__(
        self,
        contents: Contents,
        gaussian_bytes: float = float(RECORD_BYTES),
        term_bytes: float | None = None,
        measured: str = "records of the package",
    ) -> None:
        self.measured = measured
        size = float(contents.term_records.shape[1]) if term_bytes is None else term_bytes
        for name, value in (("gaussian_bytes", gaussian_bytes), ("term_bytes", size)):
            if not (np.isfinite(value) and value > 0):
                raise ValueError(f"{name}: expected a finite number > 0, got {value!r}")
        members = np.flatnonzero(contents.last == len(contents.names) - 1)
        ids = members[morton_order(contents.gaussians(members).means)]
        counts = contents.term_counts[ids].astype(np.int64)
        ends = np.cumsum(gaussian_bytes + size * counts)
        self.nbytes = int(np.ceil(ends[-1])) if len(ends) else 0
        cuts = np.unique(np.searchsorted(ends, np.arange(_CHUNK, self.nbytes + _CHUNK, _CHUNK), side="right"))
        cuts = np.unique(np.concatenate([[0], cuts, [len(ids)]]))
        sizes = np.diff(np.concatenate([[0.0], np.ceil(ends)])[cuts]).astype(np.int64)
        none = np.zeros(0, np.int64)
        parcels = []
        for k, nbytes in enumerate(sizes.tolist()):
            some = ids[cuts[k] : cuts[k + 1]]
            parcels.append(Parcel(k + 1, nbytes, some, _terms_of(contents, some), none))
        super().__init__(parcels)

    def describe(self) -> dict[str, Any]:
        """Size and where it comes from."""
        return {"bytes": self.nbytes, "measured": self.measured}


def morton_order(means: ArrayLike) -> I64:
    """(N,) the order of centers (N, 3) along a Morton curve over the box of the middle 98% of them."""
    points = _check.floats("means", means, ("N", 3))
    if len(points) == 0:
        return np.zeros(0, np.int64)
    low, high = np.quantile(points.astype(np.float64), [0.01, 0.99], axis=0)
    half = max(float((high - low).max()) / 2.0, 1e-9)
    return np.argsort(morton_codes(points, (low + high) / 2.0, half), kind="stable")


def _terms_of(contents: Contents, ids: I64) -> I64:
    """Ids of all terms of these Gaussians, in their order."""
    counts = contents.term_counts[ids].astype(np.int64)
    starts = contents.term_offsets[ids]
    total = int(counts.sum())
    within = np.arange(total) - np.repeat(np.cumsum(counts) - counts, counts)
    return np.asarray(np.repeat(starts, counts) + within)
