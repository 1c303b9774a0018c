"""Help shows all commands in groups, and of each command the options that matter first."""

from __future__ import annotations

import re
from dataclasses import MISSING
from typing import get_args

import pytest

from gsvis.cli import main
from gsvis.cli.arguments import Command
from gsvis.cli.help import FIRST, GROUPS, overview
from gsvis.cli.options import command_name, leaves

KINDS = {command_name(kind): kind for kind in get_args(Command)}
Capture = pytest.CaptureFixture[str]


def options_in(text: str) -> set[str]:
    """Options that a text names."""
    return set(re.findall(r"(?<![\w-])--[a-z][\w-]*", text))


def test_every_command_is_in_one_group() -> None:
    named = [example.split()[0] for examples in GROUPS.values() for example, _ in examples]
    assert sorted(named) == sorted(KINDS)


def test_the_overview_fits_a_terminal() -> None:
    assert max(map(len, overview().splitlines())) <= 80


@pytest.mark.parametrize("words", [[], ["-h"], ["--help"], ["--help-all"]])
def test_gsvis_alone_prints_the_overview(capsys: Capture, words: list[str]) -> None:
    assert main(words) == 0
    assert capsys.readouterr().out == overview()


@pytest.mark.parametrize("name", sorted(KINDS))
def test_the_first_options_are_at_most_ten_and_exist(name: str) -> None:
    first = FIRST[name]
    assert len(first) <= 10
    assert len(set(first)) == len(first)
    assert set(first) <= {leaf.name for leaf in leaves(KINDS[name])}


@pytest.mark.parametrize("name", ["prepare", "verify", "render"])
def test_short_help_shows_the_first_options_and_names_the_way_to_all(capsys: Capture, name: str) -> None:
    assert main([name, "--help"]) == 0
    text = capsys.readouterr().out
    required = {each.name for each in leaves(KINDS[name]) if each.default is MISSING}
    shown = set(FIRST[name]) | required
    hidden = [each.name for each in leaves(KINDS[name]) if each.name not in shown]
    assert (f"{len(hidden)} more" in text) == bool(hidden)
    assert (f"gsvis {name} --help-all" in text) == bool(hidden)
    assert main([name, "--help-all"]) == 0
    every = options_in(capsys.readouterr().out)
    assert {f"--{each.replace('_', '-')}" for each in hidden} <= every
