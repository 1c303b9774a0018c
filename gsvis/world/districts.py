"""Districts: a few Gaussians that stand for a tile, or for a square of tiles, from afar. Scene frame and units.

They are made bottom-up: that of a tile from its lowest level, that of a square from its four children.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels
from gsvis.train.merge import merge_gaussians
from gsvis.world.bare import reach_of, write_bare_package
from gsvis.world.graph import Facts, Given
from gsvis.world.rows import content_order, flatten, load_gaussians, load_tile_levels, median_spacing, save_gaussians

__all__ = ["VERSIONS", "make_district", "merge_down"]

VERSIONS = {"make_district": 2}


def make_district(params: Facts, given: Given, out: Path, work: Path) -> Facts:
    """Task: merge the lowest level of a tile, or the districts of the inputs, to at most `most` Gaussians.

    Writes the Gaussians in the order of their package, and the package.
    """
    if params["of_tile"]:
        g = load_tile_levels(given.path(0, "levels")).level(0)
    else:
        g = Gaussians.concatenate([load_gaussians(given.path(k, "district")) for k in range(len(given))])
    g = flatten(g)
    merged = merge_down(g[content_order(g)], params["most"])
    about = params["up"], params["meters_per_unit"]
    levels, facts = write_bare_package(out, Levels.single(merged, "far"), *about, reach_of(params))
    save_gaussians(out / "district", levels.union)
    return {**facts, "spacing": median_spacing(levels.union)}


def merge_down(g: Gaussians, most: int) -> Gaussians:
    """Return a scene merged to at most `most` Gaussians, or as it is if it has no more."""
    if len(g) <= most:
        return g
    different = len(np.unique(g.means, axis=0))
    return merge_gaussians(g, min(most, different))
