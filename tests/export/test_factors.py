"""The documented table of factors holds for both orders of sending: the page's and the server's."""

from __future__ import annotations

import re
from pathlib import Path

from gsvis.abr.config import AbrConfig

ROOT = Path(__file__).parents[2]
ROW = re.compile(r"^\| [^|]+ \| (?:`([\w.]+)` ([\d.]+)|none) \| (?:`(\w+)` ([\d.]+)|none) \|", re.MULTILINE)


def documented() -> tuple[dict[str, float], dict[str, float]]:
    """Factors of the page and of the server, by name, as docs/static.md gives them."""
    rows = ROW.findall((ROOT / "docs/static.md").read_text(encoding="utf-8"))
    return {row[0]: float(row[1]) for row in rows if row[0]}, {row[2]: float(row[3]) for row in rows if row[2]}


def factors_of_the_page() -> dict[str, float]:
    """Numbers of static-plan.ts, by the names of their constants."""
    source = (ROOT / "viewer/src/core/static-plan.ts").read_text(encoding="utf-8")
    return {name: float(value) for name, value in re.findall(r"\b([A-Z]+) = ([\d.]+);", source)}


def test_the_documented_factors_are_those_of_the_page_and_of_the_server() -> None:
    page, server = documented()
    assert page == {name: factors_of_the_page().get(name) for name in ("PERIPHERAL", "TERMS")}
    assert server == {name: vars(AbrConfig().utility).get(name) for name in ("peripheral", "terms", "adjacent")}
