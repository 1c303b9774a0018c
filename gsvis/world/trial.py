"""Try a few tiles of a world: where eyes may be in them, and what views, looks and a cell take there.

Times are processor time of one core, so they follow the machine and not what else it does. Scenes are read once more
for the rows of these tiles. Scene frame and units.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numba import get_num_threads, set_num_threads

from gsvis.errors import SceneError
from gsvis.io.batches import read_batch
from gsvis.prepare.config import PrepareConfig
from gsvis.pvs.build import plan_work
from gsvis.pvs.cell_count import MOST_CELLS
from gsvis.pvs.cells import MAX_CELLS, CellGrid
from gsvis.render.rasterizer import rasterize
from gsvis.render.removal import removal_effects
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.in_sight import InSight
from gsvis.scene.levels import Levels
from gsvis.scene.navigable import NavigableSpace
from gsvis.train.choosing import count_looks
from gsvis.train.level_views import views_to_choose, views_to_train
from gsvis.train.levels import LevelsConfig, frozen_sizes
from gsvis.world.build import WorldBuild
from gsvis.world.rows import flatten, load_gaussians
from gsvis.world.tiles import near_tile, space_of_tile
from gsvis.world.tiling import tiles_of

__all__ = ["Trial", "try_tiles"]

_clock = time.process_time  # tests set another

_MOST_TILES = 8  # tiles that are read
_TIMED = 6  # views and looks of a tile; one more before them loads the kernels
_POLLED = 16  # cameras from which the number of looks is found
_STAYS = 0.5  # share of the Gaussians that mostly stand in a look that chooses
_FAINT = 0.02  # presence of the others
_SEED = 3
_GOLDEN = 0.5 * (5.0**0.5 - 1.0)  # steps of this share of the tiles spread the tried ones, however many they are


@dataclass(frozen=True)
class Trial:
    """What the preparation of a tile takes, mean of the tried ones, in seconds of one core.

    Attributes:
        eyes: Share of the tiles with room for eyes.
        space: To find where eyes may be.
        view: A view to train on.
        choice: The looks that choose the Gaussians of all lower levels; 0 without levels.
        cells: Cells of a tile with room for eyes.
        cell: To find the set of a cell, its share of the shared looks included.
        tiles: Tiles of which views were timed; if 0, all times but `space` come from constants.
    """

    eyes: float
    space: float
    view: float
    choice: float
    cells: float
    cell: float
    tiles: int = 0


@dataclass(frozen=True, eq=False)
class _Tile:
    """The rows of a tile, and those in the margin around it without SH."""

    own: Gaussians
    near: Gaussians


def try_tiles(build: WorldBuild, expected: Trial, most: int, budget: float) -> Trial:
    """Return `expected` with what a few tiles say in its place, as far as a budget allows.

    Args:
        build: The preparation; its survey runs if it has not.
        expected: Times by constants.
        most: Most Gaussians around a tile.
        budget: Seconds of processor. What is expected to exceed it is not begun.
    """
    began, config = _clock(), build.config.package
    tiles = build.grid["tiles"]
    order = (np.arange(1, 4 * _MOST_TILES) * _GOLDEN % 1.0 * len(tiles)).astype(int)
    room = int(0.5 * budget / expected.space)
    chosen = list(dict.fromkeys(order.tolist()))[: min(_MOST_TILES, room)]
    with _one_thread():
        rows = _read_tiles(build, chosen)
        spaces, taken = [], []
        for number in chosen:
            start = _clock()
            own, near = rows[number].own, rows[number].near
            params = build.square_of(tiles[number])
            spaces.append(space_of_tile(Gaussians.concatenate([flatten(own), near]), params))
            taken.append(_clock() - start)
        if not chosen:
            return expected
        found = replace(expected, eyes=float(np.mean([space is not None for space in spaces])))
        found = replace(found, space=float(np.median(taken)))
        views, cells = list[tuple[float, float]](), list[tuple[int, float]]()
        last, last_cell = 0.0, 0.0  # what the tile before has taken
        for number, space in zip(chosen, spaces, strict=True):
            left = budget - (_clock() - began)
            if space is None or left < max(last, _TIMED * 3.0 * expected.view):
                continue
            with suppress(SceneError):  # no eye stands outside of everything solid
                start = _clock()
                views.append(_time_views(rows[number].own, space, config))
                last = _clock() - start
                if left - last > max(last_cell, expected.cell):
                    start = _clock()
                    cells.append(_time_cell(rows[number], _others(build, number, most), space, config))
                    last_cell = _clock() - start
    if views:
        view, choice = np.mean(views, axis=0).tolist()
        found = replace(found, view=view, choice=choice, tiles=len(views))
    if cells:
        found = replace(found, cells=float(np.mean([n for n, _ in cells])), cell=float(np.mean([s for _, s in cells])))
    return found


@contextmanager
def _one_thread() -> Iterator[None]:
    """Run kernels in one thread, as each worker does, so that processor time is time."""
    before = get_num_threads()
    set_num_threads(1)
    try:
        yield
    finally:
        set_num_threads(before)


def _read_tiles(build: WorldBuild, chosen: list[int]) -> dict[int, _Tile]:
    """Return the rows of some tiles; batches whose sample has none of them are not read."""
    squares = {k: build.square_of(build.grid["tiles"][k]) for k in chosen}
    own: dict[int, list[Gaussians]] = {k: [] for k in chosen}
    near: dict[int, list[Gaussians]] = {k: [] for k in chosen}
    for number, batch in enumerate(build.batches):
        sample = _sample(build, number)
        if sample is None or not any(near_tile(sample.means, square).any() for square in squares.values()):
            continue
        g = read_batch(batch)
        keys = tiles_of(g.means, build.grid)
        for k, square in squares.items():
            own[k].append(g[keys == k])
            near[k].append(flatten(g[(keys != k) & (keys >= 0) & near_tile(g.means, square)]))
    return {k: _Tile(Gaussians.concatenate(own[k]), Gaussians.concatenate(near[k])) for k in chosen}


def _sample(build: WorldBuild, number: int) -> Gaussians | None:
    """Return the sample of a batch; None if it is empty."""
    result = build.survey[f"sample {number}"]
    if not result.facts["sampled"]:
        return None
    with tempfile.TemporaryDirectory(prefix="gsvis-") as cache:
        return load_gaussians(build.store.path_of(result.files["sample"], Path(cache)))


def _others(build: WorldBuild, number: int, most: int) -> Gaussians:
    """Return at most so many Gaussians of the samples beyond a tile and its margin: what stands around it, thinly."""
    square, found = build.square_of(build.grid["tiles"][number]), []
    for k in range(len(build.batches)):
        sample = _sample(build, k)
        if sample is not None:
            found.append(sample[~near_tile(sample.means, square)])
    joined = Gaussians.concatenate(found)
    return joined[:: max(1, -(-len(joined) // max(most, 1)))]


def _time_views(g: Gaussians, space: NavigableSpace, config: PrepareConfig) -> tuple[float, float]:
    """Return what a view to train on takes, and all looks that choose the Gaussians of lower levels."""
    cameras = replace(views_to_train(config.level_views), count=_TIMED + 1).cameras(g, space)
    times = []
    for c in range(_TIMED + 1):
        began = _clock()
        rasterize(g, cameras[c])
        times.append(_clock() - began)
    view, levels = float(np.mean(times[1:])), config.levels
    if levels is None:
        return view, 0.0
    counts = frozen_sizes(levels.fit_to(len(g)).sizes(len(g)))
    many = views_to_choose(config.level_views)
    polled = replace(many, count=_POLLED).cameras(g, space)
    looks, _ = count_looks(g, polled, counts, of=many.count, space=space)
    sight, times = InSight.from_scene(g, space), []
    stands = np.random.default_rng(_SEED).random(len(g)) < _STAYS
    presence = np.where(stands, 1.0, _FAINT)
    for c in range(_TIMED + 1):
        began = _clock()
        some = np.flatnonzero(sight.of(polled[c]))
        removal_effects(g[some], polled[c], presence=presence[some])
        times.append(_clock() - began)
    return view, looks * float(np.mean(times[1:]))


def _time_cell(tile: _Tile, others: Gaussians, space: NavigableSpace, config: PrepareConfig) -> tuple[int, float]:
    """Return the number of cells of a tile, and the seconds of one cell with its share of the shared looks."""
    joint = _stand_in(Gaussians.concatenate([flatten(tile.own), tile.near, others]), config.levels)
    size = config.cell_size
    most = (config.cells or MOST_CELLS) if size is None else MAX_CELLS
    grid = CellGrid.over(space, max_cells=most, cell_size=size)
    with tempfile.TemporaryDirectory(prefix="gsvis-") as folder:
        work = plan_work(joint, grid, space, Path(folder) / "sets.pvs", config.sets)
        finder, shared = work.scene.finder(), work.shared
    finder.warm()
    cell, seen = len(grid) // 2, []
    looks: tuple[list[float], list[float]] = ([], [])  # coarse ones, fine ones
    for k in shared.of_cell(cell).tolist():
        began = _clock()
        seen.append(finder.look(shared.points[k], fine=bool(shared.fine[k])))
        looks[bool(shared.fine[k])].append(_clock() - began)
    began = _clock()
    finder.find_cell(work.viewpoints.voxels(cell), seen)
    finding = _clock() - began
    fine = int(np.count_nonzero(shared.fine))
    every = [*looks[0], *looks[1]]
    looking = fine * float(np.mean(looks[1] or every)) + (len(shared) - fine) * float(np.mean(looks[0] or every))
    return len(grid), finding + looking / len(grid)


def _stand_in(g: Gaussians, levels: LevelsConfig | None) -> Levels:
    """Return levels of about the right sizes, from the Gaussians that cover most; a lower level is part of the next."""
    if levels is None:
        return Levels.single(g)
    strength = g.opacities * np.sort(g.scales, axis=1)[:, 1:].prod(axis=1)
    rank = np.empty(len(g))
    rank[np.argsort(-strength, kind="stable")] = (np.arange(len(g)) + 0.5) / len(g)
    top = len(levels.shares)
    first = np.searchsorted(levels.shares, rank).astype(np.uint8)
    return Levels(g, first, np.full(len(g), top, np.uint8), levels.names)
