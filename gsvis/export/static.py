"""Write the static form of a scene: files that a page reads by byte ranges, from any file server.

docs/static.md describes the files to the byte. Names of data files contain the hash of their content, so the files
never change and may be cached forever. `scene.json` lists them and is written last, so a reader sees either the old
scene or the new one. The same scene gives the same files. A killed run resumes, because complete files are not written
again.
"""

from __future__ import annotations

import hashlib
import json
import re
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.color.records import Grids
from gsvis.errors import FormatError
from gsvis.export.bare import BareScene, encode_scene
from gsvis.export.blocks import BLOCK, Blocks
from gsvis.export.cells import CellRows, gains_of_package, replaced_rows, rows_of_package, rows_of_scene
from gsvis.export.coded import code_records, code_terms, in_order, pack_records
from gsvis.export.columns import column, compress
from gsvis.export.index import Spheres, index_of
from gsvis.export.layers import LAYERS, items_of
from gsvis.export.start import Start, start_poses
from gsvis.files.atomic import atomic_path, remove_all_partials
from gsvis.files.fields import parse_json
from gsvis.files.limits import digest_of, read_whole
from gsvis.package.layout import RECORD_BYTES, TermLayout
from gsvis.package.package import Package
from gsvis.progress import Progress, silent
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.floor import floor_of_cells
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels
from gsvis.stream.coding import Coding

__all__ = [
    "FORMAT",
    "SCENE",
    "VERSION",
    "StaticFile",
    "StaticOptions",
    "StaticScene",
    "check_target",
    "remove_other_files",
    "write_static",
]

U8 = NDArray[np.uint8]

FORMAT = "gsvis-static"
VERSION = 3
SCENE = "scene.json"
KINDS = ("index", "grid", "cells", "records", "blocks", "terms", "harmonics", "facts")
"""Files of a scene besides `scene.json`, in the order in which a page needs them."""

_OURS = re.compile(rf"(?:{'|'.join(KINDS)}|replaced)-[0-9a-f]{{16}}\.bin")  # version 2 had one more file
_MOST_JSON = 16 << 20


@dataclass(frozen=True)
class StaticFile:
    """A data file.

    Attributes:
        name: Its name, with the first digits of the hash.
        nbytes: Its size.
        sha256: Hash of its content, 64 hexadecimal digits.
    """

    name: str
    nbytes: int
    sha256: str


@dataclass(frozen=True)
class StaticOptions:
    """Facts that a static scene states besides its Gaussians.

    Attributes:
        name: Name for people.
        up: (3,) axis that points upwards; None means that of the package, or +z.
        meters_per_unit: Meters in a scene unit, 0 if unknown; None means that of the package, or 0.
        poses: Start views, the first one initially; None takes those of the package, or finds some.

    Raises:
        ValueError: If a number is out of its range.
    """

    name: str = "scene"
    up: tuple[float, float, float] | None = None
    meters_per_unit: float | None = None
    poses: tuple[Start, ...] | None = None

    def __post_init__(self) -> None:
        if self.up is not None:
            _check.unit_vectors("up", np.reshape(np.asarray(self.up, np.float64), (1, -1)))
        if self.meters_per_unit is not None and not 0.0 <= self.meters_per_unit < np.inf:
            raise ValueError(f"meters_per_unit: expected a finite number >= 0, got {self.meters_per_unit!r}")


@dataclass(frozen=True)
class StaticScene:
    """Result of `write_static`.

    Attributes:
        path: The folder.
        files: The data files by what they hold, a part of `KINDS`.
        gaussians: N, the number of Gaussians.
        terms: T, the number of terms.
        blocks: Number of blocks.
        cells: Number of cells, 1 without visible sets.
        sh_degree: Degree of the harmonics, 0 for a package.
    """

    path: Path
    files: dict[str, StaticFile] = field(repr=False)
    gaussians: int
    terms: int
    blocks: int
    cells: int
    sh_degree: int

    @property
    def nbytes(self) -> int:
        """Bytes of all data files."""
        return sum(file.nbytes for file in self.files.values())


