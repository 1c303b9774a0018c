"""One thing has one name in all commands, and one name means one thing."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Literal, get_args, get_origin

import pytest

from gsvis.cli import main
from gsvis.cli.arguments import Command
from gsvis.cli.help import option_texts
from gsvis.cli.options import command_name, leaves
from gsvis.cli.renamed import RENAMED, SYNONYMS

KINDS = {command_name(kind): kind for kind in get_args(Command)}
PATHS = {"DIR", "DIR OF KEPT TABLES", "FILE", "OUT", "DIR or URL"}
LISTS = {"N[,N...]": "N", "S [S ...]|none": "S [S ...]", "E|auto": "E", "FILE [FILE ...]": "SCENE"}
"""Metavars of the same thing, where a command takes several of it or a word more."""

KERNELS = {
    "--box": "Restrict viewpoints to this box",
    "--cameras": "Cameras ",
    "--cell-size": "Side of a cell",
    "--cells": "Largest number of cells",
    "--certify": "Largest number of random rays in each cell",
    "--drop-invalid": "Leave out rows",
    "--dry-run": "Print time, memory and disk",
    "--epsilon": "Smallest change of a color",
    "--eyes": "Number of eyes",
    "--face-size": "Pixels along a side of the six faces",
    "--fov": "Horizontal field of view",
    "--height": "Pixels down ",
    "--held-out": "Number of further views to measure on",
    "--json": "Print one JSON document",
    "--levels": "Size of each lower level as a share",
    "--device": "Device that draws and trains",
    "--discard": "Delete what is kept for the next run",
    "--limit": "The set ",
    "--lod": "Level of detail of a streamed",
    "--max-memory": "Memory limit",
    "--max-terms": "Most terms",
    "--mean-terms": "Terms a Gaussian on average",
    "--meters-per-unit": "Length of a scene unit in meters",
    "--min-psnr": "Least PSNR",
    "--names": "Names of these levels",
    "--overwrite": "Replace ",
    "--page-origins": "Other origins",
    "--path": "Walk ",
    "--photos": "Photographs to train ",
    "--precision": "Bits of colors and terms",
    "--port": "Port",
    "--pvs": "Visible sets of SCENE",
    "--report": "Report to write: a folder for report.html",
    "--scene": "The scene",
    "--scheduler": "Dask scheduler",
    "--seed": "Seed of everything random",
    "--select": "Write ",
    "--sh-degree": "Highest degree of spherical harmonics",
    "--show": "Write a picture of where people stand",
    "--steps": "Steps of training",
    "--tables": "Folder for tables",
    "--tau": "Weight from which a Gaussian counts as visible",
    "--up": "Up in ",
    "--variant": "How colors are split",
    "--views": "Number of views",
    "--width": "Pixels across ",
    "--workers": "Number of processes",
}
"""How the help of an option begins in each command that has it; others say the same, word by word."""


@dataclass(frozen=True)
class Option:
    """One option of one command, as its help states it."""

    command: str
    name: str
    metavar: str
    type: object
    choices: frozenset[str]
    text: str


def options() -> Iterator[Option]:
    for command, kind in KINDS.items():
        texts = option_texts(kind)
        for leaf in leaves(kind):
            if leaf.is_positional:
                continue
            metavar = " ".join(str(extra.metavar) for extra in leaf.extras if getattr(extra, "metavar", None))
            plain = get_args(leaf.hint)[0] if leaf.extras else leaf.hint
            choices = frozenset(get_args(plain)) if get_origin(plain) is Literal else frozenset[str]()
            yield Option(command, leaf.option, metavar, plain, choices, texts[leaf.name])


@cache
def every_option() -> tuple[Option, ...]:
    """All options of all commands, read once, and not where tests are collected."""
    return tuple(options())


@cache
def by_name() -> dict[str, list[Option]]:
    """The options of all commands by their names."""
    found: dict[str, list[Option]] = defaultdict(list)
    for option in every_option():
        found[option.name].append(option)
    return dict(found)


def shared() -> dict[str, list[Option]]:
    """The options that more than one command has."""
    found = {name: options for name, options in by_name().items() if len(options) > 1}
    assert len(found) > 40
    return found


def kind_of(option: Option) -> str:
    """Return what an option takes: a path, choices, or its metavar without the word that only some commands take."""
    if option.choices:
        return "choices"
    if option.metavar in PATHS:
        return "path"
    return LISTS.get(option.metavar, option.metavar)


def test_a_name_takes_the_same_in_all_commands() -> None:
    for name, found in shared().items():
        assert len({kind_of(each) for each in found}) == 1, (name, [(each.command, each.metavar) for each in found])
        choices = sorted((each.choices for each in found), key=len)
        assert all(few <= more for few, more in pairwise(choices)), name


def test_a_name_means_the_same_in_all_commands() -> None:
    for name, found in shared().items():
        if name == "--out":  # each command says what it writes
            assert all(each.text and each.metavar in PATHS for each in found)
        elif name in KERNELS:
            assert [each for each in found if not each.text.startswith(KERNELS[name])] == []
        else:
            assert len({each.text for each in found}) == 1, name


def test_every_command_that_reads_a_scene_can_leave_rows_out() -> None:
    """The error about such rows names this option, whichever command reads them."""
    of_scenes = {"scene", "scenes", "paths"}
    reading = {command for command, kind in KINDS.items() if of_scenes & {leaf.name for leaf in leaves(kind)}}
    assert len(reading) >= 17
    assert {each.command for each in by_name()["--drop-invalid"]} == reading


def test_no_two_names_say_the_same() -> None:
    names: dict[str, set[str]] = defaultdict(set)
    for each in every_option():
        names[each.text].add(each.name)
    assert [sorted(found) for found in names.values() if len(found) > 1] == []


def test_synonyms_do_not_exist() -> None:
    for ours, theirs in SYNONYMS.items():
        assert ours in by_name()
        assert not set(theirs) & set(by_name())


@pytest.mark.parametrize(("old", "command"), [(old, command) for old, found in RENAMED.items() for command in found])
def test_an_old_name_is_answered_with_the_new_one(capsys: pytest.CaptureFixture[str], old: str, command: str) -> None:
    assert main([command, "x", old, "1"]) == 2
    line = capsys.readouterr().err
    assert line.count("\n") == 1
    assert old in line
    new = re.findall(r"--[a-z-]+", RENAMED[old][command])
    assert new
    known = {each.name for each in every_option() if each.command == command}
    assert set(new) <= known
    assert old not in known
    assert all(each in line for each in new)


def test_a_name_of_other_programs_is_answered_with_ours(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["convert", "a.ply", "b.ply", "--force"]) == 2
    assert "its name here is --overwrite" in capsys.readouterr().err
    assert main(["inspect", "a.ply", "--force"]) == 2
    assert "--overwrite" not in capsys.readouterr().err


def documented_commands() -> Iterator[tuple[str, str]]:
    """Yield each line of the documentation that calls gsvis, and where it is."""
    root = Path(__file__).parents[2]
    for page in (root / "README.md", *sorted((root / "docs").rglob("*.md"))):
        text = page.read_text(encoding="utf-8").replace("\\\n", " ")
        for found in re.finditer(r"(?:^|`)(?:\$ )?(gsvis [a-z][a-z-]* [^`\n]*)", text, re.M):
            yield found[1].partition(" # ")[0], f"{page.relative_to(root)}: {found[1]}"


def test_the_documentation_uses_names_that_exist() -> None:
    wrong, seen = [], 0
    for line, place in documented_commands():
        words = line.split()[1:]
        if words[0] not in KINDS:
            continue
        seen += 1
        known = {name for each in every_option() if each.command == words[0] for name in (each.name, "-o")}
        wrong += [place for word in words[1:] if re.match(r"--[a-z]", word) and word.partition("=")[0] not in known]
    assert seen > 100
    assert wrong == []
