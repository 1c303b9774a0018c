"""Round the higher spherical harmonics of a bare scene, and let Gaussians share sets of them.

A coefficient becomes a byte between a low and a high end, the same for all Gaussians. Ends hold all but a few values in
ten thousand and make zero exact; the rest is clipped. A set has the bytes of all coefficients of a Gaussian. Gaussians
name a set each, so that files hold a few bytes for each instead of up to 45. Blocks of sets come in the order of their
worth; in a block each set lies beside one that resembles it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from gsvis.export.columns import compress
from gsvis.io.quantize import distinct_rows, palette_of
from gsvis.jobs.in_order import in_order

__all__ = ["ZERO", "Harmonics", "Palette", "label_bytes"]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]
Number = TypeVar("Number", bound=np.number[Any])
I64 = NDArray[np.int64]

ZERO = 128
"""The byte that stands for 0."""

BLOCK = 1024
"""Sets in a file."""

_SAMPLE = 1 << 16  # Gaussians from which the ends of coefficients are found
_TAIL = 2e-4  # share of these that lie beyond the ends
_ROWS = 1 << 15


@dataclass(frozen=True, eq=False)
class Harmonics:
    """Ranges of K coefficients, the same for R, G and B.

    Attributes:
        degree: 1 to 3.
        high: (K,) value of byte 255; byte 128 is 0 and byte 0 is -128/127 of it.
    """

    degree: int
    high: F32

    @classmethod
    def from_coefficients(cls, coefficients: F32, degree: int) -> Harmonics:
        """Return the ranges of coefficients (N, K, 3)."""
        some = np.abs(coefficients[:: max(1, len(coefficients) // _SAMPLE)])
        high = np.quantile(some, 1.0 - _TAIL, axis=(0, 2), method="higher")
        return cls(degree, np.maximum(high, 1e-6).astype(np.float32))

    @property
    def low(self) -> F32:
        """(K,) value of byte 0."""
        return np.asarray(self.high.astype(np.float64) * -(ZERO / (255.0 - ZERO)), np.float32)

    def encode(self, coefficients: F32) -> U8:
        """Return (N, 3 K) uint8, the coefficients (N, K, 3): for each coefficient R, G, B."""
        n = len(coefficients)
        k = len(self.high)
        out = np.empty((n, k, 3), np.uint8)
        factors = ((255 - ZERO) / self.high)[:, None]
        for start in range(0, n, _ROWS):
            some = coefficients[start : start + _ROWS] * factors
            np.rint(some, out=some)
            out[start : start + _ROWS] = np.clip(some + np.float32(ZERO), 0, 255)
        return out.reshape(n, 3 * k)

    def decode(self, data: U8) -> F32:
        """Return (M, K, 3) coefficients of bytes (M, 3 K)."""
        low = self.low.astype(np.float64)
        high = self.high.astype(np.float64)
        places = data.reshape(len(data), len(self.high), 3) / 255.0
        return np.asarray(low[:, None] + places * (high - low)[:, None], np.float32)

    def as_dict(self) -> dict[str, Any]:
        """Return degree and ends, ready for JSON."""
        return {"degree": self.degree, "low": self.low.tolist(), "high": self.high.tolist()}


@dataclass(frozen=True, eq=False)
class Palette:
    """Sets of higher coefficients, and which of them each Gaussian has.

    Attributes:
        sets: (E, 3 K) bytes, blocks of most worth first.
        labels: (N,) the set of each Gaussian.
        worth: (B,) what each block of sets is worth: the mean squared change of color over directions and
            channels, each Gaussian counted by its share of the light of all.
        error: Change of color by sharing, root mean square over Gaussians, directions and channels; 1 is white.
    """

    sets: U8
    labels: I64
    worth: F64
    error: float

    @classmethod
    def from_scene(cls, coefficients: F32, lights: F64, ranges: Harmonics, most: int | None) -> Palette:
        """Return the sets of N Gaussians.

        If more than `most` differ, they are grouped by their coefficients.

        Args:
            coefficients: (N, K, 3).
            lights: (N,) how much each Gaussian counts.
            ranges: Ranges of the coefficients.
            most: Largest number of sets; None gives each Gaussian its own.
        """
        n = len(coefficients)
        exact = ranges.encode(coefficients)
        sets, labels = (exact, np.arange(n)) if most is None else distinct_rows(exact)
        error = 0.0
        if most is not None and len(sets) > most:
            centers, labels = palette_of(coefficients.reshape(n, -1), most)
            sets = ranges.encode(centers.reshape(len(centers), -1, 3))
            apart = ranges.decode(sets)[labels] - coefficients
            error = float(np.sqrt(_mean_squares(apart).mean()))
        shares = lights / max(float(lights.sum()), 1e-300)
        worth = np.bincount(labels, shares * _mean_squares(coefficients), minlength=len(sets))
        order = np.argsort(-worth, kind="stable")
        if most is not None:
            order = np.concatenate([some[_chain(sets[some])] for some in _in_blocks(order)])
        place = np.empty(len(sets), np.int64)
        place[order] = np.arange(len(sets))
        blocks = np.array([worth[some].sum() for some in _in_blocks(order)])
        return cls(sets[order], place[labels], blocks, error)

    def blocks(self) -> list[bytes]:
        """Return the file of each block: each byte less that of the set before it, byte after byte, compressed."""

        def encode(block: U8) -> bytes:
            """Return the file of a block."""
            apart = np.diff(block, axis=0, prepend=np.uint8(ZERO))
            return compress(np.ascontiguousarray(apart.T).tobytes())

        return list(in_order(encode, _in_blocks(self.sets)))


def label_bytes(sets: int) -> int:
    """Return how many bytes name one of so many sets."""
    return max(1, ((sets - 1).bit_length() + 7) // 8)


def _in_blocks(values: NDArray[Number]) -> list[NDArray[Number]]:
    """Return the parts of (E, ...) values that belong to each block."""
    return [values[start : start + BLOCK] for start in range(0, len(values), BLOCK)]


def _chain(sets: U8) -> I64:
    """Return an order (B,) of sets (B, F) in which each is followed by the nearest of those that are left."""
    wide = sets.astype(np.float32)
    squares = np.einsum("ij,ij->i", wide, wide)
    apart = squares[:, None] + squares - 2.0 * (wide @ wide.T)
    order = np.empty(len(sets), np.int64)
    at = int(squares.argmin())
    for k in range(len(sets)):
        order[k] = at
        apart[:, at] = np.inf
        at = int(apart[at].argmin())
    return order


def _mean_squares(coefficients: F32) -> F64:
    """Return (N,) the mean squared color of coefficients (N, K, 3), over directions and channels."""
    squared = np.einsum("nkc,nkc->n", coefficients, coefficients, dtype=np.float64)
    return np.asarray(squared / (3.0 * 4.0 * np.pi))
