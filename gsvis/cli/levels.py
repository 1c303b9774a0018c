"""`gsvis levels`: train lower levels of a scene that share Gaussians with it; write a folder, measure quality."""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gsvis._extras import require
from gsvis.cli import version
from gsvis.cli.arguments import Levels
from gsvis.cli.asking import settle_space
from gsvis.cli.device import say_device
from gsvis.cli.memory import check_memory, machine_memory, training_grows
from gsvis.cli.options import image_size, naming, refuse
from gsvis.cli.source import open_source
from gsvis.cli.stopping import between_steps, resumable
from gsvis.cli.targets import check_exists
from gsvis.cli.terminal import Status, clock, facts, print_json, show, size_of
from gsvis.cli.where import check_where, kind_row, parse_up, space_document
from gsvis.errors import FormatError
from gsvis.files.output import check_folder
from gsvis.io.levels import MAP, check_levels_target, check_names, load_levels, save_levels
from gsvis.io.sources import check_source
from gsvis.jobs.freed_memory import keep_freed_memory
from gsvis.prepare.warm import warm_levels
from gsvis.render.device import choose_device
from gsvis.scene.content import scene_hash
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels as SceneLevels
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.paths import HeadPath
from gsvis.scene.source import Source

if TYPE_CHECKING:
    from gsvis.cli.options import Levels as Training
    from gsvis.scene.navigable import NavigableSpace
    from gsvis.scene.view_sampling import ViewSampling
    from gsvis.train.level_views import LevelViews
    from gsvis.train.levels import LevelsConfig, TrainedLevels

__all__ = [
    "SHARES",
    "check_views",
    "image_bytes",
    "level_image_size",
    "levels_config",
    "run_levels",
    "view_sampling",
]

_VIEWS = 400
_HELD_OUT = 12
_WIDTH = 480
_HEIGHT = 360
_FOV = 2.0 * math.degrees(math.atan(240.0 / 300.0))
_NAMES = {1: ("low", "high"), 2: ("low", "medium", "high")}
_REUSE = (0.90, 0.96)  # for each level; the last repeats
_LEAST_SIDE = 16  # pixels; SSIM needs 11
SHARES = {"shares": "--levels; larger shares, or a finer --lod"}
"""The option of the argument of `LevelsConfig` that states sizes."""

_MEMORY_SHARE = 0.5  # share of the machine's memory for images
_MOST_OVERHEAD = 0.05


@dataclass(frozen=True, eq=False)
class _Plan:
    """What to do.

    Attributes:
        command: The arguments, with the answers of the user.
        source: The scene.
        config: Sizes and training.
        drawn: Images to train on and to measure on.
        work: The folder with unfinished work.
        space: Where eyes of renders may be; None for photographs.
        remarks: Remarks for the user.
    """

    command: Levels
    source: Source
    config: LevelsConfig
    drawn: LevelViews
    work: Path
    space: NavigableSpace | None
    remarks: list[str]


def run_levels(command: Levels) -> None:
    """Make levels: check, draw or read views, choose what stays, train, measure, write, print the result."""
    require("gsvis levels", "torch")
    config = _check_arguments(command)
    walk = check_where(command.where, "" if command.training.photos is None else "--photos")
    device = choose_device(command.device)
    config = replace(config, backend=device.backend)
    if command.max_memory is None:
        keep_freed_memory()
    with Status() as status:
        say_device(device, status)
        plan = _plan(command, config, walk, status)
        warm_levels(config, status)
        trained, record = _run(plan.command, plan, status)
        seconds = dict(status.seconds)
    _print_result(command, trained.levels, record, plan.space, plan.remarks, seconds)


def _begun(work: Path) -> bool:
    """Return whether a folder of unfinished work holds anything to resume from."""
    from gsvis.train.importance import ROUNDS
    from gsvis.train.levels import SUBSETS

    return (work / SUBSETS).exists() or (work / ROUNDS).exists()


def _begun_or_removed(work: Path) -> bool:
    """Return whether a folder of unfinished work holds anything to resume from; remove it otherwise."""
    if not _begun(work):
        shutil.rmtree(work, ignore_errors=True)
        return False
    return True


