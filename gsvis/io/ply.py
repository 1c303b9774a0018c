"""Read and write INRIA PLY, the format that 3DGS training writes.

One `vertex` element with raw values: x y z, f_dc_*, f_rest_* (all coefficients of red, then green, then blue),
opacity (logit), scale_* (log), rot_* (wxyz). Other columns and elements are skipped. The frame is the file's own.
"""

from __future__ import annotations

import mmap
import os
from collections.abc import Iterable, Iterator
from dataclasses import replace
from io import BytesIO
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from gsvis.errors import FormatError
from gsvis.files.atomic import atomic_path
from gsvis.files.limits import open_regular
from gsvis.io._build import LEAST_SCALE, exp_scales, gaussians_from, logits, sh0_from_rgb, sigmoid
from gsvis.io._origin import choose_origin, sample_rows
from gsvis.io._ply_columns import Columns, find_columns, refuse_other_kinds
from gsvis.io._ply_comments import comments_of, facts_of
from gsvis.io._ply_header import Element, PlyHeader, parse_header
from gsvis.io._ply_rows import CHUNK_BYTES, read_rows, row_chunks
from gsvis.io.compressed_ply import is_compressed, read_compressed
from gsvis.io.losses import report_loss, report_note
from gsvis.scene.facts import SceneFacts
from gsvis.scene.gaussians import Gaussians

__all__ = ["load_ply", "ply_rows", "read_ply", "sample_ply", "save_ply", "save_ply_parts"]

F32 = NDArray[np.float32]
_MEANS = ("x", "y", "z")
_SH0 = ("f_dc_0", "f_dc_1", "f_dc_2")
_SCALES = ("scale_0", "scale_1", "scale_2")
_QUATS = ("rot_0", "rot_1", "rot_2", "rot_3")
_SH_DEGREE = 3


def load_ply(path: str | os.PathLike[str], *, rows: tuple[int, int] | None = None) -> Gaussians:
    """Read a PLY of Gaussians, plain or compressed (PlayCanvas).

    Centers too far from (0, 0, 0) for float32 are kept relative to an origin, see `SceneFacts.origin`. It is chosen
    from the whole file, even if only some rows are read. The 3D filter of Mip-Splatting is applied to scales and
    opacities.

    Args:
        path: The file.
        rows: First row, and the row after the last, if `ply_rows` can count the rows of the file; None reads all.

    Returns:
        The scene, in the file's order and frame.

    Raises:
        FormatError: If the file is not such a PLY, is truncated, or has invalid values.
        OSError: If it cannot be opened.
    """
    with open_regular(path) as stream:
        return read_ply(path, stream, os.fstat(stream.fileno()).st_size, rows=rows)


def read_ply(
    path: str | os.PathLike[str], stream: BinaryIO, size: int, *, rows: tuple[int, int] | None = None
) -> Gaussians:
    """Read a PLY from a stream; see `load_ply`.

    Args:
        path: The file, for messages.
        stream: Binary stream that can seek, at its start.
        size: Bytes in the stream.
        rows: As for `load_ply`.

    Raises:
        FormatError: As `load_ply`.
    """
    header = parse_header(path, stream, size)
    if is_compressed(header):
        return read_compressed(header, stream)
    vertex, columns = _find(header)
    facts = _facts(header, vertex, columns, stream)
    if rows is None or rows[0] == 0:
        _report(header.path, columns, facts)
    part = header if rows is None else _cut_header(header, *rows)
    return _read(part, columns, facts, stream)


def sample_ply(path: str | os.PathLike[str], most: int) -> tuple[Gaussians, int] | None:
    """Read rows spread evenly over a binary PLY of Gaussians that has more of them; None for any other file.

    Args:
        path: The file.
        most: Number of rows to read.

    Returns:
        The Gaussians of these rows, and the number of all rows.

    Raises:
        FormatError: As `load_ply`; values of other rows are not checked.
        OSError: If it cannot be opened.
    """
    with open_regular(path) as file:
        header = parse_header(path, file, os.fstat(file.fileno()).st_size)
        if header.encoding == "ascii" or is_compressed(header):
            return None
        vertex, columns = _find(header)
        if vertex.count <= most:
            return None
        row, offset = header.rows_of(vertex)
        facts = _facts(header, vertex, columns, file)
        places = np.linspace(0, vertex.count - 1, most).astype(np.int64)
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as mapped:
            plain = np.ndarray((vertex.count,), np.dtype((np.void, row.itemsize)), mapped, offset)  # no field by field
            some = replace(header, elements=(replace(vertex, count=most, offset=0),))
            return _read(some, columns, facts, _SomeRows(plain, places)), vertex.count


