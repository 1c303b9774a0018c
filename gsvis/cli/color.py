"""`gsvis color`: fit base colors and a few terms that replace SH colors; write them, and measure their quality."""

from __future__ import annotations

import math
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gsvis._extras import require
from gsvis.cli import version
from gsvis.cli.arguments import Color
from gsvis.cli.color_result import print_result
from gsvis.cli.kernels import warm_colors
from gsvis.cli.memory import check_memory
from gsvis.cli.options import Fit, command_line, config_of, refuse, values_of
from gsvis.cli.source import Source, check_source, inputs_of, inspect_scene_of, open_source, spaces_of_build
from gsvis.cli.targets import check_exists, check_report
from gsvis.cli.terminal import Status
from gsvis.cli.where import check_where, find_place, suspect_views
from gsvis.color.epsilon import DEFAULT_EPSILON
from gsvis.errors import OutputError, SceneError
from gsvis.files.limits import open_regular
from gsvis.files.output import check_file
from gsvis.pvs.store import VisibilityStore
from gsvis.scene.content import space_hash
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.paths import HeadPath

if TYPE_CHECKING:
    from gsvis.color.fit import FitConfig
    from gsvis.prepare.colors import ColorConfig
    from gsvis.prepare.fitted_colors import FittedColors
    from gsvis.prepare.scene_colors import ColorOutputs

__all__ = ["fit_config", "run_color"]

_HELD_OUT = 1  # stream of random numbers of the held-out views; that of the fit is 0
_FOV = 60.0
_SILENT = ("max_memory", "json", "debug", "drop_invalid")


@dataclass(frozen=True, eq=False)
class _Plan:
    """What to do: the scene, its visible sets and space, settings, and remarks for the user."""

    source: Source
    store: VisibilityStore | None
    space: NavigableSpace | None
    config: ColorConfig
    remarks: list[str]


def run_color(command: Color) -> None:
    """Fit colors: read, find directions, fit, write, compare, print the result."""
    config = _check_arguments(command)
    walk = check_where(command.where, "" if command.pvs is None else "--pvs")
    with ExitStack() as opened, Status() as status:
        store = None if command.pvs is None else opened.enter_context(VisibilityStore.open(command.pvs))
        plan = _plan(command, config, store, walk, status)
        fitted = _run(command, plan, status)
        seconds = dict(status.seconds)
    print_result(command, plan.source, plan.space, fitted, plan.remarks, seconds)


def _check_arguments(command: Color) -> ColorConfig:
    """Check the arguments before work begins; return the settings of the fit."""
    check_source(command.scene, command.lod)
    check_exists(command.pvs)
    targets = {"out": command.out, "active": command.active}
    for name, path in targets.items():
        if path is not None:
            check_file(path)
            _check_no_input(name, path, command)
    if command.report is not None:
        require("gsvis color --report", "matplotlib")
        check_report(command.report)
    written = [Path(path).absolute() for path in targets.values() if path is not None]
    if len(set(written)) < len(written):
        raise ValueError("--out, --active: expected files of their own, got one twice; name another")
    if command.active is not None and command.pvs is None:
        raise ValueError("--active: expected --pvs with it, got none; gsvis pvs builds one")
    if command.pvs is not None:
        refuse(command, ["up"], "with --pvs, which knows it")
    if command.report is not None and command.compared.held_out == 0:
        raise ValueError("--held-out: expected at least 1 with --report, got 0; leave it out")
    remedy = "raise it, or let gsvis world fit the colors of tiles; gsvis world --until levels leaves their scenes"
    check_memory("color", [(command.scene, command.lod)], command.max_memory, remedy)
    from gsvis.prepare.colors import ColorConfig
    from gsvis.scene.view_sampling import ViewSampling

    if command.epsilon == 0.0 or (command.epsilon is None and command.active is not None):
        from gsvis.prepare.color_quality import check_flip

        check_flip()
    fit = replace(fit_config(command.fit), refine=not command.fit.no_refine)
    return ColorConfig(fit, ViewSampling(command.compared.views, seed=command.compared.seed))


def fit_config(fit: Fit) -> FitConfig:
    """Return the settings of the fit from the options."""
    from gsvis.color.fit import FitConfig

    config = config_of(FitConfig, fit)
    return replace(config, mean_terms=None) if config.mean_terms == math.inf else config


def _check_no_input(name: str, path: str, command: Color) -> None:
    """Raise if an output would replace an input or a file of another kind, so that a typo does not destroy a scene."""
    target = Path(path)
    for given in (*inputs_of(command.scene), *([] if command.pvs is None else [Path(command.pvs)])):
        if target.exists() and given.exists() and target.samefile(given):
            raise ValueError(f"--{name}: expected a file of its own, got {path}, which is read; name another")
    if target.is_file() and target.stat().st_size > 0:
        with open_regular(target) as file:
            head = file.read(6)
        if not head.startswith(b"ARROW1"):
            raise ValueError(
                f"--{name}: expected a new file or an Arrow file to replace, got {path}, which is something else;"
                " name another"
            )


