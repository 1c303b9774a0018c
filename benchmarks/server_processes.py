"""How many more viewers do two processes on one port carry than one, and how evenly do viewers spread?

The viewers of `server_load.py`, half as many for one process as for two. The machine may be busy, and it may have
fewer free cores than processes, so what counts is the processor's time that all processes of the server take for a
megabyte: a core for each process carries `processes / (seconds a megabyte)` megabytes a second. It grows with what
processes do twice or wait for each other. Runs of one and of two processes take turns.

Given: a package, viewers for each process, links of 10 Mbit/s, synthetic walks.
Measured: processor time of the server for a megabyte, viewers of each process.
Defaults chosen on: showroom LOD 3.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from _harness import add_arguments, need, write_result
from server_load import IDLE_S, cpu_of, crowd

COUNTS = (1, 2)


def children_of(pid: int) -> list[int]:
    """Return the children of a process; none while it serves alone."""
    return [int(word) for word in Path(f"/proc/{pid}/task/{pid}/children").read_text(encoding="utf-8").split()]


def measured(package: Path, processes: int, viewers: int, seconds: float, warm: float) -> dict[str, Any]:
    """One crowd against a fresh server."""
    command = [sys.executable, "-m", "gsvis", "serve", str(package), "--port", "0", "--json", "--log-format", "json",
               "--workers", str(processes), "--clients", "400", "--per-address", "400"]  # fmt: skip
    log = Path(f"/tmp/{os.getpid()}-{processes}.log")
    with log.open("w", encoding="utf-8") as errors:
        server = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=errors, text=True,
            env=os.environ | {"NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
        )  # fmt: skip
    try:
        text = ""
        while not text.endswith("}\n"):
            text += server.stdout.readline()
        url = json.loads(text)["url"]
        asyncio.run(crowd(url, 4 * processes, package, 4.0, 2.0))  # kernels and cells of each process
        pids, marks = children_of(server.pid) or [server.pid], []

        async def both() -> dict[str, Any]:
            async def watch() -> None:
                await asyncio.sleep(warm)
                marks.append((time.monotonic(), [cpu_of(pid) for pid in pids]))
                await asyncio.sleep(max(seconds - 0.3, 0.5))
                marks.append((time.monotonic(), [cpu_of(pid) for pid in pids]))

            found, _ = await asyncio.gather(crowd(url, viewers, package, seconds, warm, IDLE_S), watch())
            return found

        found = asyncio.run(both())
        (t0, c0), (t1, c1) = marks
        spent = np.subtract(c1, c0)
        rate = found["mbytes"] / found["seconds"]
        lines = [json.loads(line) for line in log.read_text(encoding="utf-8").splitlines() if line.startswith("{")]
        opened = np.bincount([row.get("process", 0) for row in lines if row["event"] == "opened"])
        return {
            "cpu_s_per_mb": float(spent.sum()) / (t1 - t0) / rate,
            "cpu_shares": (spent / (t1 - t0)).tolist(),
            "median_mbit_per_s": float(np.median(found["mbit_per_s"])),
            "mbytes_per_s": rate,
            "opened": opened.tolist(),
        }
    finally:
        server.terminate()
        server.wait(30)
        log.unlink()


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("package", type=Path, nargs="?", help="what `gsvis prepare` made")
    parser.add_argument("--viewers", type=int, default=8, help="for each process")
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--warm", type=float, default=4.0, help="seconds before anything counts")
    parser.add_argument("--repeats", type=int, default=2)
    args = parser.parse_args()
    need(args.package, "what `gsvis prepare` made")
    runs: dict[int, list[dict[str, Any]]] = {count: [] for count in COUNTS}
    before = os.getloadavg()[0]
    for _ in range(args.repeats):
        for count in COUNTS:
            runs[count].append(measured(args.package, count, count * args.viewers, args.seconds, args.warm))
    cost = {count: float(np.median([run["cpu_s_per_mb"] for run in runs[count]])) for count in COUNTS}
    spread = [min(run["opened"]) / max(run["opened"]) for run in runs[2]]
    figures = [
        {"name": "viewers of two processes over those of one", "target": 1.8, "reached": 2.0 * cost[1] / cost[2],
         "unit": "", "better": "higher"},
        {"name": "one process: processor time of a megabyte", "target": None, "reached": cost[1], "unit": "s",
         "better": "lower"},
        {"name": "two processes: processor time of a megabyte", "target": None, "reached": cost[2], "unit": "s",
         "better": "lower"},
        {"name": "viewers of the emptier process over those of the fuller", "target": None,
         "reached": float(np.median(spread)), "unit": "", "better": "higher"},
    ]  # fmt: skip
    details = {"package": args.package.name, "runs": runs, "load_before": before, "load_after": os.getloadavg()[0]}
    write_result(args.out, "How many more viewers do two processes carry than one?", figures, details)


if __name__ == "__main__":
    main()
