"""Read colored points: COLMAP's `points3D`, a PLY, or the PLY that a `transforms.json` names.

Positions are in the frame of the file, the same as the cameras beside it; colors are sRGB in [0, 1].
"""

from __future__ import annotations

import errno
import os
from io import BufferedReader
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.errors import FormatError
from gsvis.files.limits import inside, open_regular, safe_name
from gsvis.io._ply_header import Element, PlyHeader, parse_header
from gsvis.io._ply_rows import row_chunks
from gsvis.io.colmap import find_colmap, find_colmap_points, read_colmap_points
from gsvis.io.folders import cameras_remedy
from gsvis.io.views import read_json
from gsvis.scene.points import PointCloud

__all__ = ["find_points", "load_points"]

F32 = NDArray[np.float32]

_KNOWN = "points: points3D (.bin, .txt or .ply), a PLY, or a transforms.json with ply_file_path"
_COLORS = ("red", "green", "blue")
_WHITE = {"u1": 255.0, "u2": 65535.0, "f4": 1.0, "f8": 1.0}


def load_points(path: str | PathLike[str]) -> PointCloud:
    """Read the points of a reconstruction.

    Args:
        path: A COLMAP model: its folder, one above it (`sparse/0`, `sparse` and `0` are tried), or one of its files.
            Or a PLY with x, y, z and perhaps red, green, blue (bytes, 16-bit numbers, or floats in [0, 1]). Or a
            `transforms.json` with `ply_file_path`, or its folder.

    Returns:
        The points in file order, maybe none; mid-gray if a PLY has no colors.

    Raises:
        FileNotFoundError: If there is nothing at `path`.
        FormatError: If it has no points, is truncated or malformed, or a position is not finite.

    Examples:
        >>> load_points("../shared/data/photos/bonsai")  # doctest: +SKIP
        PointCloud(51,939)
    """
    given = _check.path("path", path)
    if not given.exists():
        raise FileNotFoundError(errno.ENOENT, "no file or folder of points here", str(path))
    found = find_points(given)
    if found is None:
        raise FormatError(path, "", _KNOWN, "none", cameras_remedy(given) if given.is_dir() else "")
    if found.suffix.lower() == ".ply":
        with open_regular(found) as stream:
            return _read_ply(parse_header(found, stream, os.fstat(stream.fileno()).st_size), stream)
    positions, colors = read_colmap_points(found)
    with np.errstate(over="ignore"):  # overflow is rejected below
        means = positions.astype(np.float32)
    bad = _not_finite(means)
    if bad is not None:
        raise FormatError(found, f"point {bad:,}", "a finite position", " ".join(f"{x:g}" for x in positions[bad]))
    return PointCloud(means, colors / np.float32(255.0))


def find_points(path: Path) -> Path | None:
    """Return the file with the points of the reconstruction at `path` (see `load_points`), or None.

    Raises:
        FormatError: If a `transforms.json` is malformed, or names a file that does not exist.
    """
    if path.is_dir():
        folder = find_colmap(path)
        if folder is None and (path / "transforms.json").is_file():
            return find_points(path / "transforms.json")
        return find_colmap_points(folder or path)
    if path.suffix.lower() == ".json":
        content = read_json(path)
        name = content.get("ply_file_path") if isinstance(content, dict) else None
        if name is None:
            return None
        file = inside(path, "ply_file_path", path.parent, safe_name(path, "ply_file_path", name))
        if not file.is_file():
            raise FormatError(path, "ply_file_path", "a file beside it", f"{name!r}, which is not there")
        return file
    if path.suffix.lower() == ".ply" or path.stem == "points3D":
        return path
    return find_colmap_points(path.parent) if path.suffix in (".bin", ".txt") else None


def _read_ply(header: PlyHeader, stream: BufferedReader) -> PointCloud:
    """Return the points of a PLY."""
    vertex = header.element("vertex")
    if vertex is None:
        names = ", ".join(e.name for e in header.elements) or "none"
        raise FormatError(header.path, "header", "an element named vertex", f"elements: {names}")
    row, offset = header.rows_of(vertex)
    missing = [name for name in "xyz" if name not in vertex.properties]
    if missing:
        raise FormatError(header.path, "element vertex", "properties x, y, z", f"no {', '.join(missing)}")
    white = _white(header, vertex)
    means = np.empty((vertex.count, 3), np.float32)
    colors = np.full((vertex.count, 3), 0.5, np.float32)
    start = 0
    for rows in row_chunks(header, vertex, stream):
        some = slice(start, start + len(rows))
        with np.errstate(all="ignore"):  # a double beyond float32 becomes inf, which is rejected
            for j, name in enumerate("xyz"):
                means[some, j] = rows[name]
            if white is not None:
                for j, name in enumerate(_COLORS):
                    colors[some, j] = rows[name] / np.float32(white)
        _check_rows(header, (start, offset, row.itemsize), means[some], colors[some])
        start += len(rows)
    return PointCloud(means, colors)


def _white(header: PlyHeader, vertex: Element) -> float | None:
    """Return the value of white in the colors of a PLY; None if it has no colors."""
    assert vertex.row is not None
    have = [name for name in _COLORS if name in vertex.properties]
    if not have:
        return None
    kinds = {vertex.row[name].str[1:] for name in have}
    if len(have) < 3 or len(kinds) > 1 or not kinds <= set(_WHITE):
        got = ", ".join(f"{name} {vertex.row[name].name}" for name in have)
        expected = "red, green and blue of one type (uchar, ushort, float or double)"
        raise FormatError(header.path, "element vertex", expected, got)
    return _WHITE[kinds.pop()]


def _check_rows(header: PlyHeader, place: tuple[int, int, int], means: F32, colors: F32) -> None:
    """Raise at the first invalid position or color, with its place.

    Args:
        header: Header of the file.
        place: Number of the first row, bytes before the first row of all, bytes of a row.
        means: (R, 3) positions.
        colors: (R, 3), white is 1.
    """
    first, offset, size = place

    def where(row: int) -> str:
        """Return the place of a row in the file, as text."""
        number = first + row
        return f"row {number:,}" if header.encoding == "ascii" else f"byte {offset + number * size:,} (row {number:,})"

    bad = _not_finite(means)
    if bad is not None:
        raise FormatError(header.path, where(bad), "a finite position", " ".join(f"{x:g}" for x in means[bad]))
    outside = ~((colors >= 0.0) & (colors <= 1.0)).all(axis=1)
    if outside.any():
        row = int(outside.argmax())
        text = " ".join(f"{x:g}" for x in colors[row])
        raise FormatError(header.path, where(row), "colors from 0 to white (1 where they are floats)", text)


def _not_finite(means: NDArray[Any]) -> int | None:
    """Return the index of the first row that is not finite; None if all are."""
    bad = ~np.isfinite(means).all(axis=1)
    return int(bad.argmax()) if bad.any() else None
