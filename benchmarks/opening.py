"""What does a server pay to open a package, in time and memory, and what does it hold when one viewer looks?

Three processes open the same package: one decodes all records into memory, one computes the tables and keeps them, one
maps the kept tables. Each then plans for a viewer in one cell, and for one that walks through eight cells. Processor
time, since the machine may be busy, of a second opening in the same process: the first also loads compiled kernels.
Private memory apart from that of mapped files, which the system can take back and processes share.

Given: a package.
Measured: seconds of the processor until a scene can be streamed (of computed tables: at the first opening), resident
    memory at each step.
Defaults chosen on: showroom LOD 3.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from _harness import add_arguments, need, write_result

WAYS = {"memory": "all records in memory", "computed": "tables computed and kept", "mapped": "kept tables mapped"}


def status() -> dict[str, float]:
    """Megabytes of memory of this process: its own, and of files."""
    lines = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text(encoding="utf-8").splitlines())
    own, files = (int(lines[key].split()[0]) / 1024 for key in ("RssAnon", "RssFile"))
    return {"own_mb": own, "files_mb": files}


def opened(package: Path, tables: Path | None) -> dict[str, Any]:
    """Open a package in this process, and look."""
    from gsvis.abr.classes import FieldOfView
    from gsvis.package import Package
    from gsvis.stream import Session, StreamedScene
    from gsvis.stream.kept import open_kept

    def take() -> tuple[StreamedScene, float]:
        before = time.process_time()
        scene = StreamedScene.open(package) if tables is None else open_kept(Package.open(package), tables)[0]
        return scene, time.process_time() - before

    found: dict[str, Any] = {"before": status()}
    scene, found["first_cpu_s"] = take()
    found["opened"] = status()
    centers, digest = scene.index.grid.centers, hashlib.sha256()
    for name, count in (("one cell", 1), ("eight cells", 8)):
        session = Session(scene, FieldOfView.from_degrees(90.0, 70.0, margin=8.0))
        session.welcome(0.0)
        for k in range(count):
            for turn in range(3):
                t = k + 0.2 * turn + 0.1
                session.on_pose(t, centers[k % len(centers)], (1.0, 0.4 * turn, 0.0, 0.0))
                message = session.next_message(t, 60_000.0)
                if message is not None:
                    digest.update(message.data)
                    session.on_ack(t + 0.05, message.sequence)
        found[name] = status()
    found["cpu_s"] = take()[1]
    return {**found, "sha256": digest.hexdigest(), "gaussians": len(scene)}


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("package", type=Path, nargs="?", help="what `gsvis prepare` made")
    parser.add_argument("--way", choices=WAYS, help="for the processes that this one starts")
    parser.add_argument("--tables", type=Path)
    args = parser.parse_args()
    need(args.package, "what `gsvis prepare` made")
    if args.way:
        print(json.dumps(opened(args.package, None if args.way == "memory" else args.tables)))
        return
    runs: dict[str, dict[str, Any]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for way in WAYS:
            command = [sys.executable, __file__, str(args.package), "--way", way, "--tables", folder]
            text = subprocess.run(command, capture_output=True, text=True, check=True).stdout
            runs[way] = json.loads(text.splitlines()[-1])
        on_disk = {p.suffix: p.stat().st_size for p in Path(folder).iterdir() if p.suffix != ".lock"}
    same = len({run["sha256"] for run in runs.values()}) == 1
    n = runs["memory"]["gaussians"]
    figures: list[dict[str, Any]] = [
        {"name": "messages are the same to the byte", "target": 1, "reached": int(same), "unit": "", "better": "higher"}
    ]
    for way, label in WAYS.items():
        run = runs[way]
        seconds = run["first_cpu_s" if way == "computed" else "cpu_s"]
        figures.append({"name": f"{label}: opening", "target": 0.1 if way == "mapped" else None, "reached": seconds,
                        "unit": "s of processor", "better": "lower"})  # fmt: skip
        for step in ("opened", "one cell", "eight cells"):
            for kind, what in (("own_mb", "own memory"), ("files_mb", "memory of files")):
                grown = max(run[step][kind] - run["before"][kind], 0.0) * 2**20 / n
                figures.append({"name": f"{label}: {what}, {step}", "target": None, "reached": grown,
                                "unit": "bytes a Gaussian", "better": "lower"})  # fmt: skip
    figures.append({"name": "tables on disk", "target": None, "reached": on_disk[".tables"] / n,
                    "unit": "bytes a Gaussian", "better": "lower"})  # fmt: skip
    details = {"package": args.package.name, "gaussians": n, "runs": runs, "on_disk": on_disk}
    write_result(args.out, "What does a server pay to open a package?", figures, details)


if __name__ == "__main__":
    main()
