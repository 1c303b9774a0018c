"""Prepare the package of a tile, with what its cells see beyond it. Scene frame and units. A task of a graph."""

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

VERSIONS = {"prepare_tile": [3, {name: version for name, version in STAGES.items() if name != "levels"}]}

_HELD = 60 << 20  # bytes that earlier tasks leave in a worker

# Bytes of the package of a tile: for each Gaussian in and around it; for each of the largest level, of which looks and
# tracer are in memory while it is looked at (docs/design/070); for each pixel of a look.
_JOINT = 120
_LEVEL = {"hybrid": 420, "raster": 650, "raycast": 910}
_PIXEL = 6 * 64
# most of a tile's Gaussians that stand: of a dozen tiles, of all others
_NEAR = 12
_STANDS = 0.75
_FAR_STANDS = 0.4


def prepare_tile(params: Facts, given: Given, out: Path, work: Path) -> Facts:
    """Task: write the package of a tile, and the store of what its cells see beyond it.

    Inputs: its levels, its space, then the levels of tiles and the districts around it. Params: `around`, for each
    of these its node; `angle`; `config`; `name`; `up`; `reach`, of base colors in the world; `outside`, for the tile
    without squares and a space; `witnesses`, world to camera of cameras that judge.

    Facts: those of the package, the number of cells, and the pieces.
    """
    levels = load_tile_levels(given.path(0, "levels"))
    config = config_of(params["config"])
    if params["outside"] or not given.inputs[1].facts["voxels"]:
        return _bare(params, levels, out)
    space = replace(load_space(given.path(1, "space")), witnesses=_witnesses(params))
    target = work / f"{PACKAGE}.gsvis"
    about = json.loads(read_whole(given.path(0, "quality.json")))
    stages = stages_of(levels, target, space, config, photos=None, progress=silent)
    stages.reach = reach_of(params)
    stages.one_level = True
    stages.around, pieces = _surroundings(params, given, levels, space)
    if stages.around is not None:
        _check_memory(stages.around, levels, params, given)
    try:
        made = finish_package(stages, target, about={"tile": params["name"], "trained": about})
    except SceneError:  # no eye stands outside of everything solid
        return _bare(params, levels, out)
    shutil.copytree(target, out / PACKAGE)
    if made.around is not None:
        shutil.copyfile(made.around, out / "beyond")
    with Package.open(out / PACKAGE) as package:
        facts = facts_of_package(package, levels)
        cells = len(package.visibility)
    return {**facts, "cells": cells, "pieces": pieces, "judged": made.judged}


def _witnesses(params: Facts) -> Witnesses | None:
    """Return the cameras that judge a tile; None without any. Their sizes do not matter."""
    views = params.get("witnesses")
    if not views:
        return None
    cameras = Cameras(views, np.tile(intrinsics(64, 48, 60.0), (len(views), 1, 1)), 64, 48)
    return Witnesses(cameras, "the cameras given")


def _surroundings(
    params: Facts, given: Given, levels: Levels, space: NavigableSpace
) -> tuple[Surroundings | None, list[Facts]]:
    """Return what stands around a tile, None if nothing does, and the pieces that it consists of."""
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
    """Raise unless a tile and what stands around it fit the memory of a worker."""
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


def _bare(params: Facts, levels: Levels, out: Path) -> Facts:
    """Write a package without cells."""
    shutil.rmtree(out / PACKAGE, ignore_errors=True)
    _, facts = write_bare_package(out, levels, params["up"], params["config"]["meters_per_unit"], reach_of(params))
    return {**facts, "cells": 0, "pieces": []}


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


def _memory_of_tile(params: Facts, inputs: Sequence[Facts]) -> int:
    own = inputs[0]["gaussians"]
    if params["outside"] or not inputs[1]["voxels"]:
        return int((150 << 20) + 500 * own)
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


MEMORY = {"prepare_tile": _memory_of_tile}
"""The bytes that tasks need beyond an idle process."""
