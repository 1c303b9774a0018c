"""Write the static form of a scene: small files that a page reads whole, from any file server.

docs/static.md describes the files to the byte. Names of data files contain the hash of their content, so the files
never change and may be cached forever. `scene.json` lists them and is written last, so a reader sees either the old
scene or the new one. The same scene gives the same files. A killed run resumes, because complete files are not written
again.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.color.records import Grids
from gsvis.errors import FormatError
from gsvis.export.bare import BareScene, encode_scene
from gsvis.export.columns import compress
from gsvis.export.first import FirstViews
from gsvis.export.glances import Glances, glance_bytes
from gsvis.export.harmonics import Palette, label_bytes
from gsvis.export.index import Spheres, index_of
from gsvis.export.lights import Lights, areas_of
from gsvis.export.near import encode_near
from gsvis.export.parts import divide_in_space
from gsvis.export.pieces import PieceCoder, place
from gsvis.export.placing import Placing
from gsvis.export.rows import CellRows, SeenSpheres, TermWorth, rows_of_package, rows_of_scene
from gsvis.export.start import Start, start_poses
from gsvis.files.atomic import atomic_path, remove_all_partials
from gsvis.files.fields import parse_json
from gsvis.files.limits import digest_of, read_whole
from gsvis.io.sog_writer import report_palette_loss
from gsvis.jobs.in_order import in_order
from gsvis.package.layout import RECORD_BYTES, TermLayout
from gsvis.package.package import Package
from gsvis.progress import Progress, silent
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.floor import floor_of_cells, stand_on
from gsvis.pvs.walk import find_walk
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels
from gsvis.scene.navigable import NavigableSpace
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

I64 = NDArray[np.int64]
Data = bytes | memoryview

FORMAT = "gsvis-static"
VERSION = 8
SCENE = "scene.json"
FILES = ("index", "grid", "facts", "walk")
"""Files of a scene besides `scene.json`."""
FAMILIES = ("row", "part", "plain", "terms", "first", "glance", "sets")
"""Kinds of files that are numbered."""

_BEFORE = ("cells", "records", "blocks", "harmonics", "replaced")  # files of versions 2 and 3
_OURS = re.compile(rf"(?:{'|'.join((*FILES, *FAMILIES, *_BEFORE))})-[0-9a-f]{{16}}(?:-\d+)?\.bin")
_FIRST = 1.0  # most bytes of the files of first views, over those of the parts
_SMALL = 1 << 20  # bytes that glances may have in any case, as long as they have no more than the parts
_MOST_JSON = 16 << 20


@dataclass(frozen=True)
class StaticFile:
    """A data file, or several of one kind.

    Attributes:
        stem: What their names begin with: the kind, and the first digits of the hash.
        names: Their names.
        nbytes: Their size.
        sha256: Hash of their content, 64 hexadecimal digits.
    """

    stem: str
    names: tuple[str, ...]
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
        space: Where eyes may be in a bare scene, so that visitors can walk; None leaves walking to chance.
        most_walk: Most bytes of what is known of walking; larger ones are left out.
        most_first: Bytes that the file of a first view may have, even where all of them then have more bytes than the
            parts: of a small scene a view needs most.
        most_glances: Bytes that the files of all cells and directions may have together, over those of the parts; 0
            for none. Of a small scene they may have as many as the parts, up to 1 MiB.
        most_sets: Most sets of higher SH coefficients that the Gaussians of a bare scene share; None gives each its
            own, which is exact to the byte, takes no time, and many times the bytes.
        is_near: Whether pages read it on this machine: a bare scene is then written as the arrays that a page gives to
            the GPU, in few large files, and `most_sets` is not asked, which saves most of the time of both.

    Raises:
        ValueError: If a number is out of its range.
    """

    name: str = "scene"
    up: tuple[float, float, float] | None = None
    meters_per_unit: float | None = None
    poses: tuple[Start, ...] | None = None
    space: NavigableSpace | None = None
    most_walk: int = 1 << 26
    most_first: int = 1 << 19
    most_glances: float = 0.25
    most_sets: int | None = 1 << 16
    is_near: bool = False

    def __post_init__(self) -> None:
        if self.up is not None:
            _check.unit_vectors("up", np.reshape(np.asarray(self.up, np.float64), (1, -1)))
        if self.meters_per_unit is not None and not 0.0 <= self.meters_per_unit < np.inf:
            raise ValueError(f"meters_per_unit: expected a finite number >= 0, got {self.meters_per_unit!r}")
        if not 0.0 <= self.most_glances < np.inf:
            raise ValueError(f"most_glances: expected a finite number >= 0, got {self.most_glances!r}")
        if self.most_sets is not None:
            _check.positive_int("most_sets", self.most_sets)


