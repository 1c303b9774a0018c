"""What does one district of a world of 10^8 Gaussians cost, and what holds the process that gives out its tasks?

The whole world is cut into tiles, and each tile has lower levels and stands in its districts. Eyes are looked for in
the tiles of one district alone, the one nearest to the middle of all with at least `--tiles` tiles; these have trained
levels, a choice of nodes, and packages with all that stands around them. All other tiles are merged, as tiles without
eyes are. A run that was stopped goes on; its peak of memory stays in a file beside the work.

Given: copies of showroom, turned, mirrored and jittered, and the options of the benchmark of the smaller world.
Measured: processor time of each stage, peak of memory of the largest process and of all (PSS). Of stages that the
    district alone has, the mean of its tiles stands for all tiles: too little where more of those have eyes. Exponents
    are against a smaller world that is whole.
Defaults chosen on: no scene.
"""

from __future__ import annotations

import argparse
import json
import resource
import sys
import time
from collections.abc import Iterable
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from _harness import add_arguments, need, write_result
from world_whole import add_world_options, config_of, exponents, keep_peak, open_world_store, scenes_of

from gsvis.jobs.graph import Result
from gsvis.jobs.workers import Workers
from gsvis.world.build import WorldBuild


class Lines:
    """Progress as lines in a log, at most one a minute."""

    def __init__(self) -> None:
        self._next = 0.0

    def __call__(self, stage: str, done: int, total: int) -> None:
        if time.monotonic() >= self._next:
            print(f"{time.strftime('%H:%M:%S')} {stage} {done}/{total}", file=sys.stderr, flush=True)
            self._next = time.monotonic() + 60.0


class OfDistrict(WorldBuild):
    """The preparation of a world in which eyes are looked for in one district alone."""

    least = 8
    """Fewest tiles of the district."""

    @cached_property
    def searched(self) -> frozenset[int]:
        """The tiles of the district nearest to the middle, of those with the fewest tiles that are enough."""
        places = {k: np.array(rect[:2]) + 0.5 * np.array(rect[2:]) for k, rect in enumerate(self.tiles) if rect}
        middle = np.mean(list(places.values()), axis=0)
        large = [plan.tiles for plan in self.districts if len(plan.tiles) >= self.least]
        fewest = min(map(len, large))

        def away(tiles: Iterable[int]) -> float:
            return float(np.linalg.norm(np.mean([places[k] for k in tiles], axis=0) - middle))

        return frozenset(min((tiles for tiles in large if len(tiles) <= 1.5 * fewest), key=away))


def main() -> None:
    """Prepare the district, and write what it took."""
    parser = add_world_options(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--tiles", type=int, default=8, help="fewest tiles of the district")
    given = add_arguments(parser).parse_args()
    need(given.work, "a folder for the world with --work")
    need(given.smaller, "the result of world_whole.py on fewer copies, with the same options, with --smaller")
    given.work.mkdir(parents=True, exist_ok=True)
    scenes, config = scenes_of(given), config_of(given)
    workers = Workers(given.workers, None if given.max_memory is None else int(1e9 * given.max_memory))
    peak_file = given.work / "peak.json"
    with open_world_store(given.work / "city.gsworld") as store, keep_peak(peak_file, given.workers):
        build = OfDistrict([(str(Path(p).absolute()), lod) for p, lod in scenes], config, store, workers, Lines())
        build.least = given.tiles
        packages = build.prepared(sorted(build.searched))
        found = build.chosen
    write(given, build, found, packages, json.loads(peak_file.read_text()))


def write(
    given: argparse.Namespace, build: OfDistrict, found: dict[str, Result], packages: list[Result], peak: int
) -> None:
    """Write the figures."""
    tiles, some = len(build.tiles), sorted(build.searched)
    inhabited = [k for k in some if f"around {k}" in found]

    def spent(names: Iterable[str]) -> float:
        return sum(found[name].cpu for name in names)

    names = list(found)
    merged = spent(f"levels {k}" for k in range(tiles) if k not in build.searched)
    cpu = {
        "tiling": spent(name for name in names if name.split()[0] in ("sample", "grid", "split", "rows")),
        "spaces": spent(f"space {k}" for k in some) / len(some) * tiles,
        "levels": spent(f"levels {k}" for k in some) / len(some) * tiles,
        "districts": spent(name for name in names if name.split()[0] == "district"),
        "nodes": spent(f"around {k}" for k in inhabited) / len(some) * tiles,
        "packages": sum(result.cpu for result in packages) / len(some) * tiles,
    }
    gaussians = sum(found[f"rows {k}"].facts["gaussians"] for k in range(tiles))
    largest = max(result.peak for result in [*found.values(), *packages])
    parent = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    around = [sum(count for piece in each.facts["pieces"] for _, count in piece["runs"]) for each in packages]
    figures: list[dict[str, Any]] = [
        {"name": "Gaussians", "target": 100.0, "reached": gaussians / 1e6, "unit": "million", "better": "higher"},
        {"name": "largest worker, RSS", "target": 4.0, "reached": largest / 1e9, "unit": "GB", "better": "lower"},
        {"name": "process that gives out tasks, RSS", "target": None, "reached": parent / 1e9, "unit": "GB",
         "better": "lower"},
        {"name": "peak PSS of all processes", "target": given.max_memory, "reached": peak / 1e9, "unit": "GB",
         "better": "lower"},
        *exponents(json.loads(given.smaller.read_text())["details"], gaussians, cpu),
    ]  # fmt: skip
    details = {
        "tiles": tiles, "districts": len(build.districts), "sample": some, "with_eyes": inhabited, "cpu_s": cpu,
        "gaussians": gaussians, "cpu_of_merged_levels_s": merged, "around": around, "workers": given.workers,
        "package_s": [result.cpu for result in packages],
        "largest_by_task": {
            kind: max(result.peak for name, result in found.items() if name.split()[0] == kind)
            for kind in sorted({name.split()[0] for name in names})
        } | {"tile": max(result.peak for result in packages)},
    }  # fmt: skip
    write_result(given.out, "What does a district of a world of 10^8 Gaussians cost?", figures, details)


if __name__ == "__main__":
    main()
