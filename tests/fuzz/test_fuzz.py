"""Damaged input of every kind ends in a result or a known error of one line; what once failed is tried again.

`make fuzz` does the same with a hundred thousand inputs, in processes with limits.
"""

from __future__ import annotations

import os
import re
import sys
from importlib.util import find_spec
from pathlib import Path
from random import Random

import pytest

from tests.fuzz.engine import run_input, run_whole
from tests.fuzz.families import TARGETS
from tests.fuzz.targets import Target, case_of, unpack_case

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tools"))
import fuzz_coverage

CORPUS = Path(__file__).parents[1] / "corpus"
ENTRIES = sorted(CORPUS.rglob("*.zip"))
EFFORT = int(os.environ.get("GSVIS_FUZZ", "1"))
"""Set GSVIS_FUZZ=60 for a long run."""

SEED = 14


@pytest.mark.parametrize("name", TARGETS)
def test_damaged_input_ends_in_a_result_or_a_known_error(name: str) -> None:
    target = TARGETS[name]
    verdicts = set()
    for index in range(50 * EFFORT):
        outcome = run_input(target, SEED, index)
        assert outcome.finding is None, f"input {index}: {outcome.finding.line}"
        verdicts.add(outcome.verdict)
    assert verdicts == ({"read", "refused"} if target.refuses else {"read"})


@pytest.mark.parametrize("name", TARGETS)
def test_a_deliberate_fault_is_refused_or_counts_as_missing(name: str) -> None:
    target = TARGETS[name]
    for what, case in target.damaged.items():  # made here: kernels run, and workers that collect should compile none
        outcome = run_whole(target, case)
        assert outcome.finding is None, f"{what}: {outcome.finding.line}"
        assert outcome.verdict == ("refused" if target.refuses else "read"), what


@pytest.mark.parametrize("entry", ENTRIES, ids=lambda entry: f"{entry.parent.name}/{entry.stem}")
def test_what_once_failed(entry: Path) -> None:
    finding = run_whole(TARGETS[entry.parent.name], unpack_case(entry.read_bytes())).finding
    assert finding is None, finding.line


def test_the_corpus_is_small_and_has_a_target_for_each_folder() -> None:
    assert {entry.parent.name for entry in ENTRIES} <= set(TARGETS)
    assert all(entry.stat().st_size < 64 << 10 for entry in ENTRIES)
    assert all(re.fullmatch(r"[a-z0-9-]+", entry.stem) for entry in ENTRIES)


@pytest.mark.parametrize("name", TARGETS)
def test_an_input_follows_from_seed_target_and_number(name: str) -> None:
    target = TARGETS[name]
    for index in range(len(target.cases), len(target.cases) + 10):
        assert case_of(target, 3, index) == case_of(target, 3, index)


@pytest.mark.parametrize("name", TARGETS)
def test_mutators_change_and_do_not_fail(name: str) -> None:
    target, failed = TARGETS[name], 0
    changed = 0
    for index in range(100):
        rng = Random(index)
        case = rng.choice(target.cases)
        try:
            changed += target.change(rng, case, target) != case
        except Exception:
            failed += 1
    assert failed <= 2
    assert changed > 75


@pytest.mark.parametrize(
    ("message", "verdict"),
    [
        ("checkpoint: expected x to be of the same images, got the checkpoint of a run with different ones", "refused"),
        ("checkpoint is no array", "found"),
        ("", "found"),
        ("a: checkpoint: expected x", "found"),
    ],
)
def test_of_value_errors_a_target_allows_those_it_names_alone(message: str, verdict: str) -> None:
    def fail(folder: Path, case: dict[str, bytes]) -> None:
        raise ValueError(message)

    for target in (TARGETS["checkpoint"], TARGETS["subsets"]):
        fails = Target("x", lambda: [{"a": b""}], fail, target.allowed, beginnings=target.beginnings)
        named = verdict if target.name == "checkpoint" else "found"
        assert run_whole(fails, {"a": b""}).verdict == named


def test_readers_of_training_and_archives_are_among_the_targets() -> None:
    modules = {module for target in TARGETS.values() for module in target.modules}
    assert modules >= {
        "gsvis.files.archive",
        "gsvis.train._photo_files",
        "gsvis.train.checkpoint",
        "gsvis.train.levels",
        "gsvis.train.photos",
    }


def test_modules_of_targets_and_functions_set_apart_exist() -> None:
    modules = {module for target in TARGETS.values() for module in target.modules}
    origins = {module: find_spec(module) for module in modules}
    assert [module for module, spec in origins.items() if spec is None] == []
    owners: dict[str, set[str]] = {}
    for module, spec in origins.items():
        assert spec is not None
        assert spec.origin is not None
        owners[module] = set(fuzz_coverage.owners_of(Path(spec.origin)).values())
    for place in (place for places in fuzz_coverage.APART.values() for place in places):
        module, _, name = place.partition(":")
        assert any(owner == name or owner.startswith(f"{name}.") for owner in owners[module]), place
