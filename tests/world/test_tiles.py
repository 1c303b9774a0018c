"""Tiles before anything is seen from them: what stands for a tile that nobody can be in."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from gsvis.files.objects import open_store
from gsvis.progress import silent
from gsvis.pvs.workers import Workers
from gsvis.scene.procedural import two_rooms
from gsvis.world.build import WorldBuild
from gsvis.world.rows import load_gaussians, load_tile_levels
from gsvis.world.tiles import load_space
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


def test_eyes_are_in_rooms_that_borders_cut(tmp_path: Path) -> None:
    """What a place is, and which space is enclosed, is seen with what lies around a tile."""
    scene = two_rooms(12_000, sh_degree=0)
    config = replace(cities.config(most=4_000), resolution=48)
    one = cities.write(scene.gaussians, tmp_path / "rooms.ply")
    build = WorldBuild([one], config, open_store(tmp_path / "store"), Workers(), silent)
    eyes = scene.navigable.sample_viewpoints(2_000, np.random.default_rng(0))
    found, inside, volume = build.levels, np.zeros(len(eyes), bool), 0.0
    for k in sorted(build.searched):
        if found[f"space {k}"].facts["voxels"]:
            space = load_space(build.store.path_of(found[f"space {k}"].files["space"], Path()))
            inside |= space.contains(eyes)
            volume += space.volume
    assert len(build.searched) >= 4
    assert inside.mean() >= 0.95
    assert volume <= 1.4 * scene.navigable.volume  # that of the scene keeps a quarter of a unit from all walls
