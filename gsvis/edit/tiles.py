"""Clean a tile of a scene: find what can go from it, with a halo of what lies around. Tasks of a graph. Scene frame.

Eyes are in the space of the tile and its halo. Eyes farther off are not looked from; whatever a ray connects with a
place at the height of eyes beyond the halo counts as seen, because what lies between is not known here.
"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsvis.edit.classes import KEPT, CleanConfig, class_of
from gsvis.edit.cleaning import clean, core_of
from gsvis.edit.evidence import part_of_backdrop
from gsvis.edit.shape import far_from
from gsvis.errors import SceneError
from gsvis.files.archive import save_arrays
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.inspection import axis_vector
from gsvis.scene.navigable import NavigableSpace
from gsvis.world.graph import Facts, Given
from gsvis.world.rows import content_order, load_gaussians
from gsvis.world.tiles import MARGIN, load_space, save_space
from gsvis.world.tiling import tiles_of

__all__ = ["VERSIONS", "clean_tile", "config_of", "find_eyes", "find_flyaways"]

VERSIONS = {"clean_tile": 1, "find_eyes": 1, "find_flyaways": 1}

U8 = NDArray[np.uint8]

_STEPS = 16  # voxels along the longer side of a tile with its halo, of the places of eyes elsewhere
_BASE, _BYTES = 500 << 20, 500  # memory of a process that cleans, and for each Gaussian (cli/memory.py)


def find_eyes(params: Facts, given: Given, out: Path, work: Path) -> Facts:
    """Task: find where eyes may be in a tile and its halo. Params: as for `clean_tile`, without `band`.

    Facts: the number of free voxels, 0 if there is none, and `low` and `high`, the heights of eyes in the tile.
    """
    own, halo, _ = _load(params, given)
    try:
        core = core_of(Gaussians.concatenate([own, *halo]))
        space = NavigableSpace.from_scene(core, up=axis_vector(params["up"]))
    except SceneError:
        return {"voxels": 0}
    save_space(out / "space", space)
    upright = 3 - sum(params["axes"])
    heights = np.flatnonzero(space.free.any(axis=tuple(axis for axis in range(3) if axis != upright)))
    low, high = space.origin[upright] + space.voxel_size * np.array([heights[0], heights[-1] + 1])
    return {"voxels": int(np.count_nonzero(space.free)), "low": float(low), "high": float(high)}


def clean_tile(params: Facts, given: Given, out: Path, work: Path) -> Facts:
    """Task: find the class of each Gaussian of a tile. Inputs are splits of batches, the grid, and the eyes.

    Params: `files` and `halo` list (input, name) of the rows of the tile and of those that touch it; `low`, `high` and
    `axes`, the rectangle of the tile; `up`; `grid` and `eyes`, the numbers of these inputs; `band`, the least and the
    largest height of eyes anywhere; `config`; `name`.

    Leaves "classes" with an array for each file of the tile. Facts: Gaussians found and removed of each class, and the
    cost of each.
    """
    own, halo, order = _load(params, given)
    config = config_of(params["config"])
    joint = Gaussians.concatenate([own, *halo])
    if given.max_memory is not None and _BASE + _BYTES * len(joint) > given.max_memory:
        fits = max(0, given.max_memory - _BASE) // _BYTES
        raise ValueError(
            f"tile {params['name']}: expected at most {fits:,} Gaussians in and around it for the memory, got"
            f" {len(joint):,}; raise --max-memory"
        )
    eyes = given.inputs[params["eyes"]]
    found = classes = np.zeros(len(own), np.uint8)
    costs: Facts = {}
    if eyes.facts["voxels"]:
        space = load_space(given.path(params["eyes"], "space"))
        try:
            result = clean(joint, navigable=space, config=config, elsewhere=_elsewhere(params, given))
        except SceneError:  # all eyes lie inside something solid: nothing is known
            pass
        else:
            inside = [each[: len(own)] for each in (result.found, result.classes)]
            found, classes = (np.where(each == class_of("flyaways"), np.uint8(KEPT), each) for each in inside)
            costs = {name: asdict(cost) for name, cost in result.costs.items()}
    unsorted = np.empty(len(own), np.uint8)
    unsorted[order] = classes
    _save(out, params, given, unsorted)
    facts = _counts(found, classes, config)
    return {**facts, "costs": costs, "around": len(joint) - len(own)}


def find_flyaways(params: Facts, given: Given, out: Path, work: Path) -> Facts:
    """Task: find the flyaways among what lies outside all tiles. Inputs are splits of batches, then all samples.

    Params: `files` of the outside; `samples`, the numbers of the other inputs; `config`. Leaves what `clean_tile` does.
    """
    config = config_of(params["config"])
    samples = [load_gaussians(given.path(k, "sample")) for k in params["samples"] if given.inputs[k].facts["sampled"]]
    low, high = Gaussians.concatenate(samples).bounds(0.98)
    g = Gaussians.concatenate([load_gaussians(given.path(number, name)) for number, name in params["files"]])
    far = np.flatnonzero(far_from(g.means, low, high))
    classes = np.zeros(len(g), np.uint8)
    if "flyaways" in config.classes:
        classes[far[~part_of_backdrop(g[far], 0.5 * (low + high))]] = class_of("flyaways")
    _save(out, params, given, classes)
    return {**_counts(classes, classes, config), "costs": {}, "around": 0}


def config_of(value: Facts) -> CleanConfig:
    """Return the options of a cleaning from their `asdict`, as JSON keeps them."""
    return CleanConfig(**{**value, "classes": tuple(value["classes"])})


def _load(params: Facts, given: Given) -> tuple[Gaussians, list[Gaussians], NDArray[np.int64]]:
    """Return the rows of a tile by content, those around it within the margin, and the order of the former."""
    joined = Gaussians.concatenate([load_gaussians(given.path(number, name)) for number, name in params["files"]])
    order = content_order(joined)
    low, high, axes = (np.array(params[name]) for name in ("low", "high", "axes"))
    margin = MARGIN * float((high - low).max())
    halo = []
    for number, name in params["halo"]:
        g = load_gaussians(given.path(number, name))
        across = g.means[:, axes]
        halo.append(g[((across >= low - margin) & (across < high + margin)).all(axis=1)])
    if halo:
        around = Gaussians.concatenate(halo)
        halo = [around[content_order(around)]]
    return joined[order], halo, order


def _elsewhere(params: Facts, given: Given) -> NavigableSpace | None:
    """Return the places of the world at the height of eyes that lie in tiles but beyond the halo; None for none."""
    low, high, axes = np.array(params["low"]), np.array(params["high"]), params["axes"]
    upright, margin = 3 - sum(axes), MARGIN * float((high - low).max())
    low, high = low - margin, high + margin
    size = float((high - low).max()) / _STEPS
    facts = given.inputs[params["grid"]].facts
    grid = facts["grid"]
    first, shape = np.array(grid["origin"]), np.ones(3, np.int64)
    first[upright] = params["band"][0]
    reach = grid["side"] * np.array(grid["shape"])
    shape[axes] = np.ceil(reach / size)
    shape[upright] = max(1, int(np.ceil((params["band"][1] - params["band"][0]) / size)))
    middles = first[axes] + size * (np.indices(tuple(shape[axes].tolist())).reshape(2, -1).T + 0.5)
    points = np.full((len(middles), 3), 0.5 * (facts["bottom"] + facts["top"]))
    points[:, axes] = middles
    beyond = ((middles < low) | (middles >= high)).any(axis=1) & (tiles_of(points, facts) >= 0)
    if not beyond.any():
        return None
    free = np.expand_dims(beyond.reshape(shape[axes]), upright)
    up = axis_vector(params["up"])
    return NavigableSpace(first, size, np.broadcast_to(free, shape), up)


def _save(out: Path, params: Facts, given: Given, classes: U8) -> None:
    """Write the classes of the rows of each file."""
    sizes = [given.inputs[number].facts["counts"][name] for number, name in params["files"]]
    parts = np.split(classes, np.cumsum(sizes)[:-1])
    names = [f"{batch} {name}" for batch, (_, name) in zip(params["batches"], params["files"], strict=True)]
    save_arrays(out / "classes", dict(zip(names, parts, strict=True)))


def _counts(found: U8, classes: U8, config: CleanConfig) -> Facts:
    return {
        "gaussians": len(classes),
        "kept": int(np.count_nonzero(classes == KEPT)),
        "found": {name: int(np.count_nonzero(found == class_of(name))) for name in config.classes},
        "removed": {name: int(np.count_nonzero(classes == class_of(name))) for name in config.classes},
    }
