"""Prints constraints that hold every dependency of gsvis at the lowest version that pyproject.toml allows.

`make lowest` installs with them into .venv-lowest and runs the tests there, so that the lower bounds stay true. torch
keeps the version of constraints.txt: its lowest version would bring gigabytes of CUDA.
"""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
GROUPS = ("cluster", "open3d", "report", "torch", "train", "dev")
"""Optional dependencies that the tests use: what `all` joins, and their own."""
AS_PINNED = ("torch",)


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file, with the parser of Python 3.11 or the package it came from."""
    parser = import_module("tomllib" if sys.version_info >= (3, 11) else "tomli")
    tables: dict[str, Any] = parser.loads(path.read_text())
    return tables


def lowest_versions(lines: list[str]) -> dict[str, str]:
    """Return for each requirement of this platform, by name, the lowest version that it allows.

    Raises:
        ValueError: A requirement has no lower bound.
    """
    lowest: dict[str, str] = {}
    for line in lines:
        requirement = Requirement(line)
        if requirement.marker is not None and not requirement.marker.evaluate({"extra": ""}):
            continue
        bounds = [bound.version for bound in requirement.specifier if bound.operator in (">=", "==", "~=")]
        if not bounds:
            raise ValueError(f"pyproject.toml: expected a lower bound, got {line!r}; add >= and a version")
        lowest[canonicalize_name(requirement.name)] = bounds[0]
    return lowest


def pinned_versions(path: Path) -> dict[str, str]:
    """Return name and version of each line of a file of constraints."""
    lines = [line.partition(";")[0].strip() for line in path.read_text().splitlines() if not line.startswith("#")]
    return dict(line.split("==") for line in lines if line)


def main() -> None:
    project = read_toml(ROOT / "pyproject.toml")["project"]
    lines = project["dependencies"] + [line for group in GROUPS for line in project["optional-dependencies"][group]]
    pinned = pinned_versions(ROOT / "constraints.txt")
    for name, version in sorted(lowest_versions(lines).items()):
        print(f"{name}=={pinned[name] if name in AS_PINNED else version}")


if __name__ == "__main__":
    main()