@dataclass(frozen=True)
class StaticScene:
    """Result of `write_static`.

    Attributes:
        path: The folder.
        files: The data files by what they hold: some of `FILES` and of `FAMILIES`.
        gaussians: N, the number of Gaussians.
        terms: T, the number of terms.
        parts: Number of parts.
        cells: Number of cells, 1 without visible sets.
        sh_degree: Degree of the harmonics, 0 for a package.
        ahead: Names of the files that the first view needs, in the order of need.
    """

    path: Path
    files: dict[str, StaticFile] = field(repr=False)
    gaussians: int
    terms: int
    parts: int
    cells: int
    sh_degree: int
    ahead: tuple[str, ...] = ()

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
    if isinstance(scene, Package):
        content = _package_content(scene, said, progress)
    elif said.is_near:
        content = _near_content(scene, said, progress)
    else:
        content = _bare_content(target, scene, said, progress)
    target.mkdir(parents=True, exist_ok=True)
    remove_all_partials(target)
    counts = content.counts
    of_parts = np.array([len(data) for data in content.families[content.kind]])
    of_terms = np.array([len(data) for data in content.families.get("terms", [b""] * len(counts))])
    contents: dict[str, Data] = {
        "index": index_of(content.spheres, counts, of_parts, of_terms),
        "grid": content.cells.index(),
        **content.files,
    }
    families: dict[str, Sequence[Data]] = {"row": content.cells.rows, **content.families}
    files = {}
    progress("export", 0, len(contents) + len(families))
    for kind, data in contents.items():
        files[kind] = _keep(target, kind, [data], False)
    for kind, some in families.items():
        files[kind] = _keep(target, kind, some, True)
        progress("export", len(files), len(contents) + len(families))
    document = _document(content, files, said)
    with atomic_path(target / SCENE) as partial:
        partial.write_bytes(json.dumps(document, sort_keys=True, separators=(",", ":"), allow_nan=False).encode())
    degree = 0 if content.info.harmonics is None else content.info.harmonics["degree"]
    found = StaticScene(
        target,
        files,
        document["gaussians"],
        document["terms"],
        len(counts),
        document["cells"]["count"],
        degree,
        _ahead(content, files),
    )
    remove_other_files(found)
    return found


def _ahead(content: _Content, files: dict[str, StaticFile]) -> tuple[str, ...]:
    """Return the names of the files that the first view needs: its own, the tables, and the row of its cell."""
    grid = content.cells.grid
    first = content.info.first
    if not first or grid is None:
        return files["index"].names + files["grid"].names + files["row"].names[:1]
    cell = int(grid.nearest(np.array(first[0].position)))
    return files["first"].names[:1] + files["index"].names + files["grid"].names + (files["row"].names[cell],)


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
class _Content:
    """The content of a static scene before it is written.

    Attributes:
        records: What `scene.json` says of the records.
        counts: (P,) Gaussians of each part.
        cells: Rows of cells.
        files: Content of each file that is alone.
        families: Contents of files of one kind, which are numbered.
        spheres: Spheres around the parts.
        info: Facts for `scene.json`.
        glances: What `scene.json` says of glances; None without any.
    """

    records: dict[str, Any]
    counts: I64
    cells: CellRows
    files: dict[str, bytes]
    families: dict[str, Sequence[Data]]
    spheres: Spheres
    info: _Info
    glances: dict[str, Any] | None = None

    @property
    def kind(self) -> str:
        """The kind of the files of parts."""
        return "plain" if "plain" in self.families else "part"