class _SomeRows(BytesIO):
    """A stream of some rows of a file; no more of them are in memory than are read at a time.

    Args:
        rows: (N,) rows of the file, as bytes.
        places: (M,) which of them are read, in their order.
    """

    def __init__(self, rows: NDArray[np.void], places: NDArray[np.int64]) -> None:
        super().__init__()
        self._rows = rows
        self._places = places
        self._at = 0

    def readinto(self, buffer: Any) -> int:
        """Fill a buffer of whole rows with the next ones; return the bytes that are read."""
        into = np.frombuffer(buffer, self._rows.dtype)
        some = self._places[self._at : self._at + len(into)]
        self._rows.take(some, mode="clip", out=into[: len(some)])
        self._at += len(some)
        return len(some) * self._rows.itemsize


def _find(header: PlyHeader) -> tuple[Element, Columns]:
    """Return the element of the Gaussians, and its columns.

    Raises:
        FormatError: If the file holds none, or is truncated.
    """
    vertex = header.element("vertex")
    if vertex is None:
        names = ", ".join(e.name for e in header.elements) or "none"
        raise FormatError(header.path, "header", "an element named vertex", f"elements: {names}")
    refuse_other_kinds(header, vertex)
    header.rows_of(vertex)
    columns = find_columns(header.path, vertex)
    if vertex.count == 0:
        raise FormatError(
            header.path, "element vertex", "at least one Gaussian", "none", "the file holds an empty scene"
        )
    return vertex, columns


