"""Read and write INRIA PLY, the format that 3DGS training writes.

One `vertex` element with raw values: x y z, f_dc_*, f_rest_* (all coefficients of red, then green, then blue),
opacity (logit), scale_* (log), rot_* (wxyz). Other columns and elements are skipped. The frame is the file's own.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from dataclasses import replace
from io import BufferedReader
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.errors import FormatError
from gsvis.files.atomic import atomic_path
from gsvis.files.limits import open_regular
from gsvis.io._build import exp_scales, gaussians_from, logits, sigmoid
from gsvis.io._ply_header import Element, PlyHeader, parse_header
from gsvis.io._ply_rows import CHUNK_BYTES, row_chunks
from gsvis.io.compressed_ply import is_compressed, read_compressed
from gsvis.scene.gaussians import Gaussians

__all__ = ["load_ply", "ply_rows", "save_ply", "save_ply_parts"]

_MEANS = ("x", "y", "z")
_SH0 = ("f_dc_0", "f_dc_1", "f_dc_2")
_SCALES = ("scale_0", "scale_1", "scale_2")
_QUATS = ("rot_0", "rot_1", "rot_2", "rot_3")
_REQUIRED = (*_MEANS, *_SH0, "opacity", *_SCALES, *_QUATS)


def load_ply(path: str | os.PathLike[str], *, rows: tuple[int, int] | None = None) -> Gaussians:
    """Read a PLY of Gaussians, plain or compressed (PlayCanvas).

    Args:
        path: The file.
        rows: First row and the row after the last, of a file for which `ply_rows` counts rows; None reads all.

    Returns:
        The scene, in the file's order and frame.

    Raises:
        FormatError: If the file is not such a PLY, is truncated, or has invalid values.
        OSError: If it cannot be opened.
    """
    with open_regular(path) as stream:
        header = parse_header(path, stream, os.fstat(stream.fileno()).st_size)
        if is_compressed(header):
            return read_compressed(header, stream)
        return _read(header if rows is None else _cut(header, *rows), stream)


def ply_rows(path: str | os.PathLike[str], stream: BufferedReader) -> tuple[int, int] | None:
    """Return the number of rows of a binary PLY of Gaussians and the bytes of each; None for other kinds of PLY.

    Args:
        path: The file, for messages.
        stream: The file, opened for bytes, at its start.

    Raises:
        FormatError: If the header is damaged, or the file is too short for its rows.
    """
    header = parse_header(path, stream, os.fstat(stream.fileno()).st_size)
    vertex = header.element("vertex")
    if vertex is None or header.encoding == "ascii" or is_compressed(header):
        return None
    row, _ = header.rows_of(vertex)
    return vertex.count, row.itemsize


def _cut(header: PlyHeader, start: int, stop: int) -> PlyHeader:
    """Return the header of a file that has only some of the rows.

    Raises:
        FormatError: If the file has fewer rows.
    """
    vertex = header.element("vertex")
    if vertex is None or vertex.row is None or vertex.offset is None or not 0 <= start < stop <= vertex.count:
        got = f"{0 if vertex is None else vertex.count:,}"
        raise FormatError(header.path, "element vertex", f"rows {start:,} to {stop:,}", got, "did the file change?")
    some = replace(vertex, count=stop - start, offset=vertex.offset + start * vertex.row.itemsize)
    return replace(header, elements=tuple(some if each is vertex else each for each in header.elements))


def _read(header: PlyHeader, stream: BufferedReader) -> Gaussians:
    vertex = header.element("vertex")
    if vertex is None:
        names = ", ".join(e.name for e in header.elements) or "none"
        raise FormatError(header.path, "header", "an element named vertex", f"elements: {names}")
    _refuse_other_kinds(header, vertex)
    header.rows_of(vertex)
    higher = _higher_columns(header.path, vertex)
    n = vertex.count
    if n == 0:
        raise FormatError(
            header.path, "element vertex", "at least one Gaussian", "none", "the file holds an empty scene"
        )
    means, quats, scales = (np.empty((n, k), np.float32) for k in (3, 4, 3))
    opacities = np.empty((n, 1), np.float32)
    sh0, sh_rest = np.empty((n, 3), np.float32), np.empty((n, len(higher)), np.float32)
    groups = [(means, _MEANS), (quats, _QUATS), (scales, _SCALES), (opacities, ("opacity",)), (sh0, _SH0)]
    groups += [(sh_rest, higher)] if higher else []
    gather = _Gather(vertex, [columns for _, columns in groups])
    start = 0
    for rows in row_chunks(header, vertex, stream):
        stop = start + len(rows)
        for group, (array, _) in enumerate(groups):
            gather(rows, group, array[start:stop])
        exp_scales(scales[start:stop], out=scales[start:stop])
        sigmoid(opacities[start:stop], out=opacities[start:stop])
        start = stop
    shN = sh_rest.reshape(n, -1, 3) if higher else None
    return gaussians_from(header.path, means, quats, scales, opacities[:, 0], sh0[:, None, :], shN)


def _refuse_other_kinds(header: PlyHeader, vertex: Element) -> None:
    """Raise if the file is an ordinary PLY without Gaussians."""
    have = set(vertex.properties)
    if have & set(_REQUIRED) - set(_MEANS):
        return
    mesh = any(element.name in ("face", "tristrips") for element in header.elements)
    if mesh or set(_MEANS) <= have:
        kind = "a mesh" if mesh else "a point cloud"
        expected = f"Gaussians ({', '.join(_REQUIRED)})"
        remedy = f"this PLY is {kind}, not a trained scene"
        raise FormatError(header.path, "element vertex", expected, f"{kind} ({', '.join(sorted(have))[:200]})", remedy)


def _higher_columns(path: str, vertex: Element) -> tuple[str, ...]:
    """Return the f_rest columns in the order of `shN`: coefficient by coefficient, red, green and blue together.

    Raises:
        FormatError: If a property is missing or the number of f_rest columns fits no SH degree.
    """
    have = set(vertex.properties)
    missing = [name for name in _REQUIRED if name not in have]
    if missing:
        raise FormatError(path, "element vertex", f"properties {', '.join(_REQUIRED)}", f"no {', '.join(missing)}")
    rest = sum(name.startswith("f_rest_") and name[7:].isdecimal() for name in have)
    if rest not in (0, 9, 24, 45) or any(f"f_rest_{i}" not in have for i in range(rest)):
        raise FormatError(
            path, "element vertex", "0, 9, 24 or 45 properties f_rest_0, f_rest_1, ... (SH degree 0 to 3)", f"{rest}"
        )
    per_channel = rest // 3
    return tuple(f"f_rest_{channel * per_channel + k}" for k in range(per_channel) for channel in range(3))


class _Gather:
    """Copy named columns of packed rows into a (rows, columns) float32 array.

    Rows of float32 alone, as in nearly all files, need one indexed copy; others need one copy per column.
    """

    def __init__(self, vertex: Element, groups: list[tuple[str, ...]]) -> None:
        assert vertex.row is not None
        self.columns = groups
        self.uniform = all(vertex.row[name] == np.dtype(np.float32) for name in vertex.properties)
        place = {name: i for i, name in enumerate(vertex.properties)}
        self.indices = [np.array([place[name] for name in group]) for group in groups]

    def __call__(self, rows: NDArray[Any], group: int, out: NDArray[np.float32]) -> None:
        if self.uniform:
            values = rows.view(np.float32).reshape(len(rows), -1)
            np.take(values, self.indices[group], axis=1, out=out, mode="clip")
            return
        with np.errstate(all="ignore"):  # a double beyond float32 becomes inf, which the scene rejects
            for j, name in enumerate(self.columns[group]):
                out[:, j] = rows[name]


def save_ply(scene: Gaussians, path: str | os.PathLike[str]) -> None:
    """Write an INRIA PLY, binary little endian, in the property order of 3DGS, atomically.

    Opacities 0 and 1 have no finite logit and are written as -120 and 40, which read back as 0 and 1.

    Args:
        scene: The scene; its order and frame are kept.
        path: The file; its folder is created if missing.

    Raises:
        OSError: If it cannot be written.
    """
    save_ply_parts([scene], path, len(scene), scene.sh_degree)


def save_ply_parts(parts: Iterable[Gaussians], path: str | os.PathLike[str], count: int, sh_degree: int) -> None:
    """Write the parts of a scene one after the other, as `save_ply` writes the whole; memory holds one part.

    Args:
        parts: The parts, in order. A lower SH degree is padded with zeros.
        path: The file; its folder is created if missing.
        count: Gaussians of all parts.
        sh_degree: Highest SH degree of all parts.

    Raises:
        ValueError: If the parts have other Gaussians than `count` says, or a higher degree.
        OSError: If it cannot be written.
    """
    k = (sh_degree + 1) ** 2 - 1
    rest = tuple(f"f_rest_{i}" for i in range(3 * k))
    names = (*_MEANS, "nx", "ny", "nz", *_SH0, *rest, "opacity", *_SCALES, *_QUATS)
    lines = [
        "ply", "format binary_little_endian 1.0", f"element vertex {count}", *(f"property float {p}" for p in names)
    ]  # fmt: skip
    left = count
    with atomic_path(path) as partial, open(partial, "wb") as stream:
        stream.write(("\n".join(lines) + "\nend_header\n").encode("ascii"))
        for part in parts:
            if len(part) > left or part.sh_degree > sh_degree:
                got = f"more, or SH degree {part.sh_degree}"
                raise ValueError(f"parts: expected {count:,} Gaussians of SH degree {sh_degree}, got {got}")
            left -= len(part)
            for table in _tables(part, names, k):
                stream.write(table.data)
        if left:
            raise ValueError(f"parts: expected {count:,} Gaussians, got {count - left:,}")


def _tables(scene: Gaussians, names: tuple[str, ...], k: int) -> Iterator[NDArray[np.float32]]:
    """Yield the rows of a scene in columns of these names, some at a time; k SH coefficients above degree 0."""
    at, own = {name: i for i, name in enumerate(names)}, scene.shN.shape[1]
    per_chunk = max(1, CHUNK_BYTES // (4 * len(names)))
    for start in range(0, len(scene), per_chunk):
        some = slice(start, min(start + per_chunk, len(scene)))
        table = np.zeros((some.stop - start, len(names)), "<f4")
        table[:, 0:3] = scene.means[some]
        table[:, at["f_dc_0"] : at["f_dc_0"] + 3] = scene.sh0[some, 0]
        higher = np.zeros((len(table), 3, k), np.float32)
        higher[:, :, :own] = scene.shN[some].transpose(0, 2, 1)
        table[:, at["f_dc_0"] + 3 : at["opacity"]] = higher.reshape(len(table), 3 * k)
        table[:, at["opacity"]] = logits(scene.opacities[some])
        table[:, at["scale_0"] : at["scale_0"] + 3] = np.log(scene.scales[some].astype(np.float64))
        table[:, at["rot_0"] :] = scene.quats[some]
        yield table
