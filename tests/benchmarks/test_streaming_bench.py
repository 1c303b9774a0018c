"""The bench of streaming: which runs it makes, and what its tables say."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest

PACKAGES = ["nika=a.gsvis", "showroom=b.gsvis"]


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
    sys.modules.pop("streaming_bench", None)
    import streaming_bench

    return streaming_bench


def test_constant_links_of_all_scenes_come_before_recorded_ones(bench: Any) -> None:
    parts = bench.parts_of(PACKAGES, 4, quick=False)
    found = [(part.name, part.scene) for part in parts]
    assert found == [("constant", "nika"), ("constant", "showroom"), ("recorded", "nika"), ("recorded", "showroom")]
    assert [part.arguments[0] for part in parts] == PACKAGES * 2
    assert all(bench.OURS in part.arguments for part in parts if part.name == "recorded")


def test_the_quick_run_is_one_for_each_scene(bench: Any) -> None:
    parts = bench.parts_of(PACKAGES, 2, quick=True)
    assert [part.scene for part in parts] == ["nika", "showroom"]
    assert all("--quick" in part.arguments for part in parts)


def test_the_tables_name_the_best_rival_what_is_missed_and_what_is_left_out(bench: Any) -> None:
    parts = bench.parts_of(PACKAGES, 4, quick=False)
    apart = {"mean": 0.5, "low": 0.25, "high": 0.75, "pairs": 8}
    result = {
        "details": {
            "differences": {
                "nika, 10 Mbit/s": {"best_rival": "whole file", "ours_minus": {"whole file": {"score": apart}}},
                "nika, 30 Mbit/s": {"best_rival": None, "ours_minus": {}},
            }
        },
        "figures": [
            {"name": "35 dB after, median", "reached": 0.55, "target": 0.5, "unit": "s", "met": False},
            {"name": "20 dB after, median", "reached": 0.1, "target": 0.1, "unit": "s", "met": True},
            {"name": "bytes", "reached": 1.0, "target": None, "unit": "bytes", "met": None},
        ],
    }
    found = bench.tables([(parts[0], result)], parts[3:])
    assert "| constant | nika, 10 Mbit/s | whole file | +0.500 (0.250 to 0.750, 8 walks) |" in found
    assert "30 Mbit/s" not in found
    assert "| constant | 35 dB after, median | 0.55 s | 0.5 | **missed** |" in found
    assert "| constant | 20 dB after, median | 0.1 s | 0.1 | reached |" in found
    assert "showroom on recorded links" in found
    assert all(f"| {name} |" in found for name in bench.OTHERS)
