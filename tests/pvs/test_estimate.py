"""What a build would cost: near, within the memory that is given, and without a trace."""

from __future__ import annotations

import itertools
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsvis.jobs.workers import Workers
from gsvis.pvs import estimate as estimates
from gsvis.pvs.build import build_pvs
from gsvis.pvs.cell_view import Finder
from gsvis.pvs.estimate import estimate_pvs
from gsvis.scene.kinds import SpaceKind
from tests.pvs.jobs import CONFIG, Job, Stop

RARE = 1.7  # the mean of cells in rooms and open places over that of the few that are tried


def test_an_estimate_is_near_and_writes_nothing(job: Job, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, cells, viewpoints = tmp_path / "scene.pvs", len(job.grid), len(job.shared)
    clock = itertools.count(100.0, 3.0)  # a look takes 3 seconds, and finding a cell as many
    monkeypatch.setattr(estimates, "_clock", lambda: next(clock))
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    estimate = estimate_pvs(job.scene, job.grid, job.space, path, CONFIG, workers=Workers(2))
    assert (estimate.viewpoints, estimate.cells, estimate.finished, estimate.workers) == (viewpoints, cells, 0, 2)
    work = 3.0 * viewpoints + RARE * 3.0 * cells
    assert estimate.seconds == pytest.approx(work / 1.8 + 3.3, abs=0.2)  # two processes share it, and have to start
    assert estimate.memory > 1 << 28
    assert 0.3 < estimate.disk / len(job.wanted) < 5.0
    assert estimate.visible <= estimate.ever <= len(job.scene)
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(KeyboardInterrupt):
        job.run(path, progress=Stop(3, "viewpoints"))
    fewer = estimate_pvs(job.scene, job.grid, job.space, path, CONFIG, workers=Workers(2))
    assert estimate.seconds - fewer.seconds == pytest.approx(3.0 * 3 / 1.8)
    with pytest.raises(KeyboardInterrupt):
        job.run(path, progress=Stop(5))
    before = sorted(path.parent.rglob("*"))
    fewer = estimate_pvs(job.scene, job.grid, job.space, path, CONFIG, workers=Workers(2))
    assert fewer.finished == 5
    assert fewer.seconds == pytest.approx(RARE * 3.0 * (cells - 5) / 1.8 + 3.3, abs=0.2)
    assert sorted(path.parent.rglob("*")) == before
    with pytest.raises(KeyboardInterrupt):
        job.run(path, progress=Stop(0, "check"))
    held = sum(entry.stat().st_size for entry in job.journal(path).glob("*.bin"))
    assert 0.5 < estimate_pvs(job.scene, job.grid, job.space, path, CONFIG).working_disk / held < 2.0


def test_memory_bounds_the_workers(job: Job, tmp_path: Path) -> None:
    def workers(max_memory: int) -> int:
        bound = Workers(64, max_memory)
        return estimate_pvs(job.scene, job.grid, job.space, tmp_path / "x.pvs", CONFIG, workers=bound, sample=1).workers

    counts = [workers(gigabytes << 30) for gigabytes in (1, 4, 16, 64)]
    assert counts == sorted(counts)
    assert counts[0] < counts[1] < 64
    for gigabytes, count in zip((1, 4, 16, 64), counts, strict=True):
        bound = Workers(count, gigabytes << 30)
        estimate = estimate_pvs(job.scene, job.grid, job.space, tmp_path / "x.pvs", CONFIG, workers=bound, sample=1)
        assert estimate.memory <= gigabytes << 30
    with pytest.raises(ValueError, match=r"max_memory: expected at least .* GB for"):
        build_pvs(job.scene, job.grid, job.space, tmp_path / "x.pvs", CONFIG, workers=Workers(1, 1 << 20))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("bad", [{"count": 0}, {"count": 1.5}, {"count": True}, {"max_memory": 0}])
def test_workers_are_checked(bad: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(bad))):
        Workers(**bad)


def test_fine_looks_and_coarse_ones_are_counted_apart(
    job: Job, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried = estimates._Tried(cells=1, looking=([1.0], [3.0, 5.0]))
    monkeypatch.setattr(estimates, "_try_cells", lambda *_: tried)
    fine = np.count_nonzero(job.shared.fine)
    estimate = estimate_pvs(job.scene, job.grid, job.space, tmp_path / "scene.pvs", CONFIG)
    assert 0 < fine < len(job.shared)
    looked = 4.0 * fine + 1.0 * (len(job.shared) - fine)
    assert looked <= estimate.seconds <= looked + 1.0


def test_threads_that_were_tried_with_are_not_there_for_processes(
    job: Job, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: 2)

    def seconds(threads: float, count: int) -> tuple[float, float]:
        tried = estimates._Tried(cells=1, looking=([1.0], [1.0]), finding=2.0, threads=threads)
        monkeypatch.setattr(estimates, "_try_cells", lambda *_: tried)
        found = estimate_pvs(job.scene, job.grid, job.space, tmp_path / "x.pvs", CONFIG, workers=Workers(count))
        return found.seconds, found.of_cells

    slow, of_slow = seconds(1.0, 2)
    fast, of_fast = seconds(1.5, 2)
    work = len(job.shared) + RARE * 2.0 * len(job.grid)
    assert fast - slow == pytest.approx(0.5 * work / 1.8)
    assert (of_slow, of_fast) == pytest.approx((RARE * 2.0 * len(job.grid) / 1.8, RARE * 3.0 * len(job.grid) / 1.8))
    assert seconds(1.5, 1) == pytest.approx(seconds(1.0, 1))  # one process has its threads


def test_cells_around_an_object_are_alike(job: Job, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tried = estimates._Tried(cells=1, looking=([1.0], [1.0]), finding=2.0)
    monkeypatch.setattr(estimates, "_try_cells", lambda *_: tried)

    def of_cells(kind: str) -> float:
        space = replace(job.space, kind=SpaceKind(kind, "so it was said"))  # type: ignore[arg-type]
        return estimate_pvs(job.scene, job.grid, space, tmp_path / "x.pvs", CONFIG).of_cells

    alike = 2.0 * len(job.grid)
    assert of_cells("object") == pytest.approx(alike)
    for kind in ("rooms", "open place", "given"):
        assert of_cells(kind) == pytest.approx(RARE * alike)


@pytest.mark.parametrize(("seconds", "cells"), [(0.01, 12), (4.0, 2), (30.0, 1)])
def test_few_cells_are_tried_where_they_are_slow(
    seconds: float, cells: int, job: Job, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The clock runs on by `seconds` for a cell, whatever it looks from."""
    now = [0.0]
    found = Finder.find_cell

    def slow(self: Finder, *given: Any) -> Any:
        now[0] += seconds
        return found(self, *given)

    monkeypatch.setattr(Finder, "find_cell", slow)
    monkeypatch.setattr(estimates, "_clock", lambda: now[0])
    steps = []
    estimate_pvs(job.scene, job.grid, job.space, tmp_path / "x.pvs", CONFIG, progress=lambda *step: steps.append(step))
    tried = max(done for _, done, _ in steps[:-1])
    assert tried == (cells if seconds >= 1.0 else min(12, len(job.grid)))
    assert now[0] <= max(seconds, 12.0)
