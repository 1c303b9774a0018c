"""Try a few tiles of a world: where eyes may be in them, what views, looks and a cell take there, and bytes of files.

Times are processor time of one core, so they follow the machine and not what else it does. Scenes are read once more
for the rows of these tiles. Scene frame and units.
"""

from __future__ import annotations

import time
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gsvis._kernels.threads import one_thread
from gsvis.errors import SceneError
from gsvis.files.temporary import temporary_folder
from gsvis.io.batches import read_batch
from gsvis.jobs.graph import Facts
from gsvis.prepare.coded_size import bytes_of_record
from gsvis.prepare.config import PrepareConfig
from gsvis.pvs.build import plan_work
from gsvis.pvs.cell_count import MOST_CELLS
from gsvis.pvs.cells import MAX_CELLS, CellGrid
from gsvis.render.rasterizer import rasterize
from gsvis.render.removal import removal_effects
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.in_sight import InSight
from gsvis.scene.navigable import NavigableSpace
from gsvis.train.choosing import count_looks
from gsvis.train.level_views import views_to_choose, views_to_train
from gsvis.train.levels import frozen_sizes
from gsvis.world.build import WorldBuild, far_from_walk
from gsvis.world.coding import (
    TileBytes,
    bytes_of_space,
    bytes_of_view,
    direction_sets,
    levels_of,
    surroundings_of,
)
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
_FEWEST = 64  # Gaussians of a tile; fewer have no levels
_OTHER_LOOKS = 8  # from other cells, for the bytes of direction sets
# what other cells add to these by rays; growth with the number of looks (design/089)
_MORE_EYES = 1.5
_GROWTH = 0.5
# Gaussians that are coded for their bytes, and tiles that they come from
_CODED = 1 << 16
_MOST_CODED = 4
_CODING = 2e-5  # seconds for each of them
_SEED = 3
_GOLDEN = 0.5 * (5.0**0.5 - 1.0)  # steps of this share of the tiles spread the tried ones, however many they are


@dataclass(frozen=True)
class Trial:
    """What the preparation of a tile takes, mean of the tried ones, in seconds of one core.

    Attributes:
        eyes: Share of the tiles with room for eyes.
        space: To find where eyes may be, mean of all tiles; no time where a walk is not near.
        view: A view to train on.
        choice: The looks that choose the Gaussians of all lower levels; 0 without levels.
        cells: Cells of a tile with room for eyes.
        cell: To find the set of a cell, its share of the shared looks included.
        nbytes: Bytes of its files.
        tiles: Tiles of which views were timed; if 0, all times but `space` come from constants.
    """

    eyes: float
    space: float
    view: float
    choice: float
    cells: float
    cell: float
    nbytes: TileBytes
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
    config = build.config.package
    with one_thread():
        _load_kernels(config)
    began = _clock()
    tiles = build.grid["tiles"]
    params = [build.space_params(rect) for rect in tiles]
    near = [k for k, each in enumerate(params) if each.get("walk", True)]
    if not near:
        raise far_from_walk()
    reached = len(near) / len(tiles)
    expected = replace(expected, eyes=reached * expected.eyes, space=reached * expected.space)
    order = (np.arange(1, 4 * _MOST_TILES) * _GOLDEN % 1.0 * len(near)).astype(int)
    room = int(0.5 * budget * reached / expected.space)
    chosen = [near[k] for k in dict.fromkeys(order.tolist())][: min(_MOST_TILES, room)]
    if not chosen:
        return expected
    tried = _Tried()
    with one_thread():
        rows = _read_tiles(build, chosen)
        spaces = {}
        for number in chosen:
            start = _clock()
            tile = rows[number]
            near_and_far = [flatten(tile.own), tile.near, _surroundings(build, params[number])]
            spaces[number] = space_of_tile(Gaussians.concatenate(near_and_far), params[number])
            tried.spaces.append(_clock() - start)
        if budget - (_clock() - began) > _CODED * _CODING:
            coded = [rows[k].own for k in chosen if len(rows[k].own) >= _FEWEST][:_MOST_CODED]
            part = _CODED // max(len(coded), 1)
            tried.records = [bytes_of_record(levels_of(flatten(own), config.levels), part) for own in coded]
        # what the tile before has taken
        last = 0.0
        last_cell = 0.0
        for number, space in spaces.items():
            left = budget - (_clock() - began)
            if space is None or left < max(last, _TIMED * 3.0 * expected.view) or len(rows[number].own) < _FEWEST:
                continue
            with suppress(SceneError):  # no eye stands outside of everything solid
                start = _clock()
                tried.views.append(_time_views(rows[number].own, space, config))
                last = _clock() - start
                if left - last > max(last_cell, expected.cell):
                    start = _clock()
                    tried.cells.append(_try_cell(rows[number], _others(build, number, most), space, config))
                    last_cell = _clock() - start
    found = [space for space in spaces.values() if space is not None]
    tried.rooms = [bytes_of_space(space) for space in found]
    eyes = reached * len(found) / len(chosen)
    taken = reached * float(np.median(tried.spaces))
    return tried.in_place_of(replace(expected, eyes=eyes, space=taken))


