"""docs/cli.md holds what `--help-all` prints. After a change that is meant: `python tests/cli/test_docs.py --write`."""

from __future__ import annotations

import os
import re
import sys
from importlib.metadata import version
from pathlib import Path
from typing import get_args
from unittest import mock

import pytest

PAGE = Path(__file__).parents[2] / "docs" / "cli.md"
MARKED = re.compile(r"<!-- help: (gsvis[a-z -]*?) -->\n(.*?)<!-- /help -->", re.DOTALL)


def help_of(command: str, option: str = "--help-all") -> str:
    """What `command --help-all` prints in 80 columns without color."""
    import contextlib
    import io

    from gsvis.cli import main

    out = io.StringIO()
    with mock.patch.dict(os.environ, {"COLUMNS": "80", "NO_COLOR": "1"}), contextlib.redirect_stdout(out):
        assert main([*command.split()[1:], option]) == 0
    return "\n".join(line.rstrip() for line in out.getvalue().splitlines()).strip() + "\n"


def commands() -> list[str]:
    from gsvis.cli.arguments import Command

    names = [re.sub(r"(?<=[a-z])(?=[A-Z])", "-", command.__name__).lower() for command in get_args(Command)]
    return ["gsvis", *(f"gsvis {name}" for name in names)]


def boxed(command: str) -> str:
    return f"<!-- help: {command} -->\n```text\n{help_of(command)}```\n<!-- /help -->"


def test_the_docs_name_every_option() -> None:
    pattern = re.compile(r"(?<![\w-])--?[a-z][\w-]*")
    for found in MARKED.finditer(PAGE.read_text(encoding="utf-8")):
        assert set(pattern.findall(found.group(0))) == set(pattern.findall(boxed(found.group(1)))), found.group(1)


def test_the_help_in_the_docs_is_what_the_commands_print() -> None:
    pinned = re.search(r"^tyro==(\S+)", (PAGE.parents[1] / "constraints.txt").read_text(encoding="utf-8"), re.MULTILINE)
    assert pinned is not None
    if version("tyro") != pinned[1]:
        pytest.skip(f"docs/cli.md is laid out by tyro {pinned[1]}, here is {version('tyro')}")
    text = PAGE.read_text(encoding="utf-8")
    message = "docs/cli.md is stale; if the change is meant: python tests/cli/test_docs.py --write"
    for found in MARKED.finditer(text):
        assert found.group(0) == boxed(found.group(1)), message


def test_every_command_is_documented_once() -> None:
    text = PAGE.read_text(encoding="utf-8")
    assert [found.group(1) for found in MARKED.finditer(text)] == commands()
    for command in commands()[1:]:
        assert f"## {command}\n" in text


def test_every_builtin_scene_is_documented() -> None:
    from gsvis.scene.procedural import BUILTIN_SCENES

    assert set(re.findall(r"builtin:(\w+)", PAGE.read_text(encoding="utf-8").replace("builtin:NAME", ""))) == set(
        BUILTIN_SCENES
    )


def test_help_fits_into_80_columns() -> None:
    for command in commands():
        assert max(len(line) for line in help_of(command).splitlines()) <= 80, command


if __name__ == "__main__" and "--write" in sys.argv[1:]:
    sys.path.insert(0, str(PAGE.parents[1]))
    old = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(MARKED.sub(lambda found: boxed(found.group(1)), old), encoding="utf-8")
