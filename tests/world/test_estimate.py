"""Dry runs of worlds: tiles with room for eyes, times that follow a clock, a budget, and a limit that suffices."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from gsvis.errors import ArgumentError, SceneError
from gsvis.jobs.cost import IDLE, needed_memory
from gsvis.jobs.workers import Workers
from gsvis.train.levels import LevelsConfig
from gsvis.world import estimate as estimates
from gsvis.world import trial as trials
from gsvis.world.build import WorldBuild
from gsvis.world.config import WorldConfig
from gsvis.world.estimate import estimate_world
from gsvis.world.prepare import prepare_world
from tests.world import cities

CONFIG = cities.config(most=1200)


@pytest.fixture
def scene(tmp_path: Path) -> tuple[str, None]:
    return cities.write(cities.street(), tmp_path / "street.ply")


def tick(monkeypatch: pytest.MonkeyPatch, seconds: float) -> None:
    """Let each look at the clock of trials take some seconds."""
    clock = itertools.count(0.0, seconds)
    monkeypatch.setattr(trials, "_clock", lambda: next(clock))


def test_the_share_of_tiles_with_room_for_eyes_and_the_limit_of_memory_are_those_of_the_run(
    scene: tuple[str, None], tmp_path: Path
) -> None:
    found = estimate_world([scene], CONFIG)
    assert found.trial.tiles >= 1
    assert [path.name for path in tmp_path.iterdir()] == ["street.ply"]
    with pytest.raises(ArgumentError, match="expected at least"):
        prepare_world([scene], tmp_path / "a.gsworld", CONFIG, workers=Workers(max_memory=found.max_memory // 2))
    made = prepare_world([scene], tmp_path / "b.gsworld", CONFIG, workers=Workers(max_memory=found.max_memory))
    voxels = [result.facts["voxels"] for name, result in made.results.items() if name.startswith("space ")]
    assert found.tiles == len(voxels) <= 8
    assert found.trial.eyes == pytest.approx(sum(count > 0 for count in voxels) / len(voxels))
    assert found.trial.cells <= CONFIG.package.cells


def test_times_follow_the_clock(scene: tuple[str, None], monkeypatch: pytest.MonkeyPatch) -> None:
    config = cities.config(LevelsConfig((0.25, 0.5), iterations=4), most=1200)
    taken = []
    for seconds in (1e-6, 2e-6):
        tick(monkeypatch, seconds)
        taken.append(estimate_world([scene], config))
    slow, fast = taken[1].trial, taken[0].trial
    for name in ("space", "levels", "colors", "cell"):
        assert getattr(slow, name) == pytest.approx(2.0 * getattr(fast, name))
    assert (slow.eyes, slow.cells, slow.tiles) == (fast.eyes, fast.cells, fast.tiles)
    assert taken[1].core_seconds["packages"] > taken[0].core_seconds["packages"]


def test_after_the_budget_one_tile_is_tried(scene: tuple[str, None], monkeypatch: pytest.MonkeyPatch) -> None:
    tick(monkeypatch, 100.0)
    found = estimate_world([scene], CONFIG).trial
    assert found.tiles == 1
    assert found.cell > 0.0


def test_more_steps_cells_and_workers_change_what_they_should(
    scene: tuple[str, None], monkeypatch: pytest.MonkeyPatch
) -> None:
    tick(monkeypatch, 1e-3)
    few = estimate_world([scene], cities.config(LevelsConfig((0.25, 0.5), iterations=4), most=1200))
    tick(monkeypatch, 1e-3)
    many = estimate_world([scene], cities.config(LevelsConfig((0.25, 0.5), iterations=40), most=1200), workers=4)
    assert many.core_seconds["levels"] > few.core_seconds["levels"]
    assert many.core_seconds["packages"] == pytest.approx(few.core_seconds["packages"], rel=0.2)
    assert many.seconds < sum(many.core_seconds.values())
    assert many.max_memory > few.max_memory


def test_a_walk_counts_the_tiles_and_cells_that_it_comes_near(scene: tuple[str, None], tmp_path: Path) -> None:
    walk = ((1.0, 0.0, 1.6), (4.0, 0.0, 1.6))
    config = replace(CONFIG, walk=walk, margin=0.8)
    found, everywhere = estimate_world([scene], config), estimate_world([scene], CONFIG)
    made = prepare_world([scene], tmp_path / "a.gsworld", config)
    voxels = [result.facts["voxels"] for name, result in made.results.items() if name.startswith("space ")]
    assert found.trial.eyes == pytest.approx(sum(count > 0 for count in voxels) / len(voxels))
    assert 0.0 < found.trial.eyes < everywhere.trial.eyes
    cells = [result.facts["cells"] for name, result in made.results.items() if name.startswith("tile ")]
    assert found.trial.cells == pytest.approx(sum(cells) / max(sum(count > 0 for count in cells), 1), abs=1.0)
    assert found.core_seconds["packages"] < everywhere.core_seconds["packages"]
    with pytest.raises(SceneError, match="the walk comes near no tile"):
        estimate_world([scene], replace(CONFIG, walk=((900.0, 900.0, 900.0),)))


def test_bytes_are_near_those_of_the_run(scene: tuple[str, None], tmp_path: Path) -> None:
    found = estimate_world([scene], CONFIG)
    made = prepare_world([scene], tmp_path / "a.gsworld", CONFIG)
    kept = sum(path.stat().st_size for path in made.work.rglob("*") if path.is_file())
    assert 0.6 < found.nbytes / made.nbytes < 1.6
    assert 0.6 < found.work_bytes / kept < 1.6


def test_the_limit_of_memory_counts_every_tile_that_may_stand_around_one() -> None:
    """In a world of many tiles more than a dozen stand around each at less than full distance."""
    side, each = 8, 200_000

    def tree(x: int, y: int, size: int) -> Any:
        half = size // 2
        if size == 1:
            return x * side + y
        return [[tree(x + a, y, half), tree(x + a, y + half, half)] for a in (0, half)]

    rects = [(x, y, 1, 1) for x in range(side) for y in range(side)]
    grid = {"tiles": rects, "expected": [each] * side**2, "tree": tree(0, 0, side), "grid": {"side": 16.0}}
    config = WorldConfig()
    sizes = estimates._Sizes(config, each * side**2, side**2, 0)
    build = cast(WorldBuild, SimpleNamespace(grid=grid, config=config))
    _, limit = estimates._memory(sizes, build, each, each, 1)
    tile = {"gaussians": int(sizes.own * each), "levels": [["low", each // 4]], "spacings": []}
    params = {"outside": False, "config": config.package.as_dict()}
    inputs = [tile, {"voxels": 1}, *([tile] * 24)]  # those within two tiles of one in the middle
    assert limit >= IDLE + needed_memory("gsvis.world.packages:prepare_tile", params, inputs)
    assert limit < 4 * IDLE + needed_memory("gsvis.world.packages:prepare_tile", params, [*inputs, *([tile] * 24)])


def test_more_workers_than_tiles_save_no_time(scene: tuple[str, None]) -> None:
    found = estimate_world([scene], CONFIG)
    times = [found.seconds_with(count) for count in (2, 4, found.tiles, 1000)]
    assert times == sorted(times, reverse=True)
    assert times[-1] == times[-2]
    assert found.seconds == found.seconds_with(1) == sum(found.core_seconds.values())
