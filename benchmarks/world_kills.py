"""What does a kill cost the preparation of a world?

A world is prepared in a process with two workers that is killed again and again, workers included, at random times
after its first task began, until it is complete. Every task notes when it begins and when it has ended. Views, faces
and steps are few, so that a world of many tiles takes minutes.

Given: a scene of the real data, copies of it, or a built-in street of 4 houses.
Measured: tasks that had begun and not ended at each kill, tasks that ran again though they had ended, differing files
    against a run that nobody killed, files that only the killed run has left beside its world or among temporary files.
Defaults chosen on: nothing.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from _harness import add_arguments, need, write_result
from _worlds import small_street
from world_whole import scenes_of

from gsvis.io.ply import save_ply
from gsvis.jobs import graph
from gsvis.jobs.workers import Workers
from gsvis.prepare.config import PrepareConfig
from gsvis.pvs.config import PvsConfig
from gsvis.scene.view_sampling import ViewSampling
from gsvis.train.levels import LevelsConfig
from gsvis.world.config import WorldConfig
from gsvis.world.manifest import WORLD, WorldManifest
from gsvis.world.prepare import prepare_world
from gsvis.world.tiling import TilingConfig

WORKERS = 2


def main() -> None:
    """Prepare a world twice, once with kills."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scene", help="a scene of the real data; default: a built-in street")
    parser.add_argument("--lod", type=int, default=3)
    parser.add_argument("--copies", type=int, default=0, help="turned, mirrored and jittered copies; 0 for the scene")
    parser.add_argument("--most", type=int, default=60_000, help="Gaussians of a tile of that scene")
    parser.add_argument("--work", type=Path, help="folder for copies, some gigabytes")
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--every", type=float, help="seconds between two kills, without a run that nobody kills")
    parser.add_argument("--keep", type=Path, help="folder of the two worlds, kept; a killed one goes on")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--prepare", type=Path, help=argparse.SUPPRESS)
    given = add_arguments(parser).parse_args()
    if given.prepare:
        prepare(given.prepare, given)
        return
    if given.copies:
        need(given.work, "a folder for copies with --work")
        given.work.mkdir(parents=True, exist_ok=True)
        scenes_of(given)
    with ExitStack() as stack:
        folder = given.keep or stack.enter_context(tempfile.TemporaryDirectory(dir=given.work))
        whole, killed = Path(folder) / "whole", Path(folder) / "killed"
        for each in (whole, killed):
            (each / "tmp").mkdir(parents=True, exist_ok=True)
            if given.scene is None:
                save_ply(small_street(houses=4, step=0.35, flyaways=12), each / "street.ply")
        took = given.every * given.kills if given.every else begun(whole, None)
        kills, rng = 0, random.Random(given.seed)
        lost: list[int] = []
        while kills < given.kills:
            if begun(killed, rng.uniform(0.0, 2.0 * took / given.kills)) is not None:
                break  # complete before it could be killed
            kills += 1
            lost.append(open_tasks(killed))
            if kills == given.kills:
                begun(killed, None)
        ends = Counter(line.split(" ", 1)[1] for line in lines(killed) if line.startswith("end"))
        again = sum(count - 1 for count in ends.values())
        whole_world, killed_world = content(whole), content(killed)
        differing = sum(whole_world.get(name) != killed_world.get(name) for name in whole_world | killed_world)
        left = {name for name in kept(killed) if name.startswith("tmp")} if given.every else kept(killed) - kept(whole)
        tiles = WorldManifest.read(killed / "city.gsworld" / WORLD).tiles
    figures = [
        {"name": "kills", "target": given.kills, "reached": kills, "unit": "", "better": "higher"},
        {"name": "tasks lost by a kill, most", "target": WORKERS, "reached": max(lost), "unit": "", "better": "lower"},
        {"name": "tasks that had ended and ran again", "target": 0, "reached": again, "unit": "", "better": "lower"},
        {"name": "temporary files left", "target": 0, "reached": len(left), "unit": "", "better": "lower"},
    ]
    if not given.every:
        figures.append({"name": "files that differ", "target": 0, "reached": differing, "unit": "", "better": "lower"})
    details = {
        "scene": given.scene or "a built-in street", "copies": given.copies, "tiles": len(tiles), "tasks": len(ends),
        "gaussians": sum(tile.levels[-1][1] for tile in tiles), "unkilled_s": None if given.every else took,
        "lost": lost, "left": sorted(left),
    }  # fmt: skip
    write_result(given.out, "What does a kill cost the preparation of a world?", figures, details)