def _check_arguments(command: Levels) -> LevelsConfig:
    """Check the arguments before work begins; return the settings of the levels."""
    check_source(command.scene, command.lod)
    if command.training.photos is not None:
        check_exists(command.training.photos)
        refuse(command, ["views", "held_out", "up", "show"], "with --photos")
    size = level_image_size(command.training)
    if size is not None and min(size) < _LEAST_SIDE:
        name, got = ("--width", size[0]) if size[0] < _LEAST_SIDE else ("--height", size[1])
        raise ValueError(f"{name}: expected at least {_LEAST_SIDE} pixels, got {got}")
    config = levels_config(command.training, command.seed)
    if command.price_reuse and _held_out(command) == 0:
        raise ValueError("--price-reuse: expected held-out views to measure it in, got --held-out 0; leave out either")
    check_folder(command.out)
    check_folder(Path(os.path.abspath(command.out)).parent)  # unfinished work is kept there
    _check_target(command, config.level_names)
    images = 0
    if command.training.photos is None:
        sampling = view_sampling(command.training, command.seed)
        held_out = _held_out(command)
        check_views(sampling, held_out)
        images = image_bytes(sampling, held_out)
    elif command.max_memory is not None:
        from gsvis.train.photos import photo_bytes

        images = photo_bytes(command.training.photos, size)
    remedy = (
        "raise it, take fewer --views or a smaller --width and --height, or make levels of tiles with gsvis world"
        " --until levels"
    )
    check_memory(
        "levels",
        [(command.scene, command.lod)],
        command.max_memory,
        remedy,
        more=images,
        grows=training_grows(command.training.levels),
    )
    return config


def levels_config(training: Training, seed: int) -> LevelsConfig:
    """Return the settings of levels from the options.

    Raises:
        ValueError: If they contradict each other, or a name cannot be a file name.
    """
    from gsvis.train.levels import LevelsConfig

    shares = training.levels
    lower = len(shares)
    names = training.names or _NAMES.get(lower) or (*(f"level{k}" for k in range(lower)), "high")
    reuse = training.reuse or (*_REUSE[:lower], *_REUSE[-1:] * (lower - len(_REUSE)))
    try:
        with naming(shares="--levels"):
            config = LevelsConfig(
                shares,
                reuse,
                names,
                training.steps,
                merged=1.0 if training.grow == "merged" else 0.0,
                importance=training.importance,
                seed=seed,
            )
            if training.preview is not None:  # also in a small scene
                config = replace(config, preview=training.preview, preview_from=0)
            check_names(names)
    except ValueError as error:
        raise ValueError(f"--{str(error).removeprefix('--')}") from None
    return config


def _held_out(command: Levels) -> int:
    """Return the number of held-out views."""
    return _HELD_OUT if command.training.held_out is None else command.training.held_out


def check_views(sampling: ViewSampling, held_out: int) -> None:
    """Raise unless all images fit into half of the machine's memory.

    Raises:
        ValueError: If they do not fit.
    """
    needed = image_bytes(sampling, held_out)
    memory = machine_memory()
    if memory is not None and needed > _MEMORY_SHARE * memory:
        raise ValueError(
            f"--views: expected images that fit into half of the memory ({memory / 1e9:.1f} GB), got"
            f" {sampling.count + held_out:,} of {sampling.width} x {sampling.height}, {needed / 1e9:.1f} GB; take"
            " fewer, or smaller ones with --width and --height"
        )


def image_bytes(sampling: ViewSampling, held_out: int) -> int:
    """Return the bytes of all images of a sampling and of further ones."""
    return 12 * (sampling.count + held_out) * sampling.width * sampling.height


def _plan(command: Levels, config: LevelsConfig, walk: HeadPath | None, status: Status) -> _Plan:
    """Read the scene, draw or read the views, and find the folder of unfinished work."""
    source = open_source(command.scene, command.lod, status, "make levels of")
    g = source.gaussians
    config = config.fit_to(len(g))
    with naming(**SHARES):
        config.sizes(len(g))
    _check_replaced(command, g)
    space: NavigableSpace | None = None
    remarks: list[str] = []
    if command.training.photos is not None:
        from gsvis.train.level_views import load_photograph_views

        drawn = load_photograph_views(g, command.training.photos, level_image_size(command.training), progress=status)
    else:
        command, drawn, space, remarks = _draw_views(command, source, walk, status)
    remarks += [f" {remark}" for remark in drawn.remarks]
    least = sum((1.0 - reuse) * share for reuse, share in zip(config.reuse, config.shares, strict=True))
    if least > 0.05:
        remarks.append(
            f" Going up level by level may send {least:.1%} more than the scene alone; a higher --reuse sends less."
        )
    from gsvis.prepare.levels import find_levels_work

    work = find_levels_work(os.path.abspath(command.out), g, drawn, config)
    if _begun(work):
        status.line(f"resuming from {work.name}, which an earlier run left")
        remarks.append(" It resumed from what an earlier run had kept; the time is that of this run alone.")
    return _Plan(command, source, config, drawn, work, space, remarks)


