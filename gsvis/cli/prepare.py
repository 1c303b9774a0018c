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
from gsvis.cli.asking import settle_space
from gsvis.cli.color import fit_config
from gsvis.cli.kernels import warm_colors, warm_levels, warm_sets
from gsvis.cli.levels import (
    check_views,
    image_bytes,
    level_image_size,
    levels_config,
    view_sampling,
)
from gsvis.cli.made_from import about_source
from gsvis.cli.memory import check_preparation
from gsvis.cli.options import config_of, refuse
from gsvis.cli.prepare_result import print_estimate, print_result
from gsvis.cli.pvs import local_workers, named_memory
from gsvis.cli.source import check_source, is_builtin, is_levels, open_source
from gsvis.cli.stopping import between_steps
from gsvis.cli.targets import check_exists
from gsvis.cli.terminal import Status
from gsvis.cli.where import check_where
from gsvis.errors import ArgumentError
from gsvis.files.output import check_folder
from gsvis.package.made_from import note_paths
from gsvis.pvs.config import PvsConfig

if TYPE_CHECKING:
    from gsvis.prepare import PrepareConfig
    from gsvis.scene.cameras import Cameras

__all__ = ["run_prepare"]


def run_prepare(command: Prepare) -> None:
    """Prepare a package: check, make what is missing, write the package, print the result."""
    from gsvis.jobs.work_folder import WorkFolder
    from gsvis.prepare import estimate_preparation, prepare_package

    config = _check_arguments(command)
    walk = check_where(command.where)
    workers = local_workers(command.work)
    with Status() as status, named_memory():
        source = open_source(command.scene, command.lod, status, "see")
        if command.meters_per_unit is None:
            config = replace(config, meters_per_unit=source.gaussians.facts.meters_per_unit or 0.0)
        settled, space, remarks = settle_space(
            command.where,
            source,
            walk,
            status,
            quiet=command.output.json,
            beside=command.out if command.work.dry_run else None,
            cameras=_photo_cameras(command),
        )
        work = WorkFolder(command.out).folder
        if work.exists():
            status.line(f"reusing the results in {work.name} that fit")
        about = {"made_by": f"gsvis {version()}", "scene": source.name, "lod": source.lod}
        if not command.work.dry_run:
            about |= about_source(command.scene, source, command.out)
        try:
            if command.work.dry_run:
                estimate = estimate_preparation(
                    source.whole,
                    command.out,
                    space,
                    config,
                    photos=command.training.photos,
                    workers=workers,
                    progress=status,
                )
            else:
                with _Progress(config, status) as progress:
                    prepared = prepare_package(
                        source.whole, command.out, space, config,
                        photos=command.training.photos, about=about, workers=workers, progress=progress,
                    )  # fmt: skip
        except ArgumentError as error:
            raise _named_levels(error) from None
        except KeyboardInterrupt:
            if command.work.dry_run:
                raise
            raise KeyboardInterrupt(
                f"what was finished is kept in {work.name}; run the same command to resume"
            ) from None
        if not command.work.dry_run and command.discard:
            shutil.rmtree(prepared.work, ignore_errors=True)
        elif not command.work.dry_run:
            note_paths(command.out, [None if is_builtin(command.scene) else command.scene])
    if command.work.dry_run:
        print_estimate(command, source, space, estimate, [*remarks, settled.written])
    else:
        print_result(command, source, space, prepared, remarks)


def _photo_cameras(command: Prepare) -> Cameras | None:
    """Return the cameras of --photos, unless --cameras says others; None without photos."""
    if command.training.photos is None or command.where.cameras is not None:
        return None
    from gsvis.train.photos import load_photo_cameras

    return load_photo_cameras(command.training.photos)


def _check_arguments(command: Prepare) -> PrepareConfig:
    """Check the arguments before work begins; return the settings of the preparation."""
    from gsvis.jobs.work_folder import WorkFolder
    from gsvis.package.writer import check_target
    from gsvis.prepare import PrepareConfig
    from gsvis.prepare.colors import ColorConfig

    check_source(command.scene, command.lod)
    check_exists(command.training.photos)
    _check_training(command)
    check_folder(Path(command.out).absolute().parent)
    check_target(Path(command.out))  # before reading a large scene; `prepare_package` checks again
    WorkFolder(command.out).check()
    size = level_image_size(command.training)
    sampling = view_sampling(command.training, command.seed)
    levels = None
    if command.training.levels and not is_levels(command.scene):
        levels = levels_config(command.training, command.seed)
        if command.training.photos is None:
            check_views(sampling, PrepareConfig.level_held_out)
    config = PrepareConfig(
        levels=levels,
        level_views=sampling,
        level_size=size,
        cells=command.sets.cells,
        cell_size=command.sets.cell_size,
        sets=config_of(PvsConfig, command.sets, size=command.sets.face_size),
        colors=ColorConfig(fit_config(command.fit), replace(ColorConfig.views, seed=command.seed)),
        epsilon=command.fit.epsilon or PrepareConfig.epsilon,
        epsilon_from="given" if command.fit.epsilon else PrepareConfig.epsilon_from,
        meters_per_unit=command.meters_per_unit or 0.0,
    )
    images = image_bytes(sampling, PrepareConfig.level_held_out) if command.training.photos is None else 0
    if command.training.photos is not None and command.work.max_memory is not None and levels is not None:
        from gsvis.train.photos import photo_bytes

        images = photo_bytes(command.training.photos, size)
    try:
        check_preparation(command.scene, command.lod, config, command.work.max_memory, images)
    except ArgumentError as error:
        raise _named_levels(error) from None
    return config


def _named_levels(error: ArgumentError) -> ArgumentError:
    """Return an error that names `--levels` in place of the shares of levels."""
    return error.renamed("--levels", "larger shares, or a finer --lod") if error.name == "shares" else error


def _check_training(command: Prepare) -> None:
    """Raise if options of training are given but no level will be trained, or if they conflict."""
    names = ("levels", "reuse", "names", "preview", "steps", "views", "width", "height", "photos")
    if is_levels(command.scene):
        refuse(command.training, names, "for a folder of levels, which are taken as they are")
    if not command.training.levels:
        refuse(command.training, names[1:], "with --levels none")
    if command.training.photos is not None:
        refuse(command.training, ["views"], "with --photos")


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
