"""The report on colors as one self-contained HTML page: images inside, no script, no network."""

from __future__ import annotations

from html import escape
from typing import Any

from gsvis.prepare.fitted_colors import FittedColors
from gsvis.report.color_plots import ACTIVE_TARGET, PAPER_EPSILONS
from gsvis.report.color_spheres import COUNTS
from gsvis.report.html import Figure, figure, plain, report_page, table, tiles

__all__ = ["DIFFERENCE", "color_page"]

DIFFERENCE = 8.0
"""Factor by which pictures of differences are brightened."""

_MEASURES = (("psnr", "PSNR, dB", 1), ("ssim", "SSIM", 4), ("flip", "FLIP", 4))


def color_page(fitted: FittedColors, document: dict[str, Any], figures: dict[str, Figure]) -> str:
    """Return the whole page.

    Args:
        fitted: The colors, with their quality.
        document: The content of `report.json`.
        figures: Plots and pictures by name; missing ones are omitted from the page.
    """
    return report_page(
        f"Colors of {document['scene']['name']}",
        document,
        lead=_lead(document),
        tiles=_tiles(document),
        sections={
            "Does it look the same?": _likeness(document, figures),
            "Who has how many terms": _terms(document, figures),
            "Which terms a view needs": _active(document, figures),
            "What it costs to send": _bytes(document, figures),
            "What terms can say": _spheres(fitted, figures),
        },
    )


def _lead(document: dict[str, Any]) -> str:
    """Return the first paragraph: terms, bytes and quality in one sentence."""
    terms = document["terms"]
    quality = document["quality"]
    if not terms["total"]:
        return (
            f"<p class='lead'>The {document['gaussians']:,} Gaussians of this scene have base colors and no terms:"
            " no color depends on direction.</p>"
        )
    return (
        f"<p class='lead'>Each of the {document['gaussians']:,} Gaussians has a base color and"
        f" {terms['mean']:.2f} terms on average, each of which changes it toward one direction, in place of spherical"
        f" harmonics (SH) of degree {document['sh_degree']}. Compared with SH in {quality['views']} views that the fit"
        f" did not use, {escape(document['cameras_from'])}.</p>"
    )


def _tiles(document: dict[str, Any]) -> str:
    """Return the row of large figures."""
    quality = document["quality"]
    sizes = document["bytes_per_gaussian"]
    terms = document["terms"]
    whole = quality["all_terms"]["psnr"]
    base = quality["base_only"]["psnr"]
    shown = [
        (f"{whole['mean']:.1f} dB", "PSNR against SH, on average", f"worst view: {whole['worst']:.1f} dB"),
        (f"{base['mean']:.1f} dB", "with base colors alone", f"worst view: {base['worst']:.1f} dB"),
        (f"{sizes['records']:.1f} bytes", "for the color of a Gaussian", f"SH in 32 bits: {sizes['sh_32']:g}"),
        (f"{terms['share_1_to_4']:.0%}", "of the Gaussians have 1 to 4 terms", f"none: {terms['share_none']:.0%}"),
    ]
    return tiles(shown)


def _likeness(document: dict[str, Any], figures: dict[str, Figure]) -> str:
    """Return the section that compares the fit with spherical harmonics."""
    quality = document["quality"]
    rows = []
    for name, key in (("all terms", "all_terms"), ("base colors alone", "base_only")):
        cells = [name]
        for measure, _, digits in _MEASURES:
            if measure in quality[key]:
                cells += [f"{quality[key][measure][which]:.{digits}f}" for which in ("mean", "worst")]
        rows.append(cells)
    header = ["against SH"]
    for measure, label, _ in _MEASURES:
        if measure in quality["all_terms"]:
            header += [label, "worst"]
    text = table(header, rows)
    for role, label in (("worst", "The worst view"), ("median", "The median view")):
        if f"{role}_sh" in figures:
            row = next(each for each in quality["cameras"] if each["role"] == role)
            text += f"<h3>{label}</h3>" + _pictures(role, row, figures)
    if "first_terms" in figures:
        caption = (
            "Terms come one by one, the most useful of each Gaussian first. Below the number is how many that makes of"
            " all Gaussians on average, since most have fewer."
        )
        text += figure(figures["first_terms"], "PSNR by the number of first terms", caption)
    text += (
        f"<p>Each view has {quality['width']} x {quality['height']} pixels, values clipped to what a display shows;"
        f" equal images count as {quality['psnr_cap']:g} dB. FLIP is an error as an eye would see it, 0 for none.</p>"
    )
    return text


def _pictures(role: str, row: dict[str, Any], figures: dict[str, Figure]) -> str:
    """Return the four pictures of one view: SH, all terms, base colors, difference."""
    shown = (
        ("sh", "SH, as the scene came."),
        ("srbf", f"Base colors and all terms: {row['psnr']:.1f} dB."),
        ("base", f"Base colors alone: {row['base_psnr']:.1f} dB."),
        ("difference", f"Difference of the first two, brightened {DIFFERENCE:g} times."),
    )
    drawn = "".join(figure(figures[f"{role}_{name}"], label, label) for name, label in shown)
    return f"<div class='pair'>{drawn}</div>"


