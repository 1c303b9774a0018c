"""`gsvis export --format streamed-sog`: leaves for PlayCanvas' engine, and the leaves that each cell needs."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from gsvis.cli.arguments import Export
from gsvis.cli.terminal import Status, facts, print_json, show, size_of

if TYPE_CHECKING:
    from gsvis.export import StreamedReport

__all__ = ["export_streamed"]


def export_streamed(command: Export) -> None:
    """Write a scene as streamed SOG, and print what it takes; the target has been checked."""
    from gsvis.cli.export import open_scene
    from gsvis.export import StreamedOptions, write_streamed_sog
    from gsvis.export.leaves import LEAF
    from gsvis.pvs.store import VisibilityStore

    with ExitStack() as stack, Status() as status:
        store = None if command.pvs is None else stack.enter_context(VisibilityStore.open(command.pvs))
        scene, name, up, _ = open_scene(command, stack, status)
        if store is not None and command.where.up is None:
            up = None  # the visible sets know it
        options = StreamedOptions(leaf=command.leaf or LEAF, never_seen=command.never_seen, name=name, up=up)
        found = write_streamed_sog(
            command.out, scene, options, visibility=store, overwrite=command.overwrite, progress=status
        )
    if command.output.json:
        given: dict[str, Any] = {"format": "gsvis-export", "version": 1, "in": command.scene, "out": command.out}
        print_json({**given, "kind": command.format, "bytes": found.nbytes, **_facts(found)})
        return
    show(facts(f"{command.out}: {found.leaves:,} leaves, {size_of(found.nbytes)}", _rows(found)))
    show(f"Show it: examples/streamed, or any viewer that opens {command.out}/lod-meta.json")


def _facts(found: StreamedReport) -> dict[str, Any]:
    listed = asdict(found)
    del listed["path"], listed["nbytes"]
    return {**listed, "counts": list(found.counts)}


def _rows(found: StreamedReport) -> list[tuple[str, str]]:
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