@dataclass
class _Tried:
    """What was tried in each tile."""

    spaces: list[float] = field(default_factory=list)
    views: list[tuple[float, float]] = field(default_factory=list)
    cells: list[_Cell] = field(default_factory=list)
    records: list[float] = field(default_factory=list)
    rooms: list[float] = field(default_factory=list)

    def in_place_of(self, found: Trial) -> Trial:
        """Return a trial with means of what was tried in place of what was expected."""
        nbytes = found.nbytes
        if self.views:
            view, choice = np.mean(self.views, axis=0).tolist()
            found = replace(found, view=view, choice=choice, tiles=len(self.views))
        if self.cells:
            cells, cell, directions, seen = np.mean(np.array(self.cells), axis=0).tolist()
            found = replace(found, cells=cells, cell=cell)
            nbytes = replace(nbytes, directions=directions, cell=seen)
        if self.records:
            nbytes = replace(nbytes, record=float(np.mean(self.records)))
        if self.rooms:
            nbytes = replace(nbytes, space=float(np.mean(self.rooms)))
        return replace(found, nbytes=nbytes)


class _Cell(NamedTuple):
    """What a cell of a tile takes.

    Attributes:
        cells: Cells of the tile.
        seconds: To find its set, its share of the shared looks included.
        directions: Bytes of the direction sets of the tile and of what stands around it.
        nbytes: Bytes of the set and its classes.
    """

    cells: float
    seconds: float
    directions: float
    nbytes: float


def _load_kernels(config: PrepareConfig) -> None:
    """Try a tile of few Gaussians: the first run on a machine compiles kernels, which is no part of a budget."""
    rng = np.random.default_rng(_SEED)
    count = 4 * _FEWEST
    quats = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
    half = np.full(count, 0.5)
    g = Gaussians(rng.normal(size=(count, 3)), quats, np.full((count, 3), 0.1), half, np.zeros((count, 1, 3)))
    space = NavigableSpace.from_box((3.0, 3.0, 3.0), (4.0, 4.0, 4.0), 8)
    sets = replace(config.sets, size=8, lower_size=8, max_inner=0)
    few = replace(config, cells=1, cell_size=None, sets=sets)
    bytes_of_record(levels_of(g, config.levels), count)
    with suppress(SceneError):
        _time_views(g, space, few)
        _try_cell(_Tile(g, g[:0]), g[:0], space, few)


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
    with temporary_folder() as cache:
        return load_gaussians(build.store.path_of(result.files["sample"], Path(cache)))


def _surroundings(build: WorldBuild, params: Facts) -> Gaussians:
    """Return the Gaussians of the samples that count for the space of a tile, as large as those that they stand for."""
    found = []
    for k in range(len(build.batches)):
        sample = _sample(build, k)
        if sample is not None:
            means = sample.means
            found.append(sample[near_tile(means, params, params["around"]) & ~near_tile(means, params)])
    g = flatten(Gaussians.concatenate(found))
    return replace(g, scales=g.scales * build.every**0.5)


def _others(build: WorldBuild, number: int, most: int) -> Gaussians:
    """Return at most so many Gaussians of the samples beyond a tile and its margin: what stands around it, thinly."""
    square = build.square_of(build.grid["tiles"][number])
    found = []
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
    view = float(np.mean(times[1:]))
    levels = config.levels
    if levels is None:
        return view, 0.0
    counts = frozen_sizes(levels.fit_to(len(g)).sizes(len(g)))
    many = views_to_choose(config.level_views)
    polled = replace(many, count=_POLLED).cameras(g, space)
    looks, _ = count_looks(g, polled, counts, of=many.count, space=space)
    sight = InSight.from_scene(g, space)
    times = []
    stands = np.random.default_rng(_SEED).random(len(g)) < _STAYS
    presence = np.where(stands, 1.0, _FAINT)
    for c in range(_TIMED + 1):
        began = _clock()
        some = np.flatnonzero(sight.of(polled[c]))
        removal_effects(g[some], polled[c], presence=presence[some])
        times.append(_clock() - began)
    return view, looks * float(np.mean(times[1:]))


def _try_cell(tile: _Tile, others: Gaussians, space: NavigableSpace, config: PrepareConfig) -> _Cell:
    """Return what a cell of a tile takes."""
    own = levels_of(flatten(tile.own), config.levels)
    around = surroundings_of(Gaussians.concatenate([tile.near, others]), config.levels)
    size = config.cell_size
    most = (config.cells or MOST_CELLS) if size is None else MAX_CELLS
    grid = CellGrid.over(space, max_cells=most, cell_size=size)
    with temporary_folder() as folder:
        work = plan_work(around.joined(own), grid, space, Path(folder) / "sets.pvs", config.sets)
        finder = work.scene.finder()
        shared = work.shared
    finder.warm()
    cell = len(grid) // 2
    seen = []
    looks: tuple[list[float], list[float]] = ([], [])  # coarse ones, fine ones
    for k in shared.of_cell(cell).tolist():
        began = _clock()
        seen.append(finder.look(shared.points[k], fine=bool(shared.fine[k])))
        looks[bool(shared.fine[k])].append(_clock() - began)
    began = _clock()
    view = finder.find_cell(work.viewpoints.voxels(cell), seen)
    finding = _clock() - began
    fine = int(np.count_nonzero(shared.fine))
    every = [*looks[0], *looks[1]]
    looking = fine * float(np.mean(looks[1] or every)) + (len(shared) - fine) * float(np.mean(looks[0] or every))
    left = np.setdiff1d(np.arange(len(shared)), shared.of_cell(cell))
    some = left[np.linspace(0, len(left) - 1, min(len(left), _OTHER_LOOKS)).astype(int)]
    elsewhere = [finder.look(shared.points[k], fine=False) for k in some.tolist()]
    sets = direction_sets(view, elsewhere, work.levels.union.means)
    directions, nbytes = bytes_of_view(view, sets, len(own.union), len(config.sets.class_edges))
    directions *= _MORE_EYES * (len(shared) / (len(seen) + len(elsewhere))) ** _GROWTH
    return _Cell(len(grid), finding + looking / len(grid), directions, nbytes)
