"""Write a report: `report.json`, the plots and pictures as PNG files, and `report.html` with all of it inside."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from numpy.typing import NDArray

from gsvis.io.report_cameras import describe_cameras
from gsvis.progress import Progress, silent
from gsvis.raycast.analysis import FACE_LIMITS, PAPER, Analysis
from gsvis.report.files import write_report_folder
from gsvis.report.html import Figure, where_figure
from gsvis.report.maps import Ground, draw_directions, draw_seen_map
from gsvis.report.page import page
from gsvis.report.pictures import ViewPicture, picture_figures
from gsvis.report.plots import draw_cdf, draw_settling, draw_visible
from gsvis.report.theme import Plot, draw_plots
from gsvis.scene.gaussians import Gaussians

__all__ = ["Subject", "report_document", "write_report"]

_ROLES = ("most", "median", "least")
_PICTURES = ["where.png", "visible.png", "cdf.png", "settling.png", "map_directions.png"]
_PICTURES += [f"{kind}_{role}.png" for kind in ("view", "map") for role in _ROLES]


@dataclass(frozen=True, eq=False)
class Subject:
    """Context of a report, besides the figures.

    Attributes:
        title: Name of the scene.
        gaussians: The scene.
        up: (3,) its up axis, for maps.
        cameras_from: Source of the cameras, as a phrase.
        command: The exact command that makes this report again.
        version: Version of gsvis.
        facts: Results of the inspection, as `SceneReport.as_dict()` returns them.
        parameters: All parameters by name.
        seconds: Duration of each stage, by name.
        differs: Why the paper's figures, means over the training views of captures of one subject, cannot be
            compared with these; empty if they can.
        judged: What eyes of two rules see, `Judged.as_dict()` or a like; None if it was not checked.
        place: PNG bytes of the picture of where people stand; None without one.
    """

    title: str
    gaussians: Gaussians
    up: NDArray[Any]
    cameras_from: str
    command: str
    version: str
    facts: dict[str, Any] = field(default_factory=dict)
    parameters: dict[str, Any] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    differs: str = "the scene and its cameras may be of another kind"
    judged: dict[str, Any] | None = None
    place: bytes | None = None


def report_document(analysis: Analysis, subject: Subject) -> dict[str, Any]:
    """Return the content of `report.json`.

    Args:
        analysis: The figures.
        subject: Context of the report.
    """
    return {
        "format": "gsvis-report",
        "version": 1,
        "gsvis": subject.version,
        "command": subject.command,
        "parameters": subject.parameters,
        "scene": {"name": subject.title, **subject.facts},
        "cameras_from": subject.cameras_from,
        **analysis.as_dict(),
        "judged": subject.judged,
        "paper": {**PAPER, "comparable": not subject.differs, "differs": subject.differs or None},
        "cameras": describe_cameras(analysis.cameras),
    }


def write_report(
    folder: str | os.PathLike[str],
    analysis: Analysis,
    subject: Subject,
    pictures: list[ViewPicture],
    *,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Draw everything and write the folder, atomically.

    Args:
        folder: Created if missing; files in it that do not belong to a report are kept.
        analysis: The figures.
        subject: Context of the report.
        pictures: Rendered views, as `picture_views` returns them.
        progress: Called with stage "writing".

    Returns:
        The content of `report.json`.

    Raises:
        OSError: If the folder cannot be written.
    """
    figures = _figures(analysis, subject, pictures, progress)
    document = report_document(analysis, subject)
    html = page(analysis, document, figures)
    write_report_folder(folder, html, document, figures.values(), subject.seconds, old=_PICTURES)
    return document


def _figures(
    analysis: Analysis, subject: Subject, pictures: list[ViewPicture], progress: Progress
) -> dict[str, Figure]:
    """Return all plots, maps and pictures by name, each plot drawn for light and for dark pages."""
    cameras = analysis.cameras
    comparable = not subject.differs
    ground = Ground.from_scene(subject.gaussians, subject.up, cameras.viewpoints)
    plots: dict[str, Plot] = {
        "visible": (partial(draw_visible, analysis=analysis, published=comparable), (5.2, 2.9)),
        "cdf": (partial(draw_cdf, analysis=analysis, published=comparable), (5.2, 4.0)),
    }
    if len(cameras) >= FACE_LIMITS[0]:  # with fewer, no Gaussian can be seen from that many faces: nothing to draw
        plots["settling"] = (partial(draw_settling, analysis=analysis), (5.2, 3.4))
    for picture in pictures:
        camera = cameras[picture.camera]
        draw = partial(draw_seen_map, ground=ground, visible=picture.visible, camera=camera)
        plots[f"map_{picture.role}"] = (draw, ground.size)
    if analysis.traced is not None:
        plots["map_directions"] = (partial(draw_directions, ground=ground, analysis=analysis), ground.size)
    where = where_figure(subject.place)
    figures: dict[str, Figure] = {} if where is None else {"where": where}
    views = picture_figures({f"view_{picture.role}": picture.image for picture in pictures})
    return {**figures, **views, **draw_plots(plots, progress)}
