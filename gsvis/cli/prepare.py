"""`gsvis prepare`: make a package to serve from a scene; resume an interrupted run."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gsvis._extras import require
from gsvis.cli import version
from gsvis.cli.arguments import Prepare
from gsvis.cli.asking import settle_space
from gsvis.cli.color import color_config, learned_rows
from gsvis.cli.device import say_device
from gsvis.cli.levels import (
    SHARES,
    check_views,
    image_bytes,
    level_image_size,
    levels_config,
    view_sampling,
)
from gsvis.cli.memory import check_preparation
from gsvis.cli.options import config_of, naming, refuse
from gsvis.cli.package import fidelity_table, size_rows
from gsvis.cli.pvs import MEMORY, local_workers, spell_certificates
from gsvis.cli.source import open_source
from gsvis.cli.stopping import between_steps, resumable
from gsvis.cli.targets import check_exists, check_tracer
from gsvis.cli.terminal import Status, busy_note, clock, facts, print_json, show, size_of
from gsvis.cli.where import check_where, kind_row, space_document
from gsvis.color.epsilon import DEFAULT_EPSILON
from gsvis.files.output import check_folder
from gsvis.files.shelf import LARGE, Shelf
from gsvis.files.temporary import temporary_folder
from gsvis.io.sources import check_source, is_builtin, is_levels
from gsvis.package.made_from import note_paths
from gsvis.package.original import about_source
from gsvis.prepare.warm import warm_colors, warm_levels, warm_sets
from gsvis.pvs.config import PvsConfig
from gsvis.render.device import Device, choose_device
from gsvis.scene.lengths import spell_volume
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.source import Source

if TYPE_CHECKING:
    from gsvis.prepare import PreparationEstimate, PrepareConfig, Prepared
    from gsvis.pvs.joined import JoinedCells
    from gsvis.scene.cameras import Cameras

__all__ = ["check_arguments", "run_prepare"]
_CALLED = {
    "levels": "levels",
    "sets": "visible sets",
    "colors": "colors",
    "epsilon": "epsilon",
    "rounding": "rounding of records",
    "cost": "cost of rounding",
    "fidelity": "what a client gets",
    "terms": "lists of terms",
    "package": "package",
}


def run_prepare(command: Prepare) -> None:
    """Prepare a package: check, make what is missing, write the package, print the result."""
    from gsvis.jobs.freed_memory import keep_freed_memory
    from gsvis.jobs.work_folder import WorkFolder
    from gsvis.prepare import estimate_preparation, prepare_package

    config = check_arguments(command)
    walk = check_where(command.where)
    workers = local_workers(command.work)
    device = choose_device(command.work.device)
    config = _on_device(config, device)
    with Status() as status, naming(**MEMORY), ExitStack() as opened:
        say_device(device, status)
        source = open_source(command.scene, command.lod, status, "see")
        if command.work.max_memory is None and source.union.nbytes < LARGE:
            keep_freed_memory()
        if not command.work.dry_run:
            source = opened.enter_context(_mapped(source, Path(command.out).absolute().parent))
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
        what: dict[str, Any] = {"photos": command.training.photos, "workers": workers}
        with naming(**SHARES):
            if command.work.dry_run:
                estimate = estimate_preparation(source.whole, command.out, space, config, **what, progress=status)
            else:
                kept = f"what was finished is kept in {work.name}"
                with resumable(kept), _Progress(config, status) as progress:
                    prepared = prepare_package(
                        source.whole, command.out, space, config, about=about, **what, progress=progress
                    )
        if not command.work.dry_run and command.discard:
            shutil.rmtree(prepared.work, ignore_errors=True)
        elif not command.work.dry_run:
            note_paths(command.out, [None if is_builtin(command.scene) else command.scene])
    if command.work.dry_run:
        _print_estimate(command, source, space, estimate, [*remarks, settled.written])
    else:
        _print_result(command, source, space, prepared, remarks)


@contextmanager
def _mapped(source: Source, root: Path) -> Iterator[Source]:
    """Yield a source for this block; a large one lies in a temporary file, and leaves memory where it is not used."""
    if source.union.nbytes < LARGE:
        yield source
        return
    with temporary_folder(root) as folder:
        mapped = Shelf(folder).put(source)
        del source
        yield mapped


def _on_device(config: PrepareConfig, device: Device) -> PrepareConfig:
    """Return the same settings with the device that trains levels and draws while colors are learned."""
    levels = None if config.levels is None else replace(config.levels, backend=device.backend)
    return replace(config, levels=levels, colors=replace(config.colors, backend=device.backend))


def _photo_cameras(command: Prepare) -> Cameras | None:
    """Return the cameras of --photos, unless --cameras says others; None without photos."""
    if command.training.photos is None or command.where.cameras is not None:
        return None
    from gsvis.train.photos import load_photo_cameras

    return load_photo_cameras(command.training.photos)


def check_arguments(command: Prepare) -> PrepareConfig:
    """Check the arguments before work begins; return the settings of the preparation."""
    from gsvis.jobs.work_folder import WorkFolder
    from gsvis.package.writer import check_target
    from gsvis.prepare import PrepareConfig
    from gsvis.prepare.colors import ColorConfig

    check_source(command.scene, command.lod)
    check_exists(command.training.photos)
    check_tracer(command.sets.tracer, command.sets.certify)
    _check_training(command)
    if _steps(command):
        require("gsvis prepare --color-steps", "torch")
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
        join_cells=command.join_cells,
        sets=config_of(PvsConfig, command.sets, size=command.sets.face_size, rays=command.sets.certify),
        colors=replace(
            color_config(command.fit, replace(ColorConfig.views, seed=command.seed)),
            precision=command.fit.precision,
            record_psnr=command.fit.record_psnr or None,
        ),
        color_steps=command.color_steps,
        epsilon=_epsilon(command.fit.epsilon),
        cell_terms=command.fit.cell_terms,
        meters_per_unit=command.meters_per_unit or 0.0,
    )
    images = image_bytes(sampling, PrepareConfig.level_held_out) if command.training.photos is None else 0
    uses_photos = levels is not None or _steps(command) > 0
    if command.training.photos is not None and command.work.max_memory is not None and uses_photos:
        from gsvis.train.photos import photo_bytes

        images = photo_bytes(command.training.photos, size)
    with naming(**SHARES):
        check_preparation(command.scene, command.lod, config, command.work.max_memory, images)
    return config


def _epsilon(given: float | None) -> float | None:
    """Return epsilon as an option says it; None if the staircase has to find it."""
    if given == 0.0:
        from gsvis.prepare.color_quality import check_flip

        check_flip()
        return None
    return DEFAULT_EPSILON if given is None else given


def _check_training(command: Prepare) -> None:
    """Raise if options of training are given but no level will be trained, or if they conflict."""
    names = ["levels", "reuse", "names", "steps", "views"]
    names += ["preview"] if command.training.preview else []
    images = ["width", "height", "photos"]
    if not _steps(command):
        names += images
    if is_levels(command.scene):
        refuse(command.training, names, "for a folder of levels, which are taken as they are")
    if not command.training.levels:
        refuse(command.training, names[1:], "with --levels none")
    if command.training.photos is not None:
        refuse(command.training, ["views"], "with --photos")


def _steps(command: Prepare) -> int:
    """Return the number of steps of learning colors that the options alone ask for."""
    from gsvis.prepare.learned_colors import steps_of_learning

    return steps_of_learning(command.color_steps, photos=command.training.photos is not None)


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
        """Load the kernels of a stage."""
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


def _print_result(
    command: Prepare, source: Source, space: NavigableSpace, prepared: Prepared, remarks: list[str]
) -> None:
    """Print the package and its stages, as a JSON document or as tables."""
    m = prepared.manifest
    cost = m.info.cost
    seconds = sum(stage.seconds for stage in prepared.stages)
    levels = [{"name": n, "gaussians": c} for n, c in zip(m.names, m.counts, strict=True)]
    for row, spread in zip(levels, (prepared.quality or {}).get("psnr", ()), strict=False):
        row["psnr"] = spread
    if command.output.json:
        about = {"format": "gsvis-preparation", "version": 1, **_about(command, source, space)}
        print_json({**about, **_document(command, prepared, levels, remarks)})
        return
    sizes = ", ".join(f"{row['name']} {row['gaussians']:,}" for row in levels)
    meters = m.info.meters_per_unit
    rows = [
        ("Gaussians", f"{m.gaussians:,}" + (f" in levels {sizes}" if len(levels) > 1 else "")),
        *_quality(prepared.quality, m.names),
        kind_row(space),
        ("where eyes may be", f"{space.rule}, {spell_volume(space.volume, meters)}"),
        ("up", f"{_axis(m.info.up)}; " + (f"{meters:g} meters a unit" if meters else "meters a unit not known")),
        ("terms", f"{m.terms:,}, variant {m.grids.variant}"),
        *learned_rows(prepared.learned),
    ]
    if cost is not None:
        text = f"{cost.psnr:.1f} dB, worst {cost.worst:.1f}, in {cost.views} views of {cost.width} x {cost.height}"
        rows.append(("cost of rounding", text))
    if prepared.certificates is not None:
        rows += spell_certificates(prepared.certificates, prepared.traced_twice)
    if prepared.judged is not None:
        rows.append(("checked by other eyes", str(prepared.judged["line"])))
    rows.append(("package", f"{command.out}, {size_of(prepared.nbytes)} in {prepared.parts:,} parts"))
    rows += size_rows(m)
    rows += _joined_rows(prepared.joined)
    if prepared.parts_kept:
        rows.append(("as before", f"{prepared.parts_kept:,} of the parts, {size_of(prepared.nbytes_kept)}"))
    if not command.discard:
        rows.append(("kept beside it", f"{prepared.work.name}, {size_of(prepared.work_bytes)}; may be deleted"))
    rows.append(("time", clock(seconds)))
    given = source.levels is not None or not command.training.levels
    stages = [
        (
            _CALLED[stage.name],
            "as given" if stage.name == "levels" and given else "there already" if stage.reused else "made",
            clock(stage.seconds),
        )
        for stage in prepared.stages
    ]
    show(
        facts(f"{source.name}: package", rows),
        facts("", stages),
        *fidelity_table(m.info.fidelity, source.name),
        *remarks,
        *(f" {remark}" for remark in prepared.remarks),
    )


def _joined_rows(tried: tuple[JoinedCells, ...]) -> list[tuple[str, str]]:
    """Return table rows about the cells of the package: how many were joined, and what their sets save on a walk."""
    if not tried:
        return []
    built = tried[0]
    kept = tried[-1]
    cells = f"{kept.cells:,}" + (f", joined from {built.cells:,}" if kept.factor > 1 else "")
    walk = f"{size_of(round(kept.saved))} on a walk, which needs {kept.walk:,.0f} of {kept.ever:,} Gaussians"
    taken = f"they take {size_of(kept.nbytes)}"
    if not kept.pays and kept.factor == 1:
        taken += "; --join-cells makes them smaller, and images come later"
    return [("  cells", cells), ("  sets save", f"{walk}; {taken}")]


def _document(command: Prepare, prepared: Prepared, levels: list[dict[str, Any]], remarks: list[str]) -> dict[str, Any]:
    """Return the part of the JSON document about the package."""
    m = prepared.manifest
    return {
        "gaussians": m.gaussians,
        "levels": levels,
        "terms": m.terms,
        "variant": m.grids.variant,
        "up": list(m.info.up),
        "meters_per_unit": m.info.meters_per_unit,
        "cost": None if m.info.cost is None else asdict(m.info.cost),
        "fidelity": None if m.info.fidelity is None else m.info.fidelity.summary(),
        "certificates": None if prepared.certificates is None else prepared.certificates.as_dict(),
        "traced_twice": prepared.traced_twice,
        "judged": prepared.judged,
        "learned": prepared.learned,
        "joined": [asdict(each) for each in prepared.joined],
        "parts": prepared.parts,
        "parts_kept": prepared.parts_kept,
        "sizes": m.sizes(),
        "bytes": prepared.nbytes,
        "bytes_kept": prepared.nbytes_kept,
        "stages": [asdict(stage) for stage in prepared.stages],
        "work": None if command.discard else str(prepared.work),
        "work_bytes": 0 if command.discard else prepared.work_bytes,
        "remarks": [*(each.strip() for each in remarks), *prepared.remarks],
    }


def _print_estimate(
    command: Prepare, source: Source, space: NavigableSpace, estimate: PreparationEstimate, remarks: list[str]
) -> None:
    """Print the estimated cost, as a JSON document or as tables."""
    if command.output.json:
        print_json(
            {
                "format": "gsvis-preparation-estimate",
                "version": 1,
                **_about(command, source, space),
                **asdict(estimate),
                "levels": [{"name": name, "gaussians": count} for name, count in estimate.levels],
                "work_bytes": estimate.work_bytes,
                "remarks": [each.strip() for each in remarks],
            }
        )
        return
    stages = [
        (_CALLED[s.name], s.state, s.what, clock(s.seconds) if s.state not in ("done", "given") else "")
        for s in estimate.stages
    ]
    rows = [
        kind_row(space),
        ("where eyes may be", f"{space.rule}, {spell_volume(space.volume, source.gaussians.facts.meters_per_unit)}"),
        ("time", f"about {clock(estimate.seconds)}{busy_note(estimate.load)}"),
        ("package", f"about {size_of(estimate.nbytes)}"),
        ("kept beside it", f"about {size_of(estimate.work_bytes)}"),
    ]
    saved = f"about {size_of(estimate.saved_bytes)} on a walk"
    rows.append(("sets save", f"{saved}; they take about {size_of(estimate.sets_bytes)}"))
    rows.append(("memory", f"at most about {size_of(estimate.memory)}, all processes together"))
    show(
        facts(f"{source.name}: what it would cost", rows),
        facts("", stages),
        *remarks,
    )


def _about(command: Prepare, source: Source, space: NavigableSpace) -> dict[str, Any]:
    """Return what the command works on, for JSON."""
    return {
        "scene": source.name,
        "lod": source.lod,
        "out": command.out,
        "space": space_document(space),
    }


def _quality(quality: dict[str, Any] | None, names: tuple[str, ...]) -> list[tuple[str, str]]:
    """Return the row about levels against the scene; none if they were not measured."""
    if quality is None or "psnr" not in quality:
        return []
    text = ", ".join(f"{name} {row['mean']:.1f} dB" for name, row in zip(names[:-1], quality["psnr"], strict=False))
    return [("levels against the scene", f"{text}, in {quality['views']} views")]


def _axis(up: tuple[float, float, float]) -> str:
    """Return an axis as text: a name such as '+z', or three numbers."""
    for k, name in enumerate("xyz"):
        if abs(abs(up[k]) - 1.0) < 1e-9:
            return ("+" if up[k] > 0 else "-") + name
    return ", ".join(f"{v:.3g}" for v in up)
