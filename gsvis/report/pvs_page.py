"""The report on visible sets as one self-contained HTML page: images inside, no script, no network."""

from __future__ import annotations

from html import escape
from typing import Any

import numpy as np

from gsvis.pvs.quality import PSNR_CAP, TARGETS, Quality
from gsvis.pvs.quality import Figure as Measure
from gsvis.report.html import Figure, describe_judged, figure, report_page, table, tiles, where_part

__all__ = [
    "describe_bounds",
    "describe_certificate",
    "describe_tiles",
    "format_label",
    "format_target",
    "format_value",
    "pvs_page",
]

_WORST = 8  # number of listed cells
_ON_FACES = ("weighted_recall", "recall", "ray_recall")
_ON_DENSE_FACES = ("size_over_dense", "dense_recall")


def pvs_page(quality: Quality, document: dict[str, Any], figures: dict[str, Figure]) -> str:
    """Return the whole page.

    Args:
        quality: The measurements.
        document: The content of `report.json`.
        figures: Plots and maps by name.
    """
    return report_page(
        f"Visible sets of {document['scene']['name']}",
        document,
        lead=_lead(quality, document),
        tiles=_tiles(quality, document["store"]),
        sections={
            "What cells see": _cells(document["store"], figures),
            "Do the sets hold what is seen?": _quality(quality, document, figures),
            "What faint Gaussians are worth": _classes(quality, figures),
            "The worst cells": _worst(quality, figures),
            "Where people stand": where_part(figures.get("where")),
            "The store": _store(document["store"]),
        },
    )


def format_value(value: float | None, unit: str) -> str:
    """Format a figure with its unit; shares in percent get more digits near 0 and near 100%."""
    if value is None:
        return ""
    if unit == "share":
        return f"{value:.3%}" if value > 0.99 or 0.0 < value < 0.01 else f"{value:.1%}"
    return f"{value:.1f} dB" if unit == "dB" else f"{value:.2f}"


def format_target(target: float, unit: str) -> str:
    """Format a target with its unit, in as few digits as it has."""
    return f"{100.0 * target:g}%" if unit == "share" else f"{target:g}" + (" dB" if unit == "dB" else "")


def describe_certificate(found: dict[str, Any]) -> str:
    """Return sentences on the certificates of the measured cells: the rays, the bound, and the second tracer.

    Args:
        found: Entry "certificate" of "quality" in `report.json`.
    """
    text = (
        f"{found['rays']:,} random rays from free points of the measured cells, in all directions, miss"
        f" {found['missed']:.3%} of the light; with {1.0 - found['error']:.0%} confidence the sets miss at most"
        f" {found['bound']:.3%}. {found['heavy_rays']:.2%} of the rays miss a weight of more than a hundredth."
    )
    twice = found["rays_traced_twice"]
    if not twice:
        return f"{text} No ray was traced a second time, because Open3D is not installed or cannot be loaded."
    text += f" {twice:,} of the rays were traced a second time, through proxy meshes by Open3D's Embree:"
    if found["rays_agreeing"] == twice:
        return f"{text} both tracers agree on all of them."
    differing = twice - found["rays_agreeing"]
    return f"{text} the tracers differ on {differing:,}, by at most {found['largest_difference']:.3g} of a weight."


def describe_bounds(found: dict[str, Any]) -> str:
    """Return a sentence on the bounds of the store against fresh rays.

    Args:
        found: Entry "bounds_checked" of `report.json`.
    """
    return (
        f"The bound in the store lies below the estimate by fresh rays in {found['below_estimate']:,} of"
        f" {found['cells']:,} measured cells; bounds with 95% confidence may in one of twenty."
    )


def describe_tiles(certified: dict[str, Any]) -> str:
    """Return a sentence on the worst tiles of pictures; empty without certificates.

    Args:
        certified: Entry "certificates" of "store" in `report.json`.
    """
    tile = certified["tile"]
    if tile is None:
        return ""
    return (
        f"The worst tile of 16 x 16 pixels misses {tile['mean']:.1%} of its light on average over the cells,"
        f" {tile['max']:.1%} in the worst cell."
    )


def format_label(key: str, label: str, config: dict[str, Any]) -> str:
    """Return the label of a figure, with the size of the faces in pixels where it was measured on faces.

    Args:
        key: Key of the figure.
        label: Its label.
        config: Entry "config" of "quality" in `report.json`.
    """
    if key in _ON_DENSE_FACES:
        return f"{label}, {config['dense_size'] or config['size']} px"
    return f"{label}, {config['size']} px" if key in _ON_FACES else label


def _target(measure: Measure, which: int) -> str:
    """Return the target of a mean (0) or a worst value (1) and whether it is met; empty without one."""
    target = measure.targets[which]
    if target is None:
        return ""
    bound = "at least" if measure.better == "higher" else "at most"
    return f"{bound} {format_target(target, measure.unit)} ({'met' if measure.met(which) else 'missed'})"


