"""`gsvis pvs-report`: report how good the visible sets of a store are at viewpoints that the build did not use."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from gsvis._extras import require
from gsvis.cli import version
from gsvis.cli.arguments import PvsReport
from gsvis.cli.options import command_line, config_of, values_of
from gsvis.cli.source import inspect_scene_of, open_source
from gsvis.cli.targets import check_exists, check_report
from gsvis.cli.terminal import Status, facts, print_json, show, size_of
from gsvis.cli.where import check_cameras, framed_cameras
from gsvis.errors import SceneError
from gsvis.io.cameras import load_cameras_at
from gsvis.io.sources import check_source
from gsvis.pvs.store import VisibilityStore
from gsvis.pvs.viewpoints import CellViewpoints
from gsvis.render.judges import JUDGES
from gsvis.scene.levels import as_levels
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.place import Place
from gsvis.scene.source import Source
from gsvis.scene.upright import Upright
from gsvis.scene.view_sampling import ViewSampling
from gsvis.scene.witnesses import Witnesses, hold_out

__all__ = ["run_pvs_report"]

# pixels of views that judge, and a stream of the seed
_SMALL = (160, 120)
_STREAM = 3
_SILENT = ("out", "json", "debug", "drop_invalid")


def run_pvs_report(command: PvsReport) -> None:
    """Report on a store: open it, read the scene, measure, write the report, print tables or JSON."""
    require("gsvis pvs-report", "matplotlib")
    check_exists(command.store)
    check_source(command.scene, command.lod)
    check_report(command.out)
    check_cameras(command.where)
    with VisibilityStore.open(command.store) as store, Status() as status:
        document = _write_report(command, store, status)
    if command.output.json:
        print_json(document)
    else:
        show(*_tables(document), *_remarks(document), f" Report: {Path(command.out) / 'report.html'}")


def _write_report(command: PvsReport, store: VisibilityStore, status: Status) -> dict[str, Any]:
    """Read the scene, measure the store and write the report; return its document."""
    source = open_source(command.scene, command.lod, status)
    store.check_scene(source.whole)
    facts_found = inspect_scene_of(source)
    witnesses, framed = _witnesses(command, source)
    with status.stage("space"):
        viewpoints, text = _viewpoints(store, source)
    from gsvis.pvs.quality import QualityConfig, measure_quality
    from gsvis.report import Subject  # imports matplotlib
    from gsvis.report.pvs_document import write_pvs_report
    from gsvis.report.readings import picture_of

    config = config_of(QualityConfig, command.quality, viewpoints=command.quality.eyes, rays=command.quality.raycast)
    found = measure_quality(store, source.whole, viewpoints, config, progress=status)
    judged, unjudged = _judge(command, store, source, replace(viewpoints.space, witnesses=witnesses), status)
    subject = Subject(
        title=source.name,
        gaussians=source.gaussians,
        up=store.grid.up,
        cameras_from=text,
        command=command_line(command),
        version=version(),
        facts={"path": command.scene, "lod": source.lod, **facts_found, "remarks": [*framed, *unjudged]},
        parameters={name: value for name, value in values_of(command).items() if name not in _SILENT},
        seconds=dict(status.seconds),
        judged=judged,
        place=picture_of(source, Place(viewpoints.space, "", [], upright=Upright(store.grid.up, 1.0, "of the store"))),
    )
    return write_pvs_report(command.out, found, store, subject, progress=status)


def _witnesses(command: PvsReport, source: Source) -> tuple[Witnesses | None, list[str]]:
    """Return the cameras that judge, none without --cameras, and remarks on their frame."""
    if command.where.cameras is None:
        return None, []
    cameras = load_cameras_at(command.where.cameras, *_SMALL)
    cameras, framed = framed_cameras(source, cameras, command.where)
    kept = hold_out(len(cameras))[1]
    some = cameras[kept] if len(kept) else cameras
    return Witnesses(some, f"{len(some):,} cameras of {command.where.cameras}"), framed


def _judge(
    command: PvsReport, store: VisibilityStore, source: Source, space: NavigableSpace, status: Status
) -> tuple[dict[str, Any] | None, list[str]]:
    """Return what eyes of two rules see of the sets, or a remark why nothing judges them."""
    from gsvis.pvs.judged import judge_sets

    views = ViewSampling(JUDGES, *_SMALL, command.quality.fov, command.quality.seed, _STREAM)
    try:
        return judge_sets(as_levels(source.whole), space, store, views, progress=status).as_dict(), []
    except SceneError as error:  # the report stands without judges
        return None, [f" Not checked by other eyes: {error.problem}."]


def _viewpoints(store: VisibilityStore, source: Source) -> tuple[CellViewpoints, str]:
    """Return where to sample fresh viewpoints, and its description: in the space of the build if it is found again."""
    from gsvis.pvs.quality import box_space, find_build_space

    space, is_same = find_build_space(store, source.spaces_of_build(store.grid.up))
    if space is not None:
        text = "in the navigable space that the store was built in"
        if not is_same:
            text = "in the navigable space of the scene, of which the store covers a part"
        try:
            return CellViewpoints(store.grid, space), text
        except ValueError:  # a cell has no free voxel: the cells are of another space
            pass
    text = "anywhere in the boxes of the cells, since the space they were cut from is not known"
    return CellViewpoints(store.grid, box_space(store.grid, source.gaussians)), text


def _tables(document: dict[str, Any]) -> list[Any]:
    """Return three tables: what was measured, the figures beside their targets, and the value of faint classes."""
    from gsvis.report.pvs_page import format_label, format_target, format_value

    store = document["store"]
    quality = document["quality"]
    config = quality["config"]
    share = store["visible_share"]
    count = quality["cells_measured"]
    cells = store["grid"]["cells"]
    measured = f"{count:,} of {cells:,} cells, {config['viewpoints']} fresh viewpoints in each"
    about = [
        ("Gaussians", f"{store['gaussians']:,}"),
        ("measured", measured),
        ("faces", f"six of {config['size']} x {config['size']} pixels (px) around a viewpoint"),
        ("images", f"{config['width']} x {config['height']}, field of view {config['fov']:g} degrees"),
        ("visible from a cell", f"{share['mean']:.1%} of all; {share['min']:.1%} to {share['max']:.1%}"),
    ]
    figures = []
    for key, each in quality["figures"].items():
        mean, worst = (format_value(each[which], each["unit"]) for which in ("mean", "worst"))
        wanted = [(each[f"target_{which}"], each[f"met_{which}"]) for which in ("mean", "worst")]
        beside = "; ".join("" if target is None else format_target(target, each["unit"]) for target, _ in wanted)
        verdicts = [met for _, met in wanted if met is not None]
        verdict = "" if not verdicts else "met" if all(verdicts) else "MISSED"
        figures.append((format_label(key, each["label"], config), mean, worst, beside.strip("; "), verdict))
    classes = [
        (
            "whole set" if not each["least_class"] else f"weights from {each['least_weight']:.3g}",
            size_of(round(each["bytes"])),
            format_value(each["weighted_recall"], "share"),
            f"{each['psnr']:.1f} dB",
            "" if each["lost_per_megabyte"] is None else f"{each['lost_per_megabyte']:.2f}",
        )
        for each in quality["classes"]
    ]
    worst = ", ".join(
        f"{row['cell']} at ({', '.join(f'{x:.2f}' for x in row['center'])})"
        for cell in quality["worst_cells"][:3]
        for row in quality["cells"]
        if row["cell"] == cell
    )
    return [
        facts(document["scene"]["name"], [*about, ("worst cells", worst)]),
        facts("", figures, ("at fresh viewpoints", "mean", "worst", "targets", "")),
        facts("", classes, ("sent for a cell", "size", "light kept", "PSNR", "dB lost per MB saved")),
    ]


def _remarks(document: dict[str, Any]) -> list[str]:
    """Return lines below the tables."""
    from gsvis.report.pvs_page import describe_bounds, describe_certificate, describe_tiles

    judged = document["judged"]
    remarks = list(document["scene"]["remarks"])
    if judged is not None:
        remarks += [f" {judged['warning']}"] if judged["warning"] else []
        remarks.append(f" Images of sets at eyes that navigable space did not choose: {judged['line']}.")
    remarks.append(f" Fresh viewpoints were drawn {document['viewpoints_from']}.")
    if document["quality"]["certificate"] is not None:
        remarks.append(f" {describe_certificate(document['quality']['certificate'])}")
    if document["bounds_checked"] is not None:
        remarks.append(f" {describe_bounds(document['bounds_checked'])}")
    if tiles := describe_tiles(document["store"]["certificates"]):
        remarks.append(f" {tiles}")
    left_out = document["quality"]["cells_left_out"]
    if left_out:
        remarks.append(f" {len(left_out):,} cells were left out: every viewpoint drawn lies in something solid.")
    return remarks
