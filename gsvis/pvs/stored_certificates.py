"""Hold the certificates of all cells of a store: the effort for each set, and the light that it misses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["CERTIFIED_ROW", "StoredCertificates"]

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

_SHARES = ("missed", "bound", "tile")
CERTIFIED_ROW = np.dtype([("inner", "<u4"), ("rays", "<u4"), *[(name, "<f4") for name in _SHARES]])
"""The row of one cell in the file, in a section that older stores lack."""


@dataclass(frozen=True, eq=False)
class StoredCertificates:
    """The certificates of C cells.

    Attributes:
        inner: (C,) number of viewpoints that were added because of a certificate.
        rays: (C,) rays that certified the set; 0 without a certificate.
        missed: (C,) estimated share of light that the set misses; NaN without a certificate.
        bound: (C,) upper 95% confidence bound of this share; NaN without a certificate.
        tile: (C,) largest share of light that the set misses in a tile of an image; NaN without a certificate.
    """

    inner: I64
    rays: I64
    missed: F64
    bound: F64
    tile: F64

    @classmethod
    def from_rows(cls, rows: NDArray[Any]) -> StoredCertificates:
        """Return the certificates of rows of `CERTIFIED_ROW`.

        Raises:
            ValueError: If a share is outside [0, 1].
        """
        for name in _SHARES:
            if (~np.isnan(rows[name]) & ~((rows[name] >= 0.0) & (rows[name] <= 1.0))).any():
                raise ValueError(f"{name}: expected shares in [0, 1]")
        inner, rays = (rows[name].astype(np.int64) for name in ("inner", "rays"))
        missed, bound, tile = (rows[name].astype(np.float64) for name in _SHARES)
        return cls(inner, rays, missed, bound, tile)

    @classmethod
    def none(cls, cells: int) -> StoredCertificates:
        """Return empty certificates for C cells."""
        zero = np.zeros(cells, np.int64)
        nan = np.full(cells, np.nan)
        return cls(zero, zero, nan, nan, nan)

    @property
    def known(self) -> NDArray[np.bool_]:
        """(C,) whether a cell has a certificate."""
        return np.asarray(~np.isnan(self.bound))

    def as_dict(self) -> dict[str, Any]:
        """Return the figures of all cells together for JSON; shares are None without any certificate."""
        known = self.known
        figures: dict[str, Any] = {"cells": int(known.sum()), "rays": int(self.rays.sum())}
        for name in _SHARES:
            values = getattr(self, name)[known]
            figures[name] = {"mean": float(values.mean()), "max": float(values.max())} if len(values) else None
        return figures
