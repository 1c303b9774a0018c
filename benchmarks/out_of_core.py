"""Do clean and convert keep to `--max-memory` on scenes that do not fit it, and is what they write the same?

A scene and a larger one of its copies are converted, and cleaned in tiles under a limit that the scene at once exceeds.
The scene is also cleaned at once, without a limit, to compare.

Given: showroom LOD 2, and copies of LOD 3, turned, mirrored and jittered.
Measured: peak of proportional memory (PSS) of the command over the limit, seconds of processor, and of the Gaussians
    that clean at once removes, or keeps, the share that clean in tiles removes too; with `--smaller` an exponent.
Defaults chosen on: memory for each Gaussian on showroom LOD 2 and 3.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from _harness import add_arguments, need, realdata, write_result
from _memory import pss, tree
from _worlds import write_copies

from gsvis.io import load_scene
from gsvis.scene.gaussians import Gaussians


def main() -> None:
    """Run the commands and compare."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--lod", type=int, default=2, help="of the scene")
    parser.add_argument("--copies", type=int, default=4, help="in the larger scene")
    parser.add_argument("--copied", type=int, default=3, help="LOD of the copies")
    parser.add_argument("--limit", type=int, default=950, help="--max-memory of clean, MB")
    parser.add_argument("--only", choices=("convert", "scene", "larger"), nargs="+", help="leave out the rest")
    parser.add_argument("--smaller", type=Path, help="result of this benchmark with fewer copies, for an exponent")
    parser.add_argument("--work", type=Path, help="folder for the scenes, a gigabyte")
    given = add_arguments(parser).parse_args()
    need(given.work, "a folder for the scenes with --work")
    given.work.mkdir(parents=True, exist_ok=True)
    parts = given.only or ("convert", "scene", "larger")
    runs, figures = dict[str, dict[str, Any]](), list[dict[str, Any]]()
    scene = [str(realdata() / "scenes/showroom/lod-meta.json"), "--lod", str(given.lod)]
    larger = given.work / "large.ply"
    copies = given.work / f"copies-{given.copied}-{given.copies}"
    if not copies.is_dir():
        write_copies(scene[0], given.copied, given.copies, copies)
    runs["merge"] = command("convert", *map(str, sorted(copies.glob("*.ply"))), "-o", str(larger), "--overwrite")
    if "convert" in parts:
        out = ["-o", str(given.work / "converted.ply"), "--overwrite", "--min-opacity", "0.02", "--rotate", *"009"]
        runs["convert scene"] = command("convert", *scene, *out)
        runs["convert larger"] = command("convert", str(larger), *out)
        pair = [runs[f"convert {which}"] for which in ("scene", "larger")]
        figures.append(
            {"name": "peak PSS of convert, the larger scene over the scene", "target": 1.1, "unit": "",
             "reached": pair[1]["peak_pss"] / pair[0]["peak_pss"], "better": "lower"}
        )  # fmt: skip
    limited = ["--max-memory", f"{given.limit}MB", "--overwrite", "-o"]
    if "scene" in parts:
        whole, tiled = (str(given.work / f"{name}.ply") for name in ("whole", "tiled"))
        runs["clean at once"] = command("clean", *scene, "-o", whole, "--overwrite")
        runs["clean in tiles"] = command("clean", *scene, *limited, tiled)
        gone, both = compare(load_scene(scene[0], given.lod), load_scene(whole), load_scene(tiled))
        figures += [
            {"name": "of what clean at once removes, in tiles too", "target": None, "reached": both[0], "unit": "",
             "better": "higher"},
            {"name": "of what it keeps, removed in tiles", "target": None, "reached": both[1], "unit": "",
             "better": "lower"},
        ]  # fmt: skip
        runs["clean in tiles"]["removed_by_both"] = gone
    if "larger" in parts:
        runs["clean larger in tiles"] = command("clean", str(larger), *limited, str(given.work / "tiled-large.ply"))
        if given.smaller is not None:
            before = json.loads(given.smaller.read_text())["details"]["runs"]["clean larger in tiles"]
            ratios = [runs["clean larger in tiles"][name] / before[name] for name in ("cpu_s", "gaussians")]
            figures.append(
                {"name": "exponent of processor time of clean", "target": 1.05, "unit": "",
                 "reached": float(np.log(ratios[0]) / np.log(ratios[1])), "better": "lower"}
            )  # fmt: skip
    for name, run in runs.items():
        if "in tiles" in name:
            over = {"name": f"peak PSS over --max-memory, {name}", "target": 1.0, "unit": "", "better": "lower"}
            figures.append({**over, "reached": run["peak_pss"] / (given.limit * 1_000_000)})
    write_result(
        given.out, "Do clean and convert keep to --max-memory?", figures, {"runs": runs, "limit_mb": given.limit}
    )


def command(*words: str) -> dict[str, Any]:
    """Run a command of gsvis; return its document, seconds of processor and the peak of PSS."""
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    process = subprocess.Popen([sys.executable, "-m", "gsvis", *words, "--json"], stdout=subprocess.PIPE)
    peak = 0
    while process.poll() is None:
        peak = max(peak, sum(pss(pid) for pid in tree(process.pid)))
        time.sleep(0.1)
    assert process.stdout is not None
    text = process.stdout.read()
    if process.returncode:
        raise SystemExit(f"gsvis {words[0]} ended with {process.returncode}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    document = json.loads(text)
    names = ("gaussians", "kept", "gaussians_in", "gaussians_out", "tiles", "classes", "worst_db", "cost")
    facts = {name: document[name] for name in names if name in document}
    return {"cpu_s": cpu, "seconds": time.perf_counter() - began, "peak_pss": peak, **facts}


def compare(g: Gaussians, whole: Gaussians, tiled: Gaussians) -> tuple[int, tuple[float, float]]:
    """How many both remove; the share of what the first removes, and of what it keeps, that the second removes."""
    rows = [{row.tobytes() for row in each.means} for each in (whole, tiled)]
    names = [row.tobytes() for row in g.means]
    gone, also = (np.array([name not in kept for name in names]) for kept in rows)
    both = int((gone & also).sum())
    return both, (both / max(1, int(gone.sum())), float((also & ~gone).sum() / max(1, int((~gone).sum()))))


if __name__ == "__main__":
    main()