@dataclass(frozen=True)
class _Info:
    """Facts about a scene, and the ranges of its harmonics."""

    harmonics: dict[str, Any] | None = None
    up: tuple[float, ...] = (0.0, 0.0, 1.0)
    meters_per_unit: float = 0.0
    poses: tuple[Start, ...] = ()
    first: tuple[Start, ...] = ()


def _package_content(package: Package, options: StaticOptions, progress: Progress) -> _Content:
    """Return the content of the static form of a package: its highest level."""
    contents = package.contents
    info = package.manifest.info
    g = contents.gaussians()
    ids = np.flatnonzero(contents.last == len(contents.names) - 1)
    lights = None if package.manifest.visibility is None else Lights(package, g)
    progress("order", 0, 1)
    gains = areas_of(g) * g.opacities if lights is None else lights.brightest()
    parts = [ids[part] for part in divide_in_space(g.means[ids].astype(np.float64), gains[ids])]
    placing = Placing.from_parts(parts, contents.chunks, len(g))
    placed = place(contents, placing.order)
    coder = PieceCoder(placed, Coding.from_contents(placed))
    progress("order", 1, 1)
    views = tuple(Start.from_dict(view) for view in package.manifest.views)
    grid = None if lights is None else lights.grid
    poses = options.poses or views or start_poses(g.bounds(0.9), grid, options.up or info.up)
    known = _Info(None, info.up, info.meters_per_unit, poses)
    pieces: dict[str, Sequence[Data]] = {"part": [coder.encode(placing.of_part(k)) for k in range(len(parts))]}
    spheres = Spheres.from_parts(parts, g.means, gains)
    if len(placed.term_records):
        pieces["terms"] = [coder.encode_terms(placing.of_part(k)) for k in range(len(parts))]
    files: dict[str, bytes] = {}
    looks: Glances | None = None
    if lights is None:
        cells = rows_of_scene(gains[placing.order], placing.part_of[placing.order])
    else:
        worth = None if package.epsilon is None else TermWorth(package, g)
        seen = SeenSpheres(g.means, spheres, lights.grid.cell_size)
        of_parts = sum(map(len, pieces["part"]))
        first = FirstViews(lights, g, worth, coder, placing)
        if most := glance_bytes(len(lights), _bytes_for_glances(options, of_parts)):
            looks = Glances.from_up(first, options.up or info.up, most)
        cells = rows_of_package(lights, worth, placing.part_of, seen, looks, progress)
        meters = info.meters_per_unit if options.meters_per_unit is None else options.meters_per_unit
        floor = floor_of_cells(lights.grid, meters)
        files["facts"] = _facts(lights.grid, floor)
        files |= _walk(g[ids], lights.grid, meters, options.most_walk)
        share = int(_FIRST * of_parts / max(len(known.poses), 1))
        known = replace(known, first=tuple(_standing(pose, floor) for pose in known.poses))
        pieces["first"] = [first.encode(pose, max(share, options.most_first)) for pose in known.first]
        if looks is not None:
            pieces["glance"] = list(cells.glances)
    said = None if looks is None else looks.as_dict()
    return _Content(_describe_coded(coder), _counts_of(parts), cells, files, pieces, spheres, known, said)


def _bytes_for_glances(options: StaticOptions, of_parts: int) -> int:
    """Return the bytes that glances may have together beside parts of `of_parts` bytes."""
    small = min(of_parts, _SMALL) if options.most_glances else 0
    return max(int(options.most_glances * of_parts), small)


def _standing(pose: Start, floor: dict[str, Any]) -> Start:
    """Return a view as a page shows it: except around a thing, a visitor begins on foot."""
    if pose.mode == "orbit":
        return pose
    x, y, z = stand_on(floor, pose.position).tolist()
    return replace(pose, position=(x, y, z))


def _facts(grid: CellGrid, floor: dict[str, Any]) -> bytes:
    """Return the content of `facts`: cells and floor, as a server states them."""
    cells = {"origin": grid.origin.tolist(), "size": grid.cell_size, "boxes": grid.coords.tolist()}
    said = {"cells": cells, "floor": floor}
    return compress(json.dumps(said, separators=(",", ":"), allow_nan=False).encode())