def _plan(
    command: Color, config: ColorConfig, store: VisibilityStore | None, walk: HeadPath | None, status: Status
) -> _Plan:
    """Read the scene and find its navigable space."""
    source = open_source(command.scene, command.lod, status, "color")
    g = source.gaussians
    remarks: list[str] = []
    space: NavigableSpace | None
    with status.stage("space"):
        if store is not None:
            store.check_scene(source.whole)
            space = _space_of(store, source)
            why_not = ""
        else:
            place = find_place(source, command.where, walk)
            space = place.space
            why_not = place.why_not
            remarks += place.remarks
            remarks += [] if space is None else suspect_views(g, space)
    if space is None and g.sh_degree > 0:
        raise SceneError(f"{why_not}; say where eyes may be with --box, or give visible sets with --pvs")
    if g.sh_degree == 0:
        remarks.append(
            " The scene has SH degree 0: no color depends on direction, so there is nothing to fit. The file holds the"
            " base colors and no terms."
        )
    return _Plan(source, store, space, config, remarks)


def _space_of(store: VisibilityStore, source: Source) -> NavigableSpace:
    """Return the navigable space that visible sets were built in, or the closest one that their cells allow."""
    spaces = list(spaces_of_build(source, store.grid.up))
    for space in spaces:
        if store.info.config.get("space") == space_hash(space):
            return space
    for space in spaces:
        voxels = np.argwhere(space.free)
        held = voxels[store.grid.cell_at(space.origin + space.voxel_size * (voxels + 0.5)) >= 0]
        if np.array_equal(space.origin, store.grid.origin) and len(held):
            free = np.zeros_like(space.free)
            free[tuple(held.T)] = True
            return replace(space, free=free, rule=f"{space.rule}, in the cells")
    from gsvis.pvs.quality import box_space

    return box_space(store.grid, source.gaussians)


def _run(command: Color, plan: _Plan, status: Status) -> FittedColors:
    """Fit the colors and write all files; return the fitted colors."""
    from gsvis.prepare.scene_colors import color_scene

    source = plan.source
    out = command.out
    if source.union.sh_degree > 0:
        warm_colors(plan.config, status)
    outputs = _outputs(command)
    fitted = color_scene(source.whole, plan.space, out, outputs, config=plan.config, store=plan.store, progress=status)
    plan.remarks.extend(_remarks(command, plan, outputs, fitted))
    try:
        if fitted.quality is not None and command.report is not None:
            _write_report(command, plan, fitted, status)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"{out} is written, what else was asked for may not be") from None
    except OutputError as error:
        raise error.keeping(f"{out} is written") from error
    return fitted


def _outputs(command: Color) -> ColorOutputs:
    """Return what the command writes and measures besides the colors."""
    from gsvis.prepare.color_quality import ColorQualityConfig, has_flip
    from gsvis.prepare.scene_colors import OBSERVED, ColorOutputs
    from gsvis.scene.view_sampling import ViewSampling

    compared = command.compared
    needed = command.epsilon is not None or command.active is not None
    quality = ColorQualityConfig(flip=has_flip())
    held_out = None
    if compared.held_out:
        held_out = ViewSampling(compared.held_out, compared.width, compared.height, _FOV, compared.seed, _HELD_OUT)
    return ColorOutputs(
        precision=command.precision,
        epsilon=command.epsilon or None,
        calibrate=needed or (command.report is not None and has_flip()),
        fallback=DEFAULT_EPSILON if needed else None,
        active=command.active,
        observed=replace(OBSERVED, width=compared.width, height=compared.height, fov=_FOV, seed=compared.seed),
        held_out=held_out,
        quality=quality if command.report is not None else replace(quality, counts=(), epsilons=()),
        made_by=f"gsvis {version()}",
    )


def _remarks(command: Color, plan: _Plan, outputs: ColorOutputs, fitted: FittedColors) -> list[str]:
    """Return what the user should know about the result."""
    remarks = []
    if outputs.calibrate and outputs.epsilon is None and fitted.calibration is None:
        remarks.append(" Epsilon was not calibrated: there are no terms to leave out.")
    if fitted.calibration is not None and not fitted.calibration.converged:
        remarks.append(f" Epsilon was not found for certain: {fitted.calibration.reason}.")
    if plan.space is None and command.compared.held_out:
        remarks.append(" Nothing was compared: there is nowhere to look from.")
    return remarks


def _write_report(command: Color, plan: _Plan, fitted: FittedColors, status: Status) -> None:
    from gsvis.report import Subject  # imports matplotlib
    from gsvis.report.color_document import write_color_report

    assert command.report is not None
    assert plan.space is not None
    subject = Subject(
        title=plan.source.name,
        gaussians=plan.source.gaussians,
        up=plan.space.up,
        cameras_from=f"drawn at random where eyes may be ({plan.space.rule})",
        command=command_line(command, ("max_memory",)),
        version=version(),
        facts={"path": command.scene, "lod": plan.source.lod, **inspect_scene_of(plan.source)},
        parameters={name: value for name, value in values_of(command).items() if name not in _SILENT},
        seconds=dict(status.seconds),
    )
    write_color_report(command.report, fitted, subject, progress=status)
