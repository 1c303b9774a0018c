"""Write the folder of a report: pictures, `report.json`, `report.html`, and `timings.json`.

Two runs of one command write the same bytes, except in `timings.json`, the only file with durations.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from typing import Any

from gsvis import _check
from gsvis._text import as_json
from gsvis.files.atomic import atomic_folder
from gsvis.report.html import Figure

__all__ = ["TIMINGS", "write_report_folder"]

TIMINGS = "timings.json"
"""The file that differs between two runs."""

_LAST = ("report.html", "report.json")  # these move into place last: if report.json is new, all of the report is new


def write_report_folder(
    folder: str | os.PathLike[str],
    html: str,
    document: Mapping[str, Any],
    figures: Iterable[Figure],
    seconds: Mapping[str, float],
    *,
    old: Iterable[str] = (),
) -> None:
    """Write all files of a report, atomically, and remove the pictures of an earlier report.

    Args:
        folder: Created if missing; files in it that do not belong to a report are kept.
        html: The content of `report.html`.
        document: The content of `report.json`.
        figures: Plots and pictures; those for light pages are written as files.
        seconds: Duration of each stage, by name.
        old: Patterns of the pictures of any report of this kind, such as "view_*.png".

    Raises:
        OSError: If the folder cannot be written.
    """
    folder = _check.path("folder", folder)
    pictures = {figure.file: figure.light for figure in figures}
    timings = {"format": "gsvis-timings", "version": 1, "seconds": dict(seconds)}
    with atomic_folder(folder, last=_LAST) as partial:
        for name, content in pictures.items():
            (partial / name).write_bytes(content)
        for name, record in (("report.json", document), (TIMINGS, timings)):
            (partial / name).write_text(as_json(record, indent=2) + "\n", encoding="utf-8")
        (partial / "report.html").write_text(html, encoding="utf-8")
    for stale in (path for pattern in old for path in folder.glob(pattern)):
        if stale.name not in pictures:
            stale.unlink(missing_ok=True)
