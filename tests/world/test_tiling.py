"""Tiling: every row ends in one tile, whatever the order of rows and files, and flyaways do not stretch the grid."""

from __future__ import annotations

import tracemalloc
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsvis.errors import SceneError
from gsvis.io import batches, load_scene
from gsvis.io.batches import list_batches, read_batch
from gsvis.io.convert import rotation_about_axes
from gsvis.io.ply import save_ply
from gsvis.jobs.cost import needed_memory
from gsvis.jobs.graph import Given
from gsvis.jobs.objects import open_store
from gsvis.jobs.workers import Workers
from gsvis.progress import silent
from gsvis.scene.axes import tilt_of
from gsvis.scene.cameras import Cameras
from gsvis.scene.content import scene_hash
from gsvis.scene.facts import SceneFacts
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.procedural import random_scene
from gsvis.world import tiling
from gsvis.world.build import WorldBuild
from gsvis.world.rows import content_order, load_gaussians
from gsvis.world.tiling import TilingConfig, cut_squares, find_grid
from tests.world import cities


def built(scenes: list[tuple[str, None]], folder: Path, most: int = 700) -> WorldBuild:
    return WorldBuild(scenes, cities.config(most=most), open_store(folder), Workers(), silent)


def tiles_of(build: WorldBuild) -> dict[object, Gaussians]:
    """The rows of each tile."""
    store = build.store
    return {
        coords: load_gaussians(store.path_of(build.made[f"rows {k}"].files["rows"], Path()))
        for k, coords in enumerate(build.tiles)
    }


def test_every_row_ends_in_one_tile(tmp_path: Path) -> None:
    g = cities.street()
    tiles = tiles_of(built([cities.write(g, tmp_path / "s.ply")], tmp_path / "work"))
    together = Gaussians.concatenate(list(tiles.values()))
    stored = load_scene(tmp_path / "s.ply")  # a PLY keeps logarithms of scales
    assert scene_hash(together[content_order(together)]) == scene_hash(stored[content_order(stored)])
    for coords, rows in tiles.items():
        assert len(rows) <= 700 or coords is None


def test_what_files_state_reaches_every_tile_and_their_up_axis_the_grid(tmp_path: Path) -> None:
    known = SceneFacts(
        origin=(5e5, 0.0, 1e6), up=(0.0, 1.0, 0.0), up_source="a test", antialiased=True, meters_per_unit=0.5
    )
    scene = cities.write(cities.street().with_facts(known), tmp_path / "s.ply")
    config = replace(cities.config(), tiling=TilingConfig(700))
    build = WorldBuild([scene], config, open_store(tmp_path / "work"), Workers(), silent)
    assert {rows.facts for rows in tiles_of(build).values()} == {load_scene(tmp_path / "s.ply").facts} == {known}
    assert build.grid["up"] == [0.0, 1.0, 0.0]


def test_the_grid_takes_no_more_memory_than_is_counted_for_its_sample(tmp_path: Path) -> None:
    build = built(
        [cities.write(random_scene(np.random.default_rng(0), 120_000), tmp_path / "s.ply")], tmp_path / "work"
    )
    samples = tuple(result for name, result in build.survey.items() if name != "grid")
    params = {"config": asdict(TilingConfig(700)), "every": build.every}
    tracemalloc.start()
    try:
        find_grid(params, Given(build.store, samples, tmp_path), tmp_path, tmp_path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert sum(each.facts["sampled"] for each in samples) > 100_000
    assert peak <= needed_memory("gsvis.world.tiling:find_grid", params, [each.facts for each in samples])


@pytest.mark.parametrize("rows", [97, 1000])
def test_the_order_and_the_cut_of_rows_change_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rows: int
) -> None:
    g = cities.street()
    wanted = tiles_of(built([cities.write(g, tmp_path / "s.ply")], tmp_path / "one"))
    shuffled = g[np.random.default_rng(1).permutation(len(g))]
    monkeypatch.setattr(batches, "ROWS", rows)
    found = tiles_of(built([cities.write(shuffled, tmp_path / "t.ply")], tmp_path / "two"))
    assert {k: scene_hash(v) for k, v in found.items()} == {k: scene_hash(v) for k, v in wanted.items()}


