"""Write the pages of results: `python tools/results.py`.

docs/results.md is the summary: the rows of tools/results_rows.py. Behind it, docs/results/PAGE.md has a table for each
benchmark, from docs/results/*.json. What stands above the tables of such a page is written by hand and stays.
"""

from __future__ import annotations

import ast
import json
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "benchmarks"))
sys.path.insert(0, str(ROOT / "tools"))

from _harness import read_notes  # noqa: E402
from results_pages import PAGES, Row, Section  # noqa: E402
from results_rows import SECTIONS  # noqa: E402
from results_rows_wins import BEHIND  # noqa: E402

DOCS = ROOT / "docs"
BEGIN, END = "<!-- tables: python tools/results.py -->", "<!-- end of tables -->"
BEGIN_WINS, END_WINS = "<!-- first table: python tools/results.py -->", "<!-- end of the first table -->"
SPELLING = (
    ("colour", "color"),
    ("centre", "center"),
    ("gone on with", "resumed"),
    ("went on", "resumed"),
    ("gsvis/visibility/_codec.py", "gsvis/pvs/codec.py"),
    ("gsvis/visibility/store.py", "gsvis/pvs/store.py"),
)
"""Words and paths of recorded results that have other names now."""


def main() -> None:
    """Write all pages of results."""
    for path, text in pages().items():
        path.write_text(text, encoding="utf-8")


def pages() -> dict[Path, str]:
    """Return the text of the summary and of each page of details, by path."""
    results = read_results()
    written = {DOCS / "results.md": summary_page(results)}
    for name, page in PAGES.items():
        path = DOCS / "results" / f"{name}.md"
        tables = [benchmark_table(stem, results[stem]) for stem in page.benchmarks if stem in results]
        old = path.read_text(encoding="utf-8") if path.exists() else f"# {page.title}\n\n{BEGIN}\n{END}\n"
        written[path] = replace_between(old, BEGIN, END, "\n\n".join(tables))
    return written


def read_results() -> dict[str, dict[str, Any]]:
    """Return the results of all benchmarks by the name of their JSON, in American spelling.

    Raises:
        ValueError: If a result belongs to no page.
    """
    shown = {stem for page in PAGES.values() for stem in page.benchmarks}
    results = {}
    for path in sorted((DOCS / "results").glob("*.json")):
        if path.stem not in shown:
            raise ValueError(
                f"{path.name}: expected a page that shows it; add {path.stem!r} to PAGES in results_pages.py"
            )
        text = path.read_text(encoding="utf-8")
        for old, new in SPELLING:
            text = text.replace(old, new)
        results[path.stem] = json.loads(text)
    return results


def summary_page(results: dict[str, dict[str, Any]]) -> str:
    """Return the summary with fresh tables: the first section leads the page, the others follow the notes."""
    first, *rest = SECTIONS
    page = (DOCS / "results.md").read_text(encoding="utf-8")
    page = replace_between(page, BEGIN_WINS, END_WINS, f"{section_table(first, results)}\n\n{BEHIND}")
    parts = []
    for section in rest:
        details = f"Details: [{PAGES[section.page].title}](results/{section.page}.md)."
        parts.append(f"{section_table(section, results)}\n\n{details}")
    return replace_between(page, BEGIN, END, "\n\n".join(parts))


def section_table(section: Section, results: dict[str, dict[str, Any]]) -> str:
    """Return the table of a section: a question as its title, then a line for each row."""
    lines = [f"### {section.title}", "", "| question | ours | best peer | target | verdict |", "|---|---|---|---|---|"]
    lines += [summary_row(row, results) for row in section.rows]
    return "\n".join(lines)


def summary_row(row: Row, results: dict[str, dict[str, Any]]) -> str:
    """Return one line of the summary.

    Raises:
        ValueError: If a figure that the row names is in no JSON.
    """
    figures = [find_figure(name, results) for name in row.figures]
    ours = row.ours.format(*(figure["reached"] for figure in figures))
    if not ours:
        ours = with_unit(figures[0]["reached"], figures[0]["unit"], ".3g")
    target = row.target or (format_target(figures[0]) if figures else "")
    met = [figure["met"] for figure in figures if figure["met"] is not None]
    verdict = row.verdict or ("" if not met else "reached" if all(met) else "missed")
    if "missed" in verdict or "behind" in verdict:
        verdict = f"**{verdict}**"
    question = f"[{row.question}](results/{row.page}.md)" if row.page else row.question
    return f"| {question} | {ours} | {row.peer} | {target} | {verdict} |"


def find_figure(name: str, results: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Return the figure that "FILE: NAME" means."""
    stem, _, wanted = name.partition(": ")
    for figure in results.get(stem, {"figures": []})["figures"]:
        if figure["name"] == wanted:
            return dict(figure)
    raise ValueError(f"{stem}.json: expected a figure {wanted!r}, got none; correct the row in tools/results_rows.py")


def format_target(figure: dict[str, Any]) -> str:
    """Return "≤ 10 ms", or nothing for a figure without a target."""
    if figure["target"] is None:
        return ""
    if figure["target"] == 0 and figure["better"] == "lower":
        return with_unit(0, figure["unit"])
    sign = "≤" if figure["better"] == "lower" else "≥"
    return f"{sign} {with_unit(figure['target'], figure['unit'])}"


def with_unit(value: float, unit: str, style: str = ".4g") -> str:
    """Return a number with its unit, "90%" or "10 ms"; a ratio has none."""
    unit = "" if unit == "ratio" else unit
    return f"{value:{style}}%" if unit == "%" else f"{value:{style}} {unit}".rstrip()


def benchmark_table(stem: str, result: dict[str, Any]) -> str:
    """Return the section of one benchmark: its question, machine and command once, then a row for each figure."""
    host = result["machine"]
    load = "" if host.get("load_average") is None else f", load {host['load_average']}"
    lines = [f"### {result['question']}", "", f"`{result['command']}`", ""]
    lines.append(f"On {host['cpu']}, {host['cores']} core{'s' * (host['cores'] != 1)}{load}.")
    notes = read_benchmark_notes(stem)
    if notes:
        lines += ["", *(f"- {name}: {text}" for name, text in notes.items())]
    lines += ["", "| figure | ours | target | verdict |", "|---|---|---|---|"]
    for figure in result["figures"]:
        verdict = {True: "reached", False: "**missed**", None: ""}[figure["met"]]
        ours = with_unit(figure["reached"], figure["unit"])
        lines.append(f"| {figure['name']} | {ours} | {format_target(figure)} | {verdict} |")
    return "\n".join(lines)


def read_benchmark_notes(stem: str) -> dict[str, str]:
    """Return what the benchmark of a result is given and measures; nothing if its script is not in benchmarks/."""
    scripts = [path for path in (ROOT / "benchmarks").glob("[!_]*.py") if stem.startswith(path.stem)]
    if not scripts:
        return {}
    doc = ast.get_docstring(ast.parse(max(scripts, key=lambda path: len(path.stem)).read_text(encoding="utf-8")))
    return read_notes(doc or "")


def replace_between(page: str, begin: str, end: str, text: str) -> str:
    """Return the page with other text between two marks.

    Raises:
        ValueError: If a mark is missing.
    """
    before, found, rest = page.partition(begin)
    _, ended, after = rest.partition(end)
    if not (found and ended):
        raise ValueError(f"page: expected the marks {begin!r} and {end!r}; restore them")
    return f"{before}{begin}\n{text}\n{end}{after}"


if __name__ == "__main__":
    main()
