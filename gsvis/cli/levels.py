"""`gsvis levels`: train lower levels of a scene that share Gaussians with it; write a folder, measure quality."""

from __future__ import annotations

import math
import os
import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from gsvis._extras import require
from gsvis.cli.arguments import Levels
from gsvis.cli.asking import settle_space
from gsvis.cli.image_size import image_size
from gsvis.cli.kernels import warm_levels
from gsvis.cli.levels_result import print_result, record_of
from gsvis.cli.memory import check_memory, machine_memory, training_grows
from gsvis.cli.options import refuse
from gsvis.cli.source import Source, check_source, open_source, parse_up
from gsvis.cli.stopping import between_steps
from gsvis.cli.targets import check_exists
from gsvis.cli.terminal import Status
from gsvis.cli.where import check_where
from gsvis.errors import ArgumentError, FormatError, OutputError
from gsvis.files.atomic import find_interrupted_moves
from gsvis.files.output import check_folder
from gsvis.io.levels import MAP, check_names, levels_info, load_levels, save_levels
from gsvis.scene.content import scene_hash
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.paths import HeadPath

if TYPE_CHECKING:
    from gsvis.cli.options import Levels as Training
    from gsvis.scene.view_sampling import ViewSampling
    from gsvis.train.level_views import LevelViews
    from gsvis.train.levels import LevelsConfig, TrainedLevels

__all__ = [
    "check_views",
    "image_bytes",
    "level_image_size",
    "levels_config",
    "named_option",
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
_MEMORY_SHARE = 0.5  # share of the machine's memory for images


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
    with Status() as status:
        plan = _plan(command, config, walk, status)
        warm_levels(config, status)
        trained, record = _run(plan.command, plan, status)
        seconds = dict(status.seconds)
    print_result(command, trained.levels, record, plan.space, plan.remarks, seconds)


def _begun(work: Path) -> bool:
    """Return whether a folder of unfinished work holds anything to resume from."""
    from gsvis.train.importance import ROUNDS
    from gsvis.train.levels import SUBSETS

    return (work / SUBSETS).exists() or (work / ROUNDS).exists()


def _target(out: str) -> Path:
    return Path(os.path.abspath(out))


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
    check_folder(command.out)
    check_folder(_target(command.out).parent)  # unfinished work is kept there
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
        config = LevelsConfig(shares, reuse, names, training.steps, seed=seed)
        if training.preview is not None:  # also in a small scene
            config = replace(config, preview=training.preview, preview_from=0)
        check_names(names)
    except ValueError as error:
        raise named_option(error) from None
    return config


def _held_out(command: Levels) -> int:
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
    try:
        config.sizes(len(g))
    except ValueError as error:
        raise named_option(error) from None
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

    work = find_levels_work(_target(command.out), g, drawn, config)
    if _begun(work):
        status.line(f"resuming from {work.name}, which an earlier run left")
        remarks.append(" It resumed from what an earlier run had kept; the time is that of this run alone.")
    return _Plan(command, source, config, drawn, work, space, remarks)


def _check_target(command: Levels, names: tuple[str, ...]) -> None:
    """Raise, before work begins, if a file that is not a level would be replaced: a typo must not destroy a scene."""
    folder = _target(command.out)
    files = {name: folder / f"{name}.ply" for name in names}
    for file in files.values():
        if file.exists() and Path(command.scene).exists() and file.samefile(command.scene):
            raise ValueError(f"--out: expected a folder of its own, got {command.out}, whose {file.name} is read")
    known = find_interrupted_moves(folder)
    if (folder / MAP).exists():
        wanted = f"--out: expected a new folder, or levels of this scene to replace, got {command.out}"
        try:
            known |= {*levels_info(folder).files}
        except FormatError as error:
            raise ValueError(f"{wanted}, which cannot be read ({error}); name another, or delete it") from None
    for file in files.values():
        if file.exists() and file.name not in known:
            raise ValueError(
                f"--out: expected a folder without {file.name}, got {command.out}, which has one that no {MAP} knows;"
                " name another, or move it away"
            )


def _check_replaced(command: Levels, g: Gaussians) -> None:
    """Raise if levels of another scene would be replaced: they took hours of training."""
    folder = _target(command.out)
    if not (folder / MAP).exists():
        return
    wanted = f"--out: expected a new folder, or levels of this scene to replace, got {command.out}"
    try:
        held = load_levels(folder)
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


def named_option(error: ValueError) -> ValueError:
    """Return an error of the settings of levels as one of the option that states them."""
    if not isinstance(error, ArgumentError):
        return ValueError(f"--{error}")
    if error.name != "shares":
        return error.renamed(f"--{error.name.replace('_', '-')}")
    return error.renamed("--levels", error.remedy or "larger shares, or a finer --lod")


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
    try:
        with between_steps() as stop_if_asked:
            said = "", 0

            def report(stage: str, done: int, total: int) -> None:
                nonlocal said
                if (stage, done) != said:  # the last step may be reported twice
                    status(stage.replace("train ", "training ", 1), done, total)
                said = stage, done
                stop_if_asked()

            made = make_levels(g, plan.drawn, plan.config, work=work, progress=report)
        plan.remarks.extend([f" {made.warning}"] if made.warning else [])
        record = record_of(command, plan, made.trained, made.quality, made.judged)
        up = plan.source.known_up if command.where.up is None else parse_up(command.where.up)
        if up is not None:
            record["up"] = [float(value) for value in up]
        status("writing", 0, 1)
        save_levels(made.trained.levels, command.out, record)
        status("writing", 1, 1)
    except KeyboardInterrupt:
        if not _begun(work):
            shutil.rmtree(work, ignore_errors=True)
            raise
        raise KeyboardInterrupt(
            f"what was chosen and trained is kept in {work.name}; run the same command to resume"
        ) from None
    except OutputError as error:
        if not _begun(work):
            shutil.rmtree(work, ignore_errors=True)
            raise
        raise error.keeping(f"what was chosen and trained is kept in {work.name}") from error
    shutil.rmtree(work, ignore_errors=True)
    return made.trained, record
