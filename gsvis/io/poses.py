"""Read and write plain pose files, CSVs with the header `t,x,y,z,qw,qx,qy,qz`, and read all other pose formats.

Seconds, scene units, world from camera in OpenCV axes, quaternions wxyz. A file may be gzipped. Further columns are
ignored, and columns may come in any order.
"""

from __future__ import annotations

import errno
import gzip
import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.errors import FormatError
from gsvis.files.atomic import atomic_path
from gsvis.io._table import Table, join_names, read_table
from gsvis.io.eyenav import COLUMNS as EYENAV_COLUMNS
from gsvis.io.eyenav import is_eyenav, path_of_recording
from gsvis.scene.paths import HeadPath

__all__ = ["is_recording", "load_path", "read_poses", "write_poses"]

COLUMNS = ("t", "x", "y", "z", "qw", "qx", "qy", "qz")

_ROUNDING = 0.1  # tolerance on the length of a quaternion


def load_path(path: str | os.PathLike[str]) -> HeadPath:
    """Read a head path of any known format, detected from its header.

    Args:
        path: A plain pose file (`read_poses`) or an EyeNavGS recording (`read_eyenav`), gzipped or not.

    Returns:
        The path; `up` and `meters_per_unit` are set if the format states them.

    Raises:
        FileNotFoundError: If there is no file.
        FormatError: If it is none of the formats, or malformed.
    """
    table = _open(path)
    if is_eyenav(table):
        return path_of_recording(table)
    if not set(COLUMNS) & set(table.header):
        known = f"columns {','.join(COLUMNS)} or those of EyeNavGS ({', '.join(EYENAV_COLUMNS)}, Timestamp or timestep)"
        raise FormatError(path, f"line {table.lines[0]}", known, join_names(table.header))
    return _path_of(table)


def is_recording(path: str | os.PathLike[str]) -> bool:
    """Return whether a file holds a recorded person: true for EyeNavGS recordings, false for plain pose files.

    Raises:
        FileNotFoundError: If there is no file.
        FormatError: If the file is not a table.
    """
    return is_eyenav(_open(path))


def read_poses(path: str | os.PathLike[str]) -> HeadPath:
    """Read a plain pose file; the first time becomes 0.

    Raises:
        FileNotFoundError: If there is no file.
        FormatError: If a column is missing, a cell is not a finite number, times do not rise, or a quaternion's
            length is not 1 within 0.1.
    """
    return _path_of(_open(path))


def write_poses(poses: HeadPath, path: str | os.PathLike[str]) -> None:
    """Write a path as a plain pose file, atomically; reading it returns the same numbers.

    Args:
        poses: The path. Its `up` and `meters_per_unit` are not stored.
        path: The file; gzipped if its name ends in `.gz`.
    """
    values = np.column_stack([poses.times, poses.positions, poses.quats])
    lines = [",".join(COLUMNS), *(",".join(repr(float(v)) for v in row) for row in values), ""]
    data = "\n".join(lines).encode("ascii")
    if Path(path).suffix == ".gz":
        data = gzip.compress(data, mtime=0)
    with atomic_path(path) as partial:
        partial.write_bytes(data)


def _open(path: str | os.PathLike[str]) -> Table:
    """Return the table in a file."""
    path = _check.path("path", path)
    if path.is_dir():
        raise FormatError(path, "", "a file of poses", "a folder", "name one of the files in it")
    if not path.exists():
        raise FileNotFoundError(errno.ENOENT, "no pose file here", str(path))
    return read_table(path)


def _path_of(table: Table) -> HeadPath:
    """Return the path of a plain pose file."""
    values = table.numbers(COLUMNS)
    if len(values) == 0:
        raise FormatError(table.path, f"line {table.lines[0] + 1}", "at least one pose", "the end of the file")
    times = values[:, 0] - values[0, 0]
    quats = values[:, 4:]
    _check_times(table, times)
    with np.errstate(over="ignore"):
        lengths = np.linalg.norm(quats, axis=1)
    bad = np.flatnonzero(np.abs(lengths - 1.0) > _ROUNDING)
    if len(bad):
        remedy = "are these quaternions, in the order wxyz?"
        where = table.where(int(bad[0]), "qw to qz")
        raise FormatError(table.path, where, "a quaternion of length 1", f"length {lengths[bad[0]]:.3g}", remedy)
    return HeadPath(times, values[:, 1:4], quats)


def _check_times(table: Table, times: NDArray[np.float64]) -> None:
    """Raise unless times rise."""
    back = np.flatnonzero(np.diff(times) <= 0)
    if len(back):
        row = int(back[0]) + 1
        cell = table.column("t")
        before, after = (table.rows[i][cell].strip()[:40] for i in (row - 1, row))
        remedy = "sort the poses by time and drop repeats"
        raise FormatError(table.path, table.where(row, "t"), f"a time after {before}", after, remedy)
