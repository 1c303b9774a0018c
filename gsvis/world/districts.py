"""Districts: a few Gaussians that stand for a tile, or for tiles beside each other, from afar. Scene frame and units.

They are made bottom-up: that of a tile from its lowest level, that of several from the two to four below it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from gsvis.jobs.graph import Facts, Given
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels
from gsvis.scene.sh import SH_C0
from gsvis.train.merge import merge_gaussians
from gsvis.world.bare import Reach, reach_of, write_bare_package
from gsvis.world.rows import content_order, flatten, load_gaussians, load_tile_levels, median_spacing, save_gaussians

__all__ = ["MEMORY", "VERSIONS", "make_district", "merge_down", "round_colors", "round_shapes"]

VERSIONS = {"make_district": 3}

# steps of a component of a quaternion on each side of 0, and of a scale in an octave
_TURNS = 16
_OCTAVE = 4
# last place in the table of a component of base colors, and every how many are used
_SHADES = 255
_STEP = 4


def make_district(params: Facts, given: Given, out: Path, work: Path) -> Facts:
    """Task: merge the lowest level of a tile, or the districts of the inputs, to at most `most` Gaussians.

    Writes the Gaussians in the order of their package, and the package.
    """
    if params["of_tile"]:
        g = load_tile_levels(given.path(0, "levels")).level(0)
    else:
        g = Gaussians.concatenate([load_gaussians(given.path(k, "district")) for k in range(len(given))])
    g = flatten(g)
    merged = round_colors(round_shapes(merge_down(g[content_order(g)], params["most"])), reach_of(params))
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


def round_shapes(g: Gaussians) -> Gaussians:
    """Return a scene with scales rounded to quarters of an octave, and orientations to a few degrees.

    Nobody sees more of what is a few pixels wide. And each value that occurs takes a share of the tables by which a
    stream codes the records of all nodes.
    """
    scales = np.exp2(np.rint(_OCTAVE * np.log2(np.maximum(g.scales.astype(np.float64), 1e-30))) / _OCTAVE)
    quats = g.quats.astype(np.float64)
    rows = np.arange(len(g))
    largest = np.abs(quats).argmax(axis=1)
    quats *= np.where(quats[rows, largest] < 0.0, -1.0, 1.0)[:, None]
    step = np.sqrt(0.5) / _TURNS
    rounded = np.rint(quats / step) * step
    rounded[rows, largest] = 0.0
    squares = np.einsum("ij,ij->i", rounded, rounded)
    fits = squares < 1.0
    rounded[rows, largest] = np.sqrt(np.maximum(1.0 - squares, 0.0))
    return replace(g, quats=np.where(fits[:, None], rounded, quats), scales=scales)


def round_colors(g: Gaussians, reach: Reach) -> Gaussians:
    """Return a scene with base colors on every fourth place of the tables over a reach, as streams round them.

    Args:
        g: The scene.
        reach: Least and largest value of each component of base colors in the world.
    """
    low, high = np.array(reach, np.float64).T
    span = high - low
    colors = 0.5 + SH_C0 * g.sh0[:, 0].astype(np.float64)
    places = np.clip((colors - low) / np.where(span > 0.0, span, 1.0), 0.0, 1.0) * _SHADES
    rounded = np.minimum(_STEP * np.rint(places / _STEP), _SHADES - _SHADES % _STEP)
    sh0 = (low + span * rounded / _SHADES - 0.5) / SH_C0
    return replace(g, sh0=sh0[:, None])


def _memory_of_district(params: Facts, inputs: Sequence[Facts]) -> int:
    return int((130 << 20) + 900 * _lowest(inputs))


def _lowest(nodes: Sequence[Facts]) -> int:
    """Return the Gaussians in the lowest levels of tiles, and in districts, which have one level."""
    return sum(each["levels"][0][1] if "spacings" in each else each["gaussians"] for each in nodes)


MEMORY = {"make_district": _memory_of_district}
"""The bytes that tasks need beyond an idle process."""
