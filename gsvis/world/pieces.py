"""Choose the surroundings of a tile: nodes, and the part of each at a level that suits its distance.

The search goes from the coarsest district to finer ones. A node may be used if its spacing, divided by its distance
from the space of the eyes in the tile, is below an angle. Nodes that no eye sees in a coarse rendering are left out,
unless they are near. Scene frame and units.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsvis.jobs.graph import Facts, Given
from gsvis.prepare.surroundings import Surroundings
from gsvis.pvs.look import Look
from gsvis.raycast.tracer import TAU
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.solid import Solid
from gsvis.world.rows import flatten, load_gaussians, load_tile_levels
from gsvis.world.standing import distances_of, nodes_around, own_districts
from gsvis.world.tiles import load_space

__all__ = [
    "BLOCK",
    "MEMORY",
    "VERSIONS",
    "Part",
    "Runs",
    "choose_nodes",
    "free_box",
    "join_surroundings",
    "part_of_district",
    "parts_of_tile",
    "runs_of",
]

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Mask = NDArray[np.bool_]
Runs = list[tuple[int, int]]
"""(first id, count), ascending."""

VERSIONS = {"choose_nodes": 2}

_BESIDE = 0.5  # largest distance of eyes from the Gaussians of their tile, as a share of its longest side

BLOCK = 256
"""Consecutive ids that get the same level; they are near each other along the Morton curve of a package."""

_SIZE = 256  # pixels of the faces of a coarse look
_SEED = 7


@dataclass(frozen=True, eq=False)
class Part:
    """A part of a node around a tile.

    Attributes:
        level: Highest level of the node that is used.
        runs: Ids of the part in the package of the node.
        around: The same Gaussians, assigned to the levels of the tile.
    """

    level: int
    runs: Runs
    around: Surroundings


def choose_nodes(params: Facts, given: Given, out: Path, work: Path) -> Facts:
    """Task: choose the nodes around a tile. Inputs: the tile's levels and space, then all districts.

    Params: `tile`, number of the tile; `tiles`, number of tiles; `districts`, children and tiles of each; `angle`;
    `looks`.
    Facts: `tiles`, numbers of the tiles that are used themselves; `districts`, numbers of the districts that are used;
    `unseen`, how many were left out.
    """
    space = load_space(given.path(1, "space"))
    low, high = free_box(space)
    facts = [each.facts for each in given.inputs[2:]]
    own = own_districts(params["districts"])
    distances = distances_of(low, high, facts)
    districts, tiles = nodes_around(params, facts, distances)
    stand = [*districts, *(own[k] for k in tiles)]
    scenes = {k: load_gaussians(given.path(2 + k, "district")) for k in stand}
    seen = _look_coarsely(load_tile_levels(given.path(0, "levels")), space, scenes, params["looks"])
    near = float(np.max(high - low))
    return {
        "districts": [k for k in districts if k in seen],
        "tiles": [k for k in tiles if own[k] in seen or distances[own[k]] < near],
        "unseen": len([k for k in stand if k not in seen]),
    }


def parts_of_tile(
    levels: Levels, spacings: Sequence[float], target: int, box: tuple[F64, F64], angle: float
) -> Iterator[Part]:
    """Yield the parts of a tile that are used around a second tile, the highest level first.

    Args:
        levels: The levels of the tile, in the order of its package.
        spacings: Spacing of each level.
        target: Number of levels of the second tile.
        box: Corners (3,) of the box of the eyes in the second tile.
        angle: Largest spacing over distance, radians.
    """
    means = levels.union.means.astype(np.float64)
    away = np.linalg.norm(np.maximum(np.maximum(means - box[1], box[0] - means), 0.0), axis=1)
    blocks = np.arange(len(means)) // BLOCK
    nearest = np.minimum.reduceat(away, np.arange(0, len(means), BLOCK))[blocks]
    deserved = np.full(len(means), len(levels) - 1)
    for level in range(len(levels) - 2, -1, -1):
        deserved[spacings[level] <= angle * nearest] = level
    for level in range(len(levels) - 1, -1, -1):
        part = _chosen_part(levels, deserved == level, level, target)
        if part is not None:
            yield part


def part_of_district(g: Gaussians, target: int) -> Part:
    """Return a whole district as a part around a tile with `target` levels."""
    first = np.zeros(len(g), np.uint8)
    last = np.full(len(g), target - 1, np.uint8)
    return Part(0, [(0, len(g))], Surroundings(g, first, last))


def join_surroundings(around: Sequence[Surroundings]) -> Surroundings:
    """Return several surroundings of a tile as one."""
    return Surroundings(
        Gaussians.concatenate([flatten(each.gaussians) for each in around]),
        np.concatenate([each.first for each in around]),
        np.concatenate([each.last for each in around]),
    )


def runs_of(mask: Mask) -> Runs:
    """Return the runs of True in a mask (N,)."""
    edges = np.flatnonzero(np.diff(mask, prepend=False, append=False))
    return [(int(a), int(b - a)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _chosen_part(levels: Levels, chosen: Mask, level: int, target: int) -> Part | None:
    """Return chosen Gaussians of a tile up to a level, in the levels of a second tile; None if there are none.

    The highest level of both tiles is shown together, then the next lower one, and so on.

    Args:
        levels: Levels of the tile.
        chosen: (N,) Gaussians to use.
        level: Highest level to use.
        target: Number of levels of the second tile.
    """
    shown = [min(max(k - (target - 1) + (len(levels) - 1), 0), level) for k in range(target)]
    member = np.stack([levels.member(k) for k in shown])
    kept = chosen & member.any(axis=0)
    if not kept.any():
        return None
    member = member[:, kept]
    first = member.argmax(axis=0).astype(np.uint8)
    last = (target - 1 - member[::-1].argmax(axis=0)).astype(np.uint8)
    return Part(level, runs_of(kept), Surroundings(levels.union[kept], first, last))


def _look_coarsely(own: Levels, space: NavigableSpace, scenes: Mapping[int, Gaussians], looks: int) -> set[int]:
    """Return the numbers of the scenes that at least one of `looks` eyes in a space sees in a coarse rendering."""
    if not scenes:
        return set()
    parts = [flatten(own.level(0)), *scenes.values()]
    whole = Gaussians.concatenate(parts)
    ends = np.cumsum([len(part) for part in parts])
    eyes = space.sample_viewpoints(looks, np.random.default_rng(_SEED))
    look = Look(whole, "hybrid", _SIZE, TAU)
    solid = Solid.from_scene(whole)
    seen = set[int]()
    numbers = list(scenes)
    for eye in eyes[~solid.buries(eyes)]:
        ids, _ = look(eye)
        found = np.unique(np.searchsorted(ends, ids, side="right"))
        seen |= {numbers[k - 1] for k in found.tolist() if k}
    return seen


def free_box(space: NavigableSpace) -> tuple[F64, F64]:
    """Return the corners (3,) of the box around the free voxels."""
    voxels = np.argwhere(space.free)
    low = space.origin + space.voxel_size * voxels.min(axis=0)
    return np.asarray(low), np.asarray(space.origin + space.voxel_size * (voxels.max(axis=0) + 1))


def _memory_of_choice(params: Facts, inputs: Sequence[Facts]) -> int:
    """Return the bytes that `choose_nodes` needs: it reads the districts that may be used from any eye."""
    districts = inputs[2:]
    own = own_districts(params["districts"])
    low, high = (np.array(districts[own[params["tile"]]][name]) for name in ("low", "high"))
    beside = _BESIDE * float(np.max(high - low))
    standing, tiles = nodes_around(params, districts, distances_of(low - beside, high + beside, districts))
    stand = sum(districts[k]["gaussians"] for k in (*standing, *(own[tile] for tile in tiles)))
    return int((120 << 20) + 550 * (inputs[0]["levels"][0][1] + stand))


MEMORY = {"choose_nodes": _memory_of_choice}
"""The bytes that tasks need beyond an idle process."""
