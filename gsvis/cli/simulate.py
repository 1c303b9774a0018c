"""`gsvis simulate`: what a viewer sees while packages arrive over a recorded link, beside two other ways to send."""

from __future__ import annotations

import shlex
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gsvis._extras import has, remedy_of
from gsvis.cli import version
from gsvis.cli.arguments_simulate import Simulate
from gsvis.cli.source import check_report, check_source, load_source
from gsvis.cli.terminal import Status, facts, print_json, show
from gsvis.errors import SceneError
from gsvis.files.output import TEMPORARY, output_errors
from gsvis.io.poses import load_path
from gsvis.package.package import Package
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.paths import HeadPath

if TYPE_CHECKING:
    from gsvis.abr import BandwidthTrace
    from gsvis.report.session_document import Visit
    from gsvis.simulate import Delivery, Link, ViewingConfig
    from gsvis.stream import StreamedScene

__all__ = ["run_simulate"]

_MBIT = 10.0
_SHOWN_AT = (0.5, 2.0)  # seconds of the pictures
_NOT_SPELLED = ("package", "path", "out", "json", "debug")


@dataclass(frozen=True, eq=False)
class _Place:
    """What belongs to one package, made ready once however often it is visited."""

    title: str
    scene: StreamedScene
    reference: Gaussians | None
    whole_file: tuple[int, str]
    space: NavigableSpace | None


def run_simulate(command: Simulate) -> None:
    """Read, play, watch, write the report, print tables or JSON.

    Raises:
        GsvisError: If a file cannot be read, a package is damaged, or the path fits nowhere.
        ValueError: If an argument is wrong.
        FileNotFoundError: If a file is missing.
        OSError: If the report cannot be written.
    """
    _check(command)
    check_report(command.out)
    walk, trace = load_path(command.path), _trace(command)
    with Status() as status:
        document = _write_report(command, walk, trace, status)
    from gsvis.report.session_page import content_remarks

    if command.json:
        for remark in content_remarks(document):
            sys.stderr.write(f"gsvis: {remark}\n")
        print_json(document)
    else:
        show(
            *_tables(document),
            *(f" {remark}" for remark in content_remarks(document)),
            *([] if has("matplotlib") else [f" Plots need matplotlib: {remedy_of('matplotlib')}."]),
            f" Report: {Path(command.out) / 'report.html'}",
        )


def _check(command: Simulate) -> None:
    """Say at once what does not fit together."""
    if not command.package:
        raise ValueError("PACKAGE: expected at least one package, got none")
    if command.trace is not None and command.mbit is not None:
        raise ValueError(f"--mbit: expected none with --trace, got {command.mbit:g}; leave one out")
    for name in ("scene", "whole_file"):
        given = getattr(command, name)
        if given and len(given) != len(command.package):
            spelled = "--" + name.replace("_", "-")
            raise ValueError(f"{spelled}: expected one for each package, {len(command.package)}, got {len(given)}")
    for file in (*command.whole_file, *((command.trace,) if command.trace else ()), command.path):
        if not Path(file).exists():
            raise FileNotFoundError(2, "no such file or folder", file)
    for scene in command.scene:
        check_source(scene, command.lod)
    for package in command.package:
        Package.open(package).close()


def _trace(command: Simulate) -> BandwidthTrace:
    """The rate of the link."""
    from gsvis.abr import BandwidthTrace, load_trace

    return load_trace(command.trace) if command.trace else BandwidthTrace.constant(command.mbit or _MBIT)


def _write_report(command: Simulate, walk: HeadPath, trace: BandwidthTrace, status: Status) -> dict[str, Any]:
    """Everything between the read arguments and a written report."""
    from contextlib import ExitStack

    from gsvis.report.session_document import Simulation, write_session_report
    from gsvis.simulate import Link, ViewingConfig

    link = Link(trace, command.round_trip / 1000.0)
    config = ViewingConfig(
        seconds=command.seconds, fine=min(3.0, command.seconds), every=min(command.every, command.seconds),
        width=command.width, height=command.height, fov=command.fov,
    )  # fmt: skip
    visits = []
    with ExitStack() as opened:
        places = _places(command, opened, status)
        count = command.visits or len(places)
        for k in range(count):
            place = places[k % len(places)]
            path, record = _cut_walk(command, place, walk, k)
            later = link if k == 0 else link.from_time(k * config.seconds)
            visits.append(_simulate_visit(command, place, path, record, later, config, status))
    simulation = Simulation(
        tuple(visits), link, _command_line(command), version(),
        {name: _plain(value) for name, value in vars(command).items() if name not in ("json", "debug")},
        dict(status.seconds),
    )  # fmt: skip
    return write_session_report(command.out, simulation, progress=status)


def _places(command: Simulate, opened: Any, status: Status) -> list[_Place]:
    """All packages, made ready."""
    from gsvis.stream import StreamedScene

    status("reading", 0, len(command.package))
    places = []
    for k, folder in enumerate(command.package):
        package = opened.enter_context(Package.open(folder))
        scene = StreamedScene.open(package)
        contents = scene.contents
        highest = np.flatnonzero(contents.last == len(contents.names) - 1)
        if len(highest) == 0:
            raise SceneError(f"{folder}: the package has no Gaussian in its highest level: there is nothing to see")
        reference = load_source(command.scene[k], command.lod).gaussians if command.scene else None
        space = None if command.as_is else _space(contents.gaussians(highest), package, folder)
        measured = _file_size(command, k, reference if reference is not None else contents.gaussians(highest))
        title = Path(folder).resolve().name.removesuffix(".gsvis")
        places.append(_Place(title, scene, reference, measured, space))
        status("reading", k + 1, len(command.package))
    return places


