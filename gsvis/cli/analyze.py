"""`gsvis analyze`: report which Gaussians are visible in views, and from which directions each can be seen."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gsvis._extras import require
from gsvis.cli import version
from gsvis.cli.arguments import Analyze
from gsvis.cli.device import say_device
from gsvis.cli.options import command_line, config_of, refuse, values_of
from gsvis.cli.source import inspect_scene_of, open_source
from gsvis.cli.targets import check_report, check_tracer
from gsvis.cli.terminal import Status, facts, print_json, show
from gsvis.cli.where import check_where, find_place, framed_cameras, space_document, suspect_views
from gsvis.errors import SceneError
from gsvis.io.cameras import load_cameras_at
from gsvis.io.sources import is_builtin
from gsvis.package.shown import check_shown, load_shown
from gsvis.prepare.warm import warm_analysis
from gsvis.raycast import CrossCheck, describe_check
from gsvis.render.device import choose_device
from gsvis.render.judges import JUDGES
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.paths import HeadPath
from gsvis.scene.solid import buried

__all__ = ["PICTURE", "run_analyze"]

PICTURE = 400
"""Pixels of the longer side of the pictures."""

_COMPARABLE = 50  # least views of a capture whose mean is compared with the paper's
_VIEWS = 16
_WIDTH = 256
_HEIGHT = 192
_FOV = 60.0
# pixels of views that judge, and a stream of the seed
_SMALL = (96, 72)
_STREAM = 3


def run_analyze(command: Analyze) -> None:
    """Analyze a scene: read, trace, render, write the report, print a table or JSON."""
    require("gsvis analyze", "matplotlib")
    check_tracer(command.tracing.tracer)
    check_shown(command.scene, command.lod)
    check_report(command.out)
    walk = check_where(command.where)
    given = _given_cameras(command)
    differs = _differs(command, 0 if given is None else len(given))  # read it now: the file may change later
    device = choose_device(command.device)
    with Status() as status:
        say_device(device, status)
        document, remarks = _write_report(command, given, walk, differs, device.backend, status)
    if command.output.json:
        print_json(document)
    else:
        show(*_tables(document), *remarks, *_remarks(document), f" Report: {Path(command.out) / 'report.html'}")


def _write_report(
    command: Analyze, given: Cameras | None, walk: HeadPath | None, differs: str, backend: str, status: Status
) -> tuple[dict[str, Any], list[str]]:
    """Read the scene, analyze it and write the report; return its document."""
    from gsvis.raycast import EllipsoidProxies, Tracer
    from gsvis.raycast.analysis import AnalysisConfig, analyze
    from gsvis.report import Subject, picture_views, write_report
    from gsvis.report.readings import picture_of

    config = config_of(AnalysisConfig, command.tracing)
    source = open_source(command.scene, command.lod, status, "see", load_shown)
    g = source.gaussians
    facts_found = inspect_scene_of(source)
    framed: list[str] = []
    with status.stage("space"):
        if given is not None:
            given, framed = framed_cameras(source, given, command.where)
        for each in framed:
            status.line(each.strip())
        place = find_place(source, command.where, walk, given)
        navigable = place.space
        no_space = place.why_not
        cameras = given if given is not None else _sample_cameras(command, navigable, no_space)
    remarks = (
        framed + place.remarks + _buried_cameras(g, given) + ([] if navigable is None else suspect_views(g, navigable))
    )
    warm_analysis(status)
    tracer = Tracer.named(config.tracer, EllipsoidProxies.from_scene(g))
    analysis = analyze(g, cameras, config, navigable=navigable, tracer=tracer, progress=status)
    if no_space:
        analysis = replace(analysis, untraced_because=no_space)
    pictures = picture_views(tracer, analysis, longest_side=PICTURE, progress=status)
    space = None if navigable is None else space_document(navigable)
    judged = None if navigable is None else _judge(command, g, navigable, status)
    if judged is not None and judged["warning"]:
        remarks.append(f" {judged['warning']}")
    sentences = [each.strip() for each in remarks]
    subject = Subject(
        title=source.name,
        gaussians=g,
        up=navigable.up if navigable is not None else np.array(facts_found["up_vector"]),
        cameras_from="sampled in navigable space" if given is None else f"of {command.where.cameras}",
        command=command_line(command),
        version=version(),
        facts={"path": command.scene, "lod": source.lod, **facts_found, "space": space, "remarks": sentences},
        parameters=_parameters(command, cameras),
        seconds=dict(status.seconds),
        differs=differs,
        judged=judged,
        place=None if navigable is None else picture_of(source, place, backend=backend),
    )
    return write_report(command.out, analysis, subject, pictures, progress=status), remarks


def _judge(command: Analyze, g: Gaussians, space: NavigableSpace, status: Status) -> dict[str, Any] | None:
    """Return what views see whose eyes navigable space did not choose; None if there is no free place in it."""
    from gsvis.pvs.judged import judge_shares
    from gsvis.scene.view_sampling import ViewSampling

    views = ViewSampling(JUDGES, *_SMALL, command.fov or _FOV, command.tracing.seed, _STREAM)
    try:
        return judge_shares(g, space, views, command.tracing.tau, progress=status).as_dict()
    except SceneError:
        return None


def _buried_cameras(g: Gaussians, given: Cameras | None) -> list[str]:
    """Return a remark if cameras of --cameras lie inside something solid."""
    lost = 0 if given is None else int(np.count_nonzero(buried(g, given.viewpoints)))
    return [f" {lost:,} of the cameras of --cameras lie inside something solid and see its inside."] if lost else []


def _differs(command: Analyze, cameras: int) -> str:
    """Return why these figures cannot be compared with the paper's; empty if they can."""
    if is_builtin(command.scene):
        return "this scene was made, not captured"
    if command.where.cameras is None:
        return "the cameras here are drawn at random where a visitor may stand, not the views of a capture"
    if _repeats_views(command):
        return "the cameras here are those of a report of gsvis, not the views of a capture"
    if cameras < _COMPARABLE:
        return f"{cameras:,} views are few; the paper's are all those of a capture"
    return ""


