"""What do worlds cost: processor time of each stage against their size, and memory of all processes together?

Copies of a scene are cut into tiles out of core. All tiles get rows, spaces, one level and districts; a sample of tiles
of the largest world gets packages with what they see beyond. Exponents are of processor time against Gaussians, between
the smallest and the largest world.

Given: showroom LOD 3 in copies, turned, mirrored and jittered.
Measured: seconds of processor of each stage, peak of proportional memory (PSS) of all processes, exponents.
Defaults chosen on: no scene.
"""

from __future__ import annotations

import argparse
import math
import shutil
from pathlib import Path
from typing import Any

from _harness import add_arguments, need, realdata, write_result
from _memory import watch_memory
from _worlds import write_copies

from gsvis.jobs.objects import open_store
from gsvis.jobs.workers import Workers
from gsvis.prepare.config import PrepareConfig
from gsvis.progress import silent
from gsvis.world.build import WorldBuild
from gsvis.world.config import WorldConfig
from gsvis.world.tiling import TilingConfig

STAGES = {
    "tiling": ("sample", "grid", "split", "rows"),
    "space": ("space",),
    "districts": ("levels", "district"),
}


def main() -> None:
    """Prepare worlds of rising size as far as the sample goes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--lod", type=int, default=3)
    parser.add_argument("--copies", type=int, nargs="+", default=[1, 4])
    parser.add_argument("--most", type=int, default=250_000)
    parser.add_argument("--cells", type=int, default=2, help="cells of a tile")
    parser.add_argument("--sample", type=int, default=1, help="tiles that get their package; 0 for none")
    parser.add_argument("--district", action="store_true", help="sample all tiles of one district instead")
    parser.add_argument("--resume", action="store_true", help="go on with what an earlier run left; peaks are of now")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--work", type=Path, help="folder for the worlds, some gigabytes")
    given = add_arguments(parser).parse_args()
    need(given.work, "a folder for the worlds with --work")
    scene = realdata() / "scenes" / "showroom" / "lod-meta.json"
    builds = [start(scene, count, given) for count in given.copies]
    runs = [run(build) for build in builds]
    write(given, runs)  # the sample takes longest
    if given.sample or given.district:
        runs[-1] |= sample(builds[-1], given.sample, given.district)
        write(given, runs)


def write(given: argparse.Namespace, runs: list[dict[str, Any]]) -> None:
    """Write the figures."""
    figures: list[dict[str, Any]] = []
    if len(runs) > 1:
        figures = [
            {"name": f"exponent of {stage}", "target": 1.05, "reached": value, "unit": "", "better": "lower"}
            for stage, value in exponents(runs).items()
        ]
    peaks = [max(each["peak_pss"], each.get("sample_peak_pss", 0)) for each in runs]
    figures.append({"name": "peak PSS", "target": 4.0, "reached": max(peaks) / 1e9, "unit": "GB", "better": "lower"})
    details = {"worlds": runs, "most": given.most, "cells": given.cells, "workers": given.workers}
    write_result(given.out, "What do worlds cost in processor time and in memory?", figures, details)


def start(scene: Path, copies: int, given: argparse.Namespace) -> WorldBuild:
    """Write the copies, and return a preparation of which nothing has run."""
    folder = given.work / f"copies-{copies}"
    if not folder.is_dir():
        write_copies(str(scene), given.lod, copies, folder)
    store = given.work / f"copies-{copies}.work"
    if not given.resume:
        shutil.rmtree(store, ignore_errors=True)
    scenes = [(str(path), None) for path in sorted(folder.glob("*.ply"))]
    package = PrepareConfig(levels=None, cells=given.cells)
    config = WorldConfig(tiling=TilingConfig(most=given.most), package=package)
    return WorldBuild(scenes, config, open_store(store), Workers(given.workers), silent)


def run(build: WorldBuild) -> dict[str, Any]:
    """Seconds of processor of each stage but the packages, and the peak of memory."""
    with watch_memory(0.2) as peak:
        made = build.made
    cpu = {stage: sum(made[name].cpu for name in made if name.split()[0] in names) for stage, names in STAGES.items()}
    rows = [made[f"rows {k}"].facts["gaussians"] for k in range(len(build.tiles))]
    return {
        "gaussians": sum(rows), "tiles": len(rows), "largest_tile": max(rows), "districts": len(build.districts),
        "cpu_s": cpu, "peak_pss": peak.bytes,
    }  # fmt: skip


def sample(build: WorldBuild, count: int, district: bool) -> dict[str, Any]:
    """Packages of the fullest tiles with a space, or of those of the first district of several; the peak of memory."""
    nodes, made = build.nodes, build.made
    order = sorted(nodes, key=lambda k: -made[f"rows {k}"].facts["gaussians"])[:count]
    if district:
        order = [k for k in next(plan.tiles for plan in build.districts if len(plan.tiles) > 1) if k in nodes]
    with watch_memory(0.2) as peak:
        results = build.prepared(order)
    tiles = [
        {
            "gaussians": made[f"rows {k}"].facts["gaussians"], "nodes_around": len(nodes[k]),
            "around": sum(number for piece in result.facts["pieces"] for _, number in piece["runs"]),
            "cells": result.facts["cells"], "cpu_s": result.cpu, "bytes": result.facts["bytes"],
            "beyond_bytes": result.files["beyond"][1] if "beyond" in result.files else 0,
        }
        for k, result in zip(order, results, strict=True)
    ]  # fmt: skip
    return {"sample": tiles, "sample_peak_pss": peak.bytes}


def exponents(runs: list[dict[str, Any]]) -> dict[str, float]:
    """Exponent of processor time of each stage against Gaussians, between the smallest and the largest world."""
    small, large = runs[0], runs[-1]
    span = math.log(large["gaussians"] / small["gaussians"])
    return {stage: math.log(large["cpu_s"][stage] / small["cpu_s"][stage]) / span for stage in STAGES}


if __name__ == "__main__":
    main()
