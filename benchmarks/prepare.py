"""How long does `gsvis prepare` take from a PLY with nothing made before, and does `--dry-run` say so beforehand?

Every scene is written as a PLY; the command is then asked for its estimate and run, both as a user runs them, and the
proportional set size (PSS) of all their processes is sampled. The machine's load before each is kept beside its
figures: times on a busy machine say little.

Given: scenes, defaults of the command.
Measured: seconds from start to exit, peak PSS, and both against the estimate.
Defaults chosen on: showroom LOD 3 and flowers LOD 3 (rays, faces, steps), guitar (sets of thin objects, their
    estimate). Nika had no part in it.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from _harness import add_arguments, realdata, write_result
from _memory import pss, tree

EVERY = 0.2  # seconds between samples of memory
SCENES: dict[str, tuple[str, int | None, float | None]] = {  # file under the scenes' folder, LOD, target in seconds
    "flowers LOD 3": ("flowers_sh2/lod-meta.json", 3, 60.0),
    "flowers LOD 2": ("flowers_sh2/lod-meta.json", 2, 120.0),
    "nika LOD 0": ("nika_sh3/lod-meta.json", 0, 150.0),
    "showroom LOD 3": ("showroom/lod-meta.json", 3, 240.0),
    "nika LOD 1": ("nika_sh3/lod-meta.json", 1, None),
    "guitar": ("formats/guitar.compressed.ply", None, 120.0),
}


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    options = parser.parse_args()
    figures: list[dict[str, Any]] = []
    details: dict[str, Any] = {"every_s": EVERY}
    for name in options.scenes:
        path, lod, target = SCENES[name]
        with tempfile.TemporaryDirectory() as folder:
            ply = Path(folder) / "scene.ply"
            run(["convert", str(realdata() / "scenes" / path), str(ply), *(() if lod is None else ("--lod", str(lod)))])
            words = ["prepare", str(ply), "-o", str(Path(folder) / "scene.gsvis"), "--json"]
            said, ran = run([*words, "--dry-run"]), run(words)
        estimate = said.pop("answer")
        ratio = ran["seconds"] / estimate["seconds"]
        answer = ran.pop("answer")
        details[name] = {
            "gaussians": estimate["gaussians"],
            "dry run": said,
            "estimate": {key: estimate[key] for key in ("seconds", "memory", "stages", "cells")},
            "prepare": ran,
            "stages": answer.get("stages"),
            "time over estimate": ratio,
        }
        figures += [
            {"name": f"{name}: prepare", "target": target, "reached": ran["seconds"], "unit": "s", "better": "lower"},
            {"name": f"{name}: peak memory", "target": 3.0, "reached": ran["peak_gb"], "unit": "GB", "better": "lower"},
            {"name": f"{name}: dry run", "target": 20.0, "reached": said["seconds"], "unit": "s", "better": "lower"},
            {
                "name": f"{name}: time and estimate, the larger over the smaller",
                "target": 1.3,
                "reached": max(ratio, 1 / ratio),
                "unit": "x",
                "better": "lower",
            },
            {
                "name": f"{name}: peak memory over estimate",
                "target": 1.0,
                "reached": 1e9 * ran["peak_gb"] / estimate["memory"],
                "unit": "x",
                "better": "lower",
            },
        ]
    write_result(options.out, "How long does `gsvis prepare` take, and does the dry run say so?", figures, details)


def run(words: list[str]) -> dict[str, Any]:
    """Run the command, follow the memory of its processes, and keep what it printed as JSON."""
    load, start, peak = os.getloadavg()[0], time.perf_counter(), 0
    with tempfile.TemporaryFile() as out:
        process = subprocess.Popen([sys.executable, "-m", "gsvis", *words], stdout=out)
        while process.poll() is None:
            peak = max(peak, sum(pss(pid) for pid in tree(process.pid)))
            time.sleep(EVERY)
        seconds = time.perf_counter() - start
        if process.returncode:
            raise SystemExit(f"gsvis {words[0]} ended with {process.returncode}")
        out.seek(0)
        text = out.read().decode()
    answer = json.loads(text) if "--json" in words else None
    return {"load_before": load, "seconds": seconds, "peak_gb": peak / 1e9, "answer": answer}


if __name__ == "__main__":
    main()