def test_flyaways_do_not_stretch_the_grid(tmp_path: Path) -> None:
    near = random_scene(np.random.default_rng(0), 3000)
    rng = np.random.default_rng(2)
    away = random_scene(rng, 40).transform(np.eye(3), [0.0, 0.0, 0.0], 1e4)
    build = built([cities.write(Gaussians.concatenate([near, away]), tmp_path / "s.ply")], tmp_path / "work")
    assert build.grid["grid"]["side"] * max(build.grid["grid"]["shape"]) < 10.0 * float(np.ptp(near.bounds(0.98)))
    assert build.tiles[-1] is None
    assert build.made[f"rows {len(build.tiles) - 1}"].facts["gaussians"] >= 30


def test_a_scene_without_anything_to_see_is_refused(tmp_path: Path) -> None:
    g = random_scene(np.random.default_rng(0), 100)
    dark = Gaussians(g.means, g.quats, g.scales, np.full(100, 1e-4), g.sh0)
    with pytest.raises(SceneError, match="nothing to see"):
        _ = built([cities.write(dark, tmp_path / "s.ply")], tmp_path / "work").grid


def test_options_are_checked() -> None:
    for bad in ({"most": 0}, {"coverage": 1.0}, {"up": "up"}):
        with pytest.raises(ValueError, match="expected"):
            TilingConfig(**bad)  # type: ignore[arg-type]


@pytest.mark.parametrize("degree", [0, 3])
def test_batches_of_a_ply_are_the_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, degree: int) -> None:
    save_ply(random_scene(np.random.default_rng(0), 1000, degree), tmp_path / "s.ply")
    monkeypatch.setattr(batches, "ROWS", 300)
    found = list_batches(tmp_path / "s.ply")
    assert [each.count for each in found] == [300, 300, 300, 100]
    joined = Gaussians.concatenate([read_batch(each) for each in found])
    assert scene_hash(joined) == scene_hash(load_scene(tmp_path / "s.ply"))


def test_equal_centers_are_ordered_by_the_rest() -> None:
    g = random_scene(np.random.default_rng(0), 50, 1)
    twice = Gaussians.concatenate([g, Gaussians(g.means, g.quats, g.scales, g.opacities, g.sh0 + 1.0, g.shN)])
    mixed = twice[np.random.default_rng(1).permutation(100)]
    assert scene_hash(twice[content_order(twice)]) == scene_hash(mixed[content_order(mixed)])


@pytest.mark.parametrize("seed", range(6))
def test_tiles_cover_all_that_is_there_once_and_are_well_filled(seed: int) -> None:
    rng = np.random.default_rng(seed)
    counts = rng.integers(0, 40, (rng.integers(1, 70), rng.integers(1, 70)))
    counts[rng.random(counts.shape) < 0.4] = 0
    most = int(rng.integers(40, 4000))
    tiles, expected, tree = cut_squares(counts, most)
    owners = np.zeros(counts.shape, int)
    for (x, y, width, height), total in zip(tiles, expected, strict=True):
        owners[x : x + width, y : y + height] += 1
        assert counts[x : x + width, y : y + height].sum() == total <= most
    assert (owners[counts > 0] == 1).all()
    assert owners.max(initial=0) <= 1
    assert leaves(tree) == list(range(len(tiles)))
    assert len(tiles) <= 2.5 * counts.sum() / most + 1


@pytest.mark.parametrize("shape", [(300, 300), (400, 100), (64, 64)])
@pytest.mark.parametrize("tiles", [2, 3, 4, 5, 8])
def test_even_scenes_fill_their_tiles(shape: tuple[int, int], tiles: int) -> None:
    counts = np.full(shape, 10)
    most = int(counts.sum() / (0.9 * tiles))
    assert len(cut_squares(counts, most)[0]) == tiles


