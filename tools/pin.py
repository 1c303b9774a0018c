"""Write constraints.txt: the version, in this environment, of everything gsvis and its dev tools depend on.

Run it as `make pins` after upgrading packages in .venv, and let the tests judge the upgrade.
"""

from __future__ import annotations

import sys
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

HEADER = """\
# Versions that gsvis is tested with: every make target installs with `--constraint constraints.txt`.
# Written by `make pins`; pyproject.toml keeps the ranges open for everyone else.
"""


def closure(root: str, extras: set[str]) -> dict[str, str]:
    """Name and version of all that `root[extras]` needs and this environment holds."""
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


def main() -> None:
    pins = closure("gsvis", {"dev"})
    python = f"{sys.version_info.major}.{sys.version_info.minor}"
    # Pins may be too new for an older Python. torch is pinned everywhere: an open range may bring gigabytes of CUDA.
    lines = [
        f"{name}=={version}" + ("" if name == "torch" else f' ; python_version >= "{python}"')
        for name, version in sorted(pins.items())
    ]
    Path(__file__).parents[1].joinpath("constraints.txt").write_text(HEADER + "\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
