"""Write the report on simulated sessions: `report.json`, plots and pictures as PNG, `report.html` with all inside."""

from __future__ import annotations

import os
from functools import partial
from typing import Any

from gsvis._extras import has
from gsvis.progress import Progress, silent
from gsvis.report.files import write_report_folder
from gsvis.report.html import Figure
from gsvis.report.pictures import picture_figures
from gsvis.report.session_document import Simulation, session_document
from gsvis.report.session_page import session_page

__all__ = ["write_session_report"]

_PLOTS = ("qoe", "psnr", "latency", "bandwidth", "shares", "bytes", "start")
_PICTURES = [*(f"{name}.png" for name in _PLOTS), "shown_*_*_*.png"]


def write_session_report(
    folder: str | os.PathLike[str], simulation: Simulation, *, progress: Progress = silent
) -> dict[str, Any]:
    """Draw everything and write the folder, atomically.

    Args:
        folder: Created if missing; files in it that do not belong to a report are kept.
        simulation: The simulation.
        progress: Called with stage "writing".

    Returns:
        The content of `report.json`.

    Raises:
        ValueError: If there is no visit.
        OSError: If the folder cannot be written.
    """
    if not simulation.visits:
        raise ValueError("simulation: expected at least one visit, got none")
    document = session_document(simulation)
    figures = _figures(simulation, progress)
    html = session_page(simulation, document, figures)
    write_report_folder(folder, html, document, figures.values(), simulation.seconds, old=_PICTURES)
    return document


def _figures(simulation: Simulation, progress: Progress) -> dict[str, Figure]:
    """Return all plots and pictures by name; no plots where matplotlib is missing."""
    figures = _plots(simulation, progress) if has("matplotlib") else {}
    for v, visit in enumerate(simulation.visits):
        names = ["", *(session.playback.name for session in visit.sessions)]
        figures |= picture_figures(
            {f"shown_{v}_{round(1000 * t)}_{names.index(name)}": image for t, name, image in visit.pictures}
        )
    return figures


def _plots(simulation: Simulation, progress: Progress) -> dict[str, Figure]:
    """Return all plots by name, for light and for dark pages."""
    from gsvis.report.session_plots import (
        draw_bandwidth,
        draw_bytes,
        draw_latency,
        draw_psnr,
        draw_score,
        draw_shares,
        draw_start,
    )
    from gsvis.report.theme import Plot, draw_plots

    visits = [visit.sessions for visit in simulation.visits]
    trace = simulation.link.trace
    plots: dict[str, Plot] = {
        "qoe": (partial(draw_score, visits=visits), (7.6, 3.2)),
        "psnr": (partial(draw_psnr, visits=visits), (7.6, 3.2)),
        "latency": (partial(draw_latency, visits=visits), (7.6, 3.0)),
        "bandwidth": (partial(draw_bandwidth, visits=visits, trace=trace), (7.6, 2.2)),
        "start": (partial(draw_start, visits=visits), (5.2, 3.7)),
        "shares": (partial(draw_shares, visits=visits), (5.2, 3.5)),
        "bytes": (partial(draw_bytes, visits=visits), (5.2, 3.5)),
    }
    return draw_plots(plots, progress)
