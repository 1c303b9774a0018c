"""What does a whole world cost, and does a dry run tell it: processor time, memory, disk?

A scene, or copies of it, is prepared as a world, after a dry run with the same options. A run that was stopped goes on;
its peak of memory stays in a file beside the work. With the result of a smaller world, it reports exponents of time
against Gaussians as well.

Given: a scene and options on the command line.
Measured: seconds of processor of all tasks, peak of proportional memory (PSS) of all processes, bytes of the world and
    of the kept work, each over what the dry run says, and exponents of the stages.
Defaults chosen on: constants of the dry run on flowers LOD 3, nika LOD 2, guitar and a part of showroom LOD 2.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from _harness import add_arguments, need, realdata, write_result
from _memory import watch_memory
from _worlds import write_copies

from gsvis.jobs.objects import ObjectStore, open_store
from gsvis.jobs.work_folder import WorkFolder
from gsvis.jobs.workers import Workers
from gsvis.prepare.config import PrepareConfig
from gsvis.progress import silent
from gsvis.train.levels import LevelsConfig
from gsvis.world.build import WorldBuild
from gsvis.world.config import WorldConfig
from gsvis.world.estimate import WorldEstimate, estimate_world
from gsvis.world.prepare import PreparedWorld, prepare_world
from gsvis.world.tiling import TilingConfig

STAGES = {
    "tiling": ("sample", "grid", "split", "rows"), "spaces": ("space",), "levels": ("levels",),
    "districts": ("district",), "nodes": ("around",), "packages": ("tile",),
}  # fmt: skip


def main() -> None:
    """Estimate and prepare a world, and compare."""
    parser = add_world_options(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--sample", type=int, help="packages of so many tiles alone, those with most around them")
    given = add_arguments(parser).parse_args()
    need(given.work, "a folder for the world with --work")
    given.work.mkdir(parents=True, exist_ok=True)
    scenes, config = scenes_of(given), config_of(given)
    workers = Workers(given.workers, None if given.max_memory is None else int(1e9 * given.max_memory))
    if given.sample is not None:
        sample(given, scenes, config, workers)
        return
    estimate = estimate_world(scenes, config, workers=given.workers)
    peak_file = given.work / "peak.json"
    with keep_peak(peak_file, given.workers):
        made = prepare_world(scenes, given.work / "city.gsworld", config, workers=workers)
    write(given, estimate, made, json.loads(peak_file.read_text()))


def add_world_options(parser: argparse.ArgumentParser) -> argparse.ArgumentParser:
    """Add the options that say which world is made, and how."""
    parser.add_argument("--scene", default="showroom", help="a scene of the real data, or a file in formats/")
    parser.add_argument("--lod", type=int, default=2)
    parser.add_argument("--copies", type=int, default=0, help="turned, mirrored and jittered copies; 0 for the scene")
    parser.add_argument("--most", type=int, default=250_000)
    parser.add_argument("--cells", type=int, default=2, help="cells of a tile")
    parser.add_argument("--steps", type=int, default=60, help="steps of training of each lower level; 0 for no levels")
    parser.add_argument("--views", type=int, help="views that levels are trained from, and none held out")
    parser.add_argument("--workers", type=int, default=1, help="processes")
    parser.add_argument("--max-memory", type=float, help="gigabytes for all processes")
    parser.add_argument("--smaller", type=Path, help="result of this benchmark on fewer copies, with the same options")
    parser.add_argument("--work", type=Path, help="folder for the world, some gigabytes")
    return parser


def sample(
    given: argparse.Namespace, scenes: list[tuple[str, int | None]], config: WorldConfig, workers: Workers
) -> None:
    """Prepare everything below the packages, then the packages of some tiles, and follow the memory of these."""
    with open_world_store(given.work / "city.gsworld") as store:
        build = WorldBuild([(str(Path(path).absolute()), lod) for path, lod in scenes], config, store, workers, silent)
        found = build.chosen
        around = {k: sum(found[name].facts["gaussians"] for name in names) for k, names in build.nodes.items()}
        some = sorted(sorted(around, key=lambda k: around[k])[-given.sample :])
        with keep_peak(given.work / "peak-of-sample.json", given.workers):
            results = build.prepared(some)
    peak = json.loads((given.work / "peak-of-sample.json").read_text())
    cpu, most = sum(result.cpu for result in results), max(result.peak for result in results)
    pieces = [sum(count for piece in result.facts["pieces"] for _, count in piece["runs"]) for result in results]
    figures: list[dict[str, Any]] = [
        {"name": "peak PSS of all processes", "target": given.max_memory, "reached": peak / 1e9, "unit": "GB",
         "better": "lower"},
        {"name": "largest process, RSS", "target": None, "reached": most / 1e9, "unit": "GB", "better": "lower"},
        {"name": "processor time of a package", "target": None, "reached": cpu / len(results), "unit": "s",
         "better": "lower"},
    ]  # fmt: skip
    details = {
        "sample": f"packages of {len(some)} of {len(build.tiles)} tiles, those with most around them", "tiles": some,
        "around": pieces, "cpu_s": [result.cpu for result in results],
        "gaussians": sum(found[f"levels {k}"].facts["gaussians"] for k in range(len(build.tiles))),
        "workers": given.workers,
    }  # fmt: skip
    write_result(given.out, "What do the packages of a large world hold in memory?", figures, details)


@contextmanager
def keep_peak(file: Path, workers: int) -> Iterator[None]:
    """Follow the memory of all processes; the largest of this run and of those it goes on from stays in a file."""
    with watch_memory(0.2 * workers) as peak:
        try:
            yield
        finally:
            before = json.loads(file.read_text()) if file.is_file() else 0
            file.write_text(json.dumps(max(before, peak.bytes)))


@contextmanager
def open_world_store(world: Path) -> Iterator[ObjectStore]:
    """The results beside a world, as `prepare_world` keeps them."""
    work = WorkFolder(world)
    with work.opened():
        yield open_store(work.folder)


def exponents(smaller: dict[str, Any], gaussians: int, cpu: dict[str, float]) -> list[dict[str, Any]]:
    """Exponent of processor time against Gaussians, of each stage and of all, from two worlds."""
    before, ratio = smaller["cpu_s"], np.log(gaussians / smaller["gaussians"])
    pairs = {name: (before[name], cpu[name]) for name in cpu} | {"all": (sum(before.values()), sum(cpu.values()))}
    return [
        {"name": f"exponent of {name}", "target": 1.05, "reached": float(np.log(now / then) / ratio), "unit": "",
         "better": "lower"}
        for name, (then, now) in pairs.items()
    ]  # fmt: skip


def scenes_of(given: argparse.Namespace) -> list[tuple[str, int | None]]:
    """The scene, or its copies as PLY files."""
    scene = realdata() / "scenes" / given.scene / "lod-meta.json"
    if not scene.is_file():
        return [(str(realdata() / "scenes/formats" / given.scene), None)]
    if not given.copies:
        return [(str(scene), given.lod)]
    folder = given.work / "copies"
    if not folder.is_dir():
        write_copies(str(scene), given.lod, given.copies, folder)
    return [(str(path), None) for path in sorted(folder.glob("*.ply"))]


def config_of(given: argparse.Namespace) -> WorldConfig:
    """The options of the world."""
    levels = LevelsConfig((0.25, 0.5), iterations=given.steps) if given.steps else None
    package = PrepareConfig(levels=levels, cells=given.cells)
    if given.views is not None:
        package = replace(package, level_views=replace(package.level_views, count=given.views), level_held_out=0)
    return WorldConfig(TilingConfig(given.most), package)


def write(given: argparse.Namespace, estimate: WorldEstimate, made: PreparedWorld, peak: int) -> None:
    """Write the figures."""
    cpu = {
        stage: sum(result.cpu for name, result in made.results.items() if name.split()[0] in names)
        for stage, names in STAGES.items()
    }
    disk = sum(path.stat().st_size for path in made.work.rglob("*") if path.is_file())
    pairs = {
        "processor time": (sum(estimate.core_seconds.values()), sum(cpu.values())),
        "peak PSS": (given.workers * estimate.memory, peak), "bytes of the world": (estimate.nbytes, made.nbytes),
        "bytes of the kept work": (estimate.work_bytes, disk),
    }  # fmt: skip
    figures: list[dict[str, Any]] = [
        {"name": f"{name}, off the dry run", "target": 0.3, "reached": abs(real / said - 1.0), "unit": "",
         "better": "lower"}
        for name, (said, real) in pairs.items()
    ]  # fmt: skip
    figures += [
        {"name": "processor time", "target": None, "reached": sum(cpu.values()) / 60, "unit": "min", "better": "lower"},
        {
            "name": "peak PSS",
            "target": given.max_memory or (6.0 if given.workers <= 2 else None),
            "reached": peak / 1e9,
            "unit": "GB",
            "better": "lower",
        },
    ]
    m = made.manifest
    if given.smaller is not None:
        figures += exponents(json.loads(given.smaller.read_text())["details"], m.gaussians, cpu)
    details = {
        "gaussians": m.gaussians, "tiles": len(m.tiles), "districts": len(m.districts), "cpu_s": cpu,
        "cells": sum(tile.cells for tile in m.tiles), "estimate": asdict(estimate), "measured": pairs,
        "workers": given.workers, "largest_worker_rss": max(result.peak for result in made.results.values()),
    }  # fmt: skip
    write_result(given.out, "What does a whole world cost, and does a dry run tell it?", figures, details)


if __name__ == "__main__":
    main()
