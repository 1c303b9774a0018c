"""`gsvis color`: fit base colors and a few terms that replace SH colors; write them, and measure their quality."""

from __future__ import annotations

import math
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gsvis._extras import remedy_of, require
from gsvis.cli import version
from gsvis.cli.arguments import Color
from gsvis.cli.device import say_device
from gsvis.cli.memory import check_memory
from gsvis.cli.options import Fit, command_line, config_of, refuse, values_of
from gsvis.cli.source import inspect_scene_of, levels_spelled, open_source, summarize_levels
from gsvis.cli.stopping import resumable
from gsvis.cli.targets import check_exists, check_report
from gsvis.cli.terminal import Status, clock, facts, print_json, show, size_of
from gsvis.cli.where import check_where, find_place, kind_row, space_document, suspect_views
from gsvis.color.epsilon import DEFAULT_EPSILON
from gsvis.errors import SceneError
from gsvis.files.limits import open_regular
from gsvis.files.output import check_file
from gsvis.io.sources import check_source, inputs_of
from gsvis.jobs.freed_memory import keep_freed_memory
from gsvis.prepare.warm import warm_colors
from gsvis.pvs.store import VisibilityStore
from gsvis.render.device import choose_device
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.paths import HeadPath
from gsvis.scene.source import Source

if TYPE_CHECKING:
    from gsvis.prepare.colors import ColorConfig
    from gsvis.prepare.fitted_colors import FittedColors
    from gsvis.prepare.learned_colors import Lesson
    from gsvis.prepare.scene_colors import ColorOutputs
    from gsvis.scene.navigable import NavigableSpace
    from gsvis.scene.view_sampling import ViewSampling

__all__ = ["color_config", "learned_rows", "run_color"]

_HELD_OUT = 1  # stream of random numbers of the held-out views; that of the fit is 0
_FOV = 60.0
_SILENT = ("max_memory", "device", "json", "debug", "drop_invalid")


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
    device = choose_device(command.learning.device)
    config = replace(config, backend=device.backend)
    if command.max_memory is None:
        keep_freed_memory()
    with ExitStack() as opened, Status() as status:
        say_device(device, status)
        store = None if command.pvs is None else opened.enter_context(VisibilityStore.open(command.pvs))
        plan = _plan(command, config, store, walk, status)
        fitted = _run(command, plan, status)
        seconds = dict(status.seconds)
    _print_result(command, plan.source, plan.space, fitted, plan.remarks, seconds)


def _check_arguments(command: Color) -> ColorConfig:
    """Check the arguments before work begins; return the settings of the fit."""
    check_source(command.scene, command.lod)
    check_exists(command.pvs)
    check_exists(command.learning.photos)
    if _steps(command):
        require("gsvis color --color-steps", "torch")
    if command.learning.downscale is not None and command.learning.photos is None:
        raise ValueError("--downscale: expected --photos with it, got none; leave it out")
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
    from gsvis.scene.view_sampling import ViewSampling

    if command.epsilon == 0.0 or (command.epsilon is None and command.active is not None):
        from gsvis.prepare.color_quality import check_flip

        check_flip()
    return color_config(command.fit, ViewSampling(command.compared.views, seed=command.compared.seed))


def color_config(fit: Fit, views: ViewSampling) -> ColorConfig:
    """Return the settings of colors from the options.

    Args:
        fit: The options.
        views: The views that weigh Gaussians.
    """
    from gsvis.color.fit import FitConfig
    from gsvis.prepare.colors import ColorConfig

    epsilon = values_of(fit).get("epsilon") or None  # 0 is auto, which is found when the fit is done
    config = config_of(FitConfig, fit, refine=fit.fit == "lobes", epsilon=epsilon)
    if config.mean_terms == math.inf:
        config = replace(config, mean_terms=None)
    rays = ColorConfig.rays_per_face if fit.directions == "weighed" else 0
    return ColorConfig(config, views, rays, fit.directions)


def _check_no_input(name: str, path: str, command: Color) -> None:
    """Raise if an output would replace an input or a file of another kind, so that a typo does not destroy a scene."""
    target = Path(path)
    for given in (*inputs_of(command.scene), *([] if command.pvs is None else [Path(command.pvs)])):
        if target.exists() and given.exists() and target.samefile(given):
            raise ValueError(f"--{name}: expected a file of its own, got {path}, which is read; name another")
    if target.is_file() and target.stat().st_size > 0:
        with open_regular(target) as file:
            head = file.read(6)
        if head != b"ARROW1":
            raise ValueError(
                f"--{name}: expected a new file or an Arrow file to replace, got {path}, which is something else;"
                " name another"
            )