def begun(folder: Path, seconds: float | None) -> float | None:
    """Prepare in a group of processes of its own and kill it a time after it began a task.

    Returns:
        How long it took; None if killed.
    """
    began, noted = time.perf_counter(), (folder / "log").stat().st_size if (folder / "log").is_file() else 0
    words = [sys.executable, __file__, "--prepare", str(folder), *sys.argv[1:]]
    process = subprocess.Popen(words, start_new_session=True, env={**os.environ, "TMPDIR": str(folder / "tmp")})
    if seconds is not None:
        while process.poll() is None and not ((folder / "log").is_file() and (folder / "log").stat().st_size > noted):
            time.sleep(0.02)
    try:
        code = process.wait(seconds)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        with (folder / "log").open("a") as log:
            log.write("kill\n")
        return None
    assert code == 0
    return time.perf_counter() - began


def prepare(folder: Path, given: argparse.Namespace) -> None:
    """Prepare the world of a folder."""
    few = {
        "level_views": ViewSampling(4, 48, 36, 90.0), "cost_views": ViewSampling(1, 32, 24, 60.0, stream=3),
        "fidelity_views": ViewSampling(1, 32, 24, 60.0, stream=5),
    }  # fmt: skip
    sets = PvsConfig(size=24, lower_size=16, limit=0.05, rays=128, max_inner=1)
    levels, cells = None, 2
    tiling, options = TilingConfig(500, up="+z"), {"far": 64, "angle": 0.1, "looks": 6, "resolution": 32}
    scenes: list[tuple[str, int | None]] = [(str(folder / "street.ply"), None)]
    if given.scene is not None:
        scenes = scenes_of(given)
        sets, cells = replace(sets, size=96, lower_size=64), 1
        levels = LevelsConfig((0.25, 0.5), iterations=4)
        tiling, options = TilingConfig(given.most), {"far": 2048, "angle": 0.05, "looks": 6, "resolution": 96}
    package = PrepareConfig(levels=levels, level_held_out=0, cells=cells, sets=sets, **few)
    os.environ["GSVIS_KILLS_LOG"] = str(folder / "log")
    graph.perform = noted
    config = WorldConfig(tiling, package, **options)
    prepare_world(scenes, folder / "city.gsworld", config, workers=Workers(WORKERS))


_perform = graph.perform


def noted(job: graph.Job) -> graph.Result:
    """Run a task and note its beginning and its end."""
    note(f"begin {job.task.name}")
    found = _perform(job)
    note(f"end {job.task.name}")
    return found


def note(text: str) -> None:
    """Add a line to the log, in one write."""
    descriptor = os.open(os.environ["GSVIS_KILLS_LOG"], os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    os.write(descriptor, f"{text}\n".encode())
    os.close(descriptor)


def lines(folder: Path) -> list[str]:
    """The lines of the log."""
    return (folder / "log").read_text().splitlines()


def open_tasks(folder: Path) -> int:
    """How many tasks had begun and not ended at the last kill."""
    found = lines(folder)
    last = max(k for k, line in enumerate(found) if line == "kill")
    before = max((k for k, line in enumerate(found[:last]) if line == "kill"), default=-1)
    counts = Counter(line.split(" ", 1)[0] for line in found[before + 1 :])
    return counts["begin"] - counts["end"]


def content(folder: Path) -> dict[str, str]:
    """Digests of the files of the world."""
    world = folder / "city.gsworld"
    paths = [path for path in world.rglob("*") if path.is_file()]
    return {path.relative_to(world).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in paths}


def kept(folder: Path) -> set[str]:
    """Files beside the world and among temporary files, without the log."""
    paths = (path.relative_to(folder) for path in folder.rglob("*") if path.is_file() and path.name != "log")
    return {path.as_posix() for path in paths if path.parts[0] != "city.gsworld"}


if __name__ == "__main__":
    main()
