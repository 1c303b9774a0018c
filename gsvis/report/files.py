"""Write the files of a report into their folder: pictures, `report.json`, `report.html`, and `timings.json`.

Two runs of one command write the same bytes, except in `timings.json`, the only file with durations.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from gsvis._text import as_json
from gsvis.report.html import Figure

__all__ = ["LAST", "TIMINGS", "write_files"]

TIMINGS = "timings.json"
"""The file that differs between two runs."""

LAST = ("report.html", "report.json")
"""Files that move into place after all others: if `report.json` is new, all of the report is new."""


def write_files(
    folder: Path, figures: Iterable[Figure], document: Mapping[str, Any], html: str, seconds: Mapping[str, float]
) -> None:
    """Write all files of a report.

    Args:
        folder: A folder that exists.
        figures: Plots and pictures; those for light pages are written as files.
        document: The content of `report.json`.
        html: The content of `report.html`.
        seconds: Duration of each stage, by name.
    """
    for figure in figures:
        (folder / figure.file).write_bytes(figure.light)
    timings = {"format": "gsvis-timings", "version": 1, "seconds": dict(seconds)}
    for name, content in (("report.json", document), (TIMINGS, timings)):
        (folder / name).write_text(as_json(content, indent=2) + "\n", encoding="utf-8")
    (folder / "report.html").write_text(html, encoding="utf-8")
