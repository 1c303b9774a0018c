"""Every benchmark says what it is given, what it measures, and on which scenes a default was chosen."""

from __future__ import annotations

import ast
import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

FOLDER = Path(__file__).resolve().parents[1] / "benchmarks"
BENCHMARKS = sorted(FOLDER.glob("[!_]*.py"))


@pytest.fixture(scope="module")
def harness() -> ModuleType:
    spec = importlib.util.spec_from_file_location("benchmark_harness", FOLDER / "_harness.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


def test_every_benchmark_separates_inputs_from_findings(harness: ModuleType) -> None:
    wrong = []
    for path in BENCHMARKS:
        doc = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
        if not doc.partition("\n")[0].endswith("?"):
            wrong.append(f"{path.name}: expected a docstring that begins with one question")
        try:
            notes = list(harness.read_notes(doc))
        except ValueError as error:
            wrong.append(f"{path.name}: {error}")
        else:
            if notes != ["Given", "Measured", "Defaults chosen on"]:
                wrong.append(f"{path.name}: expected Given, Measured and Defaults chosen on, got {notes}")
    assert wrong == []


def test_lines_that_go_on_belong_to_the_same_entry(harness: ModuleType) -> None:
    doc = "A question?\n\nGiven: one\n    and two.\nMeasured: three.\nDefaults chosen on: four.\n"
    assert harness.read_notes(doc) == {"Given": "one and two.", "Measured": "three.", "Defaults chosen on": "four."}


@pytest.mark.parametrize(
    "doc", ["", "A question?", "Given: one.\nMeasured: two.", "Given: \nMeasured: 2\nDefaults chosen on: 3"]
)
def test_an_entry_that_is_missing_or_empty_is_named(harness: ModuleType, doc: str) -> None:
    with pytest.raises(ValueError, match="missing"):
        harness.read_notes(doc)


def test_what_is_missing_is_said_and_is_no_success(
    harness: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("GSVIS_REALDATA", str(tmp_path / "none"))
    assert harness.find_realdata() is None
    for miss in (harness.realdata, lambda: harness.need([], "what gsvis prepare made")):
        with pytest.raises(SystemExit) as ended:
            miss()
        assert ended.value.code == harness.SKIPPED == 77
    said = capsys.readouterr().err.splitlines()
    assert said[0].startswith("skipped: it needs real scenes")
    assert said[1] == "skipped: give it what gsvis prepare made"
    assert (FOLDER / "README.md").is_file()


def test_a_recorded_command_names_no_folder_of_a_machine(harness: ModuleType, tmp_path: Path) -> None:
    inside = FOLDER.parent / "docs" / "x.json"
    for given, kept in (
        ("--quick", "--quick"),
        ("nika.gsvis", "nika.gsvis"),
        (str(tmp_path / "nika.gsvis"), "nika.gsvis"),
        (f"nika={tmp_path / 'n.gsvis'}", "nika=n.gsvis"),
        (str(tmp_path / "nika" / "lod-meta.json"), "nika/lod-meta.json"),
        (str(inside), "docs/x.json"),
    ):
        assert harness._without_folders(given) == kept


@pytest.mark.parametrize("last", [0, 1, 7])
def test_the_first_state_that_is_good_is_found(last: int, harness: ModuleType) -> None:
    for first in range(last + 1):
        assert harness.first_reaching(lambda k, first=first: float(k >= first), last, 1.0) == first
    assert harness.first_reaching(lambda k: 0.0, last, 1.0) is None
