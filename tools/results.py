"""Write the table of docs/results.md anew from docs/results/*.json: `python tools/results.py`.

What stands below the table, the notes on what was missed and why, is written by hand and stays.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "results.md"
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


def renewed(page: str) -> str:
    """The page with a fresh table."""
    before, _, rest = page.partition(BEGIN)
    _, _, after = rest.partition(END)
    return f"{before}{BEGIN}\n{table()}\n{END}{after}"


if __name__ == "__main__":
    PAGE.write_text(renewed(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