def _plan(
    command: Color, config: ColorConfig, store: VisibilityStore | None, walk: HeadPath | None, status: Status
) -> _Plan:
    """Read the scene and find its navigable space."""
    from gsvis.pvs.quality import space_of_store

    source = open_source(command.scene, command.lod, status, "color")
    g = source.gaussians
    remarks: list[str] = []
    space: NavigableSpace | None
    with status.stage("space"):
        if store is not None:
            store.check_scene(source.whole)
            space = space_of_store(store, source.spaces_of_build(store.grid.up), source.gaussians)
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


def _run(command: Color, plan: _Plan, status: Status) -> FittedColors:
    """Fit the colors and write all files; return the fitted colors."""
    from gsvis.prepare.scene_colors import color_scene

    source = plan.source
    out = command.out
    if source.union.sh_degree > 0:
        warm_colors(plan.config, status)
    outputs = _outputs(command)
    fitted = color_scene(
        source.whole,
        plan.space,
        out,
        outputs,
        config=plan.config,
        store=plan.store,
        lesson=_lesson(command, plan, status),
        progress=status,
    )
    plan.remarks.extend(_remarks(command, plan, outputs, fitted))
    with resumable(f"{out} is written", "what else was asked for may not be"):
        if fitted.quality is not None and command.report is not None:
            _write_report(command, plan, fitted, status)
    return fitted


def learned_rows(learned: dict[str, Any] | None) -> list[tuple[str, str]]:
    """Return the row of a table about learned colors, from `Learned.as_dict`; none without held-out images."""
    if not learned or not learned["psnr"]:
        return []
    named = {name: f"{each['mean']:.2f}" for name, each in learned["psnr"].items()}
    text = f"{named['learned']} dB after learning, {named['fitted']} fitted"
    text += f", {named['sh']} by SH" if "sh" in named else ""
    return [(f"{learned['held_out']} held-out {learned['from']}", text)]


def _steps(command: Color) -> int:
    """Return the number of steps of learning that the options alone ask for."""
    from gsvis.prepare.learned_colors import steps_of_learning

    return steps_of_learning(command.learning.color_steps, photos=command.learning.photos is not None)


def _lesson(command: Color, plan: _Plan, status: Status) -> Lesson | None:
    """Return the images that colors learn from; None if they do not learn."""
    from gsvis.prepare.learned_colors import draw_lesson, read_lesson, renders_teach, steps_of_learning

    learning = command.learning
    g = plan.source.gaussians
    photos = learning.photos is not None
    steps = steps_of_learning(learning.color_steps, photos=photos, renders=plan.space is not None and renders_teach(g))
    if not steps:
        return None
    seed = command.compared.seed
    if learning.photos is not None:
        lesson, remarks = read_lesson(
            g, learning.photos, steps, downscale=learning.downscale, seed=seed, progress=status
        )
        plan.remarks.extend(f" {remark}" for remark in remarks)
        return lesson
    if plan.space is None:
        raise SceneError("there is nowhere to look from; say where eyes may be with --box, or give --photos")
    return draw_lesson(g, plan.space, steps, seed=seed)


def _outputs(command: Color) -> ColorOutputs:
    """Return what the command writes and measures besides the colors."""
    from gsvis.prepare.calibration import OBSERVED
    from gsvis.prepare.color_quality import ColorQualityConfig, has_flip
    from gsvis.prepare.scene_colors import ColorOutputs
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
    if fitted.learned is not None and fitted.learned.remark is not None:
        remarks.append(f" {fitted.learned.remark}")
    if plan.space is None and command.compared.held_out:
        remarks.append(" Nothing was compared: there is nowhere to look from.")
    return remarks


def _write_report(command: Color, plan: _Plan, fitted: FittedColors, status: Status) -> None:
    """Write the report of --report."""
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


