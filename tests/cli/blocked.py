"""Run commands in one process in which some packages cannot be imported: `python -m tests.cli.blocked PACKAGE...`.

Reads a JSON list of commands, each a list of words, from standard input. Writes for each its exit code and what it said
on stderr to standard output, as JSON.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from contextlib import nullcontext, redirect_stderr, redirect_stdout
from importlib.machinery import ModuleSpec
from io import StringIO
from types import ModuleType

import pytest


class Blocked:
    """A finder that finds nothing for some packages, as if they were not installed."""

    def __init__(self, packages: Sequence[str]) -> None:
        self.packages = frozenset(packages)

    def find_spec(self, name: str, path: object = None, target: ModuleType | None = None) -> ModuleSpec | None:
        if name.partition(".")[0] in self.packages:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
        return None


def make_quick() -> None:
    """Compile nothing ahead, draw few pixels, count few voxels, and let a server end as soon as it runs."""
    import gsvis.cli.analyze as analyze
    import gsvis.cli.terminal as terminal
    import gsvis.edit.shape as shape
    import gsvis.prepare.warm as kernels
    from gsvis.serve import Server

    for name in ("warm_sets", "warm_levels", "warm_colors"):
        setattr(kernels, name, lambda config, status: None)
    terminal._QUIET = float("inf")
    analyze.PICTURE = 24
    shape._VOXELS = 1 << 16
    serve = Server.run

    def run(self: Server, *, hung_s: float | None = None) -> None:
        self.stop()  # ends as soon as it accepts
        serve(self, hung_s=hung_s)

    Server.run = run  # type: ignore[method-assign]


def main() -> None:
    blocked = Blocked(sys.argv[1:])
    early = blocked.packages & sys.modules.keys()
    assert not early, f"imported before it was blocked, with the modules of commands: {sorted(early)}"
    sys.meta_path.insert(0, blocked)
    make_quick()
    from gsvis._extras import has
    from gsvis.cli import main as run
    from tests.bare_plots import draw_bare_plots
    from tests.few_views import take_few_views
    from tests.known_spaces import coarse_spaces, remember_spaces
    from tests.one_compiler import compile_once
    from tests.quick_reports import take_few_judges

    compile_once()  # tests beside this one compile the same kernels
    found = []
    patch = pytest.MonkeyPatch()
    take_few_judges(patch)
    if has("matplotlib"):
        from gsvis.report import theme

        theme._DPI = 40
    plots = draw_bare_plots() if has("matplotlib") else nullcontext()
    with remember_spaces(None), coarse_spaces(), take_few_views(), plots:
        for words in json.load(sys.stdin):
            out, err = StringIO(), StringIO()
            with redirect_stdout(out), redirect_stderr(err):
                code = run(words)
            found.append((code, err.getvalue()))
    json.dump(found, sys.stdout)


if __name__ == "__main__":
    main()
