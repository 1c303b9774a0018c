"""`gsvis prepare`: make a package to serve from a scene; resume an interrupted run."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from gsvis.cli import version
from gsvis.cli.arguments import Prepare
from gsvis.cli.asking import settle
from gsvis.cli.color import fit_config
from gsvis.cli.kernels import warm_colors, warm_levels, warm_sets
from gsvis.cli.levels import (
    check_views,
    image_bytes,
    level_image_size,
    levels_config,
    named_option,
    view_sampling,
)
from gsvis.cli.made_from import about_source
from gsvis.cli.memory import check_preparation
from gsvis.cli.prepare_result import print_estimate, print_result
from gsvis.cli.pvs import local_workers, named_memory, sets_config
from gsvis.cli.showing import check_show
from gsvis.cli.source import check_folder, check_source, is_builtin, is_levels, load_source, parse_up
from gsvis.cli.stopping import between_steps
from gsvis.cli.terminal import Status
from gsvis.cli.where import check_where, find_place, suspect_views
from gsvis.errors import ArgumentError, SceneError
from gsvis.package.made_from import note_paths

if TYPE_CHECKING:
    from gsvis.prepare import PrepareConfig
    from gsvis.scene.cameras import Cameras

__all__ = ["run_prepare"]

_OF_TRAINING = ("levels", "reuse", "names", "preview", "steps", "views", "width", "height", "photos")


def run_prepare(command: Prepare) -> None:
    """Prepare a package: check, make what is missing, write the package, print the result.

    Raises:
        GsvisError: If a file cannot be read, or the scene or the photographs cannot be used.
        ValueError: If an argument is wrong, or something else would be replaced.
        FileNotFoundError: If a file is missing.
        OSError: If the package cannot be written.
        KeyboardInterrupt: If the user presses Ctrl-C; the message says what is kept.
    """
    from gsvis.prepare import estimate_preparation, prepare_package
    from gsvis.prepare.work_folder import WorkFolder

    config = _check_arguments(command)
    walk = check_where(command)
    workers = local_workers(command.workers, command.max_memory)
    with Status() as status, named_memory():
        status("reading", 0, 1)
        source = load_source(command.scene, command.lod)
        if len(source.gaussians) == 0:
            raise SceneError(f"{command.scene}: the scene has no Gaussian: there is nothing to see")
        if command.meters_per_unit is None:
            config = replace(config, meters_per_unit=source.gaussians.facts.meters_per_unit or 0.0)
        status("reading", 1, 1)
        status("space", 0, 1)
        beside = command.out if command.dry_run else None
        settled = settle(
            command, source, lambda c: find_place(source, c, c.up, walk, _photo_cameras(c)), status, beside=beside
        )
        command = settled.command
        space = settled.place.required("say where eyes may be with --box or --around")
        remarks = [*settled.remarks, *suspect_views(source.gaussians, space)]
        status("space", 1, 1)
        work = WorkFolder(command.out).folder
        if work.exists():
            status.line(f"reusing the results in {work.name} that fit")
        about = {"made_by": f"gsvis {version()}", "scene": source.name, "lod": source.lod}
        if not command.dry_run:
            about |= about_source(command.scene, source, command.out)
        try:
            if command.dry_run:
                estimate = estimate_preparation(
                    source.whole, command.out, space, config, photos=command.photos, workers=workers, progress=status
                )
            else:
                with _Progress(config, status) as progress:
                    prepared = prepare_package(
                        source.whole, command.out, space, config,
                        photos=command.photos, about=about, workers=workers, progress=progress,
                    )  # fmt: skip
        except ArgumentError as error:
            raise _named_levels(error) from None
        except KeyboardInterrupt:
            if command.dry_run:
                raise
            raise KeyboardInterrupt(
                f"what was finished is kept in {work.name}; run the same command to resume"
            ) from None
        if not command.dry_run and command.discard:
            shutil.rmtree(prepared.work, ignore_errors=True)
        elif not command.dry_run:
            note_paths(command.out, [None if is_builtin(command.scene) else command.scene])
    if command.dry_run:
        print_estimate(command, source, space, estimate, [*remarks, settled.written])
    else:
        print_result(command, source, space, prepared, remarks)


def _photo_cameras(command: Prepare) -> Cameras | None:
    """Return the cameras of --photos, unless --cameras says others; None without photos."""
    if command.photos is None or command.cameras is not None:
        return None
    from gsvis.train.photos import load_photo_cameras

    return load_photo_cameras(command.photos)


def _check_arguments(command: Prepare) -> PrepareConfig:
    """Check the arguments before work begins; return the settings of the preparation."""
    from gsvis.package.writer import check_target
    from gsvis.prepare import PrepareConfig
    from gsvis.prepare.colors import ColorConfig
    from gsvis.prepare.work_folder import WorkFolder

    check_source(command.scene, command.lod)
    if command.photos is not None and not Path(command.photos).exists():
        raise FileNotFoundError(2, "no such file or folder", command.photos)
    parse_up(command.up)
    check_show(command)
    _check_training(command)
    check_folder(Path(command.out).absolute().parent)
    check_target(Path(command.out))  # before reading a large scene; `prepare_package` checks again
    WorkFolder(command.out).check()
    size = level_image_size(command)
    sampling = view_sampling(command.views, size, command.seed)
    levels = None
    if command.levels and not is_levels(command.scene):
        try:
            sizes = command.levels, command.reuse, command.names, command.preview
            levels = levels_config(*sizes, command.steps, command.seed)
        except ValueError as error:
            raise named_option(error) from None
        if command.photos is None:
            check_views(sampling, PrepareConfig.level_held_out)
    config = PrepareConfig(
        levels=levels,
        level_views=sampling,
        level_size=size,
        cells=command.cells,
        cell_size=command.cell_size,
        sets=sets_config(size=command.face_size, limit=command.limit, max_inner=command.max_inner),
        colors=ColorConfig(fit_config(command), replace(ColorConfig.views, seed=command.seed)),
        epsilon=command.epsilon or PrepareConfig.epsilon,
        epsilon_from="given" if command.epsilon else PrepareConfig.epsilon_from,
        meters_per_unit=command.meters_per_unit or 0.0,
    )
    images = image_bytes(sampling, PrepareConfig.level_held_out) if command.photos is None else 0
    if command.photos is not None and command.max_memory is not None and levels is not None:
        from gsvis.train.photos import photo_bytes

        images = photo_bytes(command.photos, size)
    try:
        check_preparation(command.scene, command.lod, config, command.max_memory, images)
    except ArgumentError as error:
        raise _named_levels(error) from None
    return config


def _named_levels(error: ArgumentError) -> ArgumentError:
    """Return an error that names `--levels` in place of the shares of levels."""
    return error.renamed("--levels", "larger shares, or a finer --lod") if error.name == "shares" else error


def _check_training(command: Prepare) -> None:
    """Raise if options of training are given but no level will be trained, or if they conflict."""
    given = [name for name in _OF_TRAINING if getattr(command, name) != getattr(Prepare, name)]
    if is_levels(command.scene) and given:
        raise ValueError(
            f"--{given[0]}: expected none for a folder of levels, which are taken as they are,"
            f" got {getattr(command, given[0])}; leave it out"
        )
    if not command.levels and (more := [name for name in given if name != "levels"]):
        raise ValueError(
            f"--{more[0]}: expected none with --levels none, got {getattr(command, more[0])}; leave it out"
        )
    if command.photos is not None and command.views is not None:
        raise ValueError(f"--views: expected none with --photos, got {command.views}; leave it out")


class _Progress:
    """A progress callback that loads kernels before the stage that needs them, and delays Ctrl-C to the end of a step.

    Args:
        config: Settings of the preparation.
        status: Progress display.
    """

    def __init__(self, config: PrepareConfig, status: Status) -> None:
        self._config = config
        self._status = status
        self._said = ("", 0)
        self._warm = {"views", "photos", "cells", "importance"}
        self._training: ExitStack | None = None
        self._stop_if_asked: Callable[[], None] | None = None

    def __enter__(self) -> _Progress:
        return self

    def __exit__(self, *reason: object) -> None:
        self._trains(False)

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Report progress of a stage; load the kernels that it needs first."""
        if stage in self._warm:
            self._warm.remove(stage)
            self._ready(stage)
        trains = stage == "prune" or stage.startswith("train ")
        self._trains(trains)
        if (stage, done) != self._said:  # the last step may be reported twice
            self._status(stage.replace("train ", "training ", 1), done, total)
        self._said = stage, done
        if trains and self._stop_if_asked is not None:
            self._stop_if_asked()

    def _ready(self, stage: str) -> None:
        if stage == "cells":
            warm_sets(self._config.sets, self._status)
        elif stage == "importance":
            warm_colors(self._config.colors, self._status)
        elif self._config.levels is not None:
            self._warm -= {"views", "photos"}
            warm_levels(self._config.levels, self._status)

    def _trains(self, trains: bool) -> None:
        """Start or stop delaying Ctrl-C and SIGTERM to the end of a step of training."""
        if trains and self._training is None:
            self._training = ExitStack()
            self._stop_if_asked = self._training.enter_context(between_steps())
        elif not trains and self._training is not None:
            self._training.close()
            self._training = None
