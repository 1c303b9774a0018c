"""While numba compiles a function of this package, nobody looks for garbage; afterward all is as it was."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from numba import njit, types
from numba.core.errors import NumbaError
from numba.extending import intrinsic

import gsvis._kernels.compiled  # noqa: F401  # pauses the collector

collected: list[bool] = []


def function(module: str, fails: bool = False) -> Any:
    """Return a function of a module that notes whether the collector is on when numba types it."""

    @intrinsic
    def look(typing_context: Any) -> Any:
        """Note it: numba asks once for each intrinsic."""
        collected.append(gc.isenabled())
        return types.void(), lambda context, builder, signature, arguments: context.get_dummy_value()

    def ours() -> None:
        look()

    def wrong() -> None:
        look()
        len(1)  # type: ignore[arg-type]

    chosen = wrong if fails else ours
    chosen.__module__ = module
    return njit(chosen)


@pytest.fixture(autouse=True)
def _fresh() -> Iterator[None]:
    collected.clear()
    yield
    gc.enable()


def test_the_collector_pauses_and_goes_on() -> None:
    function("gsvis.room")()
    assert collected
    assert not any(collected)
    assert gc.isenabled()


def test_it_goes_on_after_a_function_that_does_not_compile() -> None:
    with pytest.raises(NumbaError):
        function("gsvis.room", fails=True)()
    assert gc.isenabled()


def test_it_stays_off_where_somebody_turned_it_off() -> None:
    gc.disable()
    function("gsvis.room")()
    assert not gc.isenabled()


def test_functions_of_others_change_nothing() -> None:
    function("somebody")()
    assert collected
    assert all(collected)


READ_ONLY = """
import os, sys
from numba.core import caching
from gsvis.files import temporary

allowed = [place for place in sys.argv[1:] if place != "nowhere"]
ensure = caching._CacheLocator.ensure_cache_path

def refuse(locator):
    if not any(locator.get_cache_path().startswith(place) for place in allowed):
        raise PermissionError(13, "read-only", locator.get_cache_path())
    ensure(locator)

caching._CacheLocator.ensure_cache_path = refuse
if "nowhere" in sys.argv:
    def none(path):
        raise PermissionError(13, "read-only", str(path))
    temporary.private_folder = none
from gsvis._kernels import bits
import numpy as np
print(bits.__name__, os.environ.get("NUMBA_CACHE_DIR", ""))
from gsvis.files.places import cache_folder
print(cache_folder())
"""


@pytest.mark.parametrize("kept", ["GSVIS_CACHE", "TMPDIR", "nowhere"])
@pytest.mark.parametrize("home", ["/nonexistent", "~"])
def test_a_read_only_installation_without_a_home_starts_with_one_line(kept: str, home: str, tmp_path: Path) -> None:
    places = {"GSVIS_CACHE": tmp_path / "cache" / "deep", "TMPDIR": tmp_path / "tmp"}
    (tmp_path / "tmp").mkdir()
    environment = {name: value for name, value in os.environ.items() if name not in ("GSVIS_CACHE", "NUMBA_CACHE_DIR")}
    environment |= {"HOME": home, "PYTHONPATH": str(Path(__file__).parents[1]), "TMPDIR": str(places["TMPDIR"])}
    environment.pop("XDG_CACHE_HOME", None)
    if kept == "GSVIS_CACHE":
        environment[kept] = str(places[kept])
    done = subprocess.run(
        [sys.executable, "-c", READ_ONLY, str(places.get(kept, kept))],
        capture_output=True, text=True, env=environment, cwd=tmp_path, check=True,
    )  # fmt: skip
    (line,) = done.stderr.splitlines()
    chosen, cache = done.stdout.splitlines()
    if kept == "nowhere":
        assert line.startswith("compiled kernels are not kept")
        assert chosen.split() == ["gsvis._kernels.bits"]
    else:
        assert line.startswith(f"compiled kernels are kept in {places[kept]}/")
        assert chosen.endswith(line.split()[5].rstrip(","))
    assert "~" not in cache
    assert {path.name for path in tmp_path.iterdir()} <= {"tmp", "cache"}
