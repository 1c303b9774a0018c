"""Estimate the preparation of a world: tiles, time, memory, disk and core hours. Keeps nothing.

A sample of the rows gives the tiles. The rest comes from constants: times are rough, they distinguish minutes from
hours and days. docs/scaling.md says what they were measured on.
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
from gsvis.world.build import WorldBuild
from gsvis.world.config import WorldConfig

__all__ = ["WorldEstimate", "estimate_world"]

# Seconds of processor, measured on showroom LOD 2 as a world of 8 tiles (benchmarks/world_whole.py).
_START, _TILING, _SPACE_TILE = 2.0, 1.7e-6, 0.9  # once, for each Gaussian, for each tile
_LOOK, _DISTRICT = 0.13, 0.9  # for each look for nodes of a tile; for the districts of a tile
_ROW_LEVELS = 2e-6  # for each Gaussian, without training
_LEVELS, _STEP = 1.8e-4, 3.7e-6  # for each Gaussian, with training, and for each step of each lower level
_OWN, _JOINT, _CELL = 8.6e-5, 2.2e-5, 2e-5  # for each Gaussian of a tile, each in and around it, and in each cell
_TERMS = 4.0  # with SH: times `_OWN`, terms for each Gaussian
_AROUND = 7.5  # most Gaussians in and around a tile, in those of the tile
_EFFICIENCY = 0.9  # of workers beside each other

_BASE, _PER_GAUSSIAN = 470 << 20, 770  # bytes of a worker, and for each Gaussian that it draws
_RECORD, _SETS = 13.6, 0.3  # bytes of a package for each Gaussian, and for each cell and Gaussian in and around it
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
    levels = config.package.levels
    drawn = 1.0 if levels is None else 1.0 + sum(levels.shares)
    terms = _TERMS if degree else 0.0
    around = min(_AROUND, float(tiles))
    looks = _JOINT + _CELL * cells
    seconds = {
        "tiling": _START + _TILING * count,
        "spaces": _SPACE_TILE * tiles,
        "levels": _ROW_LEVELS * count if levels is None else (_LEVELS + _STEP * levels.iterations) * count,
        "districts": (_DISTRICT + _LOOK * config.looks) * tiles,
        "packages": (looks * around * drawn + _OWN * (1.0 + terms)) * count,
    }
    row = 4 * (14 + (3 * (degree + 1) ** 2 - 3))
    per = _RECORD * drawn + 6.0 * terms + _SETS * cells * around
    return WorldEstimate(
        gaussians=count,
        tiles=tiles,
        largest=largest,
        side=side,
        core_seconds=seconds,
        seconds=sum(seconds.values()) / max(1.0, _EFFICIENCY * min(workers, tiles)),
        workers=workers,
        memory=_BASE + int(_PER_GAUSSIAN * min(largest * around, count) * drawn),
        nbytes=int(per * count),
        work_bytes=int((_ROWS * row + per) * count + row * min(count, _SAMPLED)),
        load=load,
    )
