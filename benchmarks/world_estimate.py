"""Is `gsvis world --dry-run` right: time of each stage, memory, bytes, and what does it take itself?

Each scene is a small world of a few tiles, with 30 steps of training for each lower level and two cells a tile. A
process of its own says what it would cost and then prepares it, both in one thread.

Given: objects, scans of a room, a wall outdoors and a built-in street, of which no constant of the dry run was taken;
    the street once more with eyes along a walk through a part of it.
Measured: seconds of processor of each stage and of all, peak of proportional memory (PSS), bytes of the world and of
    the kept work, against what the dry run said; seconds of processor of the dry run; whether the limit of memory that
    it names is accepted.
Defaults chosen on: constants of the dry run on flowers LOD 3, nika LOD 2, guitar and a part of showroom LOD 2.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

from _harness import add_arguments, need, realdata, write_result
from _memory import watch_memory
from _worlds import small_street
from world_whole import STAGES

from gsvis.io import load_scene
from gsvis.io.ply import save_ply
from gsvis.jobs.processes import limit_threads, use_threads
from gsvis.jobs.workers import Workers
from gsvis.prepare.config import PrepareConfig
from gsvis.scene.gaussians import Gaussians
from gsvis.train.levels import LevelsConfig
from gsvis.world.config import WorldConfig
from gsvis.world.estimate import estimate_world
from gsvis.world.prepare import prepare_world
from gsvis.world.tiling import TilingConfig

MOST = {
    "biker": 60_000, "arkit": 40_000, "trumpet": 40_000, "nika LOD 1, half": 20_000, "street": 20_000,
    "massa": 25_000, "gsplayer": 8_000, "street, walk": 10_000,
}  # fmt: skip
"""Most Gaussians of a tile of each scene."""

WALKS = {"street, walk": ((2.0, 0.0, 1.6), (16.0, 0.5, 1.6))}
"""Positions along which eyes are, of scenes in which they are not everywhere."""


def main() -> None:
    """Compare dry runs and worlds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", nargs="+", choices=tuple(MOST), default=list(MOST))
    parser.add_argument("--steps", type=int, default=30, help="steps of training of each lower level")
    parser.add_argument("--cells", type=int, default=2, help="cells of a tile")
    parser.add_argument("--work", type=Path, help="folder for the worlds; what is in it is not made again")
    parser.add_argument("--one", help=argparse.SUPPRESS)
    given = add_arguments(parser).parse_args()
    need(given.work, "a folder for the worlds with --work")
    if given.one:
        prepare(given.one, given)
        return
    details: dict[str, Any] = {}
    for name in given.scenes:
        found = folder_of(given.work, name) / "found.json"
        if not found.is_file():
            subprocess.run([sys.executable, __file__, "--one", name, *sys.argv[1:]], check=True)
        details[name] = json.loads(found.read_text())
    figures = []
    for key, title in TITLES.items():
        worst = max(apart(*details[name]["pairs"][key]) for name in details)
        figures.append({"name": f"{title}, the larger over the smaller, worst of all", "target": 1.3, "reached": worst,
                        "unit": "x", "better": "lower"})  # fmt: skip
    for name, found in details.items():
        for key, title in TITLES.items():
            said, came = found["pairs"][key]
            figures.append({"name": f"{name}: {title}, said over came", "target": None, "reached": said / came,
                            "unit": "x", "better": "lower"})  # fmt: skip
        share = found["estimate"]["spent"] / found["pairs"]["time"][1]
        figures.append({"name": f"{name}: the dry run, of the time of the world", "target": None, "reached": share,
                        "unit": "", "better": "lower"})  # fmt: skip
    write_result(given.out, "Is the dry run of a world right?", figures, details)


TITLES = {
    "time": "processor time", "levels": "time of levels", "packages": "time of packages", "memory": "peak PSS",
    "bytes": "bytes of the world", "kept": "bytes of the kept work",
}  # fmt: skip


def apart(said: float, came: float) -> float:
    """How far apart two numbers are: the larger over the smaller."""
    return max(said, came) / max(min(said, came), 1e-9)


def folder_of(work: Path, name: str) -> Path:
    """The folder of a scene's world."""
    return work / name.replace(" ", "-").replace(",", "")


def scene_of(name: str) -> Gaussians:
    """The Gaussians of a scene."""
    formats = realdata() / "scenes/formats"
    if name == "biker":
        return load_scene(formats / "biker.compressed.ply")
    if name == "arkit":
        return load_scene(formats / "arkit_scene.splat")
    if name == "gsplayer":
        return load_scene(formats / "gsplayer_scene.compressed.ply")
    if name in ("trumpet", "massa"):
        return load_scene(realdata() / f"scenes/statues/{name}.sog")
    if name in ("street", "street, walk"):
        return small_street(houses=6, step=0.12)
    g = load_scene(realdata() / "scenes/nika_sh3/lod-meta.json", 1)
    low, high = g.bounds(0.98)
    return g[g.means[:, 0] < 0.5 * (low[0] + high[0])]


def prepare(name: str, given: argparse.Namespace) -> None:
    """Estimate and prepare the world of a scene; keep both beside it."""
    use_threads(1)
    limit_threads()
    folder = folder_of(given.work, name)
    folder.mkdir(parents=True, exist_ok=True)
    save_ply(scene_of(name), folder / "scene.ply")
    scenes = [(str(folder / "scene.ply"), None)]
    package = PrepareConfig(levels=LevelsConfig((0.25, 0.5), iterations=given.steps), cells=given.cells)
    config = WorldConfig(TilingConfig(MOST[name]), package, walk=WALKS.get(name))
    estimate = estimate_world(scenes, config)
    with watch_memory(0.2) as peak:
        made = prepare_world(scenes, folder / "city.gsworld", config, workers=Workers(max_memory=estimate.max_memory))
    cpu = {
        stage: sum(result.cpu for task, result in made.results.items() if task.split()[0] in names)
        for stage, names in STAGES.items()
    }
    disk = sum(path.stat().st_size for path in made.work.rglob("*") if path.is_file())
    said = estimate.core_seconds
    pairs = {
        "time": (sum(said.values()), sum(cpu.values())), "levels": (said["levels"], cpu["levels"]),
        "packages": (said["packages"], cpu["packages"]), "memory": (estimate.memory, peak.bytes),
        "bytes": (estimate.nbytes, made.nbytes), "kept": (estimate.work_bytes, disk),
    }  # fmt: skip
    tiles = made.manifest.tiles
    sizes = {"gaussians": made.manifest.gaussians, "tiles": len(tiles), "cells": sum(tile.cells for tile in tiles)}
    document = {**sizes, "pairs": pairs, "cpu_s": cpu, "estimate": asdict(estimate)}
    (folder / "found.json").write_text(json.dumps(document))


if __name__ == "__main__":
    main()
