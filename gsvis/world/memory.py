"""How much memory a task of a world needs, from names and sizes alone, before it runs.

Measured as the growth of a fresh process on tiles of copies of showroom, and rounded up (docs/results/world.md). Which
levels of other tiles stand around a tile is known when its package is made. Until then more than ever stood there
counts; the task checks its own need.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from gsvis.prepare.memory import kept_memory
from gsvis.pvs.config import PvsConfig
from gsvis.scene.navigable import MAX_RESOLUTION
from gsvis.world.standing import distances_of, nodes_around, own_districts

__all__ = ["IDLE", "MOST_VOXELS", "least_limit", "needed_memory", "tile_memory"]

Facts = dict[str, Any]

IDLE = 280 << 20
"""Bytes of a process that has loaded every library and runs no task."""

MOST_VOXELS = 1 << 23
"""Of the space of a tile and its surroundings, unless the resolution of the tile alone asks for more."""

_MB = 1 << 20
_GUESSED = 1 << 18  # Gaussians of a batch that only reading counts
_VOXEL = 30  # bytes of a voxel of a space, while it is looked for
_HELD = 60 * _MB  # bytes that earlier tasks leave in a worker
# gradients of a view; bytes for each pixel of all views, of which most are smaller
_TRAINING = 160 * _MB
_IMAGE = 7

# Bytes of the package of a tile: for each Gaussian in and around it; for each of the largest level, of which looks and
# tracer are in memory while it is looked at (docs/design/070); for each pixel of a look.
_JOINT = 120
_LEVEL = {"hybrid": 420, "raster": 650, "raycast": 910}
_PIXEL = 6 * 64
# most of a tile's Gaussians that stand: of a dozen tiles, of all others
_NEAR = 12
_STANDS = 0.75
_FAR_STANDS = 0.4
_BESIDE = 0.5  # how far beyond the Gaussians of a tile its eyes may be, at most, in its longest side


def needed_memory(run: str, params: Facts, inputs: Sequence[Facts]) -> int:
    """Return the bytes that a task needs beyond an idle process; 0 if nothing is known.

    Args:
        run: Its function, as `module:name`.
        params: Its values.
        inputs: Facts of the results that it reads.
    """
    known = _NEEDS.get(run)
    return 0 if known is None else known(params, inputs)


def tile_memory(own: int, counts: Sequence[int], joint: int, sh_degree: int, sets: PvsConfig) -> int:
    """Return the bytes of a worker while it makes the package of a tile.

    Args:
        own: Gaussians of all levels of the tile together.
        counts: Gaussians in and around it, in each level, lowest first.
        joint: Gaussians in and around it, of all levels together.
        sh_degree: Of the scene.
        sets: How visible sets are found.
    """
    looks = _LEVEL[sets.method] * max(counts) + _PIXEL * sets.size**2
    return _HELD + kept_memory(own, sh_degree) + _JOINT * joint + looks


def least_limit(task: int, tile: int, workers: int) -> int:
    """Return the least limit of all processes under which each task fits, one at a time.

    Args:
        task: Most bytes that a task needs beyond an idle process.
        tile: Bytes of a worker that makes a package, `tile_memory`.
        workers: Processes; 1 works in the process that gives out tasks.
    """
    idle = IDLE * (workers + 1 if workers > 1 else 1)
    return max(idle + task, idle - IDLE + tile)


def _batch(params: Facts, inputs: Sequence[Facts]) -> int:
    count = params["batch"]["count"]
    return int(10 * _MB + 200 * (count if count >= 0 else max(_GUESSED, params["batch"]["nbytes"] // 16)))


def _grid(params: Facts, inputs: Sequence[Facts]) -> int:
    return int(20 * _MB + 450 * sum(each["sampled"] for each in inputs))


def _rows(params: Facts, inputs: Sequence[Facts]) -> int:
    return int(10 * _MB + 250 * sum(inputs[number]["counts"][name] for number, name in params["files"]))


def _space(params: Facts, inputs: Sequence[Facts]) -> int:
    counts = [each["gaussians"] for each in inputs]
    least = params["resolution"]
    side = min(MAX_RESOLUTION, 4 * params["resolution"])
    rows = 900 * counts[0] + 160 * max(counts) + 60 * sum(counts[1:])
    return int(80 * _MB + _VOXEL * min(max(MOST_VOXELS, least**3), side**3) + rows)


def _levels(params: Facts, inputs: Sequence[Facts]) -> int:
    count = inputs[0]["gaussians"]
    trained = params["config"]["levels"] is not None
    views = params["config"]["level_views"]
    images = _IMAGE * views["count"] * views["width"] * views["height"]
    return int(40 * _MB + (_TRAINING + images + 1400 * count if trained else 750 * count))


def _district(params: Facts, inputs: Sequence[Facts]) -> int:
    return int(130 * _MB + 900 * _lowest(inputs))


def _around(params: Facts, inputs: Sequence[Facts]) -> int:
    """Return the bytes of a choice of nodes: of the districts it reads those that may stand, from wherever eyes are."""
    districts = inputs[2:]
    own = own_districts(params["districts"])
    low, high = (np.array(districts[own[params["tile"]]][name]) for name in ("low", "high"))
    beside = _BESIDE * float(np.max(high - low))
    standing, tiles = nodes_around(params, districts, distances_of(low - beside, high + beside, districts))
    stand = sum(districts[k]["gaussians"] for k in (*standing, *(own[tile] for tile in tiles)))
    return int(120 * _MB + 550 * (inputs[0]["levels"][0][1] + stand))


def _tile(params: Facts, inputs: Sequence[Facts]) -> int:
    own = inputs[0]["gaussians"]
    if params["outside"] or not inputs[1]["voxels"]:
        return int(150 * _MB + 500 * own)
    around = _count_standing([each for each in inputs[2:] if "spacings" in each])
    around += sum(each["gaussians"] for each in inputs[2:] if "spacings" not in each)
    sets = PvsConfig(**params["config"]["sets"])
    joint = own + around
    return tile_memory(own, [joint], joint, 0, sets) - IDLE


def _count_standing(tiles: Sequence[Facts]) -> int:
    """Return how many Gaussians of the tiles around one may stand there; the more there are, the farther most are."""
    largest = sorted(tiles, key=lambda tile: tile["gaussians"], reverse=True)
    shares = [_STANDS if k < _NEAR else _FAR_STANDS for k in range(len(largest))]
    return sum(
        max(int(tile["levels"][0][1]), int(share * tile["gaussians"]))
        for tile, share in zip(largest, shares, strict=True)
    )


def _lowest(nodes: Sequence[Facts]) -> int:
    """Return the Gaussians in the lowest levels of tiles, and in districts, which have one level."""
    return sum(each["levels"][0][1] if "spacings" in each else each["gaussians"] for each in nodes)


_NEEDS: dict[str, Callable[[Facts, Sequence[Facts]], int]] = {
    "gsvis.world.tiling:sample_rows": _batch,
    "gsvis.world.tiling:find_grid": _grid,
    "gsvis.world.tiling:split_batch": _batch,
    "gsvis.world.tiles:gather_rows": _rows,
    "gsvis.world.tiles:tile_space": _space,
    "gsvis.world.tiles:make_tile_levels": _levels,
    "gsvis.world.districts:make_district": _district,
    "gsvis.world.pieces:choose_nodes": _around,
    "gsvis.world.packages:prepare_tile": _tile,
}
