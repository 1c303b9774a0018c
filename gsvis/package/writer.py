"""Write a package: first the parts, each named by the hash of its content, then the manifest.

A killed run resumes: a part that exists with the right content is not written again. The same scene gives the same
files. The store of visible sets is cut into parts without change.
"""

from __future__ import annotations

import os
from dataclasses import replace
from os import PathLike
from pathlib import Path

from gsvis import _check
from gsvis._kernels.rounding import Limits
from gsvis.color.records import QuantizedColors
from gsvis.errors import FormatError
from gsvis.files.atomic import atomic_path
from gsvis.files.limits import open_regular
from gsvis.package.blocks import write_blocks
from gsvis.package.contents import Contents
from gsvis.package.manifest import MANIFEST, Blob, Manifest, PackageInfo
from gsvis.package.package import PARTS, Package, columns_of
from gsvis.package.parts import MOST_BYTES, Part, PartFolder
from gsvis.package.rounding import rounded_contents
from gsvis.progress import Progress, silent
from gsvis.pvs.store import VisibilityStore
from gsvis.scene.content import scene_hash
from gsvis.scene.facts import SceneFacts
from gsvis.scene.levels import Levels

__all__ = ["check_target", "write_package"]

_ROWS = 1 << 14  # rows of the table of chunks in a part


def write_package(
    folder: str | PathLike[str],
    levels: Levels,
    colors: QuantizedColors | Contents,
    *,
    info: PackageInfo | None = None,
    visibility: str | PathLike[str] | None = None,
    active_terms: str | PathLike[str] | None = None,
    limits: Limits | None = None,
    progress: Progress = silent,
) -> Package:
    """Write a scene as a package.

    Args:
        folder: Folder of the package, by custom `scene.gsvis`. An older package is replaced when the new one is
            complete.
        levels: Levels in the order of a package, from `in_package_order`.
        colors: Rounded colors of their union; or the records of these levels and colors, if they are known.
        info: Up axis, meters per unit, measured cost, provenance; None means `PackageInfo()`.
        visibility: The store of visible sets of `levels.union`; None for no visible sets.
        active_terms: Lists of the active terms of these sets' cells; None computes them on request.
        limits: How to round the records; None keeps all bits. Not for records, which are written as they are.
        progress: Called with stage "package", in blocks of the scene.

    Returns:
        The open package.

    Raises:
        ValueError: If lengths do not match, the order is not that of a package, or there are records and limits.
        FormatError: If a store was built for a different scene, or the folder has other files.
        OSError: If the folder cannot be written.
    """
    target = _check.path("folder", folder)
    check_target(target)
    contents = _records_of(levels, colors, limits)
    scene = scene_hash(levels.union)
    if visibility is not None:
        VisibilityStore.open(visibility, scene=levels.union).close()
    parts = PartFolder(target / PARTS)
    blocks = tuple(write_blocks(parts, contents, progress))
    tables = []
    for start in range(0, len(contents.table), _ROWS):
        rows = slice(start, min(start + _ROWS, len(contents.table)))
        table = contents.table[rows]
        first_last = contents.chunk_levels[rows]
        tables.append((parts.write_columns("chunks", columns_of(table, first_last)), len(table)))
    sets = None if visibility is None else _write_blob(parts, _check.path("visibility", visibility))
    known = info or PackageInfo()
    manifest = Manifest(
        replace(known, facts=contents.facts) if known.facts == SceneFacts() else known,
        scene,
        levels.names,
        levels.counts,
        contents.grids,
        tuple(tables),
        blocks,
        sets,
        None if active_terms is None else _write_blob(parts, _check.path("active_terms", active_terms)),
        contents.limits,
    )
    with atomic_path(target / MANIFEST) as partial:
        partial.write_bytes(manifest.to_json())
    parts.remove_all_but(manifest.parts())
    return Package.open(target)


def _records_of(levels: Levels, colors: QuantizedColors | Contents, limits: Limits | None) -> Contents:
    """Return the records of levels; those that are given need to be as many, and are not rounded again."""
    if not isinstance(colors, Contents):
        return rounded_contents(levels, colors, limits)
    if limits is not None:
        raise ValueError("limits: expected None for records, got limits; round the records first")
    if len(colors) != len(levels.union) or colors.names != levels.names:
        expected = f"records of {len(levels.union):,} Gaussians in the levels {levels.names}"
        raise ValueError(f"colors: expected {expected}, got {len(colors):,} in {colors.names}")
    return colors


def check_target(target: Path) -> None:
    """Check that a package may be written to a folder.

    Raises:
        FormatError: If the path is a file, or a folder with other files.
    """
    if target.exists() and not target.is_dir():
        raise FormatError(target, "", "a folder, or nothing", "a file", "choose another name")
    if target.is_dir():
        others = sorted(p.name for p in target.iterdir() if p.name not in (PARTS, MANIFEST) and p.name[:1] != ".")
        if others and not (target / MANIFEST).exists():
            raise FormatError(target, "", "a package or an empty folder", f"{others[0]!r}", "choose another name")


def _write_blob(parts: PartFolder, path: Path) -> Blob:
    """Cut a file into parts, write them, and return their list."""
    found: list[Part] = []
    with open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        while block := file.read(MOST_BYTES):
            found.append(parts.write_bytes(block))
    blob = Blob(tuple(found), sum(part.nbytes for part in found))
    if blob.nbytes != size:
        raise FormatError(path, "", f"{size:,} bytes", f"{blob.nbytes:,}", "it changes while it is read")
    return blob
