"""What a build would cost: near, within the memory that is given, and without a trace."""

from __future__ import annotations

import itertools
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsvis.pvs import estimate as estimates
from gsvis.pvs.build import build_pvs
from gsvis.pvs.estimate import estimate_pvs
from gsvis.pvs.workers import Workers
from tests.pvs.jobs import CONFIG, Job, Stop


def test_an_estimate_is_near_and_writes_nothing(job: Job, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, cells, viewpoints = tmp_path / "scene.pvs", len(job.grid), len(job.shared)
    clock = itertools.count(100.0, 3.0)  # a look takes 3 seconds, and finding a cell as many
    monkeypatch.setattr(estimates, "_clock", lambda: next(clock))
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    estimate = estimate_pvs(job.scene, job.grid, job.space, path, CONFIG, workers=Workers(2))
    assert (estimate.viewpoints, estimate.cells, estimate.finished, estimate.workers) == (viewpoints, cells, 0, 2)
    work = 3.0 * viewpoints + 3.0 * cells
    assert estimate.seconds == pytest.approx(work / 1.8 + 6.3, abs=0.2)  # two processes share it, and have to start
    assert estimate.memory > 1 << 28
    assert 0.3 < estimate.disk / len(job.wanted) < 5.0
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
    assert fewer.seconds == pytest.approx(3.0 * (cells - 5) / 1.8 + 6.3, abs=0.2)
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
    work = len(job.shared) + 2.0 * len(job.grid)
    assert fast - slow == pytest.approx(0.5 * work / 1.8)
    assert (of_slow, of_fast) == pytest.approx((2.0 * len(job.grid) / 1.8, 3.0 * len(job.grid) / 1.8))
    assert seconds(1.5, 1) == pytest.approx(seconds(1.0, 1))  # one process has its threads