def write_static(
    folder: str | PathLike[str],
    scene: Package | Levels | Gaussians,
    options: StaticOptions | None = None,
    *,
    progress: Progress = silent,
) -> StaticScene:
    """Write the static form of a package or of a bare scene.

    Args:
        folder: Folder of the scene. An older scene in it is replaced when the new one is complete.
        scene: A package; or Gaussians or levels of any SH degree, which are rounded to records here.
        options: Name, frame, views to begin with; None means `StaticOptions()`.
        progress: Called with stages "order", "sets" and "export".

    Raises:
        ValueError: If the scene is empty.
        FormatError: If the folder holds something else, or the package is damaged.
        OSError: If the folder cannot be written.
    """
    target = _check.path("folder", folder)
    said = options or StaticOptions()
    check_target(target)
    parts = _package_parts(scene, said, progress) if isinstance(scene, Package) else _bare_parts(scene, progress)
    if parts.blocks.starts[-1] == 0:
        raise ValueError("scene: expected at least one Gaussian, got none; name another scene")
    target.mkdir(parents=True, exist_ok=True)
    remove_all_partials(target)
    files = {}
    contents = parts.contents
    progress("export", 0, len(contents))
    for k, (kind, data) in enumerate(contents.items()):
        files[kind] = _keep(target, kind, data)
        progress("export", k + 1, len(contents))
    document = _document(parts, files, said)
    with atomic_path(target / SCENE) as partial:
        partial.write_bytes(json.dumps(document, sort_keys=True, separators=(",", ":"), allow_nan=False).encode())
    degree = 0 if parts.harmonics is None else parts.harmonics["degree"]
    found = StaticScene(
        target, files, document["gaussians"], document["terms"], len(parts.blocks), document["cells"]["count"], degree
    )
    remove_other_files(found)
    return found


def check_target(target: Path) -> None:
    """Raise unless a folder can take a static scene.

    Raises:
        FormatError: If the path holds something else.
    """
    if target.exists() and not target.is_dir():
        raise FormatError(target, "", "a folder, or nothing", "a file", "choose another name")
    if not target.is_dir():
        return
    others = sorted(p.name for p in target.iterdir() if not _OURS.fullmatch(p.name) and p.name[:1] != ".")
    if others and not is_static(target):
        raise FormatError(target, "", "a static scene or an empty folder", f"{others[0]!r}", "choose another name")


def is_static(folder: Path) -> bool:
    """Return whether a folder holds a static scene."""
    with suppress(OSError, FormatError):
        found = parse_json(folder / SCENE, read_whole(folder / SCENE, _MOST_JSON))
        return isinstance(found, dict) and found.get("format") == FORMAT
    return False


@dataclass(frozen=True, eq=False)
class _Parts:
    """The content of a static scene before it is written."""

    blocks: Blocks
    cells: CellRows
    contents: dict[str, Any]
    grids: Grids
    levels: tuple[tuple[str, int], ...]
    chunks: int
    terms: int
    harmonics: dict[str, Any] | None
    spheres: Spheres
    coding: Coding | None
    bounds: NDArray[np.float64]
    up: tuple[float, ...] = (0.0, 0.0, 1.0)
    meters_per_unit: float = 0.0
    poses: tuple[Start, ...] = ()
    antialiased: bool = False


def _package_parts(package: Package, options: StaticOptions, progress: Progress) -> _Parts:
    """Return the content of the static form of a package."""
    contents = package.contents
    manifest = package.manifest
    table = contents.table
    g = contents.gaussians()
    blocks = Blocks.from_chunks(table, contents.chunk_levels, gains_of_package(package, g))
    items = items_of(contents, blocks)
    cells = rows_of_package(package, g, blocks, items, progress)
    placed = in_order(contents, blocks.ids)
    spheres = Spheres.from_chunks(table, g)
    coding = Coding.from_contents(placed)
    replaced = replaced_rows(Levels(g, contents.first, contents.last, contents.names), blocks)
    records = code_records(placed, blocks, coding, replaced)
    data: dict[str, Any] = {
        "index": index_of(spheres, table, contents.chunk_levels, records.sizes),
        "grid": cells.index(),
        "cells": b"".join(cells.rows),
        "records": records.data,
    }
    if manifest.terms:
        terms = code_terms(contents, blocks, coding, items)
        data["blocks"] = compress(column(terms.sizes, 2))
        data["terms"] = terms.data
    if manifest.visibility is not None:
        meters = options.meters_per_unit
        meters = manifest.info.meters_per_unit if meters is None else meters
        data["facts"] = _facts(package.visibility.grid, meters)
    levels = tuple(zip(manifest.names, manifest.counts, strict=True))
    return _Parts(
        blocks,
        cells,
        data,
        manifest.grids,
        levels,
        len(table),
        manifest.terms,
        None,
        spheres,
        coding,
        g.bounds(0.9),
        manifest.info.up,
        manifest.info.meters_per_unit,
        tuple(Start.from_dict(view) for view in manifest.views),
        manifest.info.facts.antialiased,
    )


def _facts(grid: CellGrid, meters_per_unit: float) -> bytes:
    """Return the content of `facts`: cells and floor, as a server states them."""
    cells = {"origin": grid.origin.tolist(), "size": grid.cell_size, "boxes": grid.coords.tolist()}
    said = {"cells": cells, "floor": floor_of_cells(grid, meters_per_unit)}
    return compress(json.dumps(said, separators=(",", ":"), allow_nan=False).encode())


