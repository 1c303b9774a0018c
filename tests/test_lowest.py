"""The lowest versions that pyproject.toml allows: each dependency has a bound, and torch keeps its pin."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
TOOL = runpy.run_path(str(ROOT / "tools" / "lowest.py"))


def test_bounds_are_read_as_written() -> None:
    lines = ["NumPy>=1.26", "a-b[c]~=2.1,<3", "d==4; python_version >= '3.10'", "e>=5; python_version < '3'"]
    assert TOOL["lowest_versions"](lines) == {"numpy": "1.26", "a-b": "2.1", "d": "4"}
    with pytest.raises(ValueError, match="expected a lower bound, got 'f<3'"):
        TOOL["lowest_versions"](["f<3"])


def test_every_dependency_is_held_at_its_lowest(capsys: pytest.CaptureFixture[str]) -> None:
    TOOL["main"]()
    held = dict(line.split("==") for line in capsys.readouterr().out.splitlines())
    project = TOOL["read_toml"](ROOT / "pyproject.toml")["project"]
    pins = TOOL["pinned_versions"](ROOT / "constraints.txt")
    assert {canonicalize_name(Requirement(line).name) for line in project["dependencies"]} <= set(held)
    assert held["torch"] == pins["torch"]
    assert all(Requirement(f"{name}>={version}").specifier.contains(pins[name]) for name, version in held.items())
