"""`--as-in-paper` is short for a row of options: which, that others win, and that all of them reach the library."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, get_args

import pytest

from gsvis.cli import parse
from gsvis.cli.arguments import Command
from gsvis.cli.options import command_line, command_name, leaves, values_of
from gsvis.cli.paper import PIECES, SWITCH, expand, pieces_of
from gsvis.cli.targets import check_tracer
from gsvis.errors import MissingExtraError

KINDS = {command_name(kind): kind for kind in get_args(Command)}
WITH = sorted(name for name, kind in KINDS.items() if "as_in_paper" in {leaf.name for leaf in leaves(kind)})
WORDS = {
    "analyze": ["analyze", "a.ply", "-o", "b"],
    "color": ["color", "a.ply", "-o", "b.arrow"],
    "levels": ["levels", "a.ply", "-o", "b"],
    "prepare": ["prepare", "a.ply", "-o", "b.gsvis"],
    "serve": ["serve", "a.gsvis"],
    "simulate": ["simulate", "a.gsvis", "--path", "w.csv", "-o", "b"],
}
PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "paper.md"


def options_of(name: str) -> list[str]:
    return [leaf.option for leaf in leaves(KINDS[name])]


def values(words: list[str]) -> dict[str, Any]:
    return {name: str(value).strip() for name, value in values_of(parse(words)).items()}


def test_the_switch_is_where_a_piece_is() -> None:
    assert set(WORDS) == set(WITH)
    assert {piece.option for name in WITH for piece in pieces_of(options_of(name))} == {p.option for p in PIECES}


@pytest.mark.parametrize("name", WITH)
def test_the_switch_is_the_row_of_options(name: str) -> None:
    pieces = pieces_of(options_of(name))
    row = [word for piece in pieces for word in piece.words]
    command = parse([*WORDS[name], SWITCH])
    assert values_of(command) == values_of(parse([*WORDS[name], *row]))
    assert parse([WORDS[name][0], "--as_in_paper", *WORDS[name][1:]]) == command
    assert SWITCH not in command_line(command)  # a report states the pieces themselves
    assert all(" ".join(piece.words) in command_line(command) for piece in pieces)


@pytest.mark.parametrize("name", WITH)
def test_one_piece_of_ours_wins_over_the_switch(name: str) -> None:
    """So an ablation exchanges one piece at a time, in both directions."""
    plain, whole = values(WORDS[name]), values([*WORDS[name], SWITCH])
    for piece in pieces_of(options_of(name)):
        field = piece.option[2:].replace("-", "_")
        mixed = values([*WORDS[name], SWITCH, piece.option, piece.ours])
        assert {key for key in whole if mixed[key] != whole[key]} == {field}
        one = values([*WORDS[name], *piece.words])
        assert {key for key in plain if one[key] != plain[key]} == {field}


def test_what_is_ours_is_the_default() -> None:
    for name in WITH:
        found = {leaf.option: leaf for leaf in leaves(KINDS[name])}
        for piece in pieces_of(list(found)):
            leaf = found[piece.option]
            hints = [str(extra.help_behavior_hint) for extra in leaf.extras if getattr(extra, "help_behavior_hint", "")]
            default = str(leaf.default) if leaf.default is not None else hints[-1]
            assert piece.ours in default or "auto" in default, (name, piece.option, default)


def test_without_the_switch_nothing_changes() -> None:
    words = ["prepare", "a.ply", "-o", "b", "--fit", "omp"]
    assert expand(words, options_of("prepare")) == words


def test_the_page_lists_every_piece_with_both_ways_and_its_commands() -> None:
    found = re.findall(
        r"^\| `(--[a-z-]+) ([^`]+)` \| `([^`]+)` \| ([^|]*) ?\| ([^|]+) \|", PAGE.read_text(encoding="utf-8"), re.M
    )
    rows = {option: (paper, ours, set(re.findall(r"`([a-z]+)`", where))) for option, paper, ours, _, where in found}
    assert rows == {
        piece.option: (piece.paper, piece.ours, {name for name in WITH if piece.option in options_of(name)})
        for piece in PIECES
    }


def test_without_open3d_only_what_traces_by_it_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """The paper's package has no certificates, so its tracer has nothing to trace."""
    monkeypatch.setattr("gsvis._extras.find_spec", lambda name: None)
    check_tracer("hierarchy")
    check_tracer("embree", certify=0)
    with pytest.raises(MissingExtraError, match="open3d"):
        check_tracer("embree", certify=256)
    with pytest.raises(MissingExtraError, match="open3d"):
        check_tracer("embree")


def test_the_fit_keeps_its_own_epsilon_while_that_of_the_scene_is_not_found() -> None:
    from gsvis.cli.prepare import check_arguments
    from gsvis.color.fit import FitConfig

    for words in ([SWITCH], ["--epsilon", "auto"], ["--epsilon", "0.05"]):
        command = parse(["prepare", "builtin:two_rooms", "-o", "a.gsvis", *words])
        config = check_arguments(command)
        assert config.epsilon == (0.05 if "0.05" in words else None)
        assert config.colors.fit.epsilon == (config.epsilon or FitConfig.epsilon)
