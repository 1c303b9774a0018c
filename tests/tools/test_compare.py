"""`tools/compare.py`: which figures count as worse, and what a benchmark that fails leads to."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tools"))

from compare import compare, compare_figure, judge, read_figures, turn_ratio  # noqa: E402

WRITES = """
import json, sys
out = sys.argv[sys.argv.index("--out") + 1]
figures = [{"name": "colour time", "reached": VALUE, "better": "lower"}, {"name": OWN, "reached": 1, "better": "lower"}]
json.dump({"figures": figures}, open(out, "w"))
"""


def checkout(folder: Path, value: float, own: str) -> Path:
    (folder / "benchmarks").mkdir(parents=True)
    text = WRITES.replace("VALUE", str(value)).replace("OWN", repr(own))
    (folder / "benchmarks" / "some.py").write_text(text, encoding="utf-8")
    return folder


def test_a_figure_is_worse_if_its_median_ratio_exceeds_the_noise() -> None:
    assert judge(compare_figure([1.0, 1.0, 1.0], [1.2, 1.2, 1.2], "lower")) == "WORSE"
    assert judge(compare_figure([1.0, 1.0, 1.0], [1.2, 1.2, 1.2], "higher")) == "better"
    assert judge(compare_figure([1.0, 1.3, 1.0], [1.2, 1.2, 1.2], "lower")) == "within noise"  # a round differs by 1.3
    assert judge(compare_figure([1.0, 1.0, 1.0], [1.04, 1.04, 1.04], "lower")) == "within noise"  # least noise: 1.05


def test_a_ratio_above_one_is_worse_whatever_is_better() -> None:
    assert turn_ratio(2.0, 3.0, "lower") == pytest.approx(1.5)
    assert turn_ratio(3.0, 2.0, "higher") == pytest.approx(1.5)
    assert turn_ratio(0.0, 0.0, "lower") == 1.0
    assert turn_ratio(0.0, 0.1, "lower") == float("inf")
    assert turn_ratio(0.1, 0.0, "lower") == 0.0


def test_figures_are_paired_by_name_in_american_spelling(tmp_path: Path) -> None:
    before, after = checkout(tmp_path / "a", 2.0, "gone"), checkout(tmp_path / "b", 3.0, "new")
    found = compare(["some"], before, after, 2)["some"]
    assert found["color time"]["ratio"] == pytest.approx(1.5)
    assert found["unpaired"] == ["gone", "new"]
    assert list(read_figures({"figures": [{"name": "centre of a colour"}]})) == ["center of a color"]


def test_a_benchmark_that_fails_is_named(tmp_path: Path) -> None:
    before, after = checkout(tmp_path / "a", 1.0, "x"), checkout(tmp_path / "b", 1.0, "x")
    (after / "benchmarks" / "some.py").write_text("raise SystemExit('no scene')", encoding="utf-8")
    with pytest.raises(RuntimeError, match=r"some\.py.*exit code 1(.|\n)*no scene"):
        compare(["some"], before, after, 1)


def test_published_comparisons_say_what_was_compared() -> None:
    path = ROOT / "docs" / "results" / "compare.json"
    details = json.loads(path.read_text(encoding="utf-8"))["details"]
    assert details["before"]
    assert details["rounds"] >= 2
    assert len(details["benchmarks"]) >= 4
