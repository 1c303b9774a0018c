"""What does a kill cost the preparation of a world?

A small street is prepared in a process with two workers that is killed again and again, workers included, after random
times, until it is complete. Every task notes when it begins and when it has ended.

Given: a built-in street of 4 houses.
Measured: tasks that had begun and not ended at each kill, tasks that ran again though they had ended, differing files
    against a run that nobody killed.
Defaults chosen on: nothing.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from _harness import add_arguments, write_result
from _worlds import small_street

from gsvis.io.ply import save_ply
from gsvis.prepare.config import PrepareConfig
from gsvis.pvs.config import PvsConfig
from gsvis.pvs.workers import Workers
from gsvis.scene.view_sampling import ViewSampling
from gsvis.world import graph
from gsvis.world.config import WorldConfig
from gsvis.world.prepare import prepare_world
from gsvis.world.tiling import TilingConfig

WORKERS = 2


def main() -> None:
    """Prepare a street twice, once with kills."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--prepare", type=Path, help=argparse.SUPPRESS)
    given = add_arguments(parser).parse_args()
    if given.prepare:
        prepare(given.prepare)
        return
    with tempfile.TemporaryDirectory() as folder:
        whole, killed = Path(folder) / "whole", Path(folder) / "killed"
        for each in (whole, killed):
            each.mkdir()
            save_ply(small_street(houses=4, step=0.35, flyaways=12), each / "street.ply")
        took = begun(whole, None)
        kills, rng = 0, random.Random(given.seed)
        lost: list[int] = []
        while kills < given.kills:
            if begun(killed, rng.uniform(0.25, 0.35) * took) is not None:
                break  # complete before it could be killed
            kills += 1
            lost.append(open_tasks(killed))
            if kills == given.kills:
                begun(killed, None)
        ends = Counter(line.split(" ", 1)[1] for line in lines(killed) if line.startswith("end"))
        again = sum(count - 1 for count in ends.values())
        differing = sum(a != b for a, b in zip(content(whole), content(killed), strict=True))
    figures = [
        {"name": "kills", "target": given.kills, "reached": kills, "unit": "", "better": "higher"},
        {"name": "tasks lost by a kill, most", "target": WORKERS, "reached": max(lost), "unit": "", "better": "lower"},
        {"name": "tasks that had ended and ran again", "target": 0, "reached": again, "unit": "", "better": "lower"},
        {"name": "files that differ", "target": 0, "reached": differing, "unit": "", "better": "lower"},
    ]
    details = {"lost": lost, "tasks": len(ends), "unkilled_s": took}
    write_result(given.out, "What does a kill cost the preparation of a world?", figures, details)


def begun(folder: Path, seconds: float | None) -> float | None:
    """Prepare in a group of processes of its own and kill it after a time; return how long it took, None if killed."""
    began = time.perf_counter()
    process = subprocess.Popen([sys.executable, __file__, "--prepare", str(folder)], start_new_session=True)
    try:
        code = process.wait(seconds)
    except subprocess.TimeoutExpired:
        with (folder / "log").open("a") as log:
            log.write("kill\n")
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        return None
    assert code == 0
    return time.perf_counter() - began


def prepare(folder: Path) -> None:
    """Prepare the street of a folder."""
    few = {
        "level_views": ViewSampling(4, 48, 36, 90.0), "cost_views": ViewSampling(1, 32, 24, 60.0, stream=3),
        "fidelity_views": ViewSampling(1, 32, 24, 60.0, stream=5),
    }  # fmt: skip
    sets = PvsConfig(size=24, lower_size=16, limit=0.05, rays=128, max_inner=1)
    package = PrepareConfig(levels=None, level_held_out=0, cells=2, sets=sets, **few)
    config = WorldConfig(TilingConfig(500, up="+z"), package, far=64, angle=0.1, looks=6, resolution=32)
    os.environ["GSVIS_KILLS_LOG"] = str(folder / "log")
    graph.perform = noted
    prepare_world([(str(folder / "street.ply"), None)], folder / "city.gsworld", config, workers=Workers(WORKERS))


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


def content(folder: Path) -> list[tuple[str, bytes]]:
    """The files of the world."""
    world = folder / "city.gsworld"
    paths = sorted(path for path in world.rglob("*") if path.is_file())
    return [(path.relative_to(world).as_posix(), path.read_bytes()) for path in paths]


if __name__ == "__main__":
    main()
