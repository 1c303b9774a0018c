"""The report of a cleaning: what would go, in colors, before anything is deleted; pictures before and after.

One folder with `report.html`, `report.json` and the pictures. Needs no matplotlib.
"""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.edit import CLASSES, HIDDEN, KEPT, Cleaning, class_of
from gsvis.io.report_cameras import describe_cameras
from gsvis.progress import Progress, silent
from gsvis.render import rasterize
from gsvis.report.files import write_report_folder
from gsvis.report.html import Figure, describe_judged, figure, report_page, table, tiles, where_figure, where_part
from gsvis.report.pictures import picture_figures
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.sh import SH_C0

__all__ = ["CLASS_COLORS", "CleanSubject", "clean_document", "write_clean_report"]

F32 = NDArray[np.float32]

CLASS_COLORS = {
    "flyaways": (0.80, 0.47, 0.65),
    "interior": (0.00, 0.45, 0.70),
    "unseen": (0.34, 0.71, 0.91),
    "fog": (0.90, 0.62, 0.00),
    "floaters": (0.84, 0.20, 0.00),
}
"""RGB of each class in pictures; they differ for any color vision."""

_MEANING = {
    "flyaways": "far outside of the scene, and no backdrop",
    "interior": "seen by no eye, inside something closed",
    "unseen": "seen by no eye",
    "fog": "large and faint, in the air that eyes look through",
    "floaters": "small, alone in that air",
}
_VIEWS = 3
_OUTSIDE = (480, 320)  # pixels of the views from outside
_GHOST = 0.04  # factor on the opacity of what stays, in views from outside


@dataclass(frozen=True, eq=False)
class CleanSubject:
    """Context of a report.

    Attributes:
        title: Name of the scene.
        gaussians: The scene.
        command: The command line.
        version: Version of gsvis.
        parameters: What the result depends on.
        facts: More on the scene, for `report.json`.
        seconds: Duration of each stage.
        place: PNG bytes of the picture of where people stand; None without one.
    """

    title: str
    gaussians: Gaussians
    command: str
    version: str
    parameters: dict[str, Any]
    facts: dict[str, Any] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    place: bytes | None = None


def clean_document(found: Cleaning, subject: CleanSubject) -> dict[str, Any]:
    """Return the content of `report.json`.

    Args:
        found: The cleaning.
        subject: Its context.
    """
    return {
        "format": "gsvis-clean",
        "version": 1,
        "gsvis": subject.version,
        "command": subject.command,
        "parameters": subject.parameters,
        "scene": {"name": subject.title, **subject.facts},
        "gaussians": len(found.classes),
        "kept": int(np.count_nonzero(found.kept)),
        "classes": {
            name: {
                "found": int(np.count_nonzero(found.found == class_of(name))),
                "removed": count,
                "cost": asdict(found.costs[name]) if name in found.costs else None,
            }
            for name, count in found.counts.items()
        },
        "cost": asdict(found.costs["all"]) if "all" in found.costs else None,
        "judged": None if found.judged is None else found.judged.as_dict(),
        "eyes": found.evidence.eyes,
        "voxel_size": found.evidence.voxel_size,
        "cameras": [] if found.cameras is None else describe_cameras(found.cameras),
    }


def write_clean_report(
    folder: str | os.PathLike[str], found: Cleaning, subject: CleanSubject, *, progress: Progress = silent
) -> dict[str, Any]:
    """Draw everything and write the folder, atomically.

    Args:
        folder: Created if missing; files in it that do not belong to a report are kept.
        found: The cleaning.
        subject: Its context.
        progress: Called with stage "pictures".

    Returns:
        The content of `report.json`.

    Raises:
        OutputError: If the folder cannot be written.
    """
    figures = _draw(found, subject.gaussians, progress)
    where = where_figure(subject.place)
    if where is not None:
        figures["where"] = where
    document = clean_document(found, subject)
    html = report_page(
        f"Cleaning of {subject.title}",
        document,
        lead=_lead(document),
        tiles=_tiles(document),
        sections={
            "What can go": _classes(document),
            "Where people stand": where_part(where),
            "From within, where it changes most": _inside(figures),
            "From outside": _outside(figures),
        },
    )
    write_report_folder(folder, html, document, figures.values(), subject.seconds)
    return document


def _draw(found: Cleaning, g: Gaussians, progress: Progress) -> dict[str, Figure]:
    """Return pictures from within, before, in colors and after, and two from outside."""
    inner = found.cameras
    count = 0 if inner is None else min(_VIEWS, len(inner))
    progress("pictures", 0, count + 1)
    figures: dict[str, Figure] = {}
    after = g[found.kept]
    colors = _colors(g, found.found)
    order = [] if inner is None else _most_changed(g, after, inner)
    for k in range(count):
        assert inner is not None
        camera = inner[order[k]].resize(480, 360)
        drawn = {
            "before": rasterize(g, camera, backend="cpu").images[0],
            "classes": rasterize(g, camera, backend="cpu", colors=colors).images[0],
            "after": rasterize(after, camera, backend="cpu").images[0],
        }
        figures |= picture_figures({f"{name}_{k}": image for name, image in drawn.items()})
        progress("pictures", k + 1, count + 1)
    cameras = _around(g, found.navigable.up)
    ghost = Gaussians(
        g.means, g.quats, g.scales, np.where(found.found == KEPT, _GHOST * g.opacities, g.opacities), g.sh0
    )
    images = rasterize(ghost, cameras, backend="cpu", colors=colors).images
    figures |= picture_figures({f"outside_{k}": image for k, image in enumerate(images)})
    progress("pictures", count + 1, count + 1)
    return figures


