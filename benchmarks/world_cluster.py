"""How much faster is a Dask cluster of two workers than one, on the same graph?

Tiles of a scene go through the whole graph of a world, once with one worker and once with two, each a process with one
thread and a folder of its own. Results lie in a folder that all reach. Before, each cluster prepares a small street,
so that imports and compiled kernels are not counted.

Given: showroom LOD 3 as a world, and packages of some of its tiles.
Measured: seconds from the first task to the last, and of processor in the workers; whether the results are equal.
Defaults chosen on: no scene.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from _harness import add_arguments, need, realdata, write_result
from _worlds import small_street

from gsvis.io.ply import save_ply
from gsvis.jobs.cluster import connect
from gsvis.jobs.objects import open_store
from gsvis.prepare.config import PrepareConfig
from gsvis.progress import silent
from gsvis.pvs.config import PvsConfig
from gsvis.world.build import WorldBuild
from gsvis.world.config import WorldConfig
from gsvis.world.tiling import TilingConfig

_WAIT = 120.0  # seconds for a scheduler or workers
_QUIET = {**os.environ, "DASK_DISTRIBUTED__LOGGING__DISTRIBUTED": "critical"}


def main() -> None:
    """Run the graph on one worker, then on two."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--lod", type=int, default=3)
    parser.add_argument("--most", type=int, default=60_000)
    parser.add_argument("--tiles", type=int, default=6, help="tiles that get their package")
    parser.add_argument("--street", action="store_true", help="a built-in street instead, to try the benchmark")
    parser.add_argument("--workers", type=int, nargs=2, default=[1, 2])
    parser.add_argument("--work", type=Path, help="folder for the results, a gigabyte")
    given = add_arguments(parser).parse_args()
    need(given.work, "a folder for the results with --work")
    given.work.mkdir(parents=True, exist_ok=True)
    save_ply(small_street(houses=2, step=0.4, flyaways=12), given.work / "street.ply")
    runs = [run(given, count) for count in given.workers]
    one, more = runs
    speed_up = one["seconds"] / more["seconds"]
    target = {2: 1.7, 4: 3.2}.get(given.workers[1])
    figures: list[dict[str, Any]] = [
        {"name": f"speed-up of {given.workers[1]} workers over {given.workers[0]}", "target": target,
         "reached": speed_up, "unit": "", "better": "higher"},
        {"name": "results that differ", "target": 0, "unit": "", "better": "lower",
         "reached": sum(one["digests"][name] != digest for name, digest in more["digests"].items())},
        {"name": "processor time, more workers over one", "target": None,
         "reached": more["cpu"] / one["cpu"], "unit": "", "better": "lower"},
    ]  # fmt: skip
    details = [{name: value for name, value in each.items() if name != "digests"} for each in runs]
    write_result(given.out, "How much faster is a Dask cluster of two workers than one?", figures, {"runs": details})


def run(given: argparse.Namespace, count: int) -> dict[str, Any]:
    """The graph on a cluster of its own: time and results."""
    folder = given.work / f"workers-{count}"
    shutil.rmtree(folder, ignore_errors=True)
    street = [(str(given.work.absolute() / "street.ply"), None)]
    scene = street if given.street else [(str(realdata() / "scenes" / "showroom" / "lod-meta.json"), given.lod)]
    package = PrepareConfig(levels=None, cells=1)
    config = WorldConfig(TilingConfig(700 if given.street else given.most), package)
    quick = PrepareConfig(levels=None, cells=1, sets=PvsConfig(size=24, limit=0.05, rays=128, max_inner=1))
    with cluster(folder, count) as address, connect(address) as workers:
        for k in range(count):  # each worker gets some of the tasks
            warm = WorldConfig(TilingConfig(700, up="+z"), quick, angle=0.1 + 0.01 * k)
            perform(WorldBuild(street, warm, open_store(folder / f"warm-{k}"), workers, silent), 99)
        return perform(WorldBuild(scene, config, open_store(folder / "store"), workers, silent), given.tiles)


def perform(build: WorldBuild, tiles: int) -> dict[str, Any]:
    """Make everything but packages, and the packages of the fullest tiles."""
    began = time.perf_counter()
    nodes = build.nodes
    before = time.perf_counter() - began
    rows = {k: build.made[f"rows {k}"].facts["gaussians"] for k in nodes}
    chosen = sorted(sorted(nodes, key=lambda k: -rows[k])[:tiles])
    results = {f"tile {k}": each for k, each in zip(chosen, build.prepared(chosen), strict=True)}
    seconds = time.perf_counter() - began
    results |= build.chosen
    return {
        "seconds": seconds, "seconds_before_packages": before, "cpu": sum(each.cpu for each in results.values()),
        "tiles": len(build.tiles), "packages": {k: rows[k] for k in chosen},
        "digests": {name: each.digest for name, each in results.items()},
    }  # fmt: skip


@contextmanager
def cluster(folder: Path, count: int) -> Iterator[str]:
    """The address of a scheduler with workers, each a process with one thread and a folder of its own."""
    folder.mkdir(parents=True)
    found = folder / "scheduler.json"
    options = ["--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--no-show", "--scheduler-file", str(found)]
    processes = [started("dask_scheduler", folder, *options)]
    try:
        until = time.monotonic() + _WAIT
        address = ""
        while not address and time.monotonic() < until:
            with contextlib.suppress(FileNotFoundError, ValueError):  # not there yet, or half of it
                address = str(json.loads(found.read_text())["address"])
            time.sleep(0.05)
        for k in range(count):
            own = folder / f"worker-{k}"
            own.mkdir()
            options = ["--no-nanny", "--nthreads", "1", "--no-dashboard", "--local-directory", str(own)]
            processes.append(started("dask_worker", own, address, *options))
        wait_for_workers(address, count)
        yield address
    finally:
        for process in processes:
            process.kill()
            process.wait()


def wait_for_workers(address: str, count: int) -> None:
    """Wait until all workers are there."""
    from distributed import Client

    with Client(address, timeout=_WAIT, set_as_default=False) as client:
        client.wait_for_workers(count, timeout=_WAIT)


def started(name: str, folder: Path, *words: str) -> subprocess.Popen[bytes]:
    """A process of Dask with a folder of its own."""
    command = [sys.executable, "-m", f"distributed.cli.{name}", *words]
    return subprocess.Popen(command, cwd=folder, env=_QUIET, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


if __name__ == "__main__":
    main()