def _check_target(command: Levels, names: tuple[str, ...]) -> None:
    """Raise, before work begins, if a file that is not a level would be replaced: a typo must not destroy a scene."""
    for name in names:
        file = Path(command.out, f"{name}.ply")
        if file.exists() and Path(command.scene).exists() and file.samefile(command.scene):
            raise ValueError(f"--out: expected a folder of its own, got {command.out}, whose {file.name} is read")
    with naming(folder="--out"):
        check_levels_target(command.out, names, "levels of this scene")


def _check_replaced(command: Levels, g: Gaussians) -> None:
    """Raise if levels of another scene would be replaced: they took hours of training."""
    if not Path(command.out, MAP).exists():
        return
    wanted = f"--out: expected a new folder, or levels of this scene to replace, got {command.out}"
    try:
        held = load_levels(command.out)
    except FormatError as error:
        raise ValueError(f"{wanted}, which cannot be read ({error}); name another, or delete it") from None
    found = scene_hash(held.level(len(held) - 1))
    if found != scene_hash(g):
        raise ValueError(f"{wanted}, which holds levels of the scene with the hash {found[:12]}...; name a new folder")


def _draw_views(
    command: Levels, source: Source, walk: HeadPath | None, status: Status
) -> tuple[Levels, LevelViews, NavigableSpace, list[str]]:
    """Render the scene to train on and to measure on, from two independent sets of cameras.

    Returns:
        The command with the answers of the user, the views, where eyes may be, and remarks.
    """
    from gsvis.train.level_views import draw_views

    remedy = "photographs with cameras, --photos, serve as well, and --box says where eyes may be"
    settled, space, remarks = settle_space(
        command.where, source, walk, status, quiet=command.output.json, remedy=remedy
    )
    sampling = view_sampling(command.training, command.seed)
    drawn = draw_views(source.gaussians, space, sampling, _held_out(command), progress=status)
    return replace(command, where=settled.where), drawn, space, remarks


def level_image_size(training: Training) -> tuple[int, int] | None:
    """Return (width, height) of the views that levels are measured on; None for the usual ones.

    Raises:
        ValueError: If only one of both is given, for photographs.
    """
    return image_size(training, (_WIDTH, _HEIGHT) if training.photos is None else None)


def view_sampling(training: Training, seed: int) -> ViewSampling:
    """Return how to sample cameras to train on without photographs."""
    from gsvis.scene.view_sampling import ViewSampling

    size = level_image_size(training) or (_WIDTH, _HEIGHT)
    return ViewSampling(training.views or _VIEWS, *size, _FOV, seed)


def _run(command: Levels, plan: _Plan, status: Status) -> tuple[TrainedLevels, dict[str, object]]:
    """Train the levels, measure them and write all files; return the levels and their record."""
    from gsvis.prepare.levels import make_levels

    g = plan.source.gaussians
    work = plan.work
    kept = f"what was chosen and trained is kept in {work.name}"
    with resumable(kept, has=lambda: _begun_or_removed(work)), between_steps() as stop_if_asked:
        said = "", 0

        def report(stage: str, done: int, total: int) -> None:
            nonlocal said
            if (stage, done) != said:  # the last step may be reported twice
                status(stage.replace("train ", "training ", 1), done, total)
            said = stage, done
            stop_if_asked()

        made = make_levels(g, plan.drawn, plan.config, work=work, price_reuse=command.price_reuse, progress=report)
    plan.remarks.extend([f" {made.warning}"] if made.warning else [])
    about = {"made_by": f"gsvis {version()}", "scene": plan.source.name, "lod": plan.source.lod}
    record = about | made.record(g, plan.drawn, plan.config)
    up = plan.source.known_up if command.where.up is None else parse_up(command.where.up)
    if up is not None:
        record["up"] = [float(value) for value in up]
    with resumable(kept, has=lambda: _begun_or_removed(work)), status.stage("writing"):
        save_levels(made.trained.levels, command.out, record)
    shutil.rmtree(work, ignore_errors=True)
    return made.trained, record