def _repeats_views(command: Analyze) -> bool:
    """Return whether gsvis wrote these cameras into a report or a rendering."""
    from gsvis.io.cameras import holds_repeated_views

    return command.where.cameras is not None and holds_repeated_views(command.where.cameras)


def _given_cameras(command: Analyze) -> Cameras | None:
    """Return the cameras of --cameras at the size of --width and --height; None without a file."""
    if command.where.cameras is None:
        return None
    refuse(command, ["fov"], "with --cameras, whose file states it")
    at_most = None if _repeats_views(command) else _WIDTH  # views of a report keep their size
    cameras = load_cameras_at(command.where.cameras, command.width, command.height, at_most=at_most)
    return cameras if command.views is None else cameras.evenly(command.views)


def _sample_cameras(command: Analyze, navigable: NavigableSpace | None, no_space: str) -> Cameras:
    """Return cameras that are sampled in the navigable space."""
    if navigable is None:
        raise SceneError(
            f"{no_space}; give cameras with --cameras FILE, or say where eyes may be with --box or --around"
        )
    return navigable.sample_cameras(
        command.views or _VIEWS,
        np.random.default_rng(command.tracing.seed),
        width=command.width or _WIDTH,
        height=command.height or _HEIGHT,
        fov=command.fov or _FOV,
    )


def _parameters(command: Analyze, cameras: Cameras) -> dict[str, Any]:
    """Return all parameters that the result depends on, with defaults filled in."""
    silent = ("out", "device", "json", "debug", "drop_invalid")
    return {
        **{name: value for name, value in values_of(command).items() if name not in silent},
        "views": len(cameras),
        "width": cameras.width,
        "height": cameras.height,
        "fov": None if command.where.cameras else (command.fov or _FOV),
    }


def _tables(document: dict[str, Any]) -> list[Any]:
    """Return two tables: what was analyzed, and the figures beside those of the paper."""
    visible = document["visible_fraction"]
    rays = document["rays"]
    found = document["directions"]
    low, high = rays["horizontal_fov_degrees"]
    angle = f"{low:.0f}" if high - low < 0.5 else f"{low:.0f} to {high:.0f}"
    about = [
        ("Gaussians", f"{document['gaussians']:,}"),
        ("cameras", f"{len(visible['cameras']):,}, {document['cameras_from']}"),
        ("rays a view", f"{rays['width']} x {rays['height']}, field of view {angle} degrees"),
    ]
    if document["scene"]["space"]:
        about.append(("taken for", document["scene"]["space"]["kind"]["text"]))
    if document["judged"]:
        about.append(("checked by other eyes", document["judged"]["line"]))
    if found["traced"]:
        rays_each = document["config"]["rays_per_face"]
        about.append(("traced outward", f"{found['traced']['gaussians']:,} Gaussians, {rays_each} rays a direction"))
    check = document["traced_twice"]
    about.append(("two tracers agree", describe_check(None if check is None else CrossCheck(**check))))
    shares = [
        ("visible in a view: mean of the views", f"{visible['mean']:.2%}", "20.21%"),
        ("                   smallest", f"{visible['min']:.2%}", ""),
        ("                   largest", f"{visible['max']:.2%}", "33.58%*"),
        ("seen by at least one camera", f"{found['gathered']['seen_at_least_once'] / document['gaussians']:.2%}", ""),
    ]
    ways = {"solid_angle": "by solid angle", "traced": "80 faces, by rays"}
    if found["has_settled"]:  # else it says how many cameras there were
        ways["gathered"] = f"80 faces, {len(visible['cameras']):,} views"
    for way, named in ways.items():
        if found[way]:
            for each, limit, paper in zip(
                found[way]["share_below"], ("41.25%", "60%"), ("39.4%", "80.4%"), strict=True
            ):
                text = f"seen from < {limit} of directions, {named}"
                shares.append((text, f"{each['of_all']:.2%}", paper if way == list(ways)[-1] else ""))
    if found["agreement"]:
        shares.append(("agreement of the two: mean Jaccard index", f"{found['agreement']['mean_jaccard']:.3f}", ""))
    shown = 3 if document["paper"]["comparable"] else 2  # columns; the last is the paper's
    header = ("share of all Gaussians", "here", "paper")[:shown]
    return [facts(document["scene"]["name"], about), facts("", [row[:shown] for row in shares], header)]


def _remarks(document: dict[str, Any]) -> list[str]:
    """Return lines that explain the tables."""
    found = document["directions"]
    differs = document["paper"]["differs"]
    remarks = [" * in the one view of the paper's figure 1"]
    if differs:
        remarks = [f" The paper's 20.21% visible in a view does not compare with these: {differs}."]
    if not found["has_settled"]:
        count = len(document["visible_fraction"]["cameras"])
        instead = "shares are by rays" if found["traced"] else "no share is printed"
        remarks.append(f" {count:,} cameras are too few to count directions from them; {instead}.")
    if found["untraced_because"]:
        remarks.append(f" Directions were not traced outward: {found['untraced_because']}.")
    return remarks
