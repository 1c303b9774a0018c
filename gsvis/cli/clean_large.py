"""`gsvis clean` of a scene that does not fit `--max-memory`: in tiles, each with what lies around it."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gsvis.cli import version
from gsvis.cli.arguments import Clean
from gsvis.cli.memory import count_gaussians, expected_memory
from gsvis.cli.options import Where, changed
from gsvis.cli.source import is_builtin, parse_up
from gsvis.cli.terminal import Status, facts, least_size_of, print_json, show, size_of
from gsvis.errors import SceneError
from gsvis.files.temporary import temporary_folder

if TYPE_CHECKING:
    from gsvis.edit import CleanConfig, LargeCleaning
    from gsvis.jobs.objects import ObjectStore

__all__ = ["clean_in_tiles", "in_tiles", "remark_on_unseen"]

_WHOLE = ("report", "select", "apply", "cameras", "cameras_frame", "show", *Where.WORDS)
"""Options that need the whole scene."""

_LEAST = 50_000  # Gaussians of a tile: smaller ones are mostly halo
_MOST_UNSEEN = 0.2  # of a scene that no eye sees, above which there is a warning


def in_tiles(command: Clean) -> bool:
    """Return whether a scene is to be cleaned in tiles, because it does not fit `--max-memory`.

    Raises:
        ValueError: If not even a tile fits, or an option needs the whole scene.
    """
    if command.max_memory is None or is_builtin(command.scene):
        return False
    count, degree = count_gaussians(command.scene, command.lod)
    need = expected_memory("clean", count, degree)
    if need <= command.max_memory:
        return False
    words = f"--max-memory: expected at least {least_size_of(need)} for {count:,} Gaussians at once"
    for option in changed(command, _WHOLE):
        raise ValueError(f"{words}, got {size_of(command.max_memory)}; {option} needs all of them: leave it out")
    if command.out is not None and Path(command.out).suffix.lower() != ".ply":
        raise ValueError(f"{words}, got {size_of(command.max_memory)}; tiles are written to a .ply: name one with -o")
    if _most(command.max_memory) < _LEAST:
        from gsvis.edit.large import JOINT

        least = min(need, expected_memory("clean", int(_LEAST * JOINT) + 1, 0))
        raise ValueError(
            f"--max-memory: expected at least {least_size_of(least)} for a tile of {count:,} Gaussians, got"
            f" {size_of(command.max_memory)}; raise it, or take a coarser --lod"
        )
    return True


def clean_in_tiles(command: Clean, config: CleanConfig) -> None:
    """Clean a scene in tiles: look, guard, write the PLY, print the result."""
    from gsvis.edit import clean_large
    from gsvis.io.ply import save_ply_parts
    from gsvis.jobs.workers import Workers
    from gsvis.world.tiling import TilingConfig

    assert command.max_memory is not None
    up = parse_up(command.where.up)
    direction = None if up is None else (float(up[0]), float(up[1]), float(up[2]))
    tiling = TilingConfig(_most(command.max_memory), up=direction)
    with Status() as status:
        status.line(f"{command.scene}: does not fit {size_of(command.max_memory)}, so it is cleaned in tiles")
        with _store(command) as store:
            found = clean_large(
                (command.scene, command.lod),
                config,
                tiling,
                store,
                workers=Workers(1, command.max_memory),
                progress=status,
            )
            for each in found.build.grid["remarks"]:
                status.line(f"{command.scene}: {each}")
            if remark := remark_on_unseen(found.removed, found.gaussians):
                status.line(f"{command.scene}: {remark}")
            if not found.kept:
                raise SceneError(f"{command.scene}: everything would go: nothing written; name fewer --classes")
            if command.out is not None:
                status("writing", 0, 1)
                save_ply_parts(found.parts(), command.out, found.kept, found.sh_degree, found.facts)
                status("writing", 1, 1)
    if command.output.json:
        print_json(_document(command, found))
        return
    rows = [
        (name, f"{gone:,}", f"{gone / found.gaussians:.2%}", f"{found.found[name] - gone:,}", _decibels(found, name))
        for name, gone in found.removed.items()
    ]
    gone = found.gaussians - found.kept
    rows.append(("all", f"{gone:,}", f"{gone / found.gaussians:.2%}", "", _decibels(found, "all")))
    header = ("class", "goes", "share", "given back", "worst dB")
    show(facts(f"{command.scene}: {found.gaussians:,} Gaussians in {found.tiles} tiles", rows, header))
    if found.judged is not None:
        show(f" By eyes that navigable space did not choose: {found.judged.line}.")
        if found.judged.warning:
            show(f" {found.judged.warning}")
    if command.out is None:
        show(" Nothing was removed; -o OUT writes the clean scene.")
    else:
        size = size_of(Path(command.out).stat().st_size)
        show(f"{command.out}: {found.kept:,} of {found.gaussians:,} Gaussians, {size}")


def _most(max_memory: int) -> int:
    """Return the most Gaussians of a tile that fits the memory with what is around it; all have base colors alone."""
    from gsvis.edit.large import JOINT
    from gsvis.edit.memory import most_gaussians

    return int(most_gaussians(max_memory, 0) / JOINT)


@contextmanager
def _store(command: Clean) -> Iterator[ObjectStore]:
    """Yield where results of tasks lie: beside OUT until it is complete, so that a killed run resumes."""
    from gsvis.jobs.objects import open_store
    from gsvis.jobs.work_folder import WorkFolder

    if command.out is None:
        with temporary_folder() as folder:
            yield open_store(folder)
        return
    work = WorkFolder(command.out)
    with work.opened():
        yield open_store(work.folder)
    shutil.rmtree(work.folder, ignore_errors=True)


def remark_on_unseen(removed: dict[str, int], gaussians: int) -> str:
    """Return a remark if much of a scene goes because no eye sees it; else nothing.

    Args:
        removed: Gaussians that go, by class.
        gaussians: Of the scene.
    """
    share = sum(removed.get(name, 0) for name in ("interior", "unseen")) / max(1, gaussians)
    if share <= _MOST_UNSEEN:
        return ""
    return (
        f"{share:.0%} is never seen from where eyes were found; if people are elsewhere too, leave interior and unseen"
        " out of --classes"
    )


def _decibels(found: LargeCleaning, name: str) -> str:
    return f"{found.worst_db[name]:.1f}" if name in found.worst_db else ""


def _document(command: Clean, found: LargeCleaning) -> dict[str, Any]:
    classes = {
        name: {"found": found.found[name], "removed": gone, "worst_db": found.worst_db.get(name)}
        for name, gone in found.removed.items()
    }
    return {
        "format": "gsvis-clean",
        "version": 1,
        "gsvis": version(),
        "in": command.scene,
        "lod": command.lod,
        "out": command.out,
        "gaussians": found.gaussians,
        "kept": found.kept,
        "tiles": found.tiles,
        "classes": classes,
        "worst_db": found.worst_db.get("all"),
        "judged": None if found.judged is None else {k: v for k, v in found.judged.as_dict().items() if k != "psnr"},
    }
