"""Try a few tiles of a world: where eyes may be in them, what levels, colors and a cell take there, and bytes of files.

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
from gsvis.prepare.trial import StageTrial
from gsvis.pvs.build import plan_work
from gsvis.pvs.cell_count import MOST_CELLS
from gsvis.pvs.cells import MAX_CELLS, CellGrid
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
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
_FEWEST = 64  # Gaussians of a tile; fewer have no levels
_OTHER_LOOKS = 8  # from other cells, for the bytes of direction sets
# what other cells add to these by rays; growth with the number of looks (design/089)
_MORE_EYES = 1.5
_GROWTH = 0.5
# Gaussians that are coded for their bytes, and tiles that they come from
_CODED = 1 << 16
_MOST_CODED = 4
_BUDGET = 20.0  # seconds after which no further tile is tried
_SEED = 3
_GOLDEN = 0.5 * (5.0**0.5 - 1.0)  # steps of this share of the tiles spread the tried ones, however many they are


@dataclass(frozen=True)
class Trial:
    """What the preparation of a tile takes, mean of the tried ones, in seconds of one core.

    Attributes:
        eyes: Share of the tiles with room for eyes.
        space: To find where eyes may be, mean of all tiles; no time where a walk is not near.
        levels: To train its levels; 0 without levels.
        colors: To fit its colors, and to measure what rounding costs and what a client gets.
        cells: Cells of a tile with room for eyes.
        cell: To find the set of a cell, its share of the shared looks included.
        nbytes: Bytes of its files.
        tiles: Tiles of which all this was tried; with 0, only `eyes`, `space` and bytes are known.
    """

    eyes: float
    space: float
    levels: float
    colors: float
    cells: float
    cell: float
    nbytes: TileBytes
    tiles: int


@dataclass(frozen=True, eq=False)
class _Tile:
    """The rows of a tile, and those in the margin around it without SH."""

    own: Gaussians
    near: Gaussians


def try_tiles(build: WorldBuild, most: int) -> Trial:
    """Return what tiles take: of eight tiles where eyes may be, of one or more of these the rest.

    Args:
        build: The preparation; its survey runs if it has not.
        most: Most Gaussians around a tile.
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
    order = (np.arange(1, 4 * _MOST_TILES) * _GOLDEN % 1.0 * len(near)).astype(int)
    chosen = [near[k] for k in dict.fromkeys(order.tolist())][:_MOST_TILES]
    tried = _Tried()
    with one_thread():
        rows = _read_tiles(build, chosen)
        spaces = {}
        for number in chosen:
            start = _clock()
            if tried.spaces and start - began > 0.5 * _BUDGET:
                break
            tile = rows[number]
            near_and_far = [flatten(tile.own), tile.near, _surroundings(build, params[number])]
            spaces[number] = space_of_tile(Gaussians.concatenate(near_and_far), params[number])
            tried.spaces.append(_clock() - start)
        coded = [rows[k].own for k in chosen if len(rows[k].own) >= _FEWEST] or [tile.own for tile in rows.values()]
        part = _CODED // min(len(coded), _MOST_CODED)
        tried.records = [
            bytes_of_record(levels_of(flatten(own), config.levels), part) for own in coded[:_MOST_CODED] if len(own)
        ]
        for number, space in spaces.items():
            late = tried.cells and _clock() - began > _BUDGET
            if space is None or late or len(rows[number].own) < _FEWEST:
                continue
            with suppress(SceneError):  # no eye stands outside of everything solid
                stages = _try_stages(rows[number].own, space, config)
                tried.cells.append(_try_cell(rows[number], _others(build, number, most), space, config))
                tried.stages.append(stages)
    tried.rooms = [bytes_of_space(space) for space in spaces.values() if space is not None]
    return tried.result(reached)


@dataclass
class _Tried:
    """What was tried in each tile."""

    spaces: list[float] = field(default_factory=list)
    stages: list[tuple[float, float]] = field(default_factory=list)
    cells: list[_Cell] = field(default_factory=list)
    records: list[float] = field(default_factory=list)
    rooms: list[float] = field(default_factory=list)

    def result(self, reached: float) -> Trial:
        """Return the means; `reached` is the share of the tiles that may have room for eyes at all."""
        levels, colors = np.mean(self.stages or [(0.0, 0.0)], axis=0).tolist()
        cells, cell, directions, seen = np.mean(np.array(self.cells or [_Cell(0.0, 0.0, 0.0, 0.0)]), axis=0).tolist()
        record = float(np.mean(self.records or [0.0]))
        return Trial(
            eyes=reached * len(self.rooms) / len(self.spaces),
            space=reached * float(np.median(self.spaces)),
            levels=levels,
            colors=colors,
            cells=cells,
            cell=cell,
            nbytes=TileBytes(record, directions, seen, float(np.mean(self.rooms or [0.0]))),
            tiles=len(self.stages),
        )


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
        _try_stages(g, space, few)
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


def _try_stages(own: Gaussians, space: NavigableSpace, config: PrepareConfig) -> tuple[float, float]:
    """Return the seconds of the levels of a tile, and of its colors and what measures them."""
    trial = StageTrial(levels_of(own, config.levels), space, config, _clock)
    training = 0.0
    count = len(own)
    if config.levels is not None:
        training = trial.training(config.levels, photos=False, chosen=False)
        count += sum(total - frozen for total, frozen, _ in config.levels.fit_to(len(own)).sizes(len(own)))
    return training, trial.colors(count) + trial.cost() + trial.fidelity()


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