def _walk(g: Gaussians, cells: CellGrid, meters_per_unit: float, most: int) -> dict[str, bytes]:
    """Return the content of `walk` by its kind; nothing if nobody can walk there, or if it is larger than `most`."""
    found = find_walk(g, cells, meters_per_unit)
    packed = b"" if found is None else found.to_bytes()
    return {"walk": packed} if 0 < len(packed) <= most else {}


def _bare_content(target: Path, scene: Levels | Gaussians, options: StaticOptions, progress: Progress) -> _Content:
    """Return the content of the static form of a bare scene: its highest level; log what sharing harmonics costs."""
    progress("order", 0, 1)
    found = encode_scene(scene, options.most_sets)
    g = found.contents.gaussians()
    gains = areas_of(g) * g.opacities
    parts = divide_in_space(g.means.astype(np.float64), gains)
    placing = Placing.from_parts(parts, found.contents.chunks, len(g))
    placed = place(found.contents, placing.order)
    labels, width = _labels_of(found.palette, placing)
    if found.palette is not None:
        report_palette_loss(target, len(g), len(found.palette.sets), found.palette.error)
    coder = PieceCoder(placed, Coding.from_contents(placed), labels, width)
    progress("order", 1, 1)
    cells = rows_of_scene(gains, placing.part_of)
    pieces: dict[str, Sequence[Data]] = {"part": coder.encode_all(placing.of_part(k) for k in range(len(parts)))}
    if found.palette is not None:
        pieces["sets"] = found.palette.blocks()
    info = _bare_info(_harmonics_of(found, pieces.get("sets", [])), options, g)
    spheres = Spheres.from_parts(parts, g.means, gains)
    return _Content(_describe_coded(coder), _counts_of(parts), cells, _bare_files(g, options), pieces, spheres, info)


def _near_content(scene: Levels | Gaussians, options: StaticOptions, progress: Progress) -> _Content:
    """Return the content of the static form of a bare scene for pages on this machine: its highest level."""
    progress("order", 0, 1)
    g = scene.level(len(scene) - 1) if isinstance(scene, Levels) else scene
    found = encode_near(g)
    progress("order", 1, 1)
    said = _describe_records(found.grids, len(g), found.chunks, 0, None)
    if g.facts.antialiased:
        said["antialiased"] = True
    harmonics = None if found.ranges is None else {**found.ranges.as_dict(), "sets": len(g)}
    info = _bare_info(harmonics, options, g)
    cells = rows_of_scene(found.lights, np.arange(len(found.counts)))
    plain: dict[str, Sequence[Data]] = {"plain": found.parts}
    return _Content(said, found.counts, cells, _bare_files(g, options), plain, found.spheres, info)


def _counts_of(parts: list[I64]) -> I64:
    """Return (P,) the number of ids in each part."""
    return np.array([len(part) for part in parts])


def _describe_coded(coder: PieceCoder) -> dict[str, Any]:
    """Return what `scene.json` says of coded records."""
    contents = coder.contents
    code = coder.coding.tables.to_text()
    found = _describe_records(contents.grids, len(contents), len(contents.table), len(contents.term_records), code)
    found["levels"][0]["name"] = contents.names[-1]
    return found | ({"antialiased": True} if contents.facts.antialiased else {})


def _describe_records(grids: Grids, count: int, chunks: int, terms: int, code: str | None) -> dict[str, Any]:
    """Return what `scene.json` says of `count` records; `code` is None where they are not coded."""
    layout = TermLayout.from_grids(grids)
    return {
        "gaussians": count,
        "terms": terms,
        "chunks": chunks,
        "code": code,
        "steps": None,
        "levels": [{"name": "high", "count": count}],
        "record_bytes": RECORD_BYTES,
        "term_bits": int(layout.widths.sum()),
        "term_bytes": layout.nbytes,
        "colors": asdict(grids),
    }


def _bare_info(harmonics: dict[str, Any] | None, options: StaticOptions, g: Gaussians) -> _Info:
    """Return facts about a bare scene, whose Gaussians are `g`."""
    poses = options.poses or start_poses(g.bounds(0.9), None, options.up or (0.0, 0.0, 1.0))
    return _Info(harmonics, poses=poses)


