"""Read recorded 5G logs: a CSV with the column `DL_bitrate`, download in kbit/s, one row per second.

Timestamps are whole seconds, with repeats and gaps, although rows come once a second. So time is counted by row.

References:
    Raca et al., "Beyond Throughput, The Next Generation: a 5G Dataset with Channel and Context Metrics", MMSys 2020.
"""

from __future__ import annotations

import os

import numpy as np
from numpy.typing import NDArray

from gsvis.errors import FormatError
from gsvis.io._table import read_table

__all__ = ["COLUMN", "read_bandwidth_5g"]

F64 = NDArray[np.float64]

COLUMN = "DL_bitrate"
_MOST = 1e9  # kbit/s


def read_bandwidth_5g(path: str | os.PathLike[str]) -> tuple[F64, F64]:
    """Read a log.

    Returns:
        times: (S,) seconds 1, 2, ..., the end of each rate.
        mbit_per_s: (S,) rates.

    Raises:
        FileNotFoundError: If there is no file.
        FormatError: If the column is missing, a cell is not a number in range, or there is no row.
    """
    table = read_table(path)
    rates = table.numbers((COLUMN,))[:, 0]
    if len(rates) == 0:
        raise FormatError(table.path, f"line {table.lines[0] + 1}", "at least one row", "the end of the file")
    bad = np.flatnonzero((rates < 0) | (rates > _MOST))
    if len(bad):
        where = table.where(int(bad[0]), COLUMN)
        raise FormatError(table.path, where, f"kbit/s in [0, {_MOST:g}]", f"{rates[bad[0]]:g}")
    return np.arange(1.0, len(rates) + 1.0), rates / 1000.0
