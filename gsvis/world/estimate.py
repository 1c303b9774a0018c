"""Estimate the preparation of a world: tiles, time, memory, disk and core hours. Keeps nothing.

A sample of the rows gives the tiles. A few of them are tried, so that times follow the scene and the machine. The first
run on a machine compiles kernels as well, which takes about a minute.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from gsvis import _check
from gsvis.files.temporary import temporary_folder
from gsvis.jobs.cost import IDLE, machine_load, needed_memory
from gsvis.jobs.graph import Facts
from gsvis.jobs.objects import open_store
from gsvis.jobs.workers import Workers
from gsvis.progress import Progress, silent
from gsvis.pvs.coded_size import BESIDE
from gsvis.train.levels import LevelsConfig
from gsvis.world.build import WorldBuild, plan_districts
from gsvis.world.config import WorldConfig
from gsvis.world.packages import tile_memory
from gsvis.world.standing import distances_of, nodes_around, own_districts
from gsvis.world.trial import Trial, try_tiles

__all__ = ["WorldEstimate", "estimate_world"]

_clock = time.process_time  # tests set another

# Seconds of processor with compiled kernels, from flowers LOD 3 in 10,000s, nika LOD 2 in 20,000s, guitar in 40,000s
# and a part of showroom LOD 2 in 80,000s, each with 30 steps (docs/design/089).
# once, for each Gaussian
_START = 0.4
_TILING = 2e-6
# for each look for nodes of a tile, and for each Gaussian in it
_LOOK = 0.016
_LOOK_ROW = 7e-7
# for the districts of a tile, and for each Gaussian of its lowest level
_DISTRICT = 0.3
_DISTRICT_ROW = 4e-6
# for each tile with room for eyes, and for each Gaussian
_PACKAGE = 0.4
_PACKAGE_ROW = 1.3e-5
# the same for levels and package of one without
_BARE = 0.2
_BARE_ROW = 3e-5
# for each tile, each Gaussian of each level in and around it, and each
_TRACERS = 0.1
_TRACED = 4e-6
_TWICE = 1.7e-5
_AROUND = 7.5  # most Gaussians in and around a tile, in those of the tile
# the same of the tile with most of them: at most, and times the root of tiles
_MOST_AROUND = 12.0
_ROOT_AROUND = 1.5
_SPREAD = 1.25  # spacing of a district over that of as many Gaussians on a lattice on its ground
_ASKED = 64  # tiles of which the memory of what stands around them is found
_EFFICIENCY = 0.9  # of workers beside each other
_ALL_TILES = ("tiling", "spaces", "districts")  # stages with a task for each tile; others have one where eyes may be

_UNSURE = 1.03  # times what a sample says of the fullest tile
_PEAK = 0.85  # of what a limit of memory has to allow

# Bytes of files, from flowers LOD 3, nika LOD 2 and guitar (docs/design/089).
_TERM = 3.5  # of a term
_FAR_RECORD = 0.84  # of a Gaussian of a district, over one of a tile
# of the package and the stores of a tile; of a package without cells
_FILES = 11_000
_BARE_FILES = 4_000
# of a Gaussian that is kept, and of each SH coefficient above degree 0
_ROW = 56
_ROW_SH = 12


@dataclass(frozen=True)
class WorldEstimate:
    """The expected cost of a world.

    Attributes:
        gaussians: Gaussians of all scenes.
        tiles: Tiles with Gaussians.
        largest: Gaussians of the fullest tile.
        side: Median length of the longer side of a tile, scene units.
        core_seconds: Seconds of processor of each stage.
        workers: Number of workers.
        memory: Peak bytes of a worker.
        max_memory: Least limit of the memory of all processes under which every task fits, one at a time.
        nbytes: Bytes of the world.
        work_bytes: Bytes of the kept work.
        load: Processes that used or waited for a core when the estimate began; None if unknown.
        trial: What a tile takes, of which some were tried.
        spent: Seconds of processor that this estimate took.
        remarks: What a user has to know of the up axis, as lines.
    """

    gaussians: int
    tiles: int
    largest: int
    side: float
    core_seconds: dict[str, float]
    workers: int
    memory: int
    max_memory: int
    nbytes: int
    work_bytes: int
    load: float | None
    trial: Trial
    spent: float
    remarks: tuple[str, ...] = ()

    @property
    def seconds(self) -> float:
        """Time with the workers."""
        return self.seconds_with(self.workers)

    @property
    def core_hours(self) -> float:
        """Hours of one core."""
        return sum(self.core_seconds.values()) / 3600.0

    @property
    def most_workers(self) -> int:
        """Workers beyond which more save no time: as many as tiles with room for eyes."""
        return max(1, round(self.trial.eyes * self.tiles))

    def seconds_with(self, workers: int) -> float:
        """Return the time with so many workers, on one machine or a cluster; a tile is made by one of them."""
        _check.positive_int("workers", workers)
        if workers == 1:
            return sum(self.core_seconds.values())
        found = 0.0
        for stage, seconds in self.core_seconds.items():
            tasks = self.tiles if stage in _ALL_TILES else self.most_workers
            found += seconds * math.ceil(tasks / workers) / tasks
        return found / _EFFICIENCY


def estimate_world(
    scenes: Sequence[tuple[str, int | None]],
    config: WorldConfig | None = None,
    *,
    workers: int = 1,
    progress: Progress = silent,
) -> WorldEstimate:
    """Estimate the cost of `prepare_world` with these arguments. Reads every scene once or twice, keeps nothing.

    Args:
        scenes: As for `prepare_world`.
        config: Options; None means `WorldConfig()`.
        workers: Workers of the run; this estimate itself runs here.
        progress: Called with stages "sampling" and "trying tiles".

    Raises:
        SceneError: If the scenes have nothing to see.
        FormatError: If a scene is damaged.
    """
    config = config or WorldConfig()
    load = machine_load()
    began = _clock()
    _check.positive_int("workers", workers)
    with temporary_folder() as folder:
        build = WorldBuild(list(scenes), config, open_store(folder), Workers(), progress)
        facts = [result.facts for name, result in build.survey.items() if name != "grid"]
        expected = np.array(build.grid["expected"])
        side = float(build.grid["grid"]["side"]) * float(np.median([max(rect[2:]) for rect in build.grid["tiles"]]))
        count = sum(each["gaussians"] for each in facts)
        degree = max(each["sh_degree"] for each in facts)
        sizes = _Sizes(config, count, len(expected), degree)
        progress("trying tiles", 0, 1)
        trial = try_tiles(build, int(sizes.joint - sizes.each))
        progress("trying tiles", 1, 1)
        seconds = sizes.seconds(trial)
        world, kept = _bytes(sizes, trial, build)
        remarks = build.grid["remarks"]
    largest = int(max(expected.max(), 1))
    most = max(_UNSURE * largest * count / max(expected.sum(), 1), count - float(expected.sum()))
    memory, limit = _memory(sizes, build, largest, int(most), workers)
    return WorldEstimate(
        gaussians=count,
        tiles=sizes.tiles,
        largest=largest,
        side=side,
        core_seconds=seconds,
        workers=workers,
        memory=memory,
        max_memory=limit,
        nbytes=world,
        work_bytes=kept,
        load=load,
        trial=trial,
        spent=_clock() - began,
        remarks=tuple(remarks),
    )


class _Sizes:
    """The sizes of a world, and the time of its stages from what a tile takes.

    Attributes:
        each: Gaussians of a tile, mean.
        joint: Gaussians in and around a tile.
        own: Gaussians of all levels of a tile, in those of the tile.
        drawn: The same, those in several levels as often.
        lowest: Gaussians of all lowest levels.
    """

    def __init__(self, config: WorldConfig, count: int, tiles: int, degree: int) -> None:
        self.config = config
        self.count = count
        self.tiles = tiles
        self.degree = degree
        self.each = count / tiles
        self.joint = min(_AROUND * self.each, float(count))
        levels = config.package.levels
        self.shares = () if levels is None else levels.shares
        self.own = 1.0 + (0.0 if levels is None else sum(a * (1.0 - b) for a, b in _lower(levels)))
        self.drawn = 1.0 + sum(self.shares)
        self.lowest = count * (self.shares[0] if self.shares else 1.0)

    def seconds(self, trial: Trial) -> dict[str, float]:
        """Return the seconds of processor of each stage."""
        tiles = self.tiles
        seen = trial.eyes * self.tiles
        lowest = self.lowest / self.tiles
        far = min(lowest, self.config.far) * (self.joint / self.each - 1.0)
        bare = (tiles - seen) * (_BARE + _BARE_ROW * self.each)
        return {
            "tiling": _START + _TILING * self.count,
            "spaces": trial.space * tiles,
            "levels": seen * trial.levels,
            "districts": _DISTRICT * tiles + _DISTRICT_ROW * self.lowest,
            "nodes": seen * self.config.looks * (_LOOK + _LOOK_ROW * (lowest + far)),
            "packages": seen * self._package(trial) + bare,
        }

    def _package(self, trial: Trial) -> float:
        """Return the seconds to make the package of a tile with room for eyes."""
        sets = _TRACERS + (_TRACED * self.drawn + _TWICE) * self.joint + trial.cells * trial.cell
        return _PACKAGE + _PACKAGE_ROW * self.own * self.each + sets + trial.colors


def _bytes(sizes: _Sizes, trial: Trial, build: WorldBuild) -> tuple[int, int]:
    """Return the bytes of the world, and of the kept work."""
    far = build.config.far
    each = trial.nbytes
    cells = trial.cells
    union = sizes.own * sizes.each
    seen = trial.eyes * sizes.tiles
    lowest = sizes.lowest / sizes.tiles * trial.eyes + min(far, sizes.each) * (1.0 - trial.eyes)
    districts = plan_districts(build.grid["tree"], range(sizes.tiles), sizes.tiles)
    merged = sum(min(far, lowest * len(plan.tiles)) for plan in districts)
    stores = each.directions + each.cell * (BESIDE * cells + 1.0 - BESIDE)
    terms = _TERM * _terms_of(build.config, sizes.degree) * union
    gaussians = seen * union + (sizes.tiles - seen) * (sizes.each + min(far, sizes.each))
    world = each.record * (gaussians + _FAR_RECORD * merged) + seen * (terms + stores + _FILES)
    world += _BARE_FILES * len(districts)
    row = _ROW + _ROW_SH * ((sizes.degree + 1) ** 2 - 1)
    samples = sum(size for result in build.survey.values() for _, size in result.files.values())
    kept = samples + row * (2 * sizes.count + gaussians) + _ROW * merged + seen * each.space
    return int(world), int(world + kept)


def _memory(sizes: _Sizes, build: WorldBuild, largest: int, most: int, workers: int) -> tuple[int, int]:
    """Return the peak bytes of a worker, and the least limit of all processes.

    Args:
        sizes: The sizes of the world.
        build: The preparation.
        largest: Gaussians of the fullest tile, by the sample.
        most: What it or the outside may have, what is too faint for the sample included.
        workers: Workers of the run.
    """
    package = sizes.config.package
    joint = int(min(largest * min(_MOST_AROUND, _ROOT_AROUND * sizes.tiles**0.5), sizes.count))
    tile = tile_memory(int(sizes.own * largest), [joint], int(sizes.own * joint), sizes.degree, package.sets)
    params: Facts = {"config": package.as_dict(), "outside": False, "resolution": sizes.config.resolution}
    lowest = sizes.shares[0] if sizes.shares else 1.0

    def levels(count: int) -> Facts:
        return {"gaussians": int(sizes.own * count), "levels": [["", int(lowest * count)]], "spacings": []}

    rows = {"gaussians": most}
    own = levels(most)
    others = [levels(largest)] * min(sizes.tiles - 1, int(_MOST_AROUND))
    needs: tuple[tuple[str, list[Facts]], ...] = (
        ("tiles:tile_space", [rows, *others]),
        ("tiles:make_tile_levels", [rows]),
        ("districts:make_district", [own]),
        ("packages:prepare_tile", [own, {"voxels": 0}]),
    )
    task = max(needed_memory(f"gsvis.world.{run}", params, inputs) for run, inputs in needs)
    (plans, facts), tiles = _districts(sizes, build), [levels(int(each)) for each in build.grid["expected"]]
    params |= {"tiles": sizes.tiles, "districts": plans, "angle": sizes.config.angle}
    alone = own_districts(plans)
    packages = 0
    for number in np.unique(np.linspace(0, sizes.tiles - 1, _ASKED).astype(int)).tolist():
        params["tile"] = number
        low, high = (np.array(facts[alone[number]][name]) for name in ("low", "high"))
        far, near = nodes_around(params, facts, distances_of(low, high, facts))
        inputs = [tiles[number], {"voxels": 1}, *(tiles[k] for k in near), *(facts[k] for k in far)]
        task = max(task, needed_memory("gsvis.world.pieces:choose_nodes", params, [own, {}, *facts]))
        packages = max(packages, needed_memory("gsvis.world.packages:prepare_tile", params, inputs))
    # A package is asked for more than it takes: which parts of tiles stand around it is known when it is made.
    return int(_PEAK * _least_limit(task, tile, 1)), _least_limit(max(task, packages), tile, workers)


def _districts(sizes: _Sizes, build: WorldBuild) -> tuple[list[Facts], list[Facts]]:
    """Return the plans of the districts, and their facts if the Gaussians of each lie evenly on its ground."""
    rects = np.array(build.grid["tiles"])
    side = float(build.grid["grid"]["side"])
    plans = [asdict(plan) for plan in plan_districts(build.grid["tree"], range(sizes.tiles), sizes.tiles)]
    facts = list[Facts]()
    for plan in plans:
        some = rects[list(plan["tiles"])]
        low = some[:, :2].min(axis=0)
        high = (some[:, :2] + some[:, 2:]).max(axis=0)
        count = max(1, int(min(sizes.config.far, len(some) * sizes.lowest / sizes.tiles)))
        spacing = _SPREAD * side * math.sqrt(int(some[:, 2:].prod(axis=1).sum()) / count)
        corners = {"low": [*(side * low).tolist(), 0.0], "high": [*(side * high).tolist(), 0.0]}
        facts.append({**corners, "spacing": spacing, "gaussians": count})
    return plans, facts


def _lower(levels: LevelsConfig) -> list[tuple[float, float]]:
    """Return the size of each lower level as a share of the scene's, and how much of it stands in the next."""
    return list(zip(levels.shares, levels.reuse, strict=True))


def _terms_of(config: WorldConfig, degree: int) -> float:
    """Return the expected terms of a Gaussian."""
    fit = config.package.colors.fit
    return float(fit.max_terms if fit.mean_terms is None else min(fit.mean_terms, fit.max_terms)) if degree else 0.0


def _least_limit(task: int, tile: int, workers: int) -> int:
    """Return the least limit of all processes under which each task fits, one at a time.

    Args:
        task: Most bytes that a task needs beyond an idle process.
        tile: Bytes of a worker that makes a package, `tile_memory`.
        workers: Processes; 1 works in the process that gives out tasks.
    """
    idle = IDLE * (workers + 1 if workers > 1 else 1)
    return max(idle + task, idle - IDLE + tile)
