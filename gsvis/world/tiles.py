"""The first tasks of a tile: join its rows, find the space for eyes in it, and make its levels.

Scene frame and units.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.color.fit import FitConfig
from gsvis.errors import ArgumentError, SceneError
from gsvis.files.archive import load_arrays, save_arrays
from gsvis.jobs.graph import Facts, Given
from gsvis.package import in_package_order
from gsvis.prepare.colors import ColorConfig
from gsvis.prepare.config import PrepareConfig
from gsvis.prepare.prepare import stages_of
from gsvis.prepare.stage_levels import run_levels
from gsvis.prepare.stages import VERSIONS as STAGES
from gsvis.progress import silent
from gsvis.pvs.config import PvsConfig
from gsvis.raycast.proxies import MIN_ALPHA
from gsvis.scene.corridor import space_along
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels
from gsvis.scene.navigable import MAX_RESOLUTION, NavigableSpace
from gsvis.scene.view_sampling import ViewSampling
from gsvis.train.levels import LevelsConfig
from gsvis.world.districts import merge_down
from gsvis.world.rows import flatten, load_gaussians, load_rows, median_spacing, save_gaussians, save_tile_levels
from gsvis.world.tiling import thin_out

__all__ = [
    "MARGIN",
    "MEMORY",
    "MOST_VOXELS",
    "SURROUNDINGS",
    "VERSIONS",
    "config_of",
    "cut_to_tile",
    "gather_rows",
    "load_space",
    "make_tile_levels",
    "near_tile",
    "save_space",
    "space_of_tile",
    "tile_space",
    "within_tile",
]

VERSIONS = {"gather_rows": 1, "make_tile_levels": [2, STAGES["levels"]], "tile_space": 8}

MOST_VOXELS = 1 << 23
"""Most voxels of the space of a tile and its surroundings, unless the resolution of the tile alone needs more."""

_VOXEL = 30  # bytes of memory for each voxel while a space is searched
_TRAINING = 160 << 20  # bytes of the gradients of a view
_IMAGE = 7  # bytes for each pixel of all training views; most views are smaller than the largest

MARGIN = 0.15
"""Width of the strip around a tile in which solid Gaussians count, as a share of its longer side."""

SURROUNDINGS = 1.0
"""Width of the strip around a tile that decides what kind of place it is and which space is enclosed, likewise."""

_SAMPLE = 1 << 19  # Gaussians in and around a tile of which all tell what kind of place it is
_COVERAGE = 0.98  # share of the centers inside the box of a grid on each axis


def gather_rows(params: Facts, given: Given, out: Path, work: Path) -> Facts:
    """Task: join the rows of a tile from all batches, ordered by content. `files` lists (input, name)."""
    g = load_rows([given.path(number, name) for number, name in params["files"]])
    save_gaussians(out / "rows", g)
    return {"gaussians": len(g)}


def tile_space(params: Facts, given: Given, out: Path, work: Path) -> Facts:
    """Task: find the space for eyes in the squares of a tile. Inputs: its rows, then those of the tiles around it.

    Params: `around`, width of the strip around the tile that counts, as a share of its longer side; `walk`, positions
        of
    a walk near the tile: eyes are within `margin` of them only; `seeds`, positions of cameras, around which eyes may
    be.

    Facts: `voxels`, the number of free voxels; 0 if there is no space.
    """
    parts = []
    for k in range(len(given)):
        g = load_gaussians(given.path(k, "rows"))
        parts.append(flatten(g if k == 0 else g[near_tile(g.means, params, params["around"])]))
    space = space_of_tile(Gaussians.concatenate(parts), params)
    if space is None:
        return {"voxels": 0}
    save_space(out / "space", space)
    return {"voxels": int(np.count_nonzero(space.free))}


def near_tile(means: NDArray[np.floating[Any]], params: Facts, margin: float = MARGIN) -> NDArray[np.bool_]:
    """Return whether each center (N, 3) is in a tile or in a margin around it, as a share of its longer side.

    `params` are those of `tile_space`.
    """
    low, high, axes = (np.array(params[name]) for name in ("low", "high", "axes"))
    margin = margin * float((high - low).max())
    across = means[:, axes]
    return np.asarray(((across >= low - margin) & (across < high + margin)).all(axis=1))


def space_of_tile(near: Gaussians, params: Facts) -> NavigableSpace | None:
    """Return the space for eyes in the squares of a tile, from the Gaussians in and around it; None if there is none.

    Eyes may be both in rooms and on open ground, because a tile alone does not show which of them its surroundings are.
    If there is neither, eyes are around the Gaussians, as around an object.
    """
    if "walk" in params and not params["walk"]:
        return None
    every = max(1, len(near) // _SAMPLE)
    sample = near if every == 1 else thin_out(near, every)
    fine = _resolution(sample, near_tile(sample.means, params), params["resolution"])
    parts = _coarsen_beyond(near[near.opacities >= MIN_ALPHA], params, every)
    found: NavigableSpace | None = None
    with suppress(SceneError):
        if "walk" in params:
            found = space_along(near, params["walk"], params["margin"], resolution=fine, up=params["up"])
        else:
            options = {"resolution": fine, "up": params["up"], "seeds": params.get("seeds")}
            found = NavigableSpace.from_parts(parts, sample, mixed=True, **options)
    if found is None and "walk" not in params:  # an object: the grid around it is larger, so its voxels are larger too
        with suppress(SceneError):
            found = NavigableSpace.from_parts(parts, sample, resolution=params["resolution"], up=params["up"])
    return None if found is None else within_tile(found, params)


def _coarsen_beyond(seen: Gaussians, params: Facts, every: int) -> list[Gaussians]:
    """Return Gaussians in two parts: those in a tile and its margin, and one in `every` of the others, wider.

    The others tell what the place around the tile is. There, walls count, and not how thick they are.
    """
    if every == 1:
        return [seen]
    close = near_tile(seen.means, params)
    far = thin_out(seen[~close], every)
    return [seen[close], replace(far, scales=far.scales * every**0.5)]


def within_tile(found: NavigableSpace, params: Facts) -> NavigableSpace | None:
    """Return a space that is free only inside the squares of a tile; None if nothing is."""
    low, high, axes = (np.array(params[name]) for name in ("low", "high", "axes"))
    free = found.free.copy()
    for axis, first, last in zip(axes.tolist(), low.tolist(), high.tolist(), strict=True):
        middles = found.origin[axis] + found.voxel_size * (np.arange(free.shape[axis]) + 0.5)
        shape = [1, 1, 1]
        shape[axis] = -1
        free &= ((middles >= first) & (middles < last)).reshape(shape)
    return cut_to_tile(replace(found, free=free), params) if free.any() else None


def cut_to_tile(space: NavigableSpace, params: Facts) -> NavigableSpace | None:
    """Return a space cut to a tile with its margin; None if nothing is free there."""
    low, high, axes = (np.array(params[name]) for name in ("low", "high", "axes"))
    margin = MARGIN * float((high - low).max())
    size = space.voxel_size
    first = np.zeros(3, int)
    last = np.array(space.free.shape)
    for axis, start, end in zip(axes.tolist(), low.tolist(), high.tolist(), strict=True):
        places = np.array([start - margin, end + margin]) - space.origin[axis]
        first[axis] = max(0, int(np.floor(places[0] / size)))
        last[axis] = min(int(last[axis]), int(np.ceil(places[1] / size)))
    some = tuple(slice(a, max(a, b)) for a, b in zip(first.tolist(), last.tolist(), strict=True))
    if not space.free[some].any():
        return None
    origin = space.origin + size * first
    inside = ((space.targets >= origin) & (space.targets < origin + size * (last - first))).all(axis=1)
    targets = space.targets[inside] if inside.any() else space.targets
    return replace(space, origin=origin, free=space.free[some], occupied=space.occupied[some], targets=targets)


def _resolution(near: Gaussians, own: NDArray[np.bool_], resolution: int) -> int:
    """Return the voxels along the longest side of the grid over a tile and its surroundings.

    Voxels have the size that gives `resolution` voxels along the tile (`own`), or a larger size to limit memory.
    """
    sides = _sides(near)
    tile = _sides(near[own])
    voxel_size = max(float(tile.max()) / resolution, float(np.cbrt(sides.prod() / MOST_VOXELS)))
    return int(np.clip(np.ceil(sides.max() / max(voxel_size, 1e-12)), resolution, MAX_RESOLUTION))


def _sides(g: Gaussians) -> NDArray[np.float64]:
    """Return the sides (3,) of the box around most of the centers."""
    low, high = g.bounds(_COVERAGE)
    return np.asarray(high - low, np.float64)


def save_space(path: Path, space: NavigableSpace) -> None:
    """Write a space for eyes."""
    arrays = {name: getattr(space, name) for name in ("origin", "free", "up", "occupied", "targets")}
    save_arrays(path, {**arrays, "voxel_size": np.array([space.voxel_size])})


def load_space(path: Path) -> NavigableSpace:
    """Return the space that `save_space` wrote.

    Raises:
        FormatError: If the file is damaged.
    """
    found = load_arrays(path, sealed=True)
    free, up, occupied, targets = (found[name] for name in ("free", "up", "occupied", "targets"))
    return NavigableSpace(found["origin"], float(found["voxel_size"][0]), free, up, occupied, targets)


def make_tile_levels(params: Facts, given: Given, out: Path, work: Path) -> Facts:
    """Task: make the levels of a tile from its rows and its space, in the order of a package.

    Without a space, or with one that is too small to train levels, the lower of two levels is the tile merged to `most`
    Gaussians. Using just its largest Gaussians would leave holes.

    Facts: names, sizes and spacings of the levels, and the record of their quality.
    """
    g = load_gaussians(given.path(0, "rows"))
    config = config_of(params["config"])
    levels = None
    quality = None
    if given.inputs[1:] and given.inputs[1].facts["voxels"]:
        levels, quality = _train_levels(g, load_space(given.path(1, "space")), config, work)
    if levels is None:
        levels = in_package_order(_merge_levels(g, params["most"]))
    save_tile_levels(out / "levels", levels)
    (out / "quality.json").write_text(json.dumps(quality), encoding="ascii")
    spacings = [median_spacing(levels.level(k)) for k in range(len(levels))]
    sizes = [[name, count] for name, count in zip(levels.names, levels.counts, strict=True)]
    return {"levels": sizes, "spacings": spacings, "gaussians": len(levels.union)}


def config_of(value: dict[str, Any]) -> PrepareConfig:
    """Return the options of a tile from `PrepareConfig.as_dict`, as JSON keeps them.

    All tiles have records of the usual precision, as those without eyes do, and learn no colors: `WorldConfig` takes
    nothing else.
    """
    colors = value["colors"]
    fit = dict(colors["fit"])
    if fit["decays"] is not None:
        fit["decays"] = tuple(fit["decays"])
    if fit["width_loss"] is None:  # JSON has no infinity
        fit["width_loss"] = math.inf
    return PrepareConfig(
        levels=None if value["levels"] is None else LevelsConfig(**value["levels"]),
        level_views=ViewSampling(**value["level_views"]),
        level_held_out=value["level_held_out"],
        cells=value["cells"],
        cell_size=value["cell_size"],
        sets=PvsConfig(**value["sets"]),
        colors=ColorConfig(
            FitConfig(**fit), ViewSampling(**colors["views"]), colors["rays_per_face"], colors["directions"]
        ),
        color_steps=0,
        epsilon=value["epsilon"],
        cost_views=ViewSampling(**value["cost_views"]),
        fidelity_views=ViewSampling(**value["fidelity_views"]),
        meters_per_unit=value["meters_per_unit"],
    )


def _train_levels(
    g: Gaussians, space: NavigableSpace, config: PrepareConfig, work: Path
) -> tuple[Levels | None, dict[str, Any] | None]:
    """Return the levels that `gsvis prepare` makes, and the record of their quality; (None, None) if it cannot."""
    try:
        stages = stages_of(g, work / "levels.gsvis", space, config, photos=None, progress=silent)
        with stages.work.opened():
            return run_levels(stages)
    except (SceneError, ArgumentError):
        return None, None


def _merge_levels(g: Gaussians, most: int) -> Levels:
    """Return a scene as two levels, the lower merged to at most `most` Gaussians; as one level if it has no more.

    The levels share no Gaussian, so a viewer who sees only one of them gets only that one.
    """
    if len(g) <= most:
        return Levels.single(g)
    low = merge_down(g, most)
    level = np.repeat(np.array([0, 1], np.uint8), [len(low), len(g)])
    return Levels(Gaussians.concatenate([low, g]), level, level, ("low", "high"))


def _memory_of_rows(params: Facts, inputs: Sequence[Facts]) -> int:
    """Return the bytes that `gather_rows` needs."""
    return int((10 << 20) + 250 * sum(inputs[number]["counts"][name] for number, name in params["files"]))


def _memory_of_space(params: Facts, inputs: Sequence[Facts]) -> int:
    """Return the bytes that `tile_space` needs."""
    counts = [each["gaussians"] for each in inputs]
    least = params["resolution"]
    side = min(MAX_RESOLUTION, 4 * params["resolution"])
    rows = 900 * counts[0] + 160 * max(counts) + 60 * sum(counts[1:])
    return int((80 << 20) + _VOXEL * min(max(MOST_VOXELS, least**3), side**3) + rows)


def _memory_of_levels(params: Facts, inputs: Sequence[Facts]) -> int:
    """Return the bytes that `make_tile_levels` needs."""
    count = inputs[0]["gaussians"]
    trained = params["config"]["levels"] is not None
    views = params["config"]["level_views"]
    images = _IMAGE * views["count"] * views["width"] * views["height"]
    return int((40 << 20) + (_TRAINING + images + 1400 * count if trained else 750 * count))


MEMORY = {"gather_rows": _memory_of_rows, "tile_space": _memory_of_space, "make_tile_levels": _memory_of_levels}
"""The bytes that tasks need beyond an idle process."""