def _lead(quality: Quality, document: dict[str, Any]) -> str:
    """Return the first paragraph: what a cell sees and what its set misses."""
    store = document["store"]
    return (
        f"<p class='lead'>From one of the {store['grid']['cells']:,} cells of this scene"
        f" {store['visible_share']['mean']:.1%} of its {quality.gaussians:,} Gaussians can be seen on average."
        f" Measured at {quality.eyes.shape[1]} fresh viewpoints, which the build did not use, in each of"
        f" {len(quality):,} cells. They were drawn {escape(document['viewpoints_from'])}.</p>"
    )


def _tiles(quality: Quality, store: dict[str, Any]) -> str:
    """Return the row of large figures."""
    by_key = {each.key: each for each in quality.figures()}
    shown = [(f"{store['visible_share']['mean']:.1%}", "of the scene is visible from a cell, on average", "")]
    for key, label in (
        ("weighted_recall", "of the light at a fresh viewpoint is in the cell's set, on average"),
        ("psnr", "images from the set against the full scene, on average"),
        ("size_over_dense", "times the size of what many viewpoints see"),
    ):
        if key in by_key:
            measure = by_key[key]
            shown.append((format_value(measure.mean, measure.unit), label, f"target: {_target(measure, 0)}"))
    return tiles(shown)


def _cells(store: dict[str, Any], figures: dict[str, Figure]) -> str:
    """Return the section on the cells, with their map."""
    looked = store["viewpoints"]
    certified = store["certificates"]
    above = store["cells_above_limit"]
    from_above = (
        "The cells from above, colored by the share of the scene that each sees; of stacked cells the one that sees the"
        " most. The lines are the scene itself from above: darker where there are more Gaussians."
    )
    shares = (
        f"Each cell's visible share, highest first: {store['visible_share']['min']:.1%} to"
        f" {store['visible_share']['max']:.1%}. All cells together see {store['ever_visible_share']:.1%}."
    )
    found = (
        "Cells share the viewpoints near their corners; inner ones are added where the rays of a certificate ask for"
        f" them. {looked['min']} to {looked['max']} viewpoints, {looked['mean']:.1f} on average."
    )
    proven = "This store has no certificates: an older version has built it."
    if certified["bound"] is not None:
        proven = (
            f"What {certified['rays']:,} fresh rays prove about each set, with 95% confidence, highest first. The"
            f" estimate is {certified['missed']['mean']:.3%} on average, {certified['missed']['max']:.3%} in the worst"
            f" cell. {describe_tiles(certified)}"
        )
    if above:
        proven += f" {above:,} cells stayed above the limit."
    return (
        figure(figures["map_visible"], "Map of the cells colored by visible share", from_above)
        + figure(figures["visible"], "Visible share of each cell, sorted", shares)
        + "<div class='pair'>"
        + figure(figures["viewpoints"], "Viewpoints of the cells", found)
        + figure(figures["bounds"], "Upper bound of the light that each set misses, sorted", proven)
        + "</div>"
    )


def _quality(quality: Quality, document: dict[str, Any], figures: dict[str, Figure]) -> str:
    """Return the section on quality: each figure with its target and its worst case."""
    config = quality.config
    count = quality.psnr[..., 0].size
    rows = []
    for each in quality.figures():
        worst = f"{format_value(each.worst, each.unit)} ({each.worst_of})" if each.worst is not None else ""
        label = format_label(each.key, each.label, document["quality"]["config"])
        rows.append((label, format_value(each.mean, each.unit), _target(each, 0), worst, _target(each, 1)))
    good, least = (f"{1.0 - value:.1%}" for value in TARGETS["weighted_recall"] if value is not None)
    missed = (
        "Share of the light that the set misses, by measured cell and at each viewpoint; lower is better. The targets"
        f" are {good} on average and {least} in the worst cell."
    )
    where = "The measured cells, and what they miss; of stacked cells the one that misses most."
    text = table(("figure", "mean", "target", "worst", "target"), rows)
    text += describe_judged(document["judged"])
    text += figure(figures["missing"], "Light that each measured set misses", missed)
    text += figure(figures["map_missing"], "Map of what the sets of measured cells miss", where)
    text += (
        f"<p>Light is the sum of the weights of Gaussians (alpha times the light left in front) over six faces of"
        f" {config.size} x {config.size} pixels around a viewpoint; a Gaussian is visible when one of its weights is at"
        f" least {quality.tau:.4g}. Each of the {count:,} images has {config.width} x {config.height} pixels and a"
        f" field of view of {config.fov:g}°; values are clipped to what a display shows, and equal images count as"
        f" {PSNR_CAP:g} dB. The ceiling image is drawn from exactly the Gaussians visible in that image: it shows"
        " the loss by the threshold alone."
    )
    if config.dense:
        text += (
            f" The dense union is what {config.dense} more fresh viewpoints of the cell see on such faces. It misses"
            " small Gaussians that show only in finer images."
        )
    text += "</p>"
    found = document["quality"]["certificate"]
    if found is not None:
        text += (
            f"<p>{describe_certificate(found)} Rays are finer than pixels: they find what falls between the pixels of"
            " the faces above. The bound of a single cell holds for that cell alone."
        )
        checked = document["bounds_checked"]
        text += f" {describe_bounds(checked)}</p>" if checked is not None else "</p>"
    if quality.left_out:
        text += f"<p>{len(quality.left_out):,} cells were left out: all viewpoints drawn lie in something solid.</p>"
    return text