def test_clumps_stay_whole() -> None:
    """Three clumps of 0.9 tiles each are three tiles."""
    counts = np.zeros((100, 20), int)
    counts[[5, 52, 95]] = 45
    tiles, expected, _ = cut_squares(counts, 1000)
    assert expected == [900, 900, 900]
    assert len(tiles) == 3


def test_a_tile_is_as_full_as_a_sample_can_say() -> None:
    assert tiling._most_by_sample(250_000, 1) == 250_000
    rng = np.random.default_rng(0)
    most = tiling._most_by_sample(250_000, 200)
    real = [int(each) for each in rng.integers(240_000, 260_000, 4000)]
    taken = [200 * int(rng.binomial(count, 1 / 200)) for count in real]
    over = [count for count, sampled in zip(real, taken, strict=True) if sampled <= most and count > 250_000]
    assert len(over) < 0.05 * len(real)


def test_touching_tiles_are_those_within_the_margin(tmp_path: Path) -> None:
    """The tiles that the plain definition gives, one by one."""
    build = built([cities.write(cities.street(), tmp_path / "s.ply")], tmp_path / "work", most=120)
    rects = [rect for rect in build.tiles if rect is not None]
    assert len(rects) > 12
    for rect in rects:
        for margin in (0.0, 0.15, 1.0):
            reach = max(margin * max(rect[2:]), 1e-9)
            gaps = [[max(rect[i] - o[i] - o[i + 2], o[i] - rect[i] - rect[i + 2]) for i in (0, 1)] for o in rects]
            near = [k for k, each in enumerate(gaps) if max(each) < reach and rects[k] != rect]
            assert build.touching(rect, margin) == near


def leaves(tree: Any) -> list[int]:
    """The numbers in a tree of cuts, ascending."""
    if isinstance(tree, list):
        return sorted(k for each in tree for k in leaves(each))
    return [] if tree is None else [tree]


def test_four_times_the_gaussians_are_four_times_the_tiles() -> None:
    one = np.random.default_rng(0).integers(0, 100, (60, 60))
    four = np.tile(one, (2, 2))
    most = int(one.sum() / 2.9)
    assert len(cut_squares(one, most)[0]) == 4
    assert len(cut_squares(four, most)[0]) <= 16


def test_what_is_up_is_given_stated_or_seen_by_cameras(tmp_path: Path) -> None:
    """Squares lie along axes; up is any direction, and who does not know it says so."""
    turn = rotation_about_axes((45.0, 0.0, 20.0))
    g = cities.street().transform(turn)
    x, y, z = (float(value) for value in turn[:, 2])
    plain = cities.write(g, tmp_path / "plain.ply")
    stated = cities.write(g.with_facts(SceneFacts(up=(x, y, z), up_source="the file")), tmp_path / "stated.ply")
    ahead = np.array([[np.cos(k), np.sin(k), 0.0] for k in range(8)])
    eyes = np.tile([4.0, 2.0, 1.6], (8, 1))
    seen = Cameras.look_at(eyes @ turn.T, (eyes + ahead) @ turn.T, up=turn[:, 2], width=64, height=48, fov=60.0)
    config = replace(cities.config(), tiling=TilingConfig(700))
    ways = {
        "given": (plain, replace(config, tiling=TilingConfig(700, up=(x, y, z)))),
        "stated": (stated, config),
        "seen": (plain, replace(config, cameras=seen)),
    }
    for way, (scene, options) in ways.items():
        build = WorldBuild([scene], options, open_store(tmp_path / way), Workers(), silent)
        assert tilt_of(build.grid["up"], turn[:, 2]) < 0.1, way
        (line,) = build.grid["remarks"]
        assert "degrees off" in line
        assert "tiles are cut along" in line