def _bare_parts(scene: Levels | Gaussians, progress: Progress) -> _Parts:
    """Return the content of the static form of a bare scene."""
    if len(scene.union if isinstance(scene, Levels) else scene) == 0:
        raise ValueError("scene: expected at least one Gaussian, got none; name another scene")
    levels = scene if isinstance(scene, Levels) else Levels.single(scene)
    progress("order", 0, 1)
    found: BareScene = encode_scene(levels)
    progress("order", 1, 1)
    blocks = Blocks.from_chunks(found.table, found.chunk_levels)
    ids = found.ids[blocks.order]
    g = found.gaussians
    cells = rows_of_scene(g, blocks)
    spheres = Spheres.from_chunks(found.table, g)
    placed = Levels(g, levels.first[found.ids], levels.last[found.ids], levels.names)
    replaced = replaced_rows(placed, blocks)
    records = pack_records(found.table, blocks, found.records[blocks.order], replaced)
    data: dict[str, Any] = {
        "index": index_of(spheres, found.table, found.chunk_levels, records.sizes),
        "grid": cells.index(),
        "cells": b"".join(cells.rows),
        "records": records.data,
    }
    harmonics = found.harmonics
    if harmonics is not None:
        data["harmonics"] = harmonics.encode(levels.union.shN, ids)
    counts = tuple(zip(levels.names, levels.counts, strict=True))
    said = None if harmonics is None else harmonics.as_dict()
    return _Parts(
        blocks,
        cells,
        data,
        found.grids,
        counts,
        len(found.table),
        0,
        said,
        spheres,
        None,
        g.bounds(0.9),
        antialiased=g.facts.antialiased,
    )


def _keep(folder: Path, kind: str, data: Any) -> StaticFile:
    """Write a data file atomically, unless it exists."""
    flat = np.frombuffer(data, np.uint8) if isinstance(data, bytes) else np.ascontiguousarray(data).view(np.uint8)
    whole = flat.reshape(-1).data
    digest = hashlib.sha256(whole).hexdigest()
    file = StaticFile(f"{kind}-{digest[:16]}.bin", whole.nbytes, digest)
    target = folder / file.name
    with suppress(OSError, FormatError):
        if target.stat().st_size == file.nbytes and digest_of(target) == digest:
            return file
    with atomic_path(target, sweep=False) as partial:
        partial.write_bytes(whole)
    return file


def remove_other_files(scene: StaticScene) -> None:
    """Remove the data files of earlier scenes from the folder of a scene."""
    kept = {file.name for file in scene.files.values()}
    for path in scene.path.iterdir():
        if _OURS.fullmatch(path.name) and path.name not in kept:
            with suppress(OSError):
                path.unlink()


def _document(parts: _Parts, files: dict[str, StaticFile], options: StaticOptions) -> dict[str, Any]:
    """Return the content of `scene.json`."""
    layout = TermLayout.from_grids(parts.grids)
    grid = parts.cells.grid
    up = parts.up if options.up is None else options.up
    named = [files[kind].sha256 for kind in sorted(files)]
    poses = parts.poses or start_poses(parts.bounds, grid, up) if options.poses is None else options.poses
    spelled = json.dumps([named, asdict(parts.grids), parts.levels, parts.harmonics], sort_keys=True)
    drawn = {"antialiased": True} if parts.antialiased else {}
    return {
        "format": FORMAT,
        "version": VERSION,
        **drawn,
        "name": options.name,
        "gaussians": int(parts.blocks.starts[-1]),
        "terms": parts.terms,
        "chunks": parts.chunks,
        "places": parts.spheres.as_dict(),
        "code": None if parts.coding is None else parts.coding.tables.to_text(),
        "steps": None,
        "blocks": len(parts.blocks),
        "block_gaussians": BLOCK,
        "term_layers": LAYERS,
        "levels": [{"name": name, "count": int(count)} for name, count in parts.levels],
        "record_bytes": RECORD_BYTES,
        "term_bits": int(layout.widths.sum()),
        "term_bytes": layout.nbytes,
        "colors": asdict(parts.grids),
        "harmonics": parts.harmonics,
        "up": [float(v) for v in up],
        "meters_per_unit": parts.meters_per_unit if options.meters_per_unit is None else options.meters_per_unit,
        "identity": hashlib.sha256(spelled.encode()).hexdigest(),
        "cells": {
            "count": len(parts.cells.rows),
            "origin": [0.0, 0.0, 0.0] if grid is None else [float(v) for v in grid.origin],
            "size": 0.0 if grid is None else grid.cell_size,
            "gain_top": parts.cells.top,
            "active": parts.cells.active,
        },
        "poses": [pose.as_dict() for pose in poses],
        "files": {kind: {"name": f.name, "bytes": f.nbytes} for kind, f in sorted(files.items())},
    }
