"""Print the result of `gsvis color`: a table, or one JSON document."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from gsvis._extras import remedy_of
from gsvis.cli.arguments import Color
from gsvis.cli.source import Source, levels_spelled, summarize_levels
from gsvis.cli.terminal import clock, facts, print_json, show, size_of
from gsvis.cli.where import kind_row, space_document

if TYPE_CHECKING:
    from gsvis.prepare.fitted_colors import FittedColors
    from gsvis.scene.navigable import NavigableSpace

__all__ = ["print_result"]


def print_result(
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
    compared = ", ".join(f"{sizes[f'sh_{bits}']:g} with {bits} bits" for bits in (32, 16, 8))
    rows += [
        ("bytes of a color", f"{sizes['records']:.1f} as {document['precision']} records; SH: {compared}"),
        ("file", f"{Path(command.out).name}, {size_of(document['file_bytes'])} with geometry"),
    ]
    if document["epsilon"]:
        rows.append(("epsilon", _epsilon(document["epsilon"])))
    cells = document["active_in_cells"]
    if cells:
        share = cells["share_of_all"]
        text = f"{share['mean']:.1%} of all terms; {share['min']:.1%} to {share['max']:.1%}"
        rows.append(("active in a cell", text))
    return rows


def _epsilon(found: dict[str, Any]) -> str:
    if found["from"] == "given":
        return f"{found['value']:g}, as given"
    interval = found["interval"]
    spread = f" ({interval[0]:.2g} to {interval[1]:.2g})" if interval else ""
    return f"{found['value']:.3g}{spread}, by FLIP in {found['trials']} trials"


def _header(quality: dict[str, Any]) -> tuple[str, ...]:
    names = ["PSNR", "worst", "SSIM", "worst"]
    if "flip" in quality["all_terms"]:
        names += ["FLIP", "worst"]
    return ("against SH", *names)


def _likeness(quality: dict[str, Any]) -> list[tuple[str, ...]]:
    rows = []
    for name, key in (("all terms", "all_terms"), ("base colors alone", "base_only")):
        row = [name]
        for measure, digits in (("psnr", 1), ("ssim", 4), ("flip", 4)):
            if measure in quality[key]:
                row += [f"{quality[key][measure][which]:.{digits}f}" for which in ("mean", "worst")]
        rows.append(tuple(row))
    return rows
