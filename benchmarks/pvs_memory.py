"""Does `gsvis pvs` stay under the memory cap that was set?

Runs the command on showroom LOD 3 (747k Gaussians), few cells, under caps of 2, 4 and 8 GB,
with as many workers as the cap allows, and samples the proportional set size (PSS: shared pages are split among those
who share them) of all its processes together. Peaks shorter than the time between two samples may go unseen.

Given: showroom LOD 3, caps of memory.
Measured: peak PSS of all processes.
Defaults chosen on: showroom LOD 3, the scene that is measured too.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from _harness import add_arguments, realdata, write_result
from _memory import pss, tree

EVERY = 0.1  # seconds between samples


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--caps", type=float, nargs="+", default=[2, 4, 8], help="GB")
    parser.add_argument("--cells", type=int, default=12)
    parser.add_argument("--max-inner", type=int, default=1)
    parser.add_argument("--workers", type=int, default=16, help="wanted; the cap decides how many there are")
    parser.add_argument("--methods", nargs="+", default=["hybrid"])
    options = parser.parse_args()
    scene = realdata() / "scenes/showroom/lod-meta.json"
    figures: list[dict[str, Any]] = []
    details: dict[str, Any] = {"cells": options.cells, "max_inner": options.max_inner, "every_s": EVERY}
    for method in options.methods:
        for cap in options.caps:
            with tempfile.TemporaryDirectory() as folder:
                words = [str(scene), "--lod", "3", "-o", str(Path(folder) / "out.pvs"), "--method", method]
                words += ["--cells", str(options.cells), "--max-inner", str(options.max_inner)]
                words += ["--workers", str(options.workers), "--max-memory", f"{cap:g}GB"]
                found = watched(words)
            named = f"peak memory under a cap of {cap:g} GB" + ("" if method == "hybrid" else f", {method}")
            figures.append({"name": named, "target": cap, "reached": found["peak_gb"], "unit": "GB", "better": "lower"})
            details[f"{method}, {cap:g} GB"] = found
    write_result(options.out, "Does `gsvis pvs` stay under the memory cap that was set?", figures, details)


def watched(words: list[str]) -> dict[str, Any]:
    """Run the command and follow the memory of its processes."""
    start = time.perf_counter()
    process = subprocess.Popen([sys.executable, "-m", "gsvis", "pvs", *words], stdout=subprocess.DEVNULL)
    peak: dict[str, Any] = {"peak_gb": 0.0}
    most, samples = 0, 0
    while process.poll() is None:
        each = [size for pid in tree(process.pid) if (size := pss(pid))]
        most, samples = max(most, len(each)), samples + 1
        if sum(each) / 1e9 > peak["peak_gb"]:
            peak = {
                "peak_gb": sum(each) / 1e9,
                "peak_at_s": round(time.perf_counter() - start, 1),
                "processes_mb": sorted((round(size / 1e6) for size in each), reverse=True),
            }
        time.sleep(EVERY)
    if process.returncode:
        raise SystemExit(f"gsvis pvs ended with {process.returncode}")
    return {**peak, "most_processes": most, "samples": samples, "seconds": round(time.perf_counter() - start, 1)}


if __name__ == "__main__":
    main()
