"""Write constraints.txt: the version, in this environment, of everything gsvis, its dev tools and its site depend on.

With `--hashes`, write requirements.txt instead: what the bare install needs, each with the SHA-256 of its wheel, for
`pip install --require-hashes`. The wheels are those of this system and this Python; the Dockerfile uses the same.

Run it as `make pins` after upgrading packages in .venv, and let the tests judge the upgrade.
"""

from __future__ import annotations

import argparse
import json
import platform
import subprocess
import sys
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
HEADER = """\
# Versions that gsvis is tested with: every make target installs with `--constraint constraints.txt`.
# Written by `make pins`; pyproject.toml keeps the ranges open for everyone else.
"""
HASHED = """\
# The bare install of gsvis with hashes: pip install --require-hashes --only-binary :all: -r requirements.txt
# Written by `make pins` for Python {python} on {system}; other systems install with constraints.txt.
"""


def closure(root: str, extras: set[str]) -> dict[str, str]:
    """Return name and version of all that `root[extras]` needs and this environment holds."""
    found: dict[str, str] = {}
    seen: set[tuple[str, frozenset[str]]] = set()
    waiting = [(root, frozenset(extras))]
    while waiting:
        name, wanted = waiting.pop()
        if (name, wanted) in seen:
            continue
        seen.add((name, wanted))
        try:
            package = distribution(name)
        except PackageNotFoundError:
            continue
        found[name] = package.version.partition("+")[0]  # a local build label is not a pin
        for line in package.requires or []:
            requirement = Requirement(line)
            if requirement.marker is None or any(requirement.marker.evaluate({"extra": e}) for e in wanted | {""}):
                waiting.append((canonicalize_name(requirement.name), frozenset(requirement.extras)))
    del found[root]
    return found


def find_hashes(pins: dict[str, str]) -> dict[str, str]:
    """Return the SHA-256 of the wheel that pip would install for each pin; pip downloads, and installs nothing."""
    command = [sys.executable, "-m", "pip", "install", "--dry-run", "--ignore-installed", "--no-deps", "--quiet"]
    command += ["--disable-pip-version-check", "--only-binary", ":all:", "--report", "-"]
    command += [f"{name}=={version}" for name, version in pins.items()]
    report = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    return {
        canonicalize_name(item["metadata"]["name"]): item["download_info"]["archive_info"]["hashes"]["sha256"]
        for item in report["install"]
    }


def format_constraints(pins: dict[str, str], python: str) -> str:
    """Return the text of constraints.txt."""
    # Pins may be too new for an older Python. torch is pinned everywhere: an open range may bring gigabytes of CUDA.
    lines = [
        f"{name}=={version}" + ("" if name == "torch" else f' ; python_version >= "{python}"')
        for name, version in sorted(pins.items())
    ]
    return HEADER + "\n".join(lines) + "\n"


def format_requirements(pins: dict[str, str], hashes: dict[str, str], python: str, system: str) -> str:
    """Return the text of requirements.txt.

    Raises:
        ValueError: If a pin has no hash.
    """
    missing = sorted(set(pins) - set(hashes))
    if missing:
        raise ValueError(f"hashes: expected one for every pin, got none for {', '.join(missing)}")
    lines = [f"{name}=={version} --hash=sha256:{hashes[name]}" for name, version in sorted(pins.items())]
    return HASHED.format(python=python, system=system) + "\n".join(lines) + "\n"


def main() -> None:
    """Write one of the two files."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hashes", action="store_true", help="write requirements.txt")
    python = f"{sys.version_info.major}.{sys.version_info.minor}"
    if parser.parse_args().hashes:
        pins = closure("gsvis", set())
        system = f"{platform.system()} {platform.machine()}"
        text = format_requirements(pins, find_hashes(pins), python, system)
        (ROOT / "requirements.txt").write_text(text, encoding="utf-8")
    else:
        text = format_constraints(closure("gsvis", {"all", "dev", "docs"}), python)
        (ROOT / "constraints.txt").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