def _print_result(
    command: Levels,
    levels: SceneLevels,
    record: Mapping[str, Any],
    space: NavigableSpace | None,
    remarks: list[str],
    seconds: Mapping[str, float],
) -> None:
    """Print the document or the tables."""
    folder = Path(command.out)
    rows = [{**row, "file": f"{row['name']}.ply"} for row in record["levels"]]
    for row in rows:
        row["bytes"] = (folder / row["file"]).stat().st_size
    spent = sum(value for stage, value in seconds.items() if stage != "kernels")
    if command.output.json:
        about = {name: value for name, value in record.items() if name != "levels"}
        times = {stage: value for stage, value in seconds.items() if stage != "kernels"}
        about["space"] = None if space is None else space_document(space)
        more = {"out": command.out, "levels": rows, "remarks": [each.strip() for each in remarks], "seconds": times}
        print_json({"format": "gsvis-levels", "version": 1, **about, **more})
        return
    views = record["views"]
    photographs = record["views"]["photographs"]
    header = ["level", "Gaussians", "share", "reuse"]
    if views["held_out"]:
        header += ["PSNR", "photos", "brightness"] if photographs else ["PSNR", "brightness"]
    header.append("PLY")
    table = facts(f"{record['scene']}: levels", [_cells(row, rows[-1], views) for row in rows], header)
    size = f"{views['width']} x {views['height']}"
    lines = [
        ("views", f"{views['trained_on']:,} to train on, {views['held_out']:,} held out, {size}"),
        ("their cameras", views["from"]),
        *([] if space is None else [kind_row(space)]),
        ("steps", f"{record['config']['iterations']:,} for each lower level"),
        (
            "going up level by level",
            f"sends {record['overhead']:.1%} more than the scene alone ({record['union']:,} Gaussians)",
        ),
        ("time", clock(spent)),
    ]
    written = f" Written to {command.out}: {', '.join(row['file'] for row in rows)}, {MAP}."
    show(table, facts("", lines), *_explain(record), *remarks, written)


def _cells(row: Mapping[str, Any], top: Mapping[str, Any], views: Mapping[str, Any]) -> list[str]:
    """Return the row of a level in the table."""
    cells = [row["name"], f"{row['gaussians']:,}", f"{row['share']:.1%}"]
    cells.append("" if row["reuse"] is None else f"{row['reuse']:.1%}")
    if views["held_out"]:
        cells.append("" if row["psnr"] is None else f"{row['psnr']['mean']:.2f} dB")
        if views["photographs"]:
            cells.append(f"{row['psnr_photographs']['mean']:.2f} dB")
        drift = "" if row is top else f" ({row['brightness'] / max(top['brightness'], 1e-9) - 1.0:+.1%})"
        cells.append(f"{row['brightness']:.3f}{drift}")
    return [*cells, size_of(row["bytes"])]


def _explain(record: Mapping[str, Any]) -> list[str]:
    """Return lines that explain the columns and say what went wrong."""
    views = record["views"]
    top = record["levels"][-1]["name"]
    lines = [
        f" Reuse is the share of a level that stands unchanged in the next; {top} is the scene itself, bit by bit."
    ]
    if views["held_out"]:
        photos = ", photos against the photographs themselves" if views["photographs"] else ""
        lines.append(
            f" PSNR is the mean over the held-out views against renders of the scene{photos}; brightness is the mean of"
            " all pixels, where 1 is white."
        )
        for row in record["levels"]:
            if "reuse_costs" in row:
                costs = row["reuse_costs"]
                lines.append(
                    f" {row['name']}: reuse costs {costs['mean']:.2f} dB, {costs['worst']:.2f} in the worst view,"
                    " against a level of this size that reuses nothing."
                )
        checked = [row for row in record["levels"] if "judged" in row]
        lines += [f" {row['name']}, by other eyes: {row['judged']['line']}." for row in checked]
    else:
        lines.append(" No view was held out, so nothing was measured.")
    if record["overhead"] > _MOST_OVERHEAD:
        lines.append(" Going up sends more than 5% more than the scene alone: a higher --reuse, or lower --levels.")
    return lines
