"""`gsvis inspect`: show what a scene holds and what looks wrong with it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gsvis.cli.arguments import Inspect
from gsvis.cli.histograms import TITLES, band_lines, can_draw_blocks, histogram_lines, line_width
from gsvis.cli.inspect_world import inspect_world
from gsvis.cli.overdraw import cell_overdraw, cell_overdraw_rows, measure_overdraw, overdraw_rows
from gsvis.cli.source import inspect_scene_of, open_source
from gsvis.cli.terminal import Status, facts, print_json, show, size_of
from gsvis.cli.where import check_where, find_place, flyaway_remarks, space_document, suspect_views
from gsvis.io.facts import facts_to_json
from gsvis.io.scenes import suffix_of
from gsvis.package.shown import judged_of, load_shown
from gsvis.scene.facts import SceneFacts
from gsvis.scene.histograms import Band, Histogram, measure_bands, measure_histograms
from gsvis.scene.lengths import spell_point
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.paths import HeadPath
from gsvis.scene.source import Source
from gsvis.world import is_world

__all__ = ["run_inspect"]


def run_inspect(command: Inspect) -> None:
    """Inspect a scene: read it, measure it, print a table or JSON; of a world, what its manifests say."""
    if is_world(command.scene):
        inspect_world(command)
        return
    walk = check_where(command.where)
    with Status() as status:
        source = open_source(command.scene, command.lod, status, load=load_shown)
        report = inspect_scene_of(source)
        report["facts"] = facts_to_json(source.gaussians.facts)
        with status.stage("space"):
            space, remarks = _space(command, source, walk)
        report["space"] = None if space is None else space_document(space)
        report["problems"] += [remark.strip() for remark in remarks]
        report["judged"] = judged_of(command.scene)
        if report["judged"] is not None and report["judged"].get("warning"):
            report["problems"].append(str(report["judged"]["warning"]))
        report["cell_overdraw"] = cell_overdraw(command.scene)
        if command.overdraw:
            report["overdraw"] = measure_overdraw(command, source, space, status)
        spread = measure_histograms(source.gaussians) if command.histograms else {}
        bands = measure_bands(source.gaussians) if command.histograms else []
    if command.output.json:
        place = {"scene": source.name, "lod": source.lod, "lods_present": list(source.lods)}
        if command.histograms:
            report["histograms"] = {name: each.as_dict() for name, each in spread.items()}
            report["sh_bands"] = [band.as_dict() for band in bands]
        print_json({"format": "gsvis-inspection", "version": 1, **place, **report})
        return
    show(facts(source.name, _rows(source, report)), *_draw(spread, bands), *_verdict(report["problems"]))


def _draw(spread: dict[str, Histogram], bands: list[Band]) -> list[str]:
    """Return the lines of all histograms, an empty one behind each; none without histograms."""
    width = line_width()
    blocks = can_draw_blocks()
    lines = []
    for name in TITLES:
        if name in spread:
            lines += [*histogram_lines(name, spread[name], width=width, blocks=blocks), ""]
    return [*lines, *band_lines(bands, width=width, blocks=blocks), ""] if bands else lines


def _space(command: Inspect, source: Source, walk: HeadPath | None) -> tuple[NavigableSpace | None, list[str]]:
    """Return where eyes may be, None if nowhere; and what is implausible about it."""
    if len(source.gaussians) == 0:
        return None, []
    place = find_place(source, command.where, walk)
    counted = flyaway_remarks(source.gaussians)  # the report counts them, too
    said = [remark for remark in place.remarks if remark not in counted]
    if place.space is None:
        return None, [*said, f"{place.why_not}; say where eyes may be with --box or --around"]
    return place.space, [*said, *suspect_views(source.gaussians, place.space)]


def _rows(source: Source, report: dict[str, Any]) -> list[tuple[str, str]]:
    """Return the rows of the table."""
    rows = [("Gaussians", f"{report['count']:,}"), ("SH degree", str(report["sh_degree"]))]
    if source.lods:
        rows.append(("LODs present", ", ".join(map(str, source.lods))))
    if source.path is not None and source.path.is_file() and not source.lods:
        rows.append(("file", f"{size_of(source.path.stat().st_size)}, {_suffix(source.path)}"))
    rows.append(("in memory", size_of(report["bytes_in_memory"])))
    rows += _known(source.gaussians.facts)
    if report["count"] == 0:
        return rows
    rows += [
        ("likely up axis", f"{report['up']}, confidence {report['up_confidence']:.0%}"),
        *_box("middle 98% of centers", report["robust_bounds"]),
        *_box("all centers", report["bounds"]),
        ("opacity", _quantiles(report["opacities"])),
        ("largest scale", _quantiles(report["scales"])),
        ("opacity >= 1/2", f"{report['opaque_share']:.1%}"),
        ("opacity < 1/255", f"{report['invisible_share']:.1%}"),
        ("flat discs, needles", f"{report['disc_share']:.1%}, {report['needle_share']:.1%}"),
        ("floaters", f"{report['floaters']:,}"),
        ("exact repeats", f"{report['duplicates']:,}"),
    ]
    if report["judged"] is not None:
        rows.append(("sets, by other eyes", report["judged"]["line"]))
    if report["space"] is not None:
        rows.append(("taken for", report["space"]["kind"]["text"]))
    if report["cell_overdraw"] is not None and not report.get("overdraw"):
        rows += cell_overdraw_rows(report["cell_overdraw"])
    if report.get("overdraw"):
        rows += overdraw_rows(report["overdraw"])
    return rows


def _known(known: SceneFacts) -> list[tuple[str, str]]:
    """Return the rows of what a file states besides its Gaussians; none for what it does not."""
    rows = []
    if any(known.origin):
        rows.append(("origin", f"{spell_point(known.origin)}; centers are relative to it"))
    if known.antialiased:
        rows.append(("antialiased", "yes: opacities make up for the blur of a pixel"))
    if known.meters_per_unit is not None:
        rows.append(("length of a unit", f"{known.meters_per_unit:g} m"))
    return rows


def _verdict(problems: list[str]) -> list[str]:
    """Return lines that list what looks wrong."""
    if not problems:
        return [" Nothing looks wrong."]
    return [" What looks wrong:", *(f" - {problem}" for problem in problems)]


def _box(name: str, corners: list[list[float]]) -> list[tuple[str, str]]:
    """Return a row with the sides of a box, and one with where they lie."""
    low, high = corners
    size = " x ".join(f"{b - a:.3g}" for a, b in zip(low, high, strict=True))
    ranges = ", ".join(f"{axis} {a:.3g} to {b:.3g}" for axis, a, b in zip("xyz", low, high, strict=True))
    return [(name, size), ("", ranges)]


def _quantiles(found: dict[str, float]) -> str:
    """Return quantiles as text."""
    return f"median {found['p50']:.3g}, p10 {found['p10']:.3g}, p90 {found['p90']:.3g}, max {found['max']:.3g}"


def _suffix(path: Path) -> str:
    """Return the suffix of a scene file as text."""
    return suffix_of(path) or "no suffix"
