"""How much memory does it take to compute the tables of a world that is opened for the first time?

A world of showroom is prepared coarsely, then named several times over by a manifest of its own, so that a world of any
size costs no disk but its tables. Each size is opened in a process of its own, with its tables computed node by node;
the smaller ones also in memory, as packages are. Opened again, the tables are mapped.

Given: showroom LOD 3 in one copy, tiles of at most 250,000, no trained levels, one coarse cell a tile.
Measured: growth of the peak of private and shared memory (PSS) of a process while it opens the world, seconds of
    processor.
Defaults chosen on: no scene.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from _harness import add_arguments, need, realdata, write_result
from _memory import pss, watch_memory
from _worlds import write_copies

from gsvis.jobs.workers import Workers
from gsvis.prepare.config import PrepareConfig
from gsvis.pvs.config import PvsConfig
from gsvis.scene.view_sampling import ViewSampling
from gsvis.stream import Quality, StreamedScene
from gsvis.world import World
from gsvis.world.config import WorldConfig
from gsvis.world.manifest import District, WorldManifest
from gsvis.world.prepare import prepare_world
from gsvis.world.streamed import WorldSource, open_world
from gsvis.world.tiling import TilingConfig


def main() -> None:
    """Prepare a world, repeat it, and open each size."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--times", type=int, nargs="+", default=[1, 4, 16])
    parser.add_argument("--whole", type=int, default=4, help="largest of these that is also opened in memory")
    parser.add_argument("--work", type=Path, help="folder for worlds and tables, some gigabytes")
    parser.add_argument("--open", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--tables", type=Path, help=argparse.SUPPRESS)
    given = add_arguments(parser).parse_args()
    if given.open:
        print(json.dumps(opened(given.open, given.tables)))
        return
    need(given.work, "a folder for the worlds with --work")
    city = prepared(given.work)
    runs = []
    for times in given.times:
        world = repeated(city, given.work / f"times-{times}.gsworld", times)
        with tempfile.TemporaryDirectory(dir=given.work) as tables:
            run = {
                "gaussians": gaussians(world),
                "made": child(world, Path(tables)),
                "mapped": child(world, Path(tables)),
            }
            run["tables_bytes"] = sum(path.stat().st_size for path in Path(tables).glob("*.tables"))
        if times <= given.whole:
            run["in_memory"] = child(world, None)
        runs.append(run)
        print(json.dumps(run), file=sys.stderr)
    write(given, runs)


def write(given: argparse.Namespace, runs: list[dict[str, Any]]) -> None:
    """Write the figures."""
    small, large = runs[0], runs[-1]
    span = large["gaussians"] - small["gaussians"]
    growth = (large["made"]["grown"] - small["made"]["grown"]) / max(span, 1)
    held = [run for run in runs if "in_memory" in run]
    figures: list[dict[str, Any]] = [
        {"name": "memory to compute the tables of the largest", "target": 1.0, "reached": large["made"]["grown"] / 1e9,
         "unit": "GB", "better": "lower"},
        {"name": "more of it for each Gaussian more", "target": None, "reached": growth, "unit": "bytes",
         "better": "lower"},
        {"name": "Gaussians of the largest", "target": None, "reached": large["gaussians"] / 1e6, "unit": "million",
         "better": "higher"},
    ]  # fmt: skip
    if held:
        whole = held[-1]["in_memory"]["grown"] / held[-1]["gaussians"]
        figures.append(
            {
                "name": "in memory, for each Gaussian",
                "target": None,
                "reached": whole,
                "unit": "bytes",
                "better": "lower",
            }
        )
    write_result(given.out, "How much memory do the tables of a world take to compute?", figures, {"worlds": runs})


def prepared(work: Path) -> Path:
    """The world, prepared coarsely unless it is there."""
    scene, copies = realdata() / "scenes" / "showroom" / "lod-meta.json", work / "copies"
    if not copies.is_dir():
        write_copies(str(scene), 3, 1, copies)
    few = ViewSampling(1, 32, 24, 60.0, stream=3)
    sets = PvsConfig(size=64, lower_size=32, limit=0.2, rays=64, max_inner=1)
    package = PrepareConfig(levels=None, cells=1, sets=sets, cost_views=few, fidelity_views=replace(few, stream=5))
    config = WorldConfig(TilingConfig(250_000, up="+z"), package, looks=6)
    parts = [(str(path), None) for path in sorted(copies.glob("*.ply"))]
    prepare_world(parts, work / "city.gsworld", config, workers=Workers(1))
    return work / "city.gsworld"


def repeated(city: Path, to: Path, times: int) -> Path:
    """A world whose manifest names the nodes of another one several times, beside each other."""
    m = World.open(city).manifest
    inner = [tile for tile in m.tiles if tile.coords is not None]
    number = {k: j for j, k in enumerate(k for k, tile in enumerate(m.tiles) if tile.coords is not None)}
    total = len(inner) * times
    tiles, districts, width = [], [], m.grid.shape[0]
    for k in range(times):
        for tile in inner:
            x, y = tile.coords or (0, 0)
            tiles.append(replace(tile, coords=(x + k * width, y), beyond=None))
    for k in range(times):
        for district in m.districts:
            members = tuple(k * len(inner) + number[tile] for tile in district.tiles)
            base = total + k * len(m.districts)
            children = tuple(
                k * len(inner) + number[c] if c < len(m.tiles) else base + c - len(m.tiles) for c in district.children
            )
            districts.append(District(children, members, *_rest(district)))
    grid = replace(m.grid, shape=(width * times, m.grid.shape[1]))
    shutil.rmtree(to, ignore_errors=True)
    to.mkdir()
    os.symlink(city / "packages", to / "packages", target_is_directory=True)
    WorldManifest(m.up, m.meters_per_unit, grid, tuple(tiles), tuple(districts)).write(to / "world.json")
    return to


def _rest(d: District) -> tuple[Any, ...]:
    return d.low, d.high, d.spacing, d.package, d.nbytes, d.gaussians


def gaussians(world: Path) -> int:
    """Gaussians of all nodes."""
    m = World.open(world).manifest
    return sum(m.node(k).gaussians for k in range(len(m)))


def child(world: Path, tables: Path | None) -> dict[str, float]:
    """Open a world in a process of its own."""
    more = [] if tables is None else ["--tables", str(tables)]
    done = subprocess.run(
        [sys.executable, __file__, "--open", str(world), *more], check=True, stdout=subprocess.PIPE, text=True
    )
    found: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return found


def opened(world: Path, tables: Path | None) -> dict[str, float]:
    """Open a small part first, so that kernels are compiled and loaded, then the world."""
    before, cpu, began = pss(os.getpid()), time.process_time(), time.perf_counter()
    with watch_memory(0.05) as peak:
        if tables is None:
            scene = StreamedScene.open(WorldSource.open(world), quality=Quality())
        else:
            scene, _ = open_world(world, tables=tables, quality=Quality())
    assert len(scene)
    return {
        "grown": peak.bytes - before, "cpu_s": time.process_time() - cpu,
        "seconds": time.perf_counter() - began,
    }  # fmt: skip


if __name__ == "__main__":
    main()
