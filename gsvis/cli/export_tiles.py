"""`gsvis export --format 3dtiles|glb`: Gaussians in glTF, as a tileset or as one file."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from gsvis.cli.arguments import Export
from gsvis.cli.terminal import Status, facts, print_json, show, size_of

if TYPE_CHECKING:
    from gsvis.export import TilesReport

__all__ = ["export_tiles"]


def export_tiles(command: Export) -> None:
    """Write a scene as 3D Tiles or as one GLB, and print what it takes; the target has been checked."""
    from gsvis.cli.export import open_scene
    from gsvis.export import GlbReport, TilesOptions, write_glb, write_tiles
    from gsvis.export.leaves import LEAF
    from gsvis.pvs.store import VisibilityStore

    single = command.format == "glb"
    with ExitStack() as stack, Status() as status:
        store = None if command.pvs is None else stack.enter_context(VisibilityStore.open(command.pvs))
        scene, _, up, _ = open_scene(command, stack, status)
        if store is not None and command.where.up is None:
            up = None  # the visible sets know it
        options = TilesOptions(
            leaf=command.leaf or LEAF,
            never_seen=command.never_seen,
            compression=("none" if single else "spz") if command.compression == "auto" else command.compression,
            request_volumes=command.request_volumes,
            up=up,
            meters_per_unit=command.meters_per_unit,
        )
        found = (
            write_glb(command.out, scene, options, progress=status)
            if single
            else write_tiles(
                command.out, scene, options, visibility=store, overwrite=command.overwrite, progress=status
            )
        )
    if command.output.json:
        given: dict[str, Any] = {"format": "gsvis-export", "version": 1, "in": command.scene, "out": command.out}
        listed = asdict(found)
        del listed["path"], listed["nbytes"]
        print_json({**given, "kind": command.format, "bytes": found.nbytes, **listed})
        return
    if isinstance(found, GlbReport):
        degree = f"SH degree {found.sh_degree}"
        show(f"{command.out}: {found.gaussians:,} Gaussians, {degree}, {size_of(found.nbytes)}")
        return
    show(facts(f"{command.out}: {found.tiles:,} tiles, {size_of(found.nbytes)}", _rows(found)))
    show(f"Show it: CesiumJS opens {command.out}/tileset.json (docs/how-to/tiles.md)")


def _rows(found: TilesReport) -> list[tuple[str, str]]:
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