def _most_changed(g: Gaussians, after: Gaussians, cameras: Cameras) -> list[int]:
    """Return indices of cameras, those first whose small pictures change most."""
    small = cameras.resize(80, 60)
    change = np.abs(rasterize(g, small, backend="cpu").images - rasterize(after, small, backend="cpu").images)
    return [int(i) for i in np.argsort(-change.mean(axis=(1, 2, 3)), kind="stable")]


def _colors(g: Gaussians, classes: NDArray[np.uint8]) -> F32:
    """Return (N, 3) the colors of the classes; a dark gray by brightness for what stays."""
    gray = np.clip(0.5 + SH_C0 * g.sh0[:, 0].mean(axis=1, keepdims=True), 0.0, 1.0) * 0.5 + 0.1
    colors = np.repeat(gray, 3, axis=1)
    for name, color in CLASS_COLORS.items():
        colors[classes == class_of(name)] = color
    return np.asarray(colors, np.float32)


def _around(g: Gaussians, up: NDArray[np.float64]) -> Cameras:
    """Return two cameras outside of the scene that look down at its middle."""
    low, high = g.bounds(0.98)
    width, height = _OUTSIDE
    return Cameras.orbit(
        0.5 * (low + high),
        0.8 * float(np.linalg.norm(high - low)),
        2,
        elevation=35.0,
        up=up,
        width=width,
        height=height,
        fov=60.0,
    )


def _share(count: int, of: int) -> str:
    return f"{count / max(of, 1):.2%}"


def _lead(document: dict[str, Any]) -> str:
    """Return the first paragraph: how many Gaussians can go."""
    gone = document["gaussians"] - document["kept"]
    return (
        f"<p class='lead'>Of {document['gaussians']:,} Gaussians {gone:,} can go"
        f" ({_share(gone, document['gaussians'])}), by what {document['eyes']:,} eyes in navigable space see. Nothing"
        " has been deleted to make this page.</p>"
    )


def _tiles(document: dict[str, Any]) -> str:
    """Return the row of large figures."""
    shown = [(f"{document['kept']:,}", "Gaussians stay", f"of {document['gaussians']:,}")]
    shown += [(f"{each['removed']:,}", name, _MEANING[name]) for name, each in document["classes"].items()]
    if document["cost"]:
        shown.append(
            (
                f"{document['cost']['mean_db']:.1f} dB",
                "held-out views, after against before",
                f"worst {document['cost']['worst_db']:.1f} dB",
            )
        )
    return tiles(shown)


def _classes(document: dict[str, Any]) -> str:
    """Return the section with one row for each class of what can go."""
    rows = []
    for name, each in document["classes"].items():
        cost = each["cost"]
        red, green, blue = (round(255 * value) for value in CLASS_COLORS[name])
        mark = f"<span style='color: rgb({red}, {green}, {blue})'>&#9632;</span> {name}"
        lost = ["", "", ""]
        if cost:
            lost = [f"{cost['mean_db']:.1f}", f"{cost['worst_db']:.1f}", f"{cost['changed']:.2%}"]
        back = f"{each['found'] - each['removed']:,}"
        rows.append((mark, _MEANING[name], f"{each['found']:,}", back, f"{each['removed']:,}", *lost))
    header = ("class", "what it is", "found", "given back", "goes", "dB", "worst dB", "pixels that show mostly this")
    hidden = ", ".join(HIDDEN)
    explained = (
        "<p>dB compares held-out views without the class with the whole scene. The guard gives a class back whose"
        f" removal costs too much: for {hidden} by dB, for the others by the share of pixels that show little else.</p>"
    )
    return table(header, rows) + describe_judged(document["judged"]) + explained


def _inside(figures: dict[str, Figure]) -> str:
    """Return the pictures of held-out views: before, in the colors of the classes, after."""
    text = ""
    k = 0
    captions = {"before": "Before.", "classes": "What would go, in the colors of the classes.", "after": "After."}
    while f"before_{k}" in figures:
        parts = (figure(figures[f"{name}_{k}"], caption, caption) for name, caption in captions.items())
        text += f"<div class='three'>{''.join(parts)}</div>"
        k += 1
    return text or "<p>No views were held out.</p>"


def _outside(figures: dict[str, Figure]) -> str:
    caption = "From outside: what would go in the colors of the classes, what stays as a ghost."
    return "<div class='pair'>" + "".join(figure(figures[f"outside_{k}"], caption, caption) for k in (0, 1)) + "</div>"


assert set(CLASS_COLORS) == set(_MEANING) == set(CLASSES)
