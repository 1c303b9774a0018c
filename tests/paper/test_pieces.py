"""The table of pieces: which systems it has, whose time counts, and what a row is compared with."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest
from paper import pieces

from gsvis.cli import parse
from gsvis.cli.paper import PIECES, SWITCH


def words(system: pieces.System) -> list[str]:
    return [*system.prepare, *system.serve]


def test_each_row_exchanges_one_piece_of_the_base() -> None:
    ours, *singles, paper = pieces.systems_of("ours", None)
    assert words(ours) == []
    assert sorted(words(each) for each in singles) == sorted(list(p.words) for p in PIECES if p.option in words(paper))
    assert parse(["prepare", "a.ply", "-o", "b", *paper.prepare]) == parse(["prepare", "a.ply", "-o", "b", SWITCH])
    assert parse(["serve", "a", *paper.serve]) == parse(["serve", "a", SWITCH])
    whole, *others, back = pieces.systems_of("paper", None)
    assert (words(whole), words(back)) == (words(paper), [])
    assert [len(words(whole)) - len(words(each)) for each in others] == [2] * len(singles)
    assert [each.name for each in pieces.systems_of("ours", ["fit", "terms"])] == [
        "ours", "fit omp", "terms cell", "the paper's",
    ]  # fmt: skip


def test_only_what_is_made_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    now = iter([0.0, 1.0, 3.0, 7.0, 15.0, 31.0])
    monkeypatch.setattr(time, "process_time", lambda: next(now))
    clock = pieces.Clock()
    for stage in ("train low", "cells", "cost", "fit", "fidelity"):
        clock(stage, 0, 1)
    assert clock.seconds == {"levels": 2.0, "sets": 4.0, "colors": 16.0, "epsilon": 0.0, "terms": 0.0}


def row(value: float, score: float) -> dict[str, Any]:
    sessions = [{"score": score + k, "psnr": value} for k in range(3)]
    return {
        "name": f"{value:g}", "seconds": {"sets": value}, "bytes": 100.0 * value, "sessions": sessions,
        **dict.fromkeys(pieces.CHANGED, value),
    }  # fmt: skip


def test_rows_are_compared_with_the_first() -> None:
    rows = [row(10.0, 0.0), row(12.0, -0.5)]
    for each in rows:
        each["against"] = pieces.compare(each, rows[0])
    apart = rows[1]["against"]
    assert apart["records"] == apart["seconds"] == 2.0
    assert apart["bytes"] == pytest.approx(0.2)
    assert apart["session_score"]["mean"] == pytest.approx(-0.5)
    lines = pieces.table(rows).splitlines()
    assert len(lines) == 4
    assert "-0.500 (-0.500 to -0.500)" in lines[-1]
    reached = [figure["reached"] for figure in pieces.figures_of(rows)]
    assert reached == pytest.approx([2.0, 2.0, 2.0, 0.2, 2.0])


def test_rows_without_sessions_have_no_difference_of_sessions() -> None:
    rows = [{**row(value, 0.0), "sessions": [], "cell": None} for value in (10.0, 12.0)]
    for each in rows:
        each["against"] = pieces.compare(each, rows[0])
    assert rows[1]["against"]["session_score"] is None
    assert "cell" not in rows[1]["against"]
    assert pieces.table(rows).splitlines()[-1] == "| 12 | 12.00 | 12.00 | - | 12.00 | 0.001 | 12.0 | - | - |"
    assert len(pieces.figures_of(rows)) == 4


def test_what_is_wrong_is_said_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    for words in (["--scene", "none.ply"], ["--scene", "builtin:nothing"], ["--walks", "none.csv"]):
        monkeypatch.setattr("sys.argv", ["pieces.py", *words])
        with pytest.raises(SystemExit, match=r"^error: [^\n]+$"):
            pieces.main()


def test_walks_that_are_drawn_are_upright_and_differ() -> None:
    one, other = (pieces.drawn_walk(seed, 5.0) for seed in (1, 2))
    assert one.upright[2] > 0.99
    assert one.duration >= 6.9
    assert not np.allclose(one.positions, other.positions)
    assert np.array_equal(one.positions, pieces.drawn_walk(1, 5.0).positions)
