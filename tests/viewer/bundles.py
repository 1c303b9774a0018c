"""Programs of viewer/test, bundled for node."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

VIEWER = Path(__file__).parents[2] / "viewer"
_ESBUILD = VIEWER / "node_modules" / ".bin" / "esbuild"

NEEDS_NODE = [
    pytest.mark.skipif(shutil.which("node") is None, reason="needs node"),
    pytest.mark.skipif(not _ESBUILD.exists(), reason="needs esbuild: npm ci in viewer/"),
]
"""Marks of tests that run a program."""


def bundle(name: str, folder: Path) -> Path:
    """Return the file with the program `name`.ts and all that it imports, in a folder."""
    out = folder / f"{name}.mjs"
    options = ["--bundle", "--platform=node", "--format=esm", "--log-level=error", f"--outfile={out}"]
    subprocess.run([_ESBUILD, VIEWER / "test" / f"{name}.ts", *options], check=True, timeout=600)
    return out
