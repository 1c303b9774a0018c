"""Write the report on colors: `report.json`, plots and pictures as PNG, and `report.html` with all of it inside."""

from __future__ import annotations

import os
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.prepare.color_quality import ColorQuality
from gsvis.prepare.fitted_colors import FittedColors
from gsvis.progress import Progress, silent
from gsvis.render import rasterize
from gsvis.report.color_page import DIFFERENCE, color_page
from gsvis.report.color_plots import draw_active, draw_active_psnr, draw_bytes, draw_first_terms, draw_term_counts
from gsvis.report.color_spheres import draw_spheres, fit_spheres
from gsvis.report.document import Subject
from gsvis.report.files import write_report_folder
from gsvis.report.html import Figure
from gsvis.report.pictures import picture_figures
from gsvis.report.theme import Plot, draw_plots

__all__ = ["color_document", "write_color_report"]

_ROLES = ("worst", "median")
_PICTURES = [f"{name}.png" for name in ("term_counts", "first_terms", "active", "active_psnr", "bytes", "spheres")]
_PICTURES += [f"{role}_{name}.png" for role in _ROLES for name in ("sh", "srbf", "base", "difference")]


def color_document(fitted: FittedColors, subject: Subject) -> dict[str, Any]:
    """Return the content of `report.json`.

    Args:
        fitted: The colors, with their quality.
        subject: Context of the report; its `cameras_from` names the source of the compared views.

    Raises:
        ValueError: If the quality was not measured.
    """
    document = {
        "format": "gsvis-color-report",
        "version": 1,
        "gsvis": subject.version,
        "command": subject.command,
        "parameters": subject.parameters,
        "scene": {"name": subject.title, **subject.facts},
        "cameras_from": subject.cameras_from,
        **fitted.as_dict(),
    }
    by_view = {camera: role for role, camera in _views(_quality(fitted)).items()}
    for camera, row in enumerate(document["quality"]["cameras"]):
        row["role"] = by_view.get(camera)
    return document


def write_color_report(
    folder: str | os.PathLike[str], fitted: FittedColors, subject: Subject, *, progress: Progress = silent
) -> dict[str, Any]:
    """Draw everything and write the folder, atomically.

    Args:
        folder: Created if missing; files in it that do not belong to a report are kept.
        fitted: The colors, with their quality.
        subject: Context of the report.
        progress: Called with stage "writing".

    Returns:
        The content of `report.json`.

    Raises:
        ValueError: If the quality was not measured.
        OSError: If the folder cannot be written.
    """
    document = color_document(fitted, subject)
    figures = _figures(fitted, progress)
    html = color_page(fitted, document, figures)
    write_report_folder(folder, html, document, figures.values(), subject.seconds, old=_PICTURES)
    return document


def _quality(fitted: FittedColors) -> ColorQuality:
    """Return the measured quality of a fit, or raise if it was not measured."""
    if fitted.quality is None:
        raise ValueError("fitted: expected colors whose quality was measured, got none; see measure_colors")
    return fitted.quality


def _views(quality: ColorQuality) -> dict[str, int]:
    """Return the shown views by role."""
    order = np.argsort(quality.all_terms.psnr, kind="stable")
    roles = {"worst": int(order[0])}
    if len(order) > 1:
        roles["median"] = int(order[len(order) // 2])
    return roles


def _figures(fitted: FittedColors, progress: Progress) -> dict[str, Figure]:
    """Return all plots and pictures by name, plots for light and for dark pages."""
    quality = _quality(fitted)
    epsilon = fitted.epsilon
    plots: dict[str, Plot] = {"bytes": (partial(draw_bytes, fitted=fitted), (5.2, 2.4))}
    if fitted.colors.num_terms:
        plots["term_counts"] = (partial(draw_term_counts, fitted=fitted), (5.2, 3.3))
        plots["first_terms"] = (partial(draw_first_terms, quality=quality), (5.2, 3.6))
        if len(quality.epsilons):
            plots["active"] = (partial(draw_active, quality=quality, epsilon=epsilon), (5.2, 3.3))
            plots["active_psnr"] = (partial(draw_active_psnr, quality=quality, epsilon=epsilon), (5.2, 3.3))
        spheres = fit_spheres(fitted)
        plots["spheres"] = (partial(draw_spheres, spheres=spheres), (7.6, 0.25 + 1.08 * len(spheres.ids)))
    figures = draw_plots(plots, progress)
    for role, view in _views(quality).items():
        pictures = _pictures(fitted, quality, view)
        figures |= picture_figures({f"{role}_{name}": image for name, image in pictures.items()})
    return figures


def _pictures(fitted: FittedColors, quality: ColorQuality, view: int) -> dict[str, NDArray[np.float32]]:
    """Return pictures of one view: by SH, by all terms, by base colors, and the difference of the first two."""
    camera, (g, fit) = quality.cameras[view], fitted.drawn
    images = {
        name: np.clip(rasterize(g, camera, backend="cpu", colors=colors).images[0], 0.0, 1.0)
        for name, colors in (("sh", None), ("srbf", fit), ("base", fit.first(0)))
    }
    return {**images, "difference": DIFFERENCE * np.abs(images["sh"] - images["srbf"])}
