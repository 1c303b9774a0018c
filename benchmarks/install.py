"""How much does an install bring?

Installs gsvis into new virtual environments, bare and with `[all]`, and counts what they hold beyond an empty one.

Given: this checkout, the versions of constraints.txt, and the CPU build of torch; the build with CUDA is gigabytes
    larger.
Measured: distributions, gsvis among them, and bytes of all files, compiled Python among them.
Defaults chosen on: no scene.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from _harness import add_arguments, write_result

ROOT = Path(__file__).resolve().parents[1]
LIST = """
import json
from importlib.metadata import distributions
print(json.dumps(sorted({(d.metadata["Name"], d.version) for d in distributions()})))
"""
PACKAGES, MEGABYTES = 30, 800.0


def size_of(folder: Path) -> int:
    """Return the bytes of all files in a folder; links count as nothing."""
    return sum(path.lstat().st_size for path in folder.rglob("*") if path.is_file() and not path.is_symlink())


def names_in(python: Path) -> dict[str, str]:
    """Return name and version of every distribution of an environment."""
    return dict(json.loads(subprocess.run([python, "-c", LIST], check=True, capture_output=True, text=True).stdout))


def install(extras: str) -> dict[str, Any]:
    """Return what an install with some extras adds to an empty environment."""
    with tempfile.TemporaryDirectory(prefix="gsvis-install-") as made:
        folder = Path(made)
        subprocess.run([sys.executable, "-m", "venv", folder], check=True)
        python = folder / ("Scripts" if sys.platform == "win32" else "bin") / "python"
        before, bytes_before = names_in(python), size_of(folder)
        command = [python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
        command += ["--constraint", ROOT / "constraints.txt", f"{ROOT}{extras}"]
        subprocess.run(command, check=True)
        packages = {name: version for name, version in names_in(python).items() if name not in before}
        return {"packages": packages, "bytes": size_of(folder) - bytes_before}


def main() -> None:
    options = add_arguments(argparse.ArgumentParser(description=__doc__)).parse_args()
    found = {"gsvis": install(""), "gsvis[all]": install("[all]")}
    figures = []
    for name, one in found.items():
        count, size = (PACKAGES, MEGABYTES) if name == "gsvis" else (None, None)
        figures += [
            {
                "name": f"{name}: packages",
                "target": count,
                "reached": len(one["packages"]),
                "unit": "packages",
                "better": "lower",
            },
            {
                "name": f"{name}: size",
                "target": size,
                "reached": one["bytes"] / 1e6,
                "unit": "MB",
                "better": "lower",
            },
        ]
    write_result(options.out, "How much does an install bring?", figures, found)


if __name__ == "__main__":
    main()
