"""Read a scene of any size in batches: ranges of rows of a PLY, files of a streamed SOG, other formats as a whole.

Plain numbers describe a batch, so that other processes can read it. Memory holds one batch. Scene frame.
"""

from __future__ import annotations

import glob
import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from gsvis import _check
from gsvis.errors import FormatError
from gsvis.files.limits import open_regular
from gsvis.files.sums import file_sum
from gsvis.io._build import NOTHING_LEFT, report_dropped
from gsvis.io.invalid import dropping_invalid, is_dropping
from gsvis.io.ply import load_ply, ply_rows
from gsvis.io.scenes import check_scene, load_scene
from gsvis.io.streamed_sog import load_streamed_file, streamed_files
from gsvis.scene.facts import SceneFacts
from gsvis.scene.gaussians import Gaussians

__all__ = ["ROWS", "Batch", "align_batches", "facts_of_batches", "list_batches", "read_batch"]

_NO_ORIGIN = (0.0, 0.0, 0.0)

ROWS = 1 << 18
"""Largest number of rows of a batch of a PLY."""


@dataclass(frozen=True)
class Batch:
    """A part of a scene that is read in one step.

    Attributes:
        path: The scene.
        lod: Level of detail of a streamed scene; None for others.
        kind: "rows" of a PLY, "file" of a streamed SOG, or "whole".
        start: First row, or number of the file.
        count: Number of Gaussians; -1 if it is known only after reading.
        nbytes: Approximate bytes on disk.
        stamp: Digest of the content of its files, so that a batch of a changed file differs; "" if not requested.
        rows: Number of rows of a PLY to read; -1 for `count`.
        drops_invalid: Whether invalid rows are left out.
        origin: Origin that centers are relative to; None leaves that of the file.
    """

    path: str
    lod: int | None
    kind: str
    start: int
    count: int
    nbytes: int
    stamp: str
    rows: int = -1
    drops_invalid: bool = False
    origin: tuple[float, float, float] | None = None


def list_batches(path: str | os.PathLike[str], lod: int | None = None, *, stamped: bool = False) -> list[Batch]:
    """Return the batches of a scene, in the order of its Gaussians.

    Reads headers only. With `stamped` it reads all bytes, and inside `dropping_invalid` all rows of a PLY, to count the
    valid ones.

    Args:
        path: As for `load_scene`.
        lod: As for `load_scene`.
        stamped: Whether batches get stamps, which results on disk need: sizes and times alone do not identify a scene.

    Raises:
        FileNotFoundError: If there is nothing at `path`.
        FormatError: If the format is unknown, or a header is damaged.
        ValueError: If `lod` is given for a format with one level.
    """
    where = os.fspath(_check.path("path", path))
    if where.startswith("~"):  # a folder whose name begins with ~, not a home folder
        where = os.path.join(os.curdir, where)
    if check_scene(where, lod):
        level, files = streamed_files(where, lod)
        tree = os.path.join(where, "lod-meta.json") if os.path.isdir(where) else where
        found = [(number, count, *_size_and_stamp(stamped, at, tree)) for number, count, at in files]
        return [Batch(where, level, "file", *each) for each in found]
    nbytes, stamp = _size_and_stamp(stamped, where)
    rows = None
    if os.path.isfile(where):
        with open_regular(where) as stream:
            rows = ply_rows(where, stream) if stream.peek(3)[:3] == b"ply" else None
    drops = is_dropping().drops
    if rows is None:
        return [Batch(where, None, "whole", 0, -1, nbytes, stamp, drops_invalid=drops)]
    count, width = rows
    counts = [(start, min(ROWS, count - start)) for start in range(0, count, ROWS)]
    listed = [Batch(where, None, "rows", start, some, some * width, stamp) for start, some in counts]
    return _counted(listed) if drops else listed


