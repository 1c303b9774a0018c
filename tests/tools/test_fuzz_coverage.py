"""Which branches the coverage of the fuzz targets counts, and the figures that come of them."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

from tests.fuzz.families import TARGETS

ROOT = Path(__file__).resolve().parents[2]
MODULES = {module for target in TARGETS.values() for module in target.modules}


@pytest.fixture(scope="module")
def tool() -> ModuleType:
    spec = importlib.util.spec_from_file_location("fuzz_coverage", ROOT / "tools" / "fuzz_coverage.py")
    assert spec is not None
    assert spec.loader is not None
    made = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = made
    spec.loader.exec_module(made)
    return made


def test_what_is_set_apart_is_named_in_full_and_is_there(tool: ModuleType) -> None:
    names = [name for found in tool.APART.values() for name in found]
    assert len(set(names)) == len(names)
    for name in names:
        module, _, place = name.partition(":")
        assert module in MODULES, name
        owners = set(tool.owners_of(ROOT / (module.replace(".", "/") + ".py")).values())
        assert any(owner == place or owner.startswith(f"{place}.") for owner in owners), f"{name} is gone"


@pytest.mark.parametrize(
    ("module", "owner", "apart"),
    [
        ("gsvis.files.archive", "save_arrays", True),
        ("gsvis.files.archive", "load_arrays", False),
        ("gsvis.files.sections", "SectionWriter.append", True),  # of a class that writes
        ("gsvis.stream.drawn", "Rows.append", False),  # rows that a server sent
        ("gsvis.io.checkpoint", "_Ignored.append", False),
        ("gsvis.package.contents", "Contents.from_levels", True),
        ("gsvis.package.manifest", "Manifest._of", False),
        ("gsvis.package.active_terms", "ActiveTerms.check", True),
        ("gsvis.io.levels", "check", False),
        ("gsvis.pvs.store", "VisibilityStore.union", True),
        ("gsvis.pvs.config", "union", False),
        ("gsvis.jobs.resume", "KeptWork.opened", False),
        ("gsvis.io._ply_rows", "unpack.compiled", True),
        ("gsvis.io.levels", "save_levels.inner", True),
        ("gsvis.io.levels", "save_levels_of", False),
    ],
)
def test_names_of_one_module_say_nothing_of_another(tool: ModuleType, module: str, owner: str, apart: bool) -> None:
    assert bool(tool.reason_of(module, owner)) == apart


def test_the_worst_reader_and_what_is_set_apart_have_figures(tool: ModuleType) -> None:
    coverage = {
        "a": {"branches": 90, "covered": 90, "percent": 100.0, "apart": {"a writer": 3}},
        "b": {"branches": 10, "covered": 5, "percent": 50.0, "apart": {"a writer": 1, "no reader": 2}},
        "c": {"branches": 0, "covered": 0, "percent": 100.0, "apart": {"no reader": 4}},
    }
    whole, apart, worst = tool.figures_of(coverage)
    assert (whole["reached"], whole["target"]) == (95.0, 90.0)
    assert (apart["reached"], apart["target"]) == (10, None)
    assert (worst["reached"], worst["target"]) == (50.0, 90.0)
    assert worst["name"].endswith(", b")
    assert tool.readers_of(coverage) == [
        {"name": "b", "taken": 5, "branches": 10, "share": 50.0},
        {"name": "a", "taken": 90, "branches": 90, "share": 100.0},
    ]
    assert tool.apart_of(coverage) == {"a writer": 4, "no reader": 6}
    assert tool.figures_of({}) == []
