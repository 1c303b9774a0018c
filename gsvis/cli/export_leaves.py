"""`gsvis export --format streamed-sog|3dtiles|glb`: leaves for players of other programs, and glTF in one file."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from gsvis.cli.arguments import Export
from gsvis.cli.terminal import Status, facts, print_json, show, size_of

if TYPE_CHECKING:
    from gsvis.export import StreamedReport, TilesReport

    Triple = tuple[float, float, float]

__all__ = ["print_leaves", "write_leaves"]


def write_leaves(command: Export, scene: Any, store: Any, name: str, up: Triple | None, status: Status) -> Any:
    """Write a scene as streamed SOG, 3D Tiles or one GLB, to a checked target; return the report of the writer."""
    from gsvis.export import StreamedOptions, TilesOptions, write_glb, write_streamed_sog, write_tiles
    from gsvis.export.leaves import LEAF

    if store is not None and command.where.up is None:
        up = None  # the visible sets know it
    leaf = command.leaf or LEAF
    more: dict[str, Any] = {"visibility": store, "overwrite": command.overwrite, "progress": status}
    if command.format == "streamed-sog":
        streamed = StreamedOptions(leaf=leaf, never_seen=command.never_seen, name=name, up=up)
        return write_streamed_sog(command.out, scene, streamed, **more)
    single = command.format == "glb"
    options = TilesOptions(
        leaf=leaf,
        never_seen=command.never_seen,
        compression=("none" if single else "spz") if command.compression == "auto" else command.compression,
        request_volumes=command.request_volumes,
        up=up,
        meters_per_unit=command.meters_per_unit,
    )
    if single:
        return write_glb(command.out, scene, options, progress=status)
    return write_tiles(command.out, scene, options, **more)


def print_leaves(command: Export, found: Any) -> None:
    """Print what the files take; `found` is the report of `write_leaves`."""
    if command.output.json:
        about = {"format": "gsvis-export", "version": 1, "in": command.scene, "out": command.out}
        listed = {key: value for key, value in asdict(found).items() if key not in ("path", "nbytes")}
        print_json({**about, "kind": command.format, "bytes": found.nbytes, **listed})
    elif command.format == "glb":
        degree = f"SH degree {found.sh_degree}"
        show(f"{command.out}: {found.gaussians:,} Gaussians, {degree}, {size_of(found.nbytes)}")
    elif command.format == "3dtiles":
        show(facts(f"{command.out}: {found.tiles:,} tiles, {size_of(found.nbytes)}", _tiles_rows(found)))
        show(f"Show it: CesiumJS opens {command.out}/tileset.json (docs/how-to/tiles.md)")
    else:
        show(facts(f"{command.out}: {found.leaves:,} leaves, {size_of(found.nbytes)}", _streamed_rows(found)))
        show(f"Show it: examples/streamed, or any viewer that opens {command.out}/lod-meta.json")


def _streamed_rows(found: StreamedReport) -> list[tuple[str, str]]:
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


def _tiles_rows(found: TilesReport) -> list[tuple[str, str]]:
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
