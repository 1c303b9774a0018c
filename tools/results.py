"""Write the tables of docs/results.md anew: `python tools/results.py`.

The figures come from docs/results/*.json, what each benchmark is given and measures from its docstring.

What stands below the tables, the notes on what was missed and why, is written by hand and stays.
"""

from __future__ import annotations

import ast
import json
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "benchmarks"))

from _harness import read_notes  # noqa: E402

PAGE = ROOT / "docs" / "results.md"
NOTES_BEGIN, NOTES_END = "<!-- notes: python tools/results.py -->", "<!-- end of notes -->"
BEGIN, END = "<!-- table: python tools/results.py -->", "<!-- end of table -->"


def table() -> str:
    """All figures of all benchmarks, one row each."""
    rows = ["| figure | target | reached | | machine | command |", "|---|---|---|---|---|---|"]
    for path in sorted((ROOT / "docs" / "results").glob("*.json")):
        result = json.loads(path.read_text(encoding="utf-8"))
        for figure in result["figures"]:
            rows.append(row(figure, result))
    return "\n".join(rows)


def row(figure: dict[str, Any], result: dict[str, Any]) -> str:
    sign = "at most" if figure["better"] == "lower" else "at least"
    target = "" if figure["target"] is None else f"{sign} {figure['target']:g} {figure['unit']}"
    verdict = {True: "reached", False: "**missed**", None: ""}[figure["met"]]
    host = result["machine"]
    machine = f"{host['cpu']}, {host['cores']} cores, load {host['load_average']}"
    reached = f"{figure['reached']:.4g} {figure['unit']}"
    return f"| {figure['name']} | {target} | {reached} | {verdict} | {machine} | `{result['command']}` |"


def notes() -> str:
    """What each benchmark is given, measures, and on which scenes a default was chosen, one row each."""
    rows = ["| benchmark | given | measured | defaults chosen on |", "|---|---|---|---|"]
    for path in sorted((ROOT / "benchmarks").glob("[!_]*.py")):
        doc = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
        rows.append(" | ".join([f"| `{path.stem}`", *read_notes(doc).values()]) + " |")
    return "\n".join(rows)


def replace_between(page: str, begin: str, end: str, text: str) -> str:
    """Return the page with other text between two marks."""
    before, _, rest = page.partition(begin)
    _, _, after = rest.partition(end)
    return f"{before}{begin}\n{text}\n{end}{after}"


def renewed(page: str) -> str:
    """The page with fresh tables."""
    return replace_between(replace_between(page, BEGIN, END, table()), NOTES_BEGIN, NOTES_END, notes())


if __name__ == "__main__":
    PAGE.write_text(renewed(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
