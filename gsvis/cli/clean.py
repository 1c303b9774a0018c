"""`gsvis clean`: find what no eye sees, fog, floaters and flyaways; report, show, select or remove it."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gsvis.cli import version
from gsvis.cli.arguments import Clean
from gsvis.cli.asking import settle
from gsvis.cli.memory import count_gaussians, expected_memory
from gsvis.cli.options import Where, changed, command_line, config_of, leaves, refuse
from gsvis.cli.source import open_source
from gsvis.cli.targets import check_exists, check_one_level, check_outputs, check_report, check_scene_out
from gsvis.cli.terminal import Status, facts, least_size_of, print_json, show, size_of
from gsvis.cli.where import check_where, find_place, framed_cameras, parse_up, space_document
from gsvis.errors import SceneError
from gsvis.files.temporary import temporary_folder
from gsvis.io.cameras import load_cameras_at
from gsvis.io.scenes import suffix_of
from gsvis.io.sources import check_source, is_builtin
from gsvis.scene.place import Place

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from gsvis.edit import CleanConfig, Cleaning, LargeCleaning
    from gsvis.jobs.objects import ObjectStore
    from gsvis.scene.cameras import Cameras
    from gsvis.scene.navigable import NavigableSpace
    from gsvis.scene.paths import HeadPath
    from gsvis.scene.source import Source

__all__ = ["run_clean"]

_CAMERAS = 200  # most photographs whose viewpoints are eyes
_APPLIED = ("out", "lod", "apply", "classes", "max_memory", "overwrite", "json", "drop_invalid", "debug")
"""Options that go with --apply."""

_WHOLE = ("report", "select", "apply", "cameras", "cameras_frame", "show", *Where.WORDS)
"""Options that need the whole scene."""

_LEAST = 50_000  # Gaussians of a tile: smaller ones are mostly halo
_MOST_UNSEEN = 0.2  # of a scene that no eye sees, above which there is a warning


def run_clean(command: Clean) -> None:
    """Clean a scene: read, look, guard, write what was asked for, print the result."""
    config = _check_arguments(command)
    if _in_tiles(command):
        _clean_in_tiles(command, config)
        return
    walk = check_where(command.where)
    cameras = (
        None if command.where.cameras is None else load_cameras_at(command.where.cameras, None, None).evenly(_CAMERAS)
    )
    with Status() as status:
        source = open_source(command.scene, command.lod, status, "clean")
        if command.apply is not None:
            _apply(command, config, source, status)
            return
        framed: list[str] = []
        if cameras is not None:
            cameras, framed = framed_cameras(source, cameras, command.where)
        command, found, place, remarks = _find(command, config, source, walk, cameras, status)
        remarks = [*framed, *remarks]
        _check_left(command, found.kept)
        picture = None
        if command.report is not None:
            from gsvis.report.readings import picture_of

            picture = picture_of(source, place)
        document = _write(command, config, source, found, remarks, picture, status)
    if command.output.json:
        print_json(document)
        return
    show(*_tables(document, source), *remarks, *_lines(command, document))


def _check_arguments(command: Clean) -> CleanConfig:
    """Check the arguments before work begins; return the settings."""
    from gsvis.edit import CLASSES, CleanConfig

    check_source(command.scene, command.lod)
    check_one_level(command.scene)
    search = command.search
    try:
        config = config_of(
            CleanConfig,
            search,
            classes=command.classes or CLASSES,
            least_db=search.min_psnr,
            most_changed=search.max_changed,
        )
    except ValueError as error:
        raise ValueError(f"--{str(error).replace('_', '-', 1)}") from None
    if command.apply is not None:
        _check_apply(command)
    _check_outputs(command)
    if command.report is not None:
        check_report(command.report)
    return config


def _check_apply(command: Clean) -> None:
    """Raise if --apply is given without -o, or with an option that looks for something."""
    assert command.apply is not None
    if command.out is None:
        raise ValueError("--apply: expected -o OUT with it, got none; add it")
    names = [leaf.name for leaf in leaves(Clean) if leaf.name not in _APPLIED and not leaf.is_positional]
    refuse(command, names, "with --apply, which looks for nothing")
    check_exists(command.apply)


def _check_outputs(command: Clean) -> None:
    """Raise unless the files of -o and --select can be written."""
    from gsvis.io.selection import note_of

    outputs: dict[str, Path] = {}
    if command.out is not None:
        outputs["-o"] = check_scene_out(command.out, command.scene, command.overwrite, name="-o")
    if command.select is not None:
        target = Path(command.select)
        if target.suffix != ".npy":
            raise ValueError(f"--select: expected a name that ends in .npy, got {command.select!r}")
        outputs |= {"--select": target, "the note of --select": note_of(target)}
    check_outputs(outputs, {"SCENE": command.scene}, command.overwrite)


def _find(
    command: Clean, config: CleanConfig, source: Source, walk: HeadPath | None, cameras: Cameras | None, status: Status
) -> tuple[Clean, Cleaning, Place, list[str]]:
    """Find navigable space, without haze and flyaways, and what can go; return remarks, and the command as answered."""
    from gsvis.edit import clean, core_of, find_in_parcels

    with status.stage("space"):
        surfaces = replace(source, gaussians=core_of(source.gaussians))
        settled = settle(
            command.where,
            source,
            lambda where: find_place(surfaces, where, walk, cameras),
            status,
            quiet=command.output.json,
        )
        command = replace(command, where=settled.where)
        place = settled.place
        space = place.required("say where eyes may be with --box, --around or --path")
        stated = space.kind.kind == "given" or command.where.kind not in (None, "auto")
        if not command.where.given and cameras is None and not stated:
            space = find_in_parcels(surfaces.gaussians, space, progress=status)
    looking, space = _split(space, cameras)
    found = clean(source.gaussians, navigable=space, cameras=looking, config=config, progress=status)
    remark = "" if command.where.given else _remark_on_unseen(found.counts, len(source.gaussians))
    return command, found, place, [*settled.remarks, *([f" {remark}."] if remark else [])]


def _split(space: NavigableSpace, cameras: Cameras | None) -> tuple[Cameras | None, NavigableSpace]:
    """Return the cameras whose eyes look, and the space with the others as witnesses; those of it without cameras."""
    from gsvis.scene.witnesses import Witnesses, hold_out

    if cameras is None:
        return None, space
    looking, kept = hold_out(len(cameras))
    named = f"{len(kept):,} cameras that were held out"
    return cameras[looking], replace(space, witnesses=Witnesses(cameras[kept], named) if len(kept) else None)


def _check_left(command: Clean, kept: NDArray[np.bool_]) -> None:
    """Raise if no Gaussian would stay."""
    if not kept.any():
        raise SceneError(f"{command.scene}: everything would go: nothing written; name fewer --classes")


def _write(
    command: Clean,
    config: CleanConfig,
    source: Source,
    found: Cleaning,
    remarks: list[str],
    picture: bytes | None,
    status: Status,
) -> dict[str, Any]:
    """Write what was asked for; return the document of the result."""
    from gsvis.edit import CLASSES
    from gsvis.io import save_scene
    from gsvis.io.selection import save_selection
    from gsvis.report.clean_report import CleanSubject, clean_document, write_clean_report

    g = source.gaussians
    subject = CleanSubject(
        title=source.name,
        gaussians=g,
        command=command_line(command, ("show", "apply", "max_memory", "overwrite")),
        version=version(),
        parameters={**asdict(config), "classes": list(config.classes), "cameras": command.where.cameras},
        facts={
            "path": command.scene,
            "lod": source.lod,
            "space": space_document(found.navigable),
            "remarks": [each.strip() for each in remarks],
        },
        seconds=dict(status.seconds),
        place=picture,
    )
    if command.report is not None:
        write_clean_report(command.report, found, subject, progress=status)
    status("writing", 0, 1)
    if command.select is not None:
        save_selection(command.select, found.classes, g, CLASSES)
    if command.out is not None:
        save_scene(g[found.kept], command.out)
    status("writing", 1, 1)
    return {**clean_document(found, subject), "out": command.out, "select": command.select, "report": command.report}


def _apply(command: Clean, config: CleanConfig, source: Source, status: Status) -> None:
    """Remove what a selection says, and print it."""
    from gsvis.edit import CLASSES, KEPT, class_of
    from gsvis.io import save_scene
    from gsvis.io.selection import load_selection

    assert command.apply is not None
    assert command.out is not None
    classes = load_selection(command.apply, source.gaussians)
    kept = classes == KEPT
    if command.classes is not None:  # other numbers than those of gsvis are chosen by no name
        kept = ~np.isin(classes, [class_of(name) for name in config.classes])
    _check_left(command, kept)
    status("writing", 0, 1)
    save_scene(source.gaussians[kept], command.out)
    status("writing", 1, 1)
    if command.output.json:
        counts = {name: int(np.count_nonzero(~kept & (classes == class_of(name)))) for name in CLASSES}
        print_json(
            {
                "format": "gsvis-clean",
                "version": 1,
                "in": command.scene,
                "out": command.out,
                "apply": command.apply,
                "gaussians": len(kept),
                "kept": int(np.count_nonzero(kept)),
                "removed": counts,
            }
        )
        return
    show(_written(command.out, int(np.count_nonzero(kept)), len(kept)))


def _written(out: str, kept: int, of: int) -> str:
    """Return the line about the scene that was written."""
    return f"{out}: {kept:,} of {of:,} Gaussians, {size_of(Path(out).stat().st_size)}"


def _tables(document: dict[str, Any], source: Source) -> list[Any]:
    """Return the table of the classes."""
    rows = []
    for name, each in document["classes"].items():
        goes = each["removed"]
        back = each["found"] - each["removed"]
        share = f"{goes / document['gaussians']:.2%}"
        rows.append((name, f"{goes:,}", share, f"{back:,}", *_cost_cells(each["cost"])))
    gone = document["gaussians"] - document["kept"]
    rows.append(("all", f"{gone:,}", f"{gone / document['gaussians']:.2%}", "", *_cost_cells(document["cost"])))
    header = ("class", "goes", "share", "given back", "dB", "worst", "changed")
    return [facts(f"{source.name}: {document['gaussians']:,} Gaussians", rows, header)]


def _cost_cells(cost: dict[str, float] | None) -> tuple[str, str, str]:
    """Return the cells of a row for what it costs to remove something; empty ones without a guard."""
    if not cost:
        return "", "", ""
    return f"{cost['mean_db']:.1f}", f"{cost['worst_db']:.1f}", f"{cost['changed']:.2%}"


def _lines(command: Clean, document: dict[str, Any]) -> list[str]:
    """Return lines that say what was written, and what to do next."""
    lines = []
    if document["judged"]:
        lines.append(f" By eyes that navigable space did not choose: {document['judged']['line']}.")
        if document["judged"]["warning"]:
            lines.append(f" {document['judged']['warning']}")
    if document["cost"]:
        lines.append(" dB: held-out views against the whole scene. changed: share of pixels that show mostly this.")
    if command.report is not None:
        lines.append(f" Report: {Path(command.report) / 'report.html'}")
    if command.select is not None:
        lines.append(f" Selection: {command.select}; remove it with --apply {command.select} -o OUT")
    if command.out is not None:
        lines.append(_written(command.out, document["kept"], document["gaussians"]))
    elif command.select is None:
        lines.append(" Nothing was removed; -o OUT writes the clean scene.")
    return lines


def _in_tiles(command: Clean) -> bool:
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
    if command.out is not None and suffix_of(command.out) != ".ply":
        raise ValueError(f"{words}, got {size_of(command.max_memory)}; tiles are written to a .ply: name one with -o")
    if _most(command.max_memory) < _LEAST:
        from gsvis.edit.large import JOINT

        least = min(need, expected_memory("clean", int(_LEAST * JOINT) + 1, 0))
        raise ValueError(
            f"--max-memory: expected at least {least_size_of(least)} for a tile of {count:,} Gaussians, got"
            f" {size_of(command.max_memory)}; raise it, or take a coarser --lod"
        )
    return True


def _clean_in_tiles(command: Clean, config: CleanConfig) -> None:
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
            if remark := _remark_on_unseen(found.removed, found.gaussians):
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
        show(_written(command.out, found.kept, found.gaussians))


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


def _remark_on_unseen(removed: dict[str, int], gaussians: int) -> str:
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
    """Return the worst PSNR of a class as text; empty without a guard."""
    return f"{found.worst_db[name]:.1f}" if name in found.worst_db else ""


def _document(command: Clean, found: LargeCleaning) -> dict[str, Any]:
    """Return the result of cleaning in tiles as JSON."""
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