def ply_rows(path: str | os.PathLike[str], stream: BinaryIO) -> tuple[int, int] | None:
    """Return the number of rows of a binary PLY of Gaussians and the bytes of a row; None for other kinds of PLY.

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


def _cut_header(header: PlyHeader, start: int, stop: int) -> PlyHeader:
    """Return a header for some of the rows.

    Raises:
        FormatError: If the file has fewer rows.
    """
    vertex = header.element("vertex")
    if vertex is None or vertex.row is None or vertex.offset is None or not 0 <= start < stop <= vertex.count:
        got = f"{0 if vertex is None else vertex.count:,}"
        raise FormatError(header.path, "element vertex", f"rows {start:,} to {stop:,}", got, "did the file change?")
    some = replace(vertex, count=stop - start, offset=vertex.offset + start * vertex.row.itemsize)
    return replace(header, elements=tuple(some if each is vertex else each for each in header.elements))


def _facts(header: PlyHeader, vertex: Element, columns: Columns, stream: BinaryIO) -> SceneFacts:
    """Return the facts that the comments state, with the origin that the centers need."""
    facts = facts_of(header.comments)
    if columns.filter:  # Mip-Splatting always compensates opacities
        facts = replace(facts, antialiased=True)
    if any(facts.origin):
        return facts
    rows = read_rows(header, vertex, stream, sample_rows(vertex.count))
    with np.errstate(all="ignore"):
        means = np.stack([rows[name].astype(np.float64) for name in columns.means], axis=1)
        scales = np.exp(np.stack([rows[name].astype(np.float64) for name in columns.scales], axis=1))
    scales = np.pad(scales, ((0, 0), (0, 3 - scales.shape[1])))
    return replace(facts, origin=choose_origin(means, scales, double=_is_double(vertex, columns)))


def _is_double(vertex: Element, columns: Columns) -> bool:
    """Return whether the file stores centers in double precision."""
    assert vertex.row is not None
    return any(vertex.row[name].itemsize > 4 or vertex.row[name].kind in "iu" for name in columns.means)


def _report(path: str, columns: Columns, facts: SceneFacts) -> None:
    """Log what is not kept as in the file."""
    if columns.degree > _SH_DEGREE:
        report_loss(path, "SH", f"SH degree {columns.degree} is reduced to {_SH_DEGREE}; gsvis keeps degrees 0 to 3")
    if columns.filter:
        report_note(
            path, f"the 3D filter of Mip-Splatting ({columns.filter}) is applied to scales and opacities; antialiased"
        )
    if any(facts.origin):
        x, y, z = facts.origin
        report_note(path, f"centers are kept relative to the origin ({x:.12g}, {y:.12g}, {z:.12g})")


def _read(header: PlyHeader, columns: Columns, facts: SceneFacts, stream: BinaryIO) -> Gaussians:
    """Return the Gaussians of all rows."""
    vertex = header.element("vertex")
    assert vertex is not None
    n = vertex.count
    means = np.empty((n, 3), np.float64 if any(facts.origin) else np.float32)
    quats = np.empty((n, 4), np.float32)
    scales = np.empty((n, len(columns.scales)), np.float32)
    opacities = np.empty((n, 1), np.float32)
    sh0 = np.empty((n, 3), np.float32)
    sh_rest = np.empty((n, len(columns.higher)), np.float32)
    filters = np.empty((n, 1 if columns.filter else 0), np.float32)
    groups: list[tuple[NDArray[np.floating[Any]], tuple[str, ...]]] = [
        (means, columns.means),
        (quats, columns.quats),
        (scales, columns.scales),
        (opacities, (columns.opacity,)),
        (sh0, columns.sh0),
    ]
    groups += [(sh_rest, columns.higher)] if columns.higher else []
    groups += [(filters, (columns.filter,))] if columns.filter else []
    gather = _Gather(vertex, [names for _, names in groups])
    start = 0
    for rows in row_chunks(header, vertex, stream):
        stop = start + len(rows)
        for group, (array, _) in enumerate(groups):
            gather(rows, group, array[start:stop])
        exp_scales(scales[start:stop], out=scales[start:stop])
        sigmoid(opacities[start:stop], out=opacities[start:stop])
        start = stop
    if any(facts.origin):
        means -= np.asarray(facts.origin)
    if columns.filter:
        scales, opacities = _fuse(scales, opacities, filters)
    if scales.shape[1] == 2:
        scales = np.column_stack([scales, np.full(n, LEAST_SCALE, np.float32)])
    color = sh0[:, None, :]
    if columns.is_rgb:
        color = sh0_from_rgb(sh0 / np.float32(255.0) if _is_bytes(vertex, columns) else sh0)
    higher = sh_rest.reshape(n, -1, 3) if columns.higher else None
    with np.errstate(all="ignore"):
        return gaussians_from(
            header.path, means.astype(np.float32, copy=False), quats, scales, opacities[:, 0], color, higher, facts
        )


def _is_bytes(vertex: Element, columns: Columns) -> bool:
    """Return whether colors are stored as bytes."""
    assert vertex.row is not None
    return vertex.row[columns.sh0[0]].kind in "iu"


def _fuse(scales: F32, opacities: F32, filters: F32) -> tuple[F32, F32]:
    """Return scales and opacities with the 3D filter of Mip-Splatting applied.

    References:
        Yu et al., "Mip-Splatting: alias-free 3D Gaussian splatting", CVPR 2024, equation 9.
    """
    with np.errstate(all="ignore"):  # values that are not finite are rejected later
        own = scales.astype(np.float64)
        wide = np.sqrt(own * own + filters.astype(np.float64) ** 2)
        share = np.prod(own / wide, axis=1, keepdims=True)
        return wide.astype(np.float32), (opacities * share).astype(np.float32)


class _Gather:
    """Copy named columns of packed rows into a (rows, columns) array of floats.

    Rows that hold only float32, as in nearly all files, need one indexed copy; others need one copy per column.
    """

    def __init__(self, vertex: Element, groups: list[tuple[str, ...]]) -> None:
        assert vertex.row is not None
        self.columns = groups
        self.uniform = all(vertex.row[name] == np.dtype(np.float32) for name in vertex.properties)
        place = {name: i for i, name in enumerate(vertex.properties)}
        self.indices = [np.array([place[name] for name in group]) for group in groups]

    def __call__(self, rows: NDArray[Any], group: int, out: NDArray[np.floating[Any]]) -> None:
        if self.uniform and out.dtype == np.float32:
            values = rows.view(np.float32).reshape(len(rows), -1)
            np.take(values, self.indices[group], axis=1, out=out, mode="clip")
            return
        with np.errstate(all="ignore"):  # a double beyond float32 becomes inf, which the scene rejects
            for j, name in enumerate(self.columns[group]):
                out[:, j] = rows[name]


def save_ply(scene: Gaussians, path: str | os.PathLike[str]) -> None:
    """Write an INRIA PLY, binary little endian, in the property order of 3DGS, atomically.

    Opacities 0 and 1 have no finite logit and are written as -120 and 40, which read back as 0 and 1. Facts of the
    scene become comments. With an origin the centers are doubles in the coordinates of the source.

    Args:
        scene: The scene; its order and frame are kept.
        path: The file; its folder is created if missing.

    Raises:
        OSError: If it cannot be written.
    """
    save_ply_parts([scene], path, len(scene), scene.sh_degree, scene.facts)


def save_ply_parts(
    parts: Iterable[Gaussians],
    path: str | os.PathLike[str],
    count: int,
    sh_degree: int,
    facts: SceneFacts | None = None,
) -> None:
    """Write a scene part by part, with the same bytes as `save_ply`; memory holds one part.

    Args:
        parts: The parts, in order. A lower SH degree is padded with zeros.
        path: The file; its folder is created if missing.
        count: Number of Gaussians of all parts.
        sh_degree: Highest SH degree of all parts.
        facts: Facts for the comments; parts are moved to their origin. None writes no comments.

    Raises:
        ValueError: If the parts have more or fewer than `count` Gaussians, or a higher degree.
        OSError: If it cannot be written.
    """
    k = (sh_degree + 1) ** 2 - 1
    rest = tuple(f"f_rest_{i}" for i in range(3 * k))
    names = (*_MEANS, "nx", "ny", "nz", *_SH0, *rest, "opacity", *_SCALES, *_QUATS)
    stated = SceneFacts() if facts is None else facts
    double = any(stated.origin)
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {line}" for line in comments_of(stated)),
        f"element vertex {count}",
        *(f"property {'double' if double and p in _MEANS else 'float'} {p}" for p in names),
    ]
    left = count
    with atomic_path(path) as partial, open(partial, "wb") as stream:
        stream.write(("\n".join(lines) + "\nend_header\n").encode("ascii"))
        for part in parts:
            if len(part) > left or part.sh_degree > sh_degree:
                got = f"more, or SH degree {part.sh_degree}"
                raise ValueError(f"parts: expected {count:,} Gaussians of SH degree {sh_degree}, got {got}")
            left -= len(part)
            placed = part.with_origin(stated.origin)
            start = 0
            for table in _row_tables(placed, names, k):
                some = slice(start, start + len(table))
                stream.write(_with_doubles(placed, some, table) if double else table.data)
                start = some.stop
        if left:
            raise ValueError(f"parts: expected {count:,} Gaussians, got {count - left:,}")


def _with_doubles(scene: Gaussians, some: slice, table: F32) -> bytes:
    """Return the bytes of rows, with centers as doubles in the coordinates of the source."""
    rows = np.empty(len(table), np.dtype([("means", "<f8", (3,)), ("rest", "<f4", (table.shape[1] - 3,))]))
    rows["means"] = scene.facts.to_source(scene.means[some])
    rows["rest"] = table[:, 3:]
    return rows.tobytes()


def _row_tables(scene: Gaussians, names: tuple[str, ...], k: int) -> Iterator[NDArray[np.float32]]:
    """Yield the rows of a scene in chunks, with columns of these names; k SH coefficients above degree 0."""
    at = {name: i for i, name in enumerate(names)}
    own = scene.shN.shape[1]
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
