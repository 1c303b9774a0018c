"""Read and write quality levels as a folder: one PLY per level for any viewer, and a map that joins them.

`levels.arrow` has a row for each Gaussian of the union: its levels, and its scales and opacity, because a PLY stores
only logarithms and logits. Loading returns exactly what was saved, bit by bit. Frame and units are the scene's.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from gsvis import _check
from gsvis.errors import ArgumentError, FormatError
from gsvis.files.arrow import ArrowFile, write_arrow
from gsvis.files.atomic import atomic_folder, find_interrupted_moves
from gsvis.files.fields import Fields
from gsvis.files.limits import Budget, digest_of, safe_name
from gsvis.io.ply import load_ply, save_ply_parts
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels

__all__ = ["MAP", "LevelsInfo", "check_levels_target", "check_names", "levels_info", "load_levels", "save_levels"]

MAP = "levels.arrow"
"""File name of the map."""

FORMAT = "gsvis-levels"
VERSION = 1
_ROWS = 1 << 16
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")
_AGAIN = "write the levels again"
_FIELDS = [
    pa.field("first_level", pa.uint8(), nullable=False),
    pa.field("last_level", pa.uint8(), nullable=False),
    pa.field("scales", pa.list_(pa.field("item", pa.float32(), nullable=False), 3), nullable=False),
    pa.field("opacity", pa.float32(), nullable=False),
]


@dataclass(frozen=True)
class LevelsInfo:
    """Contents of the map of a folder of levels.

    Attributes:
        names: Names of the L levels, lowest first.
        files: Names of their PLYs inside the folder.
        counts: Number of Gaussians of each.
        digests: SHA-256 of each PLY, hexadecimal.
        gaussians: N of the union.
        extra: JSON values stored with them, as given to `save_levels`.
    """

    names: tuple[str, ...]
    files: tuple[str, ...]
    counts: tuple[int, ...]
    digests: tuple[str, ...]
    gaussians: int
    extra: dict[str, Any]


def check_names(names: Sequence[str]) -> None:
    """Raise if names of levels cannot become names of files.

    Raises:
        ValueError: If one is not a file name, two differ only in case, or there are more than 16.
    """
    for name in names:
        if not _NAME.fullmatch(name):
            raise ValueError(f"names: expected letters, digits, - and _, got {name!r}; it becomes the name of a file")
    if len({name.lower() for name in names}) < len(names):
        raise ValueError(f"names: expected names that differ in more than case, got {tuple(names)!r}")
    if len(names) > 16:
        raise ValueError(f"names: expected at most 16, got {len(names)}")


def save_levels(levels: Levels, folder: str | os.PathLike[str], extra: Mapping[str, Any] | None = None) -> None:
    """Write `NAME.ply` for each level, its Gaussians in the order of the union, and the map.

    All files are written beside the folder and replace an older result at the end: in one step if the system can, else
    the map last. Other files in the folder stay.

    Args:
        levels: The levels.
        folder: The folder; created if missing.
        extra: JSON values to store in the map.

    Raises:
        ValueError: If the name of a level is not a file name, two differ only in case, or `extra` is not JSON.
        OSError: If the folder cannot be written.
    """
    check_names(levels.names)
    try:
        kept = json.loads(json.dumps(dict(extra or {}), allow_nan=False))
    except (TypeError, ValueError) as error:
        raise ValueError(f"extra: expected JSON values, got {error}") from error
    union = levels.union
    with atomic_folder(folder, last=(MAP,)) as partial:
        rows = []
        for k, name in enumerate(levels.names):
            path = partial / f"{name}.ply"
            save_ply_parts(_parts_of(levels, k), path, levels.counts[k], union.sh_degree, union.facts)
            digest = digest_of(path)
            rows.append({"name": name, "file": f"{name}.ply", "count": levels.counts[k], "sha256": digest})
        header = {
            "format": FORMAT,
            "version": VERSION,
            "gaussians": len(levels.union),
            "levels": rows,
            "extra": kept,
        }
        write_arrow(partial / MAP, _FIELDS, header, _batches(levels))


def load_levels(folder: str | os.PathLike[str]) -> Levels:
    """Read a folder of `save_levels`: the same union, in the same order, bit by bit.

    Args:
        folder: The folder.

    Raises:
        FormatError: If the map is damaged or has a newer version, or a PLY is missing or has changed.
        OSError: If the folder or its map cannot be opened.
    """
    file = ArrowFile(_check.path("folder", folder) / MAP, FORMAT, VERSION)
    info = _info(file)
    first, last, scales, opacities = _columns(file, info)
    parts: list[Gaussians] = []
    places: list[NDArray[np.int64]] = []
    for k, count in enumerate(info.counts):
        path = _check_ply(file.path, info, k)
        member = (first <= k) & (k <= last)
        if int(member.sum()) != count:
            raise FormatError(file.path, f"level {k}", f"{count:,} Gaussians", f"{int(member.sum()):,} rows of the map")
        new = first[member] == k
        if new.any():
            scene = load_ply(path)
            if len(scene) != count:
                raise FormatError(path, "", f"{count:,} Gaussians as the map says", f"{len(scene):,}", _AGAIN)
            parts.append(scene[new])
            del scene
            places.append(np.flatnonzero(member)[new])
    joined = Gaussians.concatenate(parts)
    parts.clear()
    union = joined[np.argsort(np.concatenate(places), kind="stable")]
    del joined
    try:
        exact = Gaussians(union.means, union.quats, scales, opacities, union.sh0, union.shN, facts=union.facts)
        return Levels(exact, first, last, info.names)
    except ValueError as error:
        raise FormatError(file.path, "rows", "valid values", str(error), _AGAIN) from error


def levels_info(folder: str | os.PathLike[str]) -> LevelsInfo:
    """Read the map of a folder; verify its checksum, and skip the PLYs.

    Raises:
        FormatError: If the map is damaged or has a newer version.
        OSError: If it cannot be opened.
    """
    return _info(ArrowFile(_check.path("folder", folder) / MAP, FORMAT, VERSION))


def check_levels_target(folder: str | os.PathLike[str], names: Sequence[str], what: str) -> LevelsInfo | None:
    """Raise if writing levels to a folder would replace a PLY that no map of levels knows.

    Args:
        folder: The folder, which may not exist.
        names: Names of the levels.
        what: What may be replaced, such as "levels of this scene".

    Returns:
        The map in the folder; None without.

    Raises:
        ArgumentError: If it would, or the map cannot be read; its name is "folder".
    """
    target = Path(os.path.abspath(folder))
    wanted = f"expected a new folder, or {what} to replace, got {os.fspath(folder)}"
    known = find_interrupted_moves(target)
    info = None
    if (target / MAP).exists():
        try:
            info = levels_info(target)
        except FormatError as error:
            problem = f"{wanted}, which cannot be read ({error})"
            raise ArgumentError("folder", problem, "name another, or delete it") from None
        known |= {*info.files}
    for name in names:
        if (target / f"{name}.ply").exists() and f"{name}.ply" not in known:
            problem = f"{wanted}, which has a {name}.ply that no {MAP} knows"
            raise ArgumentError("folder", problem, "name another, or move it away")
    return info


def _parts_of(levels: Levels, level: int) -> Iterator[Gaussians]:
    """Yield the Gaussians of a level, a part at a time."""
    ids = np.flatnonzero(levels.member(level))
    for start in range(0, len(ids), _ROWS):
        yield levels.union[ids[start : start + _ROWS]]


def _batches(levels: Levels) -> Iterator[pa.RecordBatch]:
    """Yield the rows of the map, a batch at a time."""
    schema = pa.schema(_FIELDS)
    union = levels.union
    for start in range(0, len(union), _ROWS):
        some = slice(start, min(start + _ROWS, len(union)))
        scales = pa.FixedSizeListArray.from_arrays(pa.array(union.scales[some].reshape(-1)), type=_FIELDS[2].type)
        columns = [pa.array(levels.first[some]), pa.array(levels.last[some]), scales, pa.array(union.opacities[some])]
        yield pa.record_batch(columns, schema=schema)


def _info(file: ArrowFile) -> LevelsInfo:
    """Return the checked contents of a map's header."""
    header = file.header
    rows = [Fields(file.path, f"levels[{k}]", row) for k, row in enumerate(header.items("levels"))]
    if not 1 <= len(rows) <= 16:
        raise FormatError(file.path, "levels", "1 to 16 levels", f"{len(rows)}")
    names = []
    files = []
    digests = []
    for row in rows:
        name = row.raw("name")
        digest = row.raw("sha256")
        if not isinstance(name, str) or name in names:
            raise FormatError(file.path, row.where("name"), "a unique name", repr(name)[:60])
        if not isinstance(digest, str) or not re.fullmatch("[0-9a-f]{64}", digest):
            raise FormatError(file.path, row.where("sha256"), "64 hexadecimal digits", repr(digest)[:80])
        names.append(name)
        files.append(safe_name(file.path, row.where("file"), row.raw("file")))
        digests.append(digest)
    counts = tuple(row.integer("count", 1, (1 << 31) - 1) for row in rows)
    total = header.integer("gaussians", 1, (1 << 31) - 1)
    return LevelsInfo(tuple(names), tuple(files), counts, tuple(digests), total, header.child("extra").value)