def align_batches(scenes: Sequence[Sequence[Batch]]) -> list[list[Batch]]:
    """Return the batches of several scenes with a common origin: that of the scene with the most Gaussians.

    Reads one row of each PLY. Scenes that need no origin stay as they are.
    """
    if len(scenes) < 2:
        return [list(scene) for scene in scenes]
    origins = [_NO_ORIGIN if scene[0].kind == "file" else facts_of_batches(scene).origin for scene in scenes]
    if all(origin == origins[0] for origin in origins):
        return [list(scene) for scene in scenes]
    sizes = [sum(max(batch.count, 0) for batch in scene) for scene in scenes]
    common = origins[max(range(len(sizes)), key=sizes.__getitem__)]
    return [[replace(batch, origin=common) for batch in scene] for scene in scenes]


def facts_of_batches(batches: Sequence[Batch]) -> SceneFacts:
    """Return the facts of a scene; reads one row of a PLY, else the first batch.

    Args:
        batches: At least one batch of one scene.
    """
    first = batches[0]
    return read_batch(replace(first, count=1) if first.kind == "rows" and first.rows < 0 else first).facts


def _counted(batches: list[Batch]) -> list[Batch]:
    """Return batches of a PLY with their counts of valid rows; batches without valid rows are left out.

    Raises:
        FormatError: If no row is valid.
    """
    found = []
    dropped = 0
    for batch in batches:
        with dropping_invalid(quiet=True):
            try:
                count = len(load_ply(batch.path, rows=(batch.start, batch.start + batch.count)))
            except FormatError as error:
                if error.got != NOTHING_LEFT:
                    raise
                count = 0
        dropped += batch.count - count
        if count:
            found.append(replace(batch, count=count, rows=batch.count, drops_invalid=True))
    total = sum(batch.count for batch in batches)
    if not found:
        raise FormatError(batches[0].path, "", "at least one valid row", NOTHING_LEFT)
    if dropped and not is_dropping().quiet:
        report_dropped(batches[0].path, dropped, total)
    return found


def read_batch(batch: Batch) -> Gaussians:
    """Return the Gaussians of a batch.

    Raises:
        FormatError: If the file is damaged or has changed since it was listed.
        OSError: If it cannot be read.
    """
    with dropping_invalid(batch.drops_invalid, quiet=batch.kind == "rows"):
        found = _read(batch)
    return found if batch.origin is None else found.with_origin(batch.origin)


def _read(batch: Batch) -> Gaussians:
    """Return the Gaussians of a batch, as they are in the file."""
    if batch.kind == "file":
        return load_streamed_file(batch.path, batch.lod or 0, batch.start)
    if batch.kind == "whole":
        return load_scene(batch.path, batch.lod)
    rows = batch.count if batch.rows < 0 else batch.rows
    found = load_ply(batch.path, rows=(batch.start, batch.start + rows))
    if len(found) != batch.count and batch.rows < 0:
        raise FormatError(batch.path, f"row {batch.start:,}", f"{batch.count:,} rows", f"{len(found):,}")
    return found


def _size_and_stamp(stamped: bool, path: str | os.PathLike[str], *beside: str) -> tuple[int, str]:
    """Return the bytes of a file, or of all files in a folder, and a digest of their content and of files beside them.

    The images of a SOG lie beside its meta.json, so they count with it.
    """
    place = os.fspath(path)
    if place.lower().endswith(".gltf"):
        beside = (*beside, *sorted(glob.glob(os.path.join(glob.escape(os.path.dirname(place)), "*.bin"))))
    place = os.path.dirname(place) or os.curdir if place.lower().endswith(".json") else place
    files = [place]
    if os.path.isdir(place):
        with os.scandir(place) as entries:
            files = sorted(entry.path for entry in entries if entry.is_file())  # skips broken links
    nbytes = sum(os.stat(file).st_size for file in files)
    if not stamped:
        return nbytes, ""
    sums = [file_sum(Path(file)) for file in (*files, *beside) if os.path.isfile(file)]
    return nbytes, hashlib.sha256(" ".join(sums).encode()).hexdigest()[:16]