def _classes(quality: Quality, figures: dict[str, Figure]) -> str:
    """Return the section on what is lost when the lightest weight classes are left out."""
    trades = quality.trades()
    whole = quality.gaussians * quality.bytes_per_gaussian / 1e6
    rows = [("the whole scene", f"{quality.gaussians:,}", f"{whole:.2f}", "", "100%", "", "", "", "")]
    for each in trades:
        rate = each.lost_per_megabyte
        rows.append(
            (
                "whole set" if each.least_class == 0 else f"weights from {each.least_weight:.3g}",
                f"{each.gaussians:,.0f}",
                f"{each.bytes / 1e6:.2f}",
                f"{each.saved / 1e6:.2f}" if each.least_class else "",
                format_value(each.weighted_recall, "share"),
                f"{each.psnr:.1f}",
                f"{each.psnr_worst:.1f}",
                f"{each.lost:.1f}" if each.least_class else "",
                f"{rate:.2f}" if rate is not None else "",
            )
        )
    caption = (
        "Loss of quality if the faintest classes of a set are not sent. Each point omits all Gaussians whose largest"
        " weight seen from the cell lies below the value beside it."
    )
    header = ("sent for a cell", "Gaussians", "MB", "MB saved", "light kept", "PSNR", "worst", "dB lost", "dB per MB")
    return (
        figure(figures["classes"], "PSNR by megabytes sent", caption)
        + table(header, rows)
        + f"<p>Averages over the measured cells, {quality.bytes_per_gaussian} bytes a Gaussian. Savings and losses are"
        " relative to the whole set.</p>"
    )


def _worst(quality: Quality, figures: dict[str, Figure]) -> str:
    """Return the table of the worst eyes."""
    rows = []
    for m in quality.worst(_WORST).tolist():
        x, y, z = quality.centers[m]
        row = [
            f"cell {int(quality.cells[m])}",
            f"{x:.2f}, {y:.2f}, {z:.2f}",
            format_value(float(quality.weighted_recall[m, :, 0].mean()), "share"),
            format_value(float(quality.weighted_recall[m, :, 0].min()), "share"),
            f"{quality.psnr[m, :, 0].mean():.1f}",
            f"{quality.psnr[m, :, 0].min():.1f}",
            f"{quality.ceiling[m].min():.1f}",
            f"{quality.kept[m, 0]:,}",
        ]
        rows.append(row)
    header = ("", "center", "light kept", "at worst", "PSNR", "at worst", "ceiling at worst", "Gaussians")
    m, v = np.unravel_index(int(quality.psnr[..., 0].argmin()), quality.psnr.shape[:2])
    where = f"cell {int(quality.cells[m])}"
    pictures = (
        ("worst_full", f"The image with the largest loss, drawn from the full scene, in {where}."),
        ("worst_set", f"The same from the cell's set: {quality.psnr[m, v, 0]:.1f} dB."),
        ("worst_difference", "The difference, brightened eight times."),
    )
    return (
        table(header, rows)
        + "<div class='three'>"
        + "".join(figure(figures[name], label, label) for name, label in pictures)
        + "</div>"
    )


def _store(store: dict[str, Any]) -> str:
    """Return the table of what the file of visible sets holds."""
    grid = store["grid"]
    sizes = store["bytes"]
    x, y, z = grid["shape"]
    rows = [
        ("Gaussians of the scene", f"{store['gaussians']:,}"),
        ("cells", f"{grid['cells']:,} of side {grid['cell_size']:.3g} scene units, in {x} x {y} x {z} boxes"),
        ("file", f"{sizes['file'] / 1e6:.2f} MB"),
        ("bits for each Gaussian that a cell sees", f"{sizes['bits_per_pair']:.2f}"),
        ("bits for its weight class", f"{sizes['class_bits_per_pair']:.2f}"),
        ("visible from a weight of", f"{store['tau']:.4g}"),
        ("cells without a viewpoint outside something solid", f"{store['cells_without_a_free_viewpoint']:,}"),
    ]
    known = ("method", "size", "limit", "tile_limit", "rays", "max_inner")
    rows += [(f"built with {name}", escape(str(store["config"][name]))) for name in known if name in store["config"]]
    return table(("store", ""), rows)