def _columns(file: ArrowFile, info: LevelsInfo) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Return first and last level, scales and opacities of the union."""
    file.check_schema(pa.schema(_FIELDS))
    budget = Budget(file.path, file.nbytes)
    pieces: list[list[NDArray[Any]]] = [[], [], [], []]
    for batch in file.batches(budget):
        budget.claim(batch.nbytes, "all batches together")
        for k, column in enumerate(batch.columns):
            values = column.flatten().to_numpy().reshape(-1, 3) if k == 2 else column.to_numpy()
            pieces[k].append(values)
    rows = sum(len(piece) for piece in pieces[0])
    if rows != info.gaussians:
        raise FormatError(file.path, "rows", f"{info.gaussians:,} as the header says", f"{rows:,}", _AGAIN)
    first, last, scales, opacities = (np.concatenate(piece) for piece in pieces)
    wrong = (first > last) | (last >= len(info.names))
    if wrong.any():
        k = int(np.argmax(wrong))
        expected = f"levels in order, below {len(info.names)}"
        got = f"{first[k]} to {last[k]} in row {k:,}"
        raise FormatError(file.path, "rows", expected, got, _AGAIN)
    return first, last, scales, opacities


def _check_ply(file: Path, info: LevelsInfo, level: int) -> Path:
    """Return the PLY of a level after checking its digest."""
    path = file.parent / info.files[level]  # may be a link; the digest verifies the content
    try:
        digest = digest_of(path)
    except FileNotFoundError as error:
        raise FormatError(path, "", f"the PLY of level {info.names[level]!r}", "no such file", _AGAIN) from error
    if digest != info.digests[level]:
        wanted = f"a content of SHA-256 {info.digests[level][:12]}..."
        got = f"{digest[:12]}..."
        raise FormatError(path, "", wanted, got, f"it has changed since the map was written: {_AGAIN}")
    return path
