"""Figures of rivals: means over links within a walk, the best rival, curves over bytes, throughput."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest


@pytest.fixture
def figures(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
    sys.modules.pop("_delivery_figures", None)
    import _delivery_figures

    return _delivery_figures


def session(system: str, walk: str, link: str, score: float, **more: Any) -> dict[str, Any]:
    figure = {"score": score, "psnr": 30.0 + score, "latency": 0.1, "stall": 0.0, "bytes": 4e6}
    times = [0.0, 1.0, 2.0, 3.0]
    curves = {
        "times": times, "psnr": [0.0, 20.0, 30.0, 40.0], "latency": [1.0, 0.1, 0.0, 0.0], "qoe": [0.0] * 4,
        "bytes": [0.0, 1e6, 2e6, 4e6], "gaussian_share": [0.0] * 4, "term_share": [0.0] * 4, "content": [1, 1, 1, 1],
    }  # fmt: skip
    row = {"scene": "s", "class": 10, "walk": walk, "link": link, "system": system, "bytes_to_35": None}
    first = {"seconds_to_first_image": 1.0, "seconds_to_good_image": None}
    return {**row, "figures": {**figure, **first}, "curves": curves, **more}


@pytest.fixture
def rows(figures: Any) -> list[dict[str, Any]]:
    scores = {figures.OURS: 0.5, figures.ABLATED[0]: 0.9, "whole file": -1.0, "leaves, spark": 0.25}
    return [
        session(system, walk, link, score + (walk == "b") * 0.1 + (link != "10 Mbit/s") * 0.2)
        for system, score in scores.items()
        for walk in ("a", "b")
        for link in ("10 Mbit/s", "recorded")
    ]


def test_links_are_averaged_within_a_walk(figures: Any, rows: list[dict[str, Any]]) -> None:
    ours = figures.chosen(rows, system=figures.OURS)
    np.testing.assert_allclose(figures.by_walk(ours, "score"), [0.6, 0.7])


def test_the_best_rival_is_no_ablation_of_ours(figures: Any, rows: list[dict[str, Any]]) -> None:
    assert figures.best_rival(rows) == "leaves, spark"
    assert figures.best_rival(figures.chosen(rows, system=figures.OURS)) is None


def test_figures_with_a_target_are_of_ours_beside_the_fewest_bytes_and_the_worst_final_view(
    figures: Any, rows: list[dict[str, Any]]
) -> None:
    for row in rows:
        row["bytes_to_35"] = {figures.OURS: 1e6, "whole file": 4e6, "leaves, spark": 2e6}.get(row["system"])
        if row["system"] == figures.OURS and row["walk"] == "b":
            row["curves"] = {**row["curves"], "psnr": [0.0, 20.0, 30.0, 30.0]}
    found = {row["name"]: row for row in figures.targets_of(rows, [10])}
    assert found["20 dB after, median, 10 Mbit/s, s"]["reached"] == 1.0
    assert found["35 dB after, median, 10 Mbit/s, s"]["reached"] == 1e9  # never
    assert found["bytes until 35 dB, 10 Mbit/s, s, of those of the best rival"]["reached"] == 0.5
    final = found["final PSNR, 10 Mbit/s, s, of the whole file's, worst walk in which it arrives"]
    assert final["reached"] == pytest.approx(0.75)
    assert not any("SRBFs" in name for name in found)


def test_differences_are_over_walks(figures: Any, rows: list[dict[str, Any]]) -> None:
    found = {row["name"]: row for row in figures.figures_of(rows, [10])}
    apart = found["QoE of a step, 10 Mbit/s, s, gsvis minus the best rival"]
    assert apart["reached"] == pytest.approx(0.25)
    assert "over 2 walks" in apart["unit"]
    least = found["the same, lower end of its interval, 10 Mbit/s, s"]
    assert least["target"] == 0.0
    assert least["reached"] == pytest.approx(0.25)
    assert "35 dB never" in found["QoE of a step, 10 Mbit/s, s, gsvis"]["unit"]
    report = figures.report(rows, [10])
    assert report["differences"]["s, 10 Mbit/s"]["best_rival"] == "leaves, spark"
    assert len(report["sessions"]["rows"]) == len(rows)


def test_curves_over_bytes_take_the_last_step_with_at_most_so_many(figures: Any) -> None:
    found = figures.curves_over_bytes([session("x", "a", "l", 0.0)], 7)
    by = dict(zip(found["bytes"], found["psnr"], strict=True))
    for nbytes, psnr in by.items():
        expected = None if nbytes > 4e6 else 0.0 if nbytes < 1e6 else 20.0 if nbytes < 2e6 else 30.0
        assert psnr == expected, nbytes


def test_throughput_is_what_arrives_in_each_second(figures: Any) -> None:
    found = figures.throughput([session("x", "a", "l", 0.0)], 10.0)
    assert found["mbit_per_s"] == [8.0, 8.0, 16.0]
    assert found["megabytes"] == 4.0
    assert found["share_of_link"] == pytest.approx(32.0 / 40.0)


def test_frames_are_averaged_by_system(figures: Any) -> None:
    frames = [
        {"scene": "s", "walk": w, "system": "whole file", "t": 1.0, "psnr": p, "ssim": 0.5, "flip": 0.1}
        for w, p in (("a", 20.0), ("b", 30.0))
    ]
    found = figures.means_of_frames(frames)["whole file"]
    assert (found["psnr"], found["ssim"], found["flip"]) == (25.0, 0.5, 0.1)
    assert len(found["frames"]) == 2


def test_systems_of_the_bench_are_the_rivals_of_the_library(figures: Any) -> None:
    from paper.ablation import ABLATIONS
    from paper.rivals import RIVALS

    assert set(RIVALS) < set(figures.OTHERS)
    assert len(figures.ABLATED) == len(ABLATIONS)
