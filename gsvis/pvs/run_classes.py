"""Weight classes as a package has them: one for each Gaussian, and a shift for each run of neighbors in each cell.

Which class a Gaussian has from a cell depends on the Gaussian, and on how well the cell sees the place where it is. Its
neighbors in the order of the package are at the same place. So a class is that of the Gaussian plus the shift of its
run, kept between the lowest and the highest class. This module knows no files and no cells beside their numbers.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsvis.pvs._kernels import store as kernels
from gsvis.pvs.codec import CodecError, compress, decompress

__all__ = ["RunClasses", "decode_common", "decode_shifts", "run_levels"]

_LEVEL = 19  # of zstd: written once

I8 = NDArray[np.int8]
U8 = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class RunClasses:
    """The classes of N Gaussians in R runs, from C cells.

    Attributes:
        run: Gaussians in a run; the last run may have fewer.
        classes: K, number of classes.
        common: (N,) uint8 below K, scene order.
        shifts: (C, R) int8 in (-K, K): what to add in a cell.
    """

    run: int
    classes: int
    common: U8
    shifts: I8

    def encode_common(self) -> bytes:
        """Return the bytes of `common`."""
        return compress(self.common.tobytes(), _LEVEL)

    def encode_shifts(self, cell: int) -> bytes:
        """Return the bytes of the shifts of a cell."""
        return compress((self.shifts[cell] + np.int8(self.classes - 1)).astype(np.uint8).tobytes(), _LEVEL)


def decode_common(data: bytes, n: int, classes: int) -> U8:
    """Return the (N,) uint8 that `RunClasses.encode_common` encoded.

    Raises:
        CodecError: If the bytes are not N classes below K.
    """
    common = np.frombuffer(decompress(data, n), np.uint8)
    if common.max(initial=0) >= classes:
        raise CodecError(f"expected classes below {classes}, got {common.max()}")
    return common


def decode_shifts(data: bytes, n: int, run: int, classes: int) -> I8:
    """Return the (R,) int8 that `RunClasses.encode_shifts` encoded.

    Raises:
        CodecError: If the bytes are not a shift in (-K, K) for each run.
    """
    coded = np.frombuffer(decompress(data, -(-n // run)), np.uint8)
    if coded.max(initial=0) > 2 * (classes - 1):
        raise CodecError(f"expected shifts of at most {classes - 1} classes, got {int(coded.max()) - classes + 1}")
    return np.asarray(coded.astype(np.int8) - np.int8(classes - 1))


def run_levels(
    words: NDArray[np.uint64], order: NDArray[np.int32], shared: tuple[U8, I8], run: int, classes: int
) -> U8:
    """Return (N,) uint8, stored order: class plus 1 of the Gaussians of a set, 0 elsewhere.

    Args:
        words: The set, stored order.
        order: (N,) the Gaussian at each stored place.
        shared: (N,) common classes, scene order, and (R,) shifts of the cell.
        run: Gaussians in a run.
        classes: K, number of classes.
    """
    levels = np.zeros(len(order), np.uint8)
    kernels.shift_levels(words, order, *shared, run, classes, levels)
    return levels
