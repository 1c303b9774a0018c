"""The documented table of factors holds for both orders of sending: the page's and the server's."""

from __future__ import annotations

import re
from pathlib import Path

from gsvis.abr import policies
from gsvis.abr.config import AbrConfig

ROOT = Path(__file__).parents[2]
ROW = re.compile(r"^\| [^|]+ \| (?:`([\w.]+)` ([\d.]+)|none) \| `(\w+)` ([\d.]+) \|", re.MULTILINE)


def documented() -> tuple[dict[str, float], dict[str, float]]:
    """Factors of the page and of the server, by name, as docs/static.md gives them."""
    rows = ROW.findall((ROOT / "docs/static.md").read_text(encoding="utf-8"))
    return {row[0]: float(row[1]) for row in rows if row[0]}, {row[2]: float(row[3]) for row in rows}


def factors_of_the_page() -> dict[str, float]:
    """Numbers of static-plan.ts, by the names of their constants: factors, exponents, seconds."""
    source = (ROOT / "viewer/src/core/static-plan.ts").read_text(encoding="utf-8")
    found = dict(re.findall(r"\b([A-Z]+) = (?:Math\.log2\()?([\d.]+)", source))
    powers = re.search(r"POWERS = \{ high: 1, medium: ([\d.]+), low: ([\d.]+) \}", source)
    assert powers is not None
    found |= {"POWERS.medium": powers[1], "POWERS.low": powers[2]}
    return {name: float(value) for name, value in found.items()}


def factors_of_the_server() -> dict[str, float]:
    config = AbrConfig()
    return vars(config.utility) | {"horizon": config.horizon, "_STICKY": policies._STICKY}


def test_the_documented_factors_are_those_of_the_page_and_of_the_server() -> None:
    page, server = documented()
    assert len(page) == 8
    assert len(server) == 9
    assert page == {name: factors_of_the_page().get(name) for name in page}
    assert server == {name: factors_of_the_server().get(name) for name in server}


def test_no_factor_of_the_page_is_missing_in_the_table() -> None:
    source = (ROOT / "viewer/src/core/static-plan.ts").read_text(encoding="utf-8")
    logarithms = set(re.findall(r"\b([A-Z]+) = Math\.log2\(", source))
    assert logarithms
    assert logarithms <= set(documented()[0])