def _print_result(
    command: Color,
    source: Source,
    space: NavigableSpace | None,
    fitted: FittedColors,
    remarks: list[str],
    seconds: dict[str, float],
) -> None:
    """Print the result.

    Args:
        command: The arguments.
        source: The scene.
        space: Where eyes may be; None where none was needed.
        fitted: The fitted colors.
        remarks: Lines for people.
        seconds: How long each stage took.
    """
    document = fitted.as_dict()
    if command.output.json:
        about: dict[str, Any] = {
            "format": "gsvis-color",
            "version": 1,
            "scene": source.name,
            "lod": source.lod,
            "out": command.out,
        }
        about["levels"] = summarize_levels(source)
        about["space"] = None if space is None else space_document(space)
        about["remarks"] = [each.strip() for each in remarks]
        written = {"active": command.active, "report": command.report}
        print_json({**about, **written, **document, "seconds": seconds})
        return
    lines = list(remarks)
    if document["quality"]:
        looked = document["quality"]
        lines.append(
            f" Compared in {looked['views']} views that the fit did not use, {looked['width']} x {looked['height']}"
            " pixels each."
        )
        if "flip" not in looked["all_terms"]:
            lines.append(f" FLIP was not asked: {remedy_of('flip_evaluator')}.")
    if command.report is not None and Path(command.report, "report.html").exists():
        lines.append(f" Report: {Path(command.report) / 'report.html'}")
    total = sum(seconds.values())
    kind = [] if space is None else [kind_row(space)]
    parts: list[Any] = [facts(source.name, [*_rows(command, source, document), *kind, ("time", clock(total))])]
    if document["quality"]:
        parts.append(facts("", _likeness(document["quality"]), _header(document["quality"])))
    show(*parts, *lines)


def _rows(command: Color, source: Source, document: dict[str, Any]) -> list[tuple[str, str]]:
    """Return the rows of the table about colors."""
    terms = document["terms"]
    sizes = document["bytes_per_gaussian"]
    seen = document["directions"]
    rows = [
        ("Gaussians", f"{document['gaussians']:,}{levels_spelled(source)}, SH degree {document['sh_degree']}"),
        ("directions", f"{seen['from']}; {seen['mean_share']:.1%} on average"),
    ]
    if seen["without_any"]:
        rows.append(("seen from nowhere", f"{seen['without_any']:,}: they get base colors"))
    rows.append(("terms", f"{terms['mean']:.2f} a Gaussian on average, variant {document['variant']}"))
    if terms["total"]:
        text = f"{terms['share_none']:.1%}, {terms['share_1_to_4']:.1%}, {terms['share_more']:.1%}"
        rows.append(("no term, 1 to 4, more", f"{text} of the Gaussians"))
        if document["quality"]:
            none, *few, more = document["quality"]["visible_by_active"]["shares"]
            text = f"{none:.1%}, {sum(few):.1%}, {more:.1%} of the Gaussians that an eye sees"
            rows.append(("no active term, 1 to 4, more", text))
    compared = ", ".join(f"{sizes[f'sh_{bits}']:g} with {bits} bits" for bits in (32, 16, 8))
    rows += [
        ("bytes of a color", f"{sizes['records']:.1f} as {document['precision']} records; SH: {compared}"),
        ("file", f"{Path(command.out).name}, {size_of(document['file_bytes'])} with geometry"),
    ]
    if document["epsilon"]:
        rows.append(("epsilon", _epsilon(document["epsilon"])))
    rows += learned_rows(document["learned"])
    cells = document["active_in_cells"]
    if cells:
        share = cells["share_of_all"]
        text = f"{share['mean']:.1%} of all terms; {share['min']:.1%} to {share['max']:.1%}"
        rows.append(("active in a cell", text))
    return rows


def _epsilon(found: dict[str, Any]) -> str:
    """Return epsilon as text, with how it was found."""
    if found["from"] == "given":
        return f"{found['value']:g}, as given"
    interval = found["interval"]
    spread = f" ({interval[0]:.2g} to {interval[1]:.2g})" if interval else ""
    return f"{found['value']:.3g}{spread}, by FLIP in {found['trials']} trials"


def _header(quality: dict[str, Any]) -> tuple[str, ...]:
    """Return the header of the table of quality."""
    names = ["PSNR", "worst", "SSIM", "worst"]
    if "flip" in quality["all_terms"]:
        names += ["FLIP", "worst"]
    return ("against SH", *names)


def _likeness(quality: dict[str, Any]) -> list[tuple[str, ...]]:
    """Return the rows of the table of quality: all terms, and base colors alone."""
    rows = []
    for name, key in (("all terms", "all_terms"), ("base colors alone", "base_only")):
        row = [name]
        for measure, digits in (("psnr", 1), ("ssim", 4), ("flip", 4)):
            if measure in quality[key]:
                row += [f"{quality[key][measure][which]:.{digits}f}" for which in ("mean", "worst")]
        rows.append(tuple(row))
    return rows
