"""A world of a scene with view-dependent colors: terms in tiles with cells, base colors elsewhere."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from gsvis.color.fit import FitConfig
from gsvis.prepare.colors import ColorConfig
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.view_sampling import ViewSampling
from gsvis.world import World
from gsvis.world.prepare import prepare_world
from tests.world import cities


def test_tiles_with_cells_have_terms_and_districts_have_none(tmp_path: Path) -> None:
    g = cities.street()
    higher = 0.3 * np.random.default_rng(0).normal(size=(len(g), 3, 3))
    shiny = Gaussians(g.means, g.quats, g.scales, g.opacities, g.sh0, higher)
    config = cities.config(most=2000)
    colors = ColorConfig(FitConfig(max_terms=1, mean_terms=1.0), ViewSampling(2, 32, 24))
    config = replace(config, package=replace(config.package, colors=colors))
    prepare_world([cities.write(shiny, tmp_path / "s.ply")], tmp_path / "city.gsworld", config)
    world = World.open(tmp_path / "city.gsworld")
    world.verify()
    for node in range(len(world)):
        entry = world.manifest.node(node)
        with world.package(node) as package:
            assert (package.manifest.terms > 0) == bool(getattr(entry, "cells", 0)), node
