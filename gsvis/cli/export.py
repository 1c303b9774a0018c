"""`gsvis export`: write a package or a scene for players that need no gsvis."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gsvis._text import as_line
from gsvis.cli.arguments import Export
from gsvis.cli.arguments_publish import Presented
from gsvis.cli.asking import settle_visit
from gsvis.cli.options import PLACING, changed
from gsvis.cli.overdraw import Lighter, lighten
from gsvis.cli.source import open_source
from gsvis.cli.targets import check_exists, check_new
from gsvis.cli.terminal import Status, facts, print_json, show, size_of
from gsvis.cli.where import check_where, parse_up
from gsvis.files.origins import parse_origins
from gsvis.files.output import check_file, check_folder
from gsvis.files.shown import shown_as
from gsvis.files.temporary import temporary_folder
from gsvis.io.sources import check_source, is_builtin, title_of
from gsvis.io.streamed_zip import ZIP_SUFFIXES, pack_streamed
from gsvis.package.shown import is_package
from gsvis.scene.axes import describe_direction
from gsvis.scene.source import Source

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from gsvis.export import StreamedReport, TilesReport
    from gsvis.package import Package
    from gsvis.scene.gaussians import Gaussians
    from gsvis.scene.levels import Levels
    from gsvis.scene.paths import HeadPath

__all__ = ["run_export"]

Triple = tuple[float, float, float]
_PRESENTED = tuple(each.name for each in fields(Presented))
_SUFFIXES = {"glb": (".glb",), "html": (".html", ".htm"), "usd": (".usdz", ".usdc", ".usda", ".usd")}
_UPRIGHT = 0.98  # cosine of the angle between two axes that are alike
_PLACING = tuple(name for name in PLACING if name != "up")


def run_export(command: Export) -> None:
    """Write a scene in the format of the command, and print what it takes."""
    walk = _check_options(command)
    opens = parse_origins("--page-origins", command.page.page_origins)
    _check_target(command)
    _check_apart(command)
    if command.format in ("streamed-sog", "3dtiles", "glb", "usd"):
        _export_leaves(command, walk)
        return
    from gsvis.export import PageOptions, StaticOptions, check_page, write_html, write_site

    page = PageOptions(**{name: value for name, value in vars(command.page).items() if name != "page_origins"})
    check_page(page)
    with ExitStack() as stack, Status() as status:
        scene, name, up, source, lighter = _open_scene(command, walk, stack, status)
        visit = None
        if source is not None:
            _, visit = settle_visit(command.where, source, walk, status, quiet=command.output.json)
            up = _triple(visit.up)
        options = StaticOptions(name, up)
        if visit is not None:
            options = replace(options, poses=visit.starts, space=visit.space)
        if command.format == "static":
            found = write_site(command.out, scene, options, opens=opens, page=page, progress=status)
        else:
            found = write_html(command.out, scene, options, page=page, progress=status)
    made = found.scene
    remarks = [*lighter.remarks, *([] if visit is None else visit.remarks)]
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
            "budget": lighter.figures,
            "remarks": [each.strip() for each in remarks],
        }
        print_json(facts)
        return
    show(f"{command.out}: {made.gaussians:,} Gaussians, {_detail(made.terms, made.cells)}, {size_of(found.nbytes)}")
    show(*remarks)
    if command.format == "static":
        show("Put it on any file server (docs/how-to/publish.md).")
        show(f"To look at it here: python -m http.server -d {command.out}")


def _check_options(command: Export) -> HeadPath | None:
    """Raise if an option is given that the format does not know, or that needs another; return the walk of --path."""
    leaves = ("streamed-sog", "3dtiles")
    gltf = ("3dtiles", "glb")
    pages = ("static", "html", "streamed-sog")
    budget = command.budget.budget_splats is not None or command.budget.budget_fill is not None
    placed = (command.format,) if budget else ("static", "html")
    given = {
        "--pvs": (command.pvs, leaves),
        "--leaf": (command.leaf, leaves),
        "--never-seen": (command.never_seen != "keep" or None, leaves),
        "--compression": (None if command.tiled.compression == "auto" else command.tiled.compression, gltf),
        "--meters-per-unit": (command.meters_per_unit, (*gltf, "usd")),
        "--request-volumes": (command.tiled.request_volumes or None, ("3dtiles",)),
        "--name": (command.name, pages),
        **{option: (words, ("static", "html")) for option, words in changed(command, _PRESENTED).items()},
        **{option: (words, placed) for option, words in changed(command, _PLACING).items()},
        "--page-origins": (command.page.page_origins or None, ("static",)),
    }
    for option, (value, formats) in given.items():
        if value is not None and command.format not in formats:
            known = " or ".join(formats)
            raise ValueError(f"{option}: expected --format {known} with it, got {command.format}; leave it out")
    walk = check_where(command.where)
    if budget:
        _check_budget(command)
    sets = command.pvs is not None or is_package(command.scene)
    if command.tiled.request_volumes and not sets:
        raise ValueError("--request-volumes: expected a package or --pvs FILE with it, got neither; see gsvis pvs")
    check_exists(command.pvs)
    return walk


def _check_budget(command: Export) -> None:
    """Raise if the visible sets of the scene would not fit the lighter version."""
    option = "--budget-fill" if command.budget.budget_splats is None else "--budget-splats"
    if is_package(command.scene):
        raise ValueError(f"{option}: expected a scene, got a package; name the scene that it was made from")
    if command.pvs is not None:
        raise ValueError(f"{option}: expected no --pvs with it, got {command.pvs}; find sets of the result instead")


def _detail(terms: int, cells: int) -> str:
    """Return the terms and cells of a static scene as text."""
    sees = f"{cells:,} cells" if cells > 1 else "no visible sets"
    return f"{terms:,} terms, {sees}" if terms else sees


def _check_target(command: Export) -> None:
    """Raise unless the result may be written, before the scene is read."""
    from gsvis.export.page import check_site
    from gsvis.export.static import check_target

    out = Path(command.out)
    if command.format == "streamed-sog" and not _is_zipped(command):
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
    if not _is_zipped(command) and out.suffix.lower() not in _SUFFIXES[command.format]:
        known = ", ".join(_SUFFIXES[command.format])
        raise ValueError(f"--out: expected a file that ends in {known}, got {command.out}; name one")
    if command.format == "usd":
        from gsvis.io.usd_writer import check_usd

        check_usd(out)
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
    command: Export, walk: HeadPath | None, stack: ExitStack, status: Status
) -> tuple[Package | Levels | Gaussians, str, Triple | None, Source | None, Lighter]:
    """Return the package or scene of a command, its name, its up axis if known, how it was read, and its budget."""
    up = parse_up(command.where.up)
    if is_package(command.scene):
        from gsvis.package import Package

        for option, words in changed(command, ("lod", *_PLACING)).items():
            raise ValueError(f"{option}: expected none for a package, got {' '.join(words) or option}; leave it out")
        name = as_line(command.name or command.page.title or Path(command.scene).resolve().name.removesuffix(".gsvis"))
        return stack.enter_context(Package.open(command.scene)), name, _triple(up), None, Lighter()
    check_source(command.scene, command.lod)
    source = open_source(command.scene, command.lod, status)
    name = as_line(command.name or command.page.title or title_of(command.scene, source.lod))
    lighter = lighten(command, source, walk, status)
    source = lighter.source or source
    return source.whole, name, _triple(source.steady_up if up is None else up), source, lighter


def _is_zipped(command: Export) -> bool:
    """Return whether a streamed SOG is to be written as one zip."""
    return command.format == "streamed-sog" and Path(command.out).suffix.lower() in ZIP_SUFFIXES


def _triple(vector: NDArray[np.float64] | None) -> Triple | None:
    """Return a vector as three numbers; None without one."""
    if vector is None:
        return None
    x, y, z = vector.tolist()
    return x, y, z


def _export_leaves(command: Export, walk: HeadPath | None) -> None:
    """Write a scene as streamed SOG, 3D Tiles or one GLB, and print what it takes; the target has been checked."""
    from gsvis.pvs.store import VisibilityStore

    with ExitStack() as stack, Status() as status:
        store = None if command.pvs is None else stack.enter_context(VisibilityStore.open(command.pvs))
        scene, name, up, _, lighter = _open_scene(command, walk, stack, status)
        if store is not None and command.where.up is None:
            up = None  # the visible sets know it
        if _is_zipped(command):
            folder = stack.enter_context(temporary_folder()) / "scene"
            stack.enter_context(shown_as(folder, command.out))
            inner = _write(replace(command, out=str(folder)), scene, store, name, up, status)
            found = replace(inner, nbytes=pack_streamed(inner.path, command.out))
        else:
            found = _write(command, scene, store, name, up, status)
    if command.output.json:
        about = {"format": "gsvis-export", "version": 1, "in": command.scene, "out": command.out}
        listed = {key: value for key, value in asdict(found).items() if key not in ("path", "nbytes")}
        print_json({**about, "kind": command.format, "bytes": found.nbytes, **listed, "budget": lighter.figures})
        return
    show(*lighter.remarks)
    if command.format in ("glb", "usd"):
        degree = f"SH degree {found.sh_degree}"
        show(f"{command.out}: {found.gaussians:,} Gaussians, {degree}, {size_of(found.nbytes)}")
    elif command.format == "3dtiles":
        show(facts(f"{command.out}: {found.tiles:,} tiles, {size_of(found.nbytes)}", _tiles_rows(found)))
        show(f"Show it: CesiumJS opens {command.out}/tileset.json (docs/how-to/tiles.md)")
    else:
        show(facts(f"{command.out}: {found.leaves:,} leaves, {size_of(found.nbytes)}", _streamed_rows(found)))
        show(*_turned(found.up))
        if _is_zipped(command):
            show("Upload it to SuperSplat, or unzip it for a viewer that opens its lod-meta.json.")
        else:
            show(f"Show it: examples/engines, or any viewer that opens {command.out}/lod-meta.json")


def _write(command: Export, scene: Any, store: Any, name: str, up: Triple | None, status: Status) -> Any:
    """Write the scene in the format of the command; return the report of the writer."""
    from gsvis.export import StreamedOptions, TilesOptions, write_glb, write_streamed_sog, write_tiles, write_usd
    from gsvis.export.leaves import LEAF

    leaf = command.leaf or LEAF
    more: dict[str, Any] = {"visibility": store, "overwrite": command.overwrite, "progress": status}
    if command.format == "streamed-sog":
        streamed = StreamedOptions(leaf=leaf, never_seen=command.never_seen, name=name, up=up)
        return write_streamed_sog(command.out, scene, streamed, **more)
    single = command.format == "glb"
    options = TilesOptions(
        leaf=leaf,
        never_seen=command.never_seen,
        compression=("none" if single else "spz") if command.tiled.compression == "auto" else command.tiled.compression,
        request_volumes=command.tiled.request_volumes,
        up=up,
        meters_per_unit=command.meters_per_unit,
    )
    if command.format == "usd":
        return write_usd(command.out, scene, options, progress=status)
    if single:
        return write_glb(command.out, scene, options, progress=status)
    return write_tiles(command.out, scene, options, **more)


def _streamed_rows(found: StreamedReport) -> list[tuple[str, str]]:
    """Return the rows of the table about a streamed SOG."""
    sizes = ", ".join(f"{n:,}" for n in found.counts)
    rows = [("Gaussians, finest level first", sizes)]
    if found.environment:
        rows.append(("far outside, drawn always", f"{found.environment:,}"))
    share = found.sidecar_nbytes / found.nbytes
    if found.cells == 0:
        rows.append(("visible sets", "none: leaves are ordered by size (gsvis pvs finds them, --pvs gives them)"))
    else:
        rows.append(("a cell needs, on average", f"{100 * found.needed:.1f}% of the finest level"))
    if found.never_seen is not None:
        done = "left out" if found.dropped else "kept"
        rows.append(("never seen from any cell", f"{found.never_seen:,}, {done}"))
    rows.append((f"sidecar {found.sidecar}", f"{size_of(found.sidecar_nbytes)}, {100 * share:.2f}% of all bytes"))
    return rows


def _turned(up: Triple) -> list[str]:
    """Return a line if viewers of PlayCanvas would show a scene turned: they take -y as up; none if not."""
    if up[1] < -_UPRIGHT:
        return []
    axis = describe_direction(up)
    change = f"gsvis convert --change-up {axis}:-y" if len(axis) == 2 else "gsvis convert --rotate"
    return [
        f"LIES TURNED IN VIEWERS: up is {axis}, PlayCanvas' viewers take -y for up; turn the scene first ({change})"
    ]


def _tiles_rows(found: TilesReport) -> list[tuple[str, str]]:
    """Return the rows of the table about a tileset."""
    rows = [("Gaussians, finest level first", ", ".join(f"{n:,}" for n in found.counts))]
    if found.environment:
        rows.append(("far outside, a tile of their own", f"{found.environment:,}"))
    if found.never_seen is not None:
        done = "left out" if found.dropped else "kept"
        rows.append(("never seen from any cell", f"{found.never_seen:,}, {done}"))
    if found.volumes or found.unneeded:
        rows.append(("leaves with a request volume", f"{found.volumes:,} of {found.leaves:,}"))
        rows.append(("leaves that no cell needs", f"{found.unneeded:,}, left out"))
        asked, exact = (f"{100 * share:.1f}%" for share in (found.requested, found.needed))
        rows.append(("a cell requests, on average", f"{asked} of the finest level; it needs {exact}"))
    return rows
