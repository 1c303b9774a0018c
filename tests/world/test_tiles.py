"""Tiles before anything is seen from them: what stands for a tile that nobody can be in."""

from __future__ import annotations

import json
import tracemalloc
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree

from gsvis.errors import SceneError
from gsvis.io.convert import rotation_about_axes
from gsvis.jobs.cost import needed_memory
from gsvis.jobs.objects import open_store
from gsvis.jobs.workers import Workers
from gsvis.progress import silent
from gsvis.scene.cameras import Cameras
from gsvis.scene.kinds import SpaceKind
from gsvis.scene.procedural import nested_shells, two_rooms
from gsvis.world import tiles
from gsvis.world.build import WorldBuild
from gsvis.world.packages import _witnesses
from gsvis.world.rows import load_gaussians, load_tile_levels
from gsvis.world.tiles import config_of, load_space, space_of_tile
from gsvis.world.tiling import TilingConfig
from tests.world import cities


@pytest.fixture(scope="module")
def build(tmp_path_factory: pytest.TempPathFactory) -> WorldBuild:
    """A street of which one end alone is walked."""
    folder = tmp_path_factory.mktemp("tiles")
    config = replace(cities.config(most=400), walk=((0.5, 2.0, 1.5), (1.0, 2.0, 1.5)), margin=0.5)
    scene = cities.write(cities.street(), folder / "street.ply")
    return WorldBuild([scene], config, open_store(folder / "store"), Workers(), silent)


def test_the_lower_level_of_a_tile_without_eyes_is_as_fine_as_it_says_and_shares_nothing(build: WorldBuild) -> None:
    found, seen = build.levels, 0
    for k, rect in enumerate(build.tiles):
        if rect is None or found[f"space {k}"].facts["voxels"]:
            continue
        seen += 1
        levels = load_tile_levels(build.store.path_of(found[f"levels {k}"].files["levels"], Path()))
        rows = load_gaussians(build.store.path_of(found[f"rows {k}"].files["rows"], Path()))
        assert levels.names == ("low", "high")
        assert np.array_equal(levels.first, levels.last)
        low, high = levels.level(0), levels.level(1)
        assert len(low) <= build.config.far
        assert np.array_equal(np.sort(high.means, axis=0), np.sort(rows.means, axis=0))
        away = cKDTree(low.means).query(high.means)[0]
        assert np.quantile(away, 0.95) <= 1.5 * found[f"levels {k}"].facts["spacings"][0]
    assert seen >= 2


TURNS = {"upright": np.eye(3), "oblique": rotation_about_axes((45.0, 0.0, 20.0))}


