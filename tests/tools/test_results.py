"""The summary of results stays short, agrees with the JSON of the benchmarks, and hides no missed target."""

from __future__ import annotations

import copy
import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tools"))

import results  # noqa: E402
from results_pages import PAGES, Row  # noqa: E402
from results_rows import SECTIONS  # noqa: E402

SUMMARY = ROOT / "docs" / "results.md"


def test_pages_are_what_the_tool_writes() -> None:
    stale = [path.name for path, text in results.pages().items() if path.read_text(encoding="utf-8") != text]
    assert not stale, f"run `python tools/results.py`: {stale}"


def test_summary_is_one_page_that_a_person_reads() -> None:
    assert SUMMARY.stat().st_size <= 15_000
    assert sum(len(section.rows) for section in SECTIONS) <= 60


def test_the_page_begins_with_what_is_better_than_a_peer() -> None:
    first = SECTIONS[0]
    assert len(first.rows) <= 12
    assert all(row.peer and row.figures for row in first.rows)
    assert all(row.page in PAGES for row in first.rows)
    page = SUMMARY.read_text(encoding="utf-8")
    titles = [page.index(f"### {section.title}\n") for section in SECTIONS]
    assert titles == sorted(titles)


def test_titles_of_tables_are_questions() -> None:
    assert all(section.title.endswith("?") for section in SECTIONS)
    assert all(row.question.endswith("?") for section in SECTIONS for row in section.rows)


def test_no_row_repeats_machine_or_command() -> None:
    pages = [SUMMARY, *(ROOT / "docs" / "results" / f"{name}.md" for name in PAGES)]
    rows = [line for page in pages for line in page.read_text(encoding="utf-8").splitlines() if line.startswith("|")]
    assert rows
    assert not [row for row in rows if "Xeon" in row or "python benchmarks/" in row]


def test_a_missed_figure_is_shown_as_missed() -> None:
    found = results.read_results()
    row = Row("Wrong bytes?", ("server_soak: wrong bytes of what honest viewers hold",))
    assert results.summary_row(row, found).endswith("| reached |")
    worse = copy.deepcopy(found)
    for figure in worse["server_soak"]["figures"]:
        figure["met"] = False
    assert results.summary_row(row, worse).endswith("| **missed** |")


def test_verdicts_by_hand_never_say_reached() -> None:
    assert not [row.question for section in SECTIONS for row in section.rows if row.verdict == "reached"]


def test_a_figure_that_is_gone_is_named() -> None:
    with pytest.raises(ValueError, match=re.escape("fuzz.json: expected a figure 'no such'")):
        results.find_figure("fuzz: no such", results.read_results())
