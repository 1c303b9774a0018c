"""Districts: a few Gaussians that replace a tile, or neighboring tiles, when seen from far. Scene frame and units.

They are made bottom-up: the district of a tile from its lowest level, a larger one from the two to four districts in
it.
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

_TURNS = 16  # steps of a quaternion component from 0 to its largest value
_OCTAVE = 4  # steps of a scale in an octave
_SHADES = 255  # last index of the table of a component of base colors
_STEP = 4  # one of so many indices is used


def make_district(params: Facts, given: Given, out: Path, work: Path) -> Facts:
    """Task: merge the lowest level of a tile, or the districts of the inputs, to at most `most` Gaussians.

    Write the Gaussians in the order of their package, and the package.
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
    """Return a scene merged to at most `most` Gaussians; a scene that has no more is returned unchanged."""
    if len(g) <= most:
        return g
    different = len(np.unique(g.means, axis=0))
    return merge_gaussians(g, min(most, different))


def round_shapes(g: Gaussians) -> Gaussians:
    """Return a scene with scales rounded to quarters of an octave, and orientations to a few degrees.

    Finer values are not visible in Gaussians that are a few pixels wide. Fewer different values also make the coding
    tables of a stream better for all nodes.
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
    """Return a scene with base colors rounded to every fourth entry of the color tables, as streams round them.

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
    """Return the bytes that `make_district` needs."""
    return int((130 << 20) + 900 * _count_lowest(inputs))


def _count_lowest(nodes: Sequence[Facts]) -> int:
    """Return the number of Gaussians in the lowest levels of tiles and in districts."""
    return sum(each["levels"][0][1] if "spacings" in each else each["gaussians"] for each in nodes)


MEMORY = {"make_district": _memory_of_district}
"""The bytes that tasks need beyond an idle process."""