@pytest.mark.parametrize(("turn", "sample"), [("upright", 1 << 19), ("oblique", 1 << 19), ("upright", 3_000)])
def test_eyes_are_in_rooms_that_borders_cut(
    turn: str, sample: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What a place is, and which space is enclosed, is seen with what lies around a tile, however the scene lies.

    A sample of it tells the kind of the place as well as all of it.
    """
    monkeypatch.setattr(tiles, "_SAMPLE", sample)
    scene, rotation = two_rooms(12_000, sh_degree=0), TURNS[turn]
    x, y, z = rotation[:, 2].tolist()
    config = replace(cities.config(most=4_000), resolution=48, tiling=TilingConfig(4_000, up=(x, y, z)))
    one = cities.write(scene.gaussians.transform(rotation), tmp_path / "rooms.ply")
    build = WorldBuild([one], config, open_store(tmp_path / "store"), Workers(), silent)
    eyes = scene.navigable.sample_viewpoints(2_000, np.random.default_rng(0)) @ rotation.T
    found, inside, volume = build.levels, np.zeros(len(eyes), bool), 0.0
    for k in sorted(build.searched):
        if found[f"space {k}"].facts["voxels"]:
            space = load_space(build.store.path_of(found[f"space {k}"].files["space"], Path()))
            inside |= space.contains(eyes)
            volume += space.volume
            assert np.allclose(space.up, rotation[:, 2])
    assert len(build.searched) >= 4
    assert inside.mean() >= 0.95
    assert volume <= 1.4 * scene.navigable.volume  # that of the scene keeps a quarter of a unit from all walls


def test_every_other_camera_judges_the_tile_that_it_stands_in(tmp_path: Path) -> None:
    """Beside a street, three units above it: where no rule of rooms and ground has eyes."""
    eyes = np.stack([np.linspace(0.5, 11.0, 20), np.full(20, 2.0), np.full(20, 3.6)], axis=1)
    cameras = Cameras.look_at(eyes, eyes + np.array([1.0, 0.0, -0.2]), width=64, height=48, fov=60.0)
    config = replace(cities.config(), cameras=cameras)
    scene = cities.write(cities.street(), tmp_path / "street.ply")
    build = WorldBuild([scene], config, open_store(tmp_path / "store"), Workers(), silent)
    views, held = [np.zeros((0, 3))], np.zeros(len(eyes), bool)
    for k in sorted(build.searched):
        rect = build.tiles[k]
        assert rect is not None
        witnesses = _witnesses(build.witnesses_in(rect))
        views.append(np.zeros((0, 3)) if witnesses is None else witnesses.cameras.viewpoints)
        if build.levels[f"space {k}"].facts["voxels"]:
            space = load_space(build.store.path_of(build.levels[f"space {k}"].files["space"], Path()))
            held |= space.contains(eyes)
    judges = np.concatenate(views)
    np.testing.assert_allclose(judges[judges[:, 0].argsort()], eyes[1::2], atol=1e-6)
    assert held[::2].all()


def test_the_space_around_an_object_takes_no_more_memory_than_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Eyes around an object need a grid beyond it: voxels as small as for rooms would take three times as much."""

    def has_neither(*_: object) -> None:
        raise SceneError("no room and no open ground")

    monkeypatch.setattr("gsvis.scene.navigable.find_mixed", has_neither)
    monkeypatch.setattr("gsvis.scene._eyes.is_rooms", lambda _: False)
    monkeypatch.setattr("gsvis.scene._eyes.find_kind", lambda found: SpaceKind("object", "for this test", found))
    g = nested_shells(4_000, sh_degree=0).gaussians
    params: dict[str, Any] = {
        "low": [-9.0, -9.0], "high": [9.0, 9.0], "axes": [0, 1], "up": [0.0, 0.0, 1.0], "resolution": 160, "around": 1.0
    }  # fmt: skip
    tracemalloc.start()
    try:
        space = space_of_tile(g, params)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert space is not None
    assert space.kind.kind == "object"
    assert peak <= needed_memory("gsvis.world.tiles:tile_space", params, [{"gaussians": len(g)}])


def test_options_that_tiles_do_not_take_are_refused() -> None:
    package = cities.config().package
    coarse = replace(package, colors=replace(package.colors, precision="coarse"))
    with pytest.raises(ValueError, match="package: expected colors of the precision 'wire' in tiles, got 'coarse'"):
        replace(cities.config(), package=coarse)
    with pytest.raises(ValueError, match="package: expected no color_steps, got 7; tiles keep the fit"):
        replace(cities.config(), package=replace(package, color_steps=7))
    with pytest.raises(ValueError, match="package: expected no record_psnr, got one; records of tiles keep all bits"):
        replace(cities.config(), package=replace(package, colors=replace(package.colors, record_psnr=48.0)))


@pytest.mark.parametrize("loss", [0.5, float("inf")])
def test_tiles_take_over_how_colors_are_fitted(loss: float) -> None:
    package = cities.config().package
    colors = replace(package.colors, fit=replace(package.colors.fit, width_loss=loss))
    written = json.loads(json.dumps(replace(package, colors=colors).as_dict(), allow_nan=False))
    assert config_of(written).colors.fit == colors.fit