def _space(g: Gaussians, package: Package, folder: str) -> NavigableSpace:
    try:
        return NavigableSpace.from_scene(g, up=np.array(package.manifest.info.up))
    except SceneError as error:
        raise SceneError(f"{folder}: {error}; if the path lies in the scene, say --as-is") from None


def _file_size(command: Simulate, which: int, g: Gaussians) -> tuple[int, str]:
    """Bytes of the scene as one file, and how they were found."""
    if command.whole_file:
        path = Path(command.whole_file[which])
        files = [path] if path.is_file() else sorted(file for file in path.rglob("*") if file.is_file())
        size = sum(file.stat().st_size for file in files)
        if size == 0:
            raise ValueError(f"--whole-file: expected a file with something in it, got {path}, which is empty")
        return size, f"size of {path.name}"
    from gsvis.io.sog_writer import save_sog
    from gsvis.simulate import morton_order

    with tempfile.TemporaryDirectory(prefix="gsvis-") as folder:
        with output_errors(folder, remedy=TEMPORARY):
            save_sog(g[morton_order(g.means)], Path(folder) / "scene.sog")
        text = "before it was packaged" if command.scene else "the package's highest level, base colors alone"
        return (Path(folder) / "scene.sog").stat().st_size, f"SOG as gsvis writes it, of the scene: {text}"


def _cut_walk(command: Simulate, place: _Place, walk: HeadPath, visit: int) -> tuple[HeadPath, dict[str, Any]]:
    """The part of the recording that a visit replays, in its scene: the next one while it lasts, else the first."""
    start = visit * command.seconds
    start = start if start + 0.5 * command.seconds <= walk.duration else 0.0
    part = walk.cut(start, start + command.seconds + 1.0) if walk.duration > 0 else walk
    record: dict[str, Any] = {"from_s": start, "recorded_s": part.duration}
    if place.space is None:
        return part, {**record, "rule": "left as it is"}
    from gsvis.scene.retarget import RetargetConfig, retarget

    meters = place.scene.package.manifest.info.meters_per_unit
    config = RetargetConfig(meters_per_unit=meters or None, project=True, seed=command.seed + visit)
    moved = retarget(part, place.space, config)
    return moved.path, {**record, **moved.as_dict()}


def _simulate_visit(
    command: Simulate, place: _Place, path: HeadPath, record: dict[str, Any], link: Link, config: ViewingConfig,
    status: Status,
) -> Visit:  # fmt: skip
    """One scene, sent in three ways."""
    from gsvis.abr import AbrConfig
    from gsvis.report.session_document import Visit
    from gsvis.simulate import Adaptive, MortonProgressive, Stage, WholeFile, play, watch

    contents = place.scene.contents
    stage = Stage(contents, place.reference)
    deliveries: tuple[Delivery, ...] = (
        Adaptive(place.scene, config.view, AbrConfig(policy=command.policy)),
        WholeFile(contents, *place.whole_file),
        MortonProgressive(contents),
    )
    status("playing", 0, len(deliveries))
    played = []
    for k, delivery in enumerate(deliveries):
        played.append(play(delivery, link, path, stage.size, seconds=config.watched, tick=config.tick))
        status("playing", k + 1, len(deliveries))
    sessions = tuple(watch(stage, played, path, config, progress=status))
    return Visit(
        place.title, sessions, stage.compared_with, record,
        {"gaussians": stage.size[0], "terms": stage.size[1], "levels": list(contents.names)},
        _pictures(stage, sessions, path, config),
    )  # fmt: skip


def _pictures(stage: Any, sessions: Any, path: HeadPath, config: ViewingConfig) -> Any:
    """What was shown now and then, beside the full scene; black where there was no image."""
    from gsvis.simulate import show_at

    shown = []
    for t in _SHOWN_AT:
        if t < config.seconds:
            full, images = show_at(stage, [session.playback for session in sessions], path, t, config)
            shown.append((t, "", full))
            for session, image in zip(sessions, images, strict=True):
                shown.append((t, session.playback.name, np.zeros_like(full) if image is None else image))
    return tuple(shown)


def _command_line(command: Simulate) -> str:
    """The command line that makes the report again."""
    words = ["gsvis", "simulate", *command.package, "--path", command.path, "-o", command.out]
    for name, value in vars(command).items():
        if name in _NOT_SPELLED or value == getattr(Simulate, name):
            continue
        words.append("--" + name.replace("_", "-"))
        if isinstance(value, tuple):
            words += value
        elif value is not True:
            words.append(f"{value:g}" if isinstance(value, float) else str(value))
    return shlex.join(words)


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def _tables(document: dict[str, Any]) -> list[Any]:
    """A table of figures for each visit."""
    from gsvis.report.session_page import format_figures

    link = document["link"]
    text = f"{link['trace']}, {link['mean_mbit_per_s']:.2f} Mbit/s, {1000 * link['round_trip']:g} ms"
    parts: list[Any] = [f" Link: {text} there and back."]
    for visit in document["visits"]:
        header, rows = format_figures(visit["systems"])
        parts.append(facts(visit["scene"]["name"], rows, header))
    return parts
