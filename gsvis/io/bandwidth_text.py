"""Read bandwidth as text: two numbers per line, seconds and Mbit/s, as in the traces of Pensieve and Oboe.

The rate of a line holds from the time of the previous line, or 0, to its own time. Lines at time 0 are ignored.
"""

from __future__ import annotations

import os

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.errors import FormatError
from gsvis.files.limits import read_whole

__all__ = ["read_bandwidth_text"]

F64 = NDArray[np.float64]

_MOST = 1e6  # Mbit/s, and a year of seconds is below 1e8
_LONGEST = 1e9


def read_bandwidth_text(path: str | os.PathLike[str]) -> tuple[F64, F64]:
    """Read a trace.

    Returns:
        times: (S,) seconds > 0, strictly rising, the end of each rate.
        mbit_per_s: (S,) rates.

    Raises:
        FileNotFoundError: If there is no file.
        FormatError: If a line is not two numbers, times do not rise, a rate is out of range, or no line remains.
    """
    path = _check.path("path", path)
    data = read_whole(path)
    times: list[float] = []
    rates: list[float] = []
    latest = -1.0
    for number, line in enumerate(data.splitlines(), 1):
        cells = line.split()
        if not cells:
            continue
        where = f"line {number}"
        try:
            time, rate = (float(cell) for cell in cells)
        except ValueError as error:
            got = repr(line[:40].decode("latin-1"))
            raise FormatError(path, where, "two numbers, seconds and Mbit/s", got) from error
        if not 0.0 <= time <= _LONGEST or time <= latest:
            raise FormatError(path, where, f"seconds after {max(latest, 0.0):g}", f"{time:g}", "sort the lines by time")
        if not 0.0 <= rate <= _MOST:
            raise FormatError(path, where, f"Mbit/s in [0, {_MOST:g}]", f"{rate:g}")
        latest = time
        if time > 0.0:
            times.append(time)
            rates.append(rate)
    if not times:
        raise FormatError(path, "", "at least one line after time 0", "none", "is the file truncated?")
    return np.array(times), np.array(rates)