def _bare_files(g: Gaussians, options: StaticOptions) -> dict[str, bytes]:
    """Return the files of a bare scene that are alone: where one can walk."""
    if options.space is None:
        return {}
    return _walk(g, CellGrid.over(options.space), options.meters_per_unit or 0.0, options.most_walk)


def _labels_of(palette: Palette | None, placing: Placing) -> tuple[I64 | None, int]:
    """Return the sets of higher coefficients of the Gaussians of the static form, and the bytes that name one."""
    if palette is None:
        return None, 0
    return palette.labels[placing.order], label_bytes(len(palette.sets))


def _harmonics_of(scene: BareScene, blocks: Sequence[Data]) -> dict[str, Any] | None:
    """Return what `scene.json` says of higher coefficients; None in degree 0."""
    if scene.ranges is None or scene.palette is None:
        return None
    worth = [float(f"{value:.4g}") for value in scene.palette.worth.tolist()]
    palette = {"sets": len(scene.palette.sets), "bytes": [len(block) for block in blocks], "worth": worth}
    return scene.ranges.as_dict() | palette


def _keep(folder: Path, kind: str, contents: Sequence[Data], numbered: bool) -> StaticFile:
    """Write the data files of a kind atomically, unless they exist; their names contain the hash of all of them."""
    hashes = list(in_order(hashlib.sha256, contents))
    digest = hashes[0].hexdigest() if not numbered else hashlib.sha256(b"".join(h.digest() for h in hashes)).hexdigest()
    stem = f"{kind}-{digest[:16]}"
    names = tuple(f"{stem}-{k}.bin" if numbered else f"{stem}.bin" for k in range(len(contents)))
    for name, data, sha256 in zip(names, contents, hashes, strict=True):
        target = folder / name
        with suppress(OSError, FormatError):
            if target.stat().st_size == len(data) and digest_of(target) == sha256.hexdigest():
                continue
        with atomic_path(target, sweep=False) as partial:
            partial.write_bytes(data)
    return StaticFile(stem, names, sum(map(len, contents)), digest)


def remove_other_files(scene: StaticScene) -> None:
    """Remove the data files of earlier scenes from the folder of a scene."""
    kept = {name for file in scene.files.values() for name in file.names}
    for path in scene.path.iterdir():
        if _OURS.fullmatch(path.name) and path.name not in kept:
            with suppress(OSError):
                path.unlink()


def _document(content: _Content, files: dict[str, StaticFile], options: StaticOptions) -> dict[str, Any]:
    """Return the content of `scene.json`."""
    info = content.info
    grid = content.cells.grid
    named = [files[kind].sha256 for kind in sorted(files)]
    spelled = json.dumps([named, content.records["colors"], info.harmonics], sort_keys=True)
    firsts = content.families.get("first", [])
    return {
        "format": FORMAT,
        "version": VERSION,
        **content.records,
        "name": options.name,
        "parts": len(content.counts),
        "places": content.spheres.as_dict(),
        "harmonics": info.harmonics,
        "up": [float(v) for v in (info.up if options.up is None else options.up)],
        "meters_per_unit": info.meters_per_unit if options.meters_per_unit is None else options.meters_per_unit,
        "identity": hashlib.sha256(spelled.encode()).hexdigest(),
        "cells": {
            "count": len(content.cells.rows),
            "origin": [0.0, 0.0, 0.0] if grid is None else [float(v) for v in grid.origin],
            "size": 0.0 if grid is None else grid.cell_size,
            "gain_top": content.cells.top,
            "active": content.cells.active,
            "spheres": grid is not None,
            "glances": content.glances,
        },
        "poses": [pose.as_dict() for pose in info.poses],
        "first": [{"bytes": len(data), **pose.as_dict()} for data, pose in zip(firsts, info.first, strict=True)],
        "files": {
            kind: {"name": f.stem if kind in FAMILIES else f.names[0], "bytes": f.nbytes, "count": len(f.names)}
            for kind, f in sorted(files.items())
        },
    }
