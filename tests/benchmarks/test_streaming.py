"""Curves of a stream: the mean of a step is of the walks that see something then."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest


@pytest.fixture
def streaming(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
    sys.modules.pop("streaming", None)
    import streaming

    return streaming


def row(system: str, content: list[int], psnr: list[float], arrived: list[float]) -> dict[str, Any]:
    curves = {"times": [0.0, 0.1, 0.2], "psnr": psnr, "latency": psnr, "qoe": psnr, "bytes": arrived}
    return {"scene": "s", "link": "10 Mbit/s", "system": system, "curves": {**curves, "content": content}}


def test_steps_without_content_are_in_no_mean(streaming: Any) -> None:
    systems = (streaming.OURS, streaming.WHOLE, streaming.MORTON)
    rows = [row(system, [1, 1, 0], [10.0, 20.0, 99.0], [0.0, 1.0, 2.0]) for system in systems]
    rows += [row(system, [1, 0, 0], [30.0, 99.0, 99.0], [0.0, 3.0, 4.0]) for system in systems]
    rows += [{**rows[0], "scene": "another"}, {**rows[0], "link": "a recorded one"}]
    for system, curves in streaming.mean_curves("s", rows).items():
        assert system in systems
        assert curves["content"] == [2, 1, 0]  # walks that see something
        for key in streaming.SEEN:
            assert curves[key] == [20.0, 20.0, None]
        assert curves["bytes"] == [0.0, 2.0, 3.0]  # what arrives counts wherever one looks
        assert curves["times"] == [0.0, 0.1, 0.2]


def test_where_all_see_something_it_is_the_plain_mean(streaming: Any) -> None:
    rows = [
        row(system, [1, 1, 1], [10.0 * k, 1.0, 2.0], [1.0, 2.0, 3.0])
        for system in (streaming.OURS, streaming.WHOLE, streaming.MORTON)
        for k in range(3)
    ]
    assert streaming.mean_curves("s", rows)[streaming.OURS]["psnr"] == [10.0, 1.0, 2.0]