def _terms(document: dict[str, Any], figures: dict[str, Figure]) -> str:
    """Return the section on the number of terms of a Gaussian."""
    terms = document["terms"]
    seen = document["directions"]
    text = ""
    if "term_counts" in figures:
        caption = (
            f"{terms['share_none']:.1%} of the Gaussians have no term, {terms['share_1_to_4']:.1%} have 1 to 4,"
            f" {terms['share_more']:.1%} more. Beside it the same, each Gaussian counted by how much images show of"
            " it (its squared blending weights in the views of the fit)."
        )
        text += figure(figures["term_counts"], "Share of Gaussians by their number of terms", caption)
    rows = [
        ("variant", escape(document["variant"])),
        ("terms", f"{terms['total']:,}"),
        ("terms of a Gaussian on average", f"{terms['mean']:.2f}"),
        ("directions from which a Gaussian counts", escape(seen["from"])),
        ("their share of all, on average", f"{seen['mean_share']:.1%}"),
        ("Gaussians without any", f"{seen['without_any']:,}"),
    ]
    return text + table(("colors", ""), rows)


def _active(document: dict[str, Any], figures: dict[str, Figure]) -> str:
    """Return the section on the share of terms that are active for an eye."""
    quality = document["quality"]
    epsilon = document["epsilon"]
    if "active" not in figures:
        return "<p>The colors have no terms.</p>"
    shares = "Share of all terms that change a channel of their Gaussian by more than epsilon, as an eye sees it."
    kept = f"Quality with active terms only, against all terms. The target is {ACTIVE_TARGET:g} dB."
    low, high = PAPER_EPSILONS
    text = "<div class='pair'>"
    text += figure(figures["active"], "Share of active terms by epsilon", shares)
    text += figure(figures["active_psnr"], "PSNR of active terms by epsilon", kept) + "</div>"
    rows = [
        (f"{each['epsilon']:.3g}", f"{each['share']:.1%}", f"{each['psnr']:.1f}", f"{each['psnr_worst']:.1f}")
        for each in quality["active"]
    ]
    text += table(("epsilon", "active for an eye", "PSNR against all terms, dB", "worst"), rows)
    found = quality["visible_by_active"]
    none, *few, more = found["shares"]
    text += f"<p>Of the Gaussians that an eye sees, {none:.1%} have no active term at epsilon {found['epsilon']:g},"
    text += f" {sum(few):.1%} have 1 to 4 and {more:.1%} have more.</p>"
    text += f"<p>The paper's epsilons are {low:g} to {high:g}."
    if epsilon is not None and epsilon["from"] == "calibrated":
        text += (
            f" For this scene a model observer came to {epsilon['value']:.3g} in {epsilon['trials']} trials: it notices"
            f" a difference where the metric FLIP exceeds {epsilon['provenance']['threshold']:g} in the worst hundredth"
            " of an image."
        )
        text += "" if epsilon["converged"] else f" It did not settle: {escape(plain(epsilon['reason']))}."
    elif epsilon is not None:
        text += f" {epsilon['value']:g} was given."
    text += "</p>"
    cells = document["active_in_cells"]
    if cells:
        share = cells["share_of_all"]
        text += (
            f"<p>A cell of the visible sets needs {share['mean']:.1%} of all terms on average, {share['min']:.1%} to"
            f" {share['max']:.1%}: those that may be active from anywhere in it, of the Gaussians that it sees.</p>"
        )
    return text


def _bytes(document: dict[str, Any], figures: dict[str, Figure]) -> str:
    """Return the section on the bytes that the color of a Gaussian takes."""
    sizes = document["bytes_per_gaussian"]
    count = document["gaussians"]
    rows = [
        (name, f"{size:.2f}", f"{size * count / 1e6:.2f}", f"{size / sizes['sh_32']:.1%}")
        for name, size in (
            ("SH, 32 bits a coefficient", sizes["sh_32"]),
            ("SH, 16 bits", sizes["sh_16"]),
            ("SH, 8 bits", sizes["sh_8"]),
            (f"base and all terms, {escape(document['precision'])} records", sizes["records"]),
            ("base alone", sizes["base"]),
            ("one term", sizes["term"]),
        )
    ]
    rows[-1] = (rows[-1][0], rows[-1][1], "", "")
    caption = "Bytes of a Gaussian's color, before any further compression. Geometry is the same in all cases."
    return (
        figure(figures["bytes"], "Bytes of a color, by encoding", caption)
        + table(("color", "bytes a Gaussian", "MB in all", "of SH in 32 bits"), rows)
        + f"<p>The file, with geometry in 32 bits a number, takes {document['file_bytes'] / 1e6:.2f} MB.</p>"
    )


def _spheres(fitted: FittedColors, figures: dict[str, Figure]) -> str:
    """Return the figure of colors drawn on spheres; empty without that figure."""
    if "spheres" not in figures:
        return ""
    counts = ", ".join(str(k) for k in COUNTS)
    caption = (
        "Gaussians whose color depends much on direction, as spheres that show what an eye on that side would see:"
        f" by SH, by the base color, and by {counts} terms ({escape(fitted.colors.variant)}). Below each is its mean"
        " squared error over all directions. The terms were fitted for this picture, over the whole sphere."
    )
    return figure(figures["spheres"], "Spheres drawn with more and more terms", caption)
