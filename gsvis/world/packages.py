"""Task: prepare the package of a tile, and the table of what its cells see outside it. Scene frame and units."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from gsvis.errors import SceneError
from gsvis.files.limits import read_whole
from gsvis.jobs.cost import IDLE, memory_error
from gsvis.jobs.graph import TOO_LARGE, Facts, Given
from gsvis.package import Package
from gsvis.prepare.memory import kept_memory
from gsvis.prepare.prepare import finish_package, stages_of
from gsvis.prepare.stages import VERSIONS as STAGES
from gsvis.prepare.surroundings import Surroundings
from gsvis.progress import silent
from gsvis.pvs.config import PvsConfig
from gsvis.scene.cameras import Cameras, intrinsics
from gsvis.scene.levels import Levels
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.witnesses import Witnesses
from gsvis.world.bare import PACKAGE, facts_of_package, reach_of, write_bare_package
from gsvis.world.pieces import free_box, join_surroundings, part_of_district, parts_of_tile
from gsvis.world.rows import load_gaussians, load_tile_levels
from gsvis.world.tiles import config_of, load_space

__all__ = ["MEMORY", "VERSIONS", "prepare_tile", "tile_memory"]

VERSIONS = {"prepare_tile": [4, {name: version for name, version in STAGES.items() if name != "levels"}]}

_HELD = 60 << 20  # bytes that a worker still holds from earlier tasks

# Bytes of memory: for each Gaussian in and around a tile; for each Gaussian of its largest level, by method of the
# visible sets (docs/design/070); for each pixel of a look.
_JOINT = 120
_LEVEL = {"hybrid": 420, "raster": 650, "raycast": 910}
_PIXEL = 6 * 64
_NEAR = 12  # number of tiles around a tile that count as near
_STANDS = 0.75  # largest share of a near tile's Gaussians that is used around a tile
_FAR_STANDS = 0.4  # the same for farther tiles


def prepare_tile(params: Facts, given: Given, out: Path, work: Path) -> Facts:
    """Task: write the package of a tile, and the store of what its cells see outside it.

    Inputs: the levels of the tile, its space, then the levels of tiles and the districts around it. Params: `around`,
    the node of each of these; `angle`; `config`; `name`; `up`; `reach` of base colors in the world; `outside`, True for
    the tile without squares, which has no space; `witnesses`, world-to-camera matrices of cameras that judge.

    Facts: those of the package, the number of cells, and the pieces.
    """
    levels = load_tile_levels(given.path(0, "levels"))
    config = config_of(params["config"])
    if params["outside"] or not given.inputs[1].facts["voxels"]:
        return _write_bare(params, levels, out)
    space = replace(load_space(given.path(1, "space")), witnesses=_witnesses(params))
    target = work / f"{PACKAGE}.gsvis"
    about = json.loads(read_whole(given.path(0, "quality.json")))
    stages = stages_of(levels, target, space, config, photos=None, progress=silent)
    stages.reach = reach_of(params)
    stages.one_level = True
    stages.judges = params["judges"]
    stages.around, pieces = _surroundings(params, given, levels, space)
    if stages.around is not None:
        _check_memory(stages.around, levels, params, given)
    try:
        made = finish_package(stages, target, about={"tile": params["name"], "trained": about})
    except SceneError:  # all eyes are inside solid matter
        return _write_bare(params, levels, out)
    shutil.copytree(target, out / PACKAGE)
    if made.around is not None:
        shutil.copyfile(made.around, out / "beyond")
    with Package.open(out / PACKAGE) as package:
        facts = facts_of_package(package, levels)
        cells = len(package.visibility)
    return {**facts, "cells": cells, "pieces": pieces, "judged": made.judged}


def _witnesses(params: Facts) -> Witnesses | None:
    """Return the cameras that judge a tile; None without any. Their image sizes do not matter."""
    views = params.get("witnesses")
    if not views:
        return None
    cameras = Cameras(views, np.tile(intrinsics(64, 48, 60.0), (len(views), 1, 1)), 64, 48)
    return Witnesses(cameras, "the cameras given")


def _surroundings(
    params: Facts, given: Given, levels: Levels, space: NavigableSpace
) -> tuple[Surroundings | None, list[Facts]]:
    """Return the Gaussians around a tile (None if there are none), and the pieces that they consist of."""
    box = free_box(space)
    around = list[Surroundings]()
    pieces = list[Facts]()
    for k, node in enumerate(params["around"], start=2):
        if "spacings" in given.inputs[k].facts:
            other = load_tile_levels(given.path(k, "levels"))
            spacings = given.inputs[k].facts["spacings"]
            found = list(parts_of_tile(other, spacings, len(levels), box, params["angle"]))
        else:
            found = [part_of_district(load_gaussians(given.path(k, "district")), len(levels))]
        around += [part.around for part in found]
        pieces += [{"node": node, "level": part.level, "runs": part.runs} for part in found]
    return (join_surroundings(around) if around else None), pieces


def _check_memory(around: Surroundings, levels: Levels, params: Facts, given: Given) -> None:
    """Raise unless a tile and its surroundings fit the memory of a worker."""
    if given.max_memory is None:
        return
    own = len(levels.union)
    count = len(levels.union) + len(around)
    sets = config_of(params["config"]).sets
    degree = levels.union.sh_degree
    needed = tile_memory(own, around.joined_counts(levels), count, degree, sets)
    if needed > given.max_memory:
        what = f"a worker with the {count:,} Gaussians in and around tile {params['name']}"
        raise memory_error(needed, given.max_memory, what, TOO_LARGE)


def _write_bare(params: Facts, levels: Levels, out: Path) -> Facts:
    """Write a package without cells; return its facts."""
    shutil.rmtree(out / PACKAGE, ignore_errors=True)
    _, facts = write_bare_package(out, levels, params["up"], params["config"]["meters_per_unit"], reach_of(params))
    return {**facts, "cells": 0, "pieces": []}


def tile_memory(own: int, counts: Sequence[int], joint: int, sh_degree: int, sets: PvsConfig) -> int:
    """Return the bytes of a worker while it makes the package of a tile.

    Args:
        own: Gaussians of all levels of the tile together.
        counts: Gaussians in and around it, in each level, lowest first.
        joint: Gaussians in and around it, of all levels together.
        sh_degree: SH degree of the scene.
        sets: How visible sets are found.
    """
    looks = _LEVEL[sets.method] * max(counts) + _PIXEL * sets.size**2
    return _HELD + kept_memory(own, sh_degree) + _JOINT * joint + looks


def _memory_of_tile(params: Facts, inputs: Sequence[Facts]) -> int:
    """Return the bytes that `prepare_tile` needs."""
    own = inputs[0]["gaussians"]
    if params["outside"] or not inputs[1]["voxels"]:
        return int((150 << 20) + 500 * own)
    around = _count_around([each for each in inputs[2:] if "spacings" in each])
    around += sum(each["gaussians"] for each in inputs[2:] if "spacings" not in each)
    sets = PvsConfig(**params["config"]["sets"])
    joint = own + around
    return tile_memory(own, [joint], joint, 0, sets) - IDLE


def _count_around(tiles: Sequence[Facts]) -> int:
    """Return how many Gaussians of the tiles around a tile may be used at most; of farther tiles fewer are used."""
    largest = sorted(tiles, key=lambda tile: tile["gaussians"], reverse=True)
    shares = [_STANDS if k < _NEAR else _FAR_STANDS for k in range(len(largest))]
    return sum(
        max(int(tile["levels"][0][1]), int(share * tile["gaussians"]))
        for tile, share in zip(largest, shares, strict=True)
    )


MEMORY = {"prepare_tile": _memory_of_tile}
"""The bytes that tasks need beyond an idle process."""
