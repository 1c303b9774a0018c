"""Write the report on simulated sessions: `report.json`, plots and pictures as PNG, `report.html` with all inside."""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import Any

from gsvis import _check
from gsvis._extras import has
from gsvis.files.atomic import atomic_folder
from gsvis.progress import Progress, silent
from gsvis.report.files import LAST, write_files
from gsvis.report.html import Figure
from gsvis.report.pictures import png_of
from gsvis.report.session_page import session_page
from gsvis.simulate.frames import CONTENT_DB
from gsvis.simulate.link import Link
from gsvis.simulate.visits import Visit

__all__ = ["Simulation", "session_document", "titled", "write_session_report"]

_PLOTS = ("qoe", "psnr", "latency", "bandwidth", "shares", "bytes", "start")


@dataclass(frozen=True, eq=False)
class Simulation:
    """Consecutive visits over one link.

    Attributes:
        visits: The visits, in order.
        link: The link at the start of the first visit.
        command: The exact command that makes this report again.
        version: Version of gsvis.
        parameters: All parameters by name.
        seconds: Duration of each stage, by name.
        walk: What the path is: a recording only if its file says so.
        bandwidth: What the link is: a recording only if its file says so.
    """

    visits: tuple[Visit, ...]
    link: Link
    command: str
    version: str
    parameters: dict[str, Any] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    walk: str = "a path"
    bandwidth: str = "a link"

    @property
    def title(self) -> str:
        """Names of the scenes, and which of them are compared with their own package alone."""
        return ", then ".join(dict.fromkeys(titled(visit.title, visit.against) for visit in self.visits))


def titled(name: str, against: str) -> str:
    """Return the name of a scene for a title, with what it is compared with if that is not the scene.

    Args:
        name: Name of the scene.
        against: As `Visit.against`.
    """
    return f"{name} against {against}" if against else name


def session_document(simulation: Simulation) -> dict[str, Any]:
    """Return the content of `report.json`.

    Args:
        simulation: The simulation.
    """
    link = simulation.link
    config = simulation.visits[0].sessions[0].config
    end = config.seconds * len(simulation.visits)
    return {
        "format": "gsvis-simulation",
        "version": 1,
        "title": f"Streaming {simulation.title}",
        "gsvis": simulation.version,
        "command": simulation.command,
        "parameters": simulation.parameters,
        "config": asdict(config),
        "link": {
            "trace": link.trace.name,
            "kind": simulation.bandwidth,
            "round_trip": link.round_trip,
            "mean_mbit_per_s": link.trace.bytes_between(0.0, end) * 8e-6 / end,
        },
        "walk": simulation.walk,
        "visits": [
            {
                "title": titled(visit.title, visit.against),
                "scene": {"name": visit.title, **visit.scene},
                "path": visit.path,
                "compared_with": visit.compared_with,
                "against_itself": bool(visit.against),
                "against": visit.against,
                "remark": visit.remark,
                "views": {
                    "compared": len(visit.sessions[0].content),
                    "with_content": int(visit.sessions[0].content.sum()),
                    "content": f"black is worse than {CONTENT_DB:g} dB against the full scene; figures are of these",
                },
                "systems": [session.as_dict() for session in visit.sessions],
            }
            for visit in simulation.visits
        ],
    }


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
    folder = _check.path("folder", folder)
    with atomic_folder(folder, last=LAST) as partial_folder:
        write_files(
            partial_folder, figures.values(), document, session_page(simulation, document, figures), simulation.seconds
        )
    kept = {figure.file for figure in figures.values()}
    for stale in [
        *(folder / f"{name}.png" for name in _PLOTS),
        *folder.glob("shown_*_*_*.png"),
    ]:
        if stale.name not in kept:
            stale.unlink(missing_ok=True)  # belongs to an earlier report
    return document


def _figures(simulation: Simulation, progress: Progress) -> dict[str, Figure]:
    """Return all plots and pictures by name; no plots where matplotlib is missing."""
    figures = _plots(simulation, progress) if has("matplotlib") else {}
    for v, visit in enumerate(simulation.visits):
        names = ["", *(session.playback.name for session in visit.sessions)]
        for t, name, image in visit.pictures:
            key = f"shown_{v}_{round(1000 * t)}_{names.index(name)}"
            figures[key] = Figure(f"{key}.png", png_of(image))
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
    from gsvis.report.theme import DARK, LIGHT, draw_png

    visits = [visit.sessions for visit in simulation.visits]
    trace = simulation.link.trace
    plots: dict[str, tuple[Any, tuple[float, float]]] = {
        "qoe": (partial(draw_score, visits=visits), (7.6, 3.2)),
        "psnr": (partial(draw_psnr, visits=visits), (7.6, 3.2)),
        "latency": (partial(draw_latency, visits=visits), (7.6, 3.0)),
        "bandwidth": (partial(draw_bandwidth, visits=visits, trace=trace), (7.6, 2.2)),
        "start": (partial(draw_start, visits=visits), (5.2, 3.7)),
        "shares": (partial(draw_shares, visits=visits), (5.2, 3.5)),
        "bytes": (partial(draw_bytes, visits=visits), (5.2, 3.5)),
    }
    progress("writing", 0, len(plots))
    figures = {}
    for done, (name, (draw, size)) in enumerate(plots.items(), 1):
        figures[name] = Figure(f"{name}.png", draw_png(draw, LIGHT, size), draw_png(draw, DARK, size))
        progress("writing", done, len(plots))
    return figures
