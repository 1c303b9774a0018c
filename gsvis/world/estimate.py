"""Estimate the preparation of a world: tiles, time, memory, disk and core hours. Keeps nothing.

A sample of the rows gives the tiles. The rest comes from constants: times are rough, they distinguish minutes from
hours and days. The first run on a machine compiles kernels as well, which takes about a minute.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gsvis import _check
from gsvis.files.objects import open_store
from gsvis.progress import Progress, silent
from gsvis.pvs.cell_count import MOST_CELLS
from gsvis.pvs.workers import Workers, machine_load
from gsvis.train.levels import LevelsConfig
from gsvis.world.build import WorldBuild
from gsvis.world.config import WorldConfig
from gsvis.world.memory import tile_memory

__all__ = ["WorldEstimate", "estimate_world"]

# Seconds of processor with compiled kernels, from showroom LOD 2 (no levels, one cell), nika LOD 2 in 20,000s and
# flowers LOD 2 in 40,000s (60 and 12 steps, two cells): benchmarks/world_whole.py, docs/design/084.
_START, _TILING, _SPACE_TILE = 2.0, 1.7e-6, 0.9  # once, for each Gaussian, for each tile
_LOOK, _LOOK_ROW = 0.015, 6.9e-7  # for each look for nodes of a tile, and for each Gaussian of its lowest level
_DISTRICT, _DISTRICT_ROW = 0.3, 4e-6  # for the districts of a tile, and for each Gaussian of its lowest level
_ROW_LEVELS = 2e-6  # for each Gaussian, without training
_TRAINED, _STEP = 5.0, 0.33  # with training: for each tile, and for each step of each of its lower levels
_STEP_ROW, _STEP_SH = 3.7e-6, 1.6  # for each Gaussian and step, with two lower levels; what 16 SH coefficients add
_PACKAGE, _EYES = 6.0, 2.0  # for each tile, and for each of its cells
_OWN, _JOINT, _CELL = 5.5e-5, 2.2e-5, 2e-5  # for each Gaussian of a tile, each in and around it, and in each cell
_TERMS = 0.1  # times `_OWN` for each SH coefficient above degree 0
_AROUND = 7.5  # most Gaussians in and around a tile, in those of the tile
_MOST_AROUND, _ROOT_AROUND = 12.0, 1.5  # the same of the tile with most of them: at most, and times the root of tiles
_EFFICIENCY = 0.9  # of workers beside each other

_PEAK = 0.85  # of what `--max-memory` has to allow
_RECORD, _TERM, _SETS = 13.6, 6.0, 0.3  # bytes for each Gaussian, each term, and each cell and Gaussian in and around
_DISTRICTS, _SPACE = 1.33, 2_500_000  # districts for each tile; bytes of where eyes may be in one
_ROWS = 3  # how often a Gaussian is kept with all its values
_SAMPLED = 1 << 19


@dataclass(frozen=True)
class WorldEstimate:
    """The expected cost of a world.

    Attributes:
        gaussians: Gaussians of all scenes.
        tiles: Tiles with Gaussians.
        largest: Gaussians of the fullest tile.
        side: Median length of the longer side of a tile, scene units.
        core_seconds: Seconds of processor of each stage.
        seconds: Time with the workers.
        workers: Number of workers.
        memory: Peak bytes of a worker.
        nbytes: Bytes of the world.
        work_bytes: Bytes of the kept work.
        load: Processes that used or waited for a core when the estimate began; None if unknown.
    """

    gaussians: int
    tiles: int
    largest: int
    side: float
    core_seconds: dict[str, float]
    seconds: float
    workers: int
    memory: int
    nbytes: int
    work_bytes: int
    load: float | None

    @property
    def core_hours(self) -> float:
        """Hours of one core."""
        return sum(self.core_seconds.values()) / 3600.0


def estimate_world(
    scenes: Sequence[tuple[str, int | None]],
    config: WorldConfig | None = None,
    *,
    workers: int = 1,
    progress: Progress = silent,
) -> WorldEstimate:
    """Estimate the cost of `prepare_world` with these arguments. Reads every scene once and writes a temporary sample.

    Args:
        scenes: As for `prepare_world`.
        config: Options; None means `WorldConfig()`.
        workers: Workers of the run; this estimate itself runs here.
        progress: Called with stage "sampling".

    Raises:
        SceneError: If the scenes have nothing to see.
        FormatError: If a scene is damaged.
    """
    config, load = config or WorldConfig(), machine_load()
    _check.positive_int("workers", workers)
    with tempfile.TemporaryDirectory(prefix="gsvis-") as folder:
        build = WorldBuild(list(scenes), config, open_store(folder), Workers(), progress)
        facts = [result.facts for name, result in build.survey.items() if name != "grid"]
        expected = np.array(build.grid["expected"])
        side = float(build.grid["grid"]["side"]) * float(np.median([max(rect[2:]) for rect in build.grid["tiles"]]))
    count, degree = sum(each["gaussians"] for each in facts), max(each["sh_degree"] for each in facts)
    tiles, cells = len(expected), config.package.cells or MOST_CELLS
    largest = int(max(expected.max(), 1))
    levels, coefficients = config.package.levels, 3 * ((degree + 1) ** 2 - 1)
    shares = () if levels is None else levels.shares
    drawn, own = 1.0 + sum(shares), 1.0 + (0.0 if levels is None else sum(a * (1.0 - b) for a, b in _lower(levels)))
    around = min(_AROUND, float(tiles))
    rows = count * (shares[0] if shares else 1.0)  # of the lowest levels
    seconds = {
        "tiling": _START + _TILING * count,
        "spaces": _SPACE_TILE * tiles,
        "levels": _ROW_LEVELS * count if levels is None else _training(levels, tiles, count, coefficients),
        "districts": _DISTRICT * tiles + _DISTRICT_ROW * rows,
        "nodes": config.looks * (_LOOK * tiles + _LOOK_ROW * rows),
        "packages": (_PACKAGE + _EYES * cells) * tiles
        + ((_JOINT + _CELL * cells) * around * drawn + _OWN * (1.0 + _TERMS * coefficients)) * count,
    }
    row = 4 * (14 + (3 * (degree + 1) ** 2 - 3))
    per = _RECORD * own + _TERM * _terms_of(config, degree) + _SETS * cells * around
    districts = int(_RECORD * _DISTRICTS * tiles * min(config.far, rows / tiles))
    joint = int(min(largest * min(_MOST_AROUND, _ROOT_AROUND * tiles**0.5), count))
    return WorldEstimate(
        gaussians=count,
        tiles=tiles,
        largest=largest,
        side=side,
        core_seconds=seconds,
        seconds=sum(seconds.values()) / max(1.0, _EFFICIENCY * min(workers, tiles)),
        workers=workers,
        memory=int(_PEAK * tile_memory(int(own * largest), [joint], int(own * joint), degree, config.package.sets)),
        nbytes=districts + int(per * count),
        work_bytes=districts + _SPACE * tiles + int((_ROWS * row + per) * count + row * min(count, _SAMPLED)),
        load=load,
    )


def _lower(levels: LevelsConfig) -> list[tuple[float, float]]:
    """Return the size of each lower level as a share of the scene's, and how much of it stands in the next."""
    return list(zip(levels.shares, levels.reuse, strict=True))


def _training(levels: LevelsConfig, tiles: int, count: int, coefficients: int) -> float:
    """Return the seconds to train the levels of all tiles."""
    each = _TRAINED + _STEP * levels.iterations * len(levels.shares)
    return tiles * each + _STEP_ROW * (1.0 + _STEP_SH * coefficients / 45.0) * levels.iterations * count


def _terms_of(config: WorldConfig, degree: int) -> float:
    """Return the expected terms of a Gaussian."""
    fit = config.package.colors.fit
    return float(fit.max_terms if fit.mean_terms is None else min(fit.mean_terms, fit.max_terms)) if degree else 0.0
