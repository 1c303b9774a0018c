"""`gsvis export`: write a package or a scene for players that need no gsvis."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gsvis._text import as_line
from gsvis.cli.arguments import Export
from gsvis.cli.options import PLACING, changed
from gsvis.cli.source import Source, check_source, is_builtin, open_source, parse_up, title_of, up_to_turn
from gsvis.cli.targets import check_exists, check_new
from gsvis.cli.terminal import Status, print_json, show, size_of
from gsvis.cli.visits import settle_visit
from gsvis.cli.where import check_where
from gsvis.files.origins import parse_origins
from gsvis.files.output import check_file, check_folder
from gsvis.package.manifest import MANIFEST

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from gsvis.package import Package
    from gsvis.scene.gaussians import Gaussians
    from gsvis.scene.levels import Levels
    from gsvis.scene.paths import HeadPath

__all__ = ["run_export"]

Triple = tuple[float, float, float]
_PLACING = tuple(name for name in PLACING if name != "up")


def run_export(command: Export) -> None:
    """Write a scene in the format of the command, and print what it takes."""
    walk = _check_options(command)
    opens = parse_origins("--page-origins", command.page_origins)
    _check_target(command)
    _check_apart(command)
    if command.format in ("streamed-sog", "3dtiles", "glb"):
        _export_leaves(command)
        return
    from gsvis.export import StaticOptions, write_html, write_site

    with ExitStack() as stack, Status() as status:
        scene, name, up, source = _open_scene(command, stack, status)
        visit = None
        if source is not None:
            _, visit = settle_visit(command.where, source, walk, status, quiet=command.output.json)
            up = _triple(visit.up)
        options = StaticOptions(name, up, poses=None if visit is None else visit.starts)
        if command.format == "static":
            found = write_site(command.out, scene, options, opens=opens, progress=status)
        else:
            found = write_html(command.out, scene, options, progress=status)
    made = found.scene
    remarks = [] if visit is None else visit.remarks
    if command.output.json:
        facts: dict[str, Any] = {
            "format": "gsvis-export",
            "version": 1,
            "in": command.scene,
            "out": command.out,
            "kind": command.format,
            "bytes": found.nbytes,
            "gaussians": made.gaussians,
            "terms": made.terms,
            "cells": made.cells,
            "sh_degree": made.sh_degree,
            "files": {kind: file.nbytes for kind, file in made.files.items()},
            "remarks": [each.strip() for each in remarks],
        }
        print_json(facts)
        return
    show(f"{command.out}: {made.gaussians:,} Gaussians, {_detail(made.terms, made.cells)}, {size_of(found.nbytes)}")
    show(*remarks)
    if command.format == "static":
        show(f"Serve it from any file server, such as: python -m http.server -d {command.out}")


def _export_leaves(command: Export) -> None:
    """Write a scene as streamed SOG, 3D Tiles or one GLB, and print what it takes."""
    from gsvis.cli.export_leaves import print_leaves, write_leaves
    from gsvis.pvs.store import VisibilityStore

    with ExitStack() as stack, Status() as status:
        store = None if command.pvs is None else stack.enter_context(VisibilityStore.open(command.pvs))
        scene, name, up, _ = _open_scene(command, stack, status)
        found = write_leaves(command, scene, store, name, up, status)
    print_leaves(command, found)


def _check_options(command: Export) -> HeadPath | None:
    """Raise if an option is given that the format does not know, or that needs another; return the walk of --path."""
    leaves = ("streamed-sog", "3dtiles")
    gltf = ("3dtiles", "glb")
    pages = ("static", "html", "streamed-sog")
    given = {
        "--pvs": (command.pvs, leaves),
        "--leaf": (command.leaf, leaves),
        "--never-seen": (command.never_seen != "keep" or None, leaves),
        "--compression": (None if command.compression == "auto" else command.compression, gltf),
        "--meters-per-unit": (command.meters_per_unit, gltf),
        "--request-volumes": (command.request_volumes or None, ("3dtiles",)),
        "--name": (command.name, pages),
        **{option: (words, ("static", "html")) for option, words in changed(command, _PLACING).items()},
        "--page-origins": (command.page_origins or None, ("static",)),
    }
    for option, (value, formats) in given.items():
        if value is not None and command.format not in formats:
            known = " or ".join(formats)
            raise ValueError(f"{option}: expected --format {known} with it, got {command.format}; leave it out")
    walk = check_where(command.where)
    sets = command.pvs is not None or (Path(command.scene) / MANIFEST).is_file()
    if command.request_volumes and not sets:
        raise ValueError("--request-volumes: expected a package or --pvs FILE with it, got neither; see gsvis pvs")
    check_exists(command.pvs)
    return walk


def _detail(terms: int, cells: int) -> str:
    sees = f"{cells:,} cells" if cells > 1 else "no visible sets"
    return f"{terms:,} terms, {sees}" if terms else sees


def _check_target(command: Export) -> None:
    """Raise unless the result may be written, before the scene is read."""
    from gsvis.export.page import check_site
    from gsvis.export.static import check_target

    out = Path(command.out)
    if command.format == "streamed-sog":
        from gsvis.io.streamed_sog_writer import check_streamed_target

        check_streamed_target(out, command.overwrite)
        check_folder(out)
        return
    if command.format == "3dtiles":
        from gsvis.export.tiles import check_tiles_target

        check_tiles_target(out, command.overwrite)
        check_folder(out)
        return
    if command.format == "static":
        check_folder(out)
        check_site(out, command.overwrite)
        check_target(out / "scene")
        return
    suffixes = (".glb",) if command.format == "glb" else (".html", ".htm")
    if out.suffix.lower() not in suffixes:
        raise ValueError(f"--out: expected a file that ends in {suffixes[0]}, got {command.out}; name one")
    check_file(out)
    check_new(out, command.overwrite)


def _check_apart(command: Export) -> None:
    """Raise if the result would be SCENE itself, or lie in the folder of SCENE."""
    scene = Path(command.scene).resolve()
    out = Path(command.out).resolve()
    inner = command.format == "streamed-sog" and scene.name == "lod-meta.json" and scene.parent == out
    inner = inner or (command.format == "3dtiles" and out in scene.parents)
    if not is_builtin(command.scene) and (out == scene or inner or (scene.is_dir() and scene in out.parents)):
        raise ValueError(f"--out: expected a place outside of SCENE, got {command.out}; name another")


def _open_scene(
    command: Export, stack: ExitStack, status: Status
) -> tuple[Package | Levels | Gaussians, str, Triple | None, Source | None]:
    """Return the package or scene of a command, its name, its up axis if that is known, and how a scene was read."""
    up = parse_up(command.where.up)
    if (Path(command.scene) / MANIFEST).is_file():
        from gsvis.package import Package

        for option, words in changed(command, ("lod", *_PLACING)).items():
            raise ValueError(f"{option}: expected none for a package, got {' '.join(words) or option}; leave it out")
        name = as_line(command.name or Path(command.scene).resolve().name.removesuffix(".gsvis"))
        return stack.enter_context(Package.open(command.scene)), name, _triple(up), None
    check_source(command.scene, command.lod)
    source = open_source(command.scene, command.lod, status)
    name = as_line(command.name or title_of(command.scene, source.lod))
    return source.whole, name, _triple(up_to_turn(source) if up is None else up), source


def _triple(vector: NDArray[np.float64] | None) -> Triple | None:
    if vector is None:
        return None
    x, y, z = vector.tolist()
    return x, y, z
