"""How many viewers does one server core sustain at 10 Mbit/s each, and what breaks when there are more?

A server process pinned to one core. Viewers in another process, on other cores where there are more than two, and not
on one that shares a core's hardware with the server. Each is behind a link of its own that carries 10 Mbit/s:
they do not decode, they acknowledge a batch when such a link would have brought it, and say ten times a second where
they are on a walk through the cells. One that has been sent everything for its view comes back with nothing. Reported
for each number of viewers: the rate that reached them, how late the server looks after them, its seconds of CPU for a
megabyte. The machine may be busy with other things; CPU seconds count only those of the server, so `viewers by CPU`
says what a whole core would carry.

With --stay none comes back: then the warm-up and the measurement have to end before the link has carried the scene.

Given: a package, the number of viewers, links of 10 Mbit/s, synthetic walks.
Measured: rate that reaches the viewers, delay, CPU seconds of the server.
Defaults chosen on: showroom LOD 3.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import re
import resource
import subprocess
import sys
import time
import urllib.request
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from _harness import add_arguments, need, write_result
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed

from gsvis.abr.classes import FieldOfView
from gsvis.package import Package
from gsvis.stream import Ack, Hello, PoseAt

MBIT = 10.0
VIEW = FieldOfView.from_degrees(90, 70, margin=8)
IDLE_S = 0.5  # a viewer that has been sent nothing for so long has all that its view asks for


class Viewer:
    """One viewer behind a link of its own."""

    def __init__(self, url: str, stops: np.ndarray, up: np.ndarray, seed: int, idle_s: float) -> None:
        rng = np.random.default_rng(seed)
        self._url, self._up, self._turn, self._idle_s = url, up, rng.uniform(0.0, 6.28), idle_s
        apart = np.linalg.norm(stops - stops[rng.integers(len(stops))], axis=1)
        self._stops = stops[np.argsort(apart)[:8]]
        self.bytes, self.opened = 0, 0
        self._free, self._last = 0.0, 0.0
        self._saying: set[asyncio.Future[None]] = set()

    def note(self, data: bytes, at: float) -> None:
        """Take note of a message that the link has brought at a time of the monotonic clock."""

    def pose(self, t: float) -> bytes:
        """Half a cell a second from cell to cell, turning by 30 degrees a second."""
        along = min(0.5 * t, len(self._stops) - 1.001) if len(self._stops) > 1 else 0.0
        k = int(along)
        place = self._stops[k] + (along - k) * (self._stops[min(k + 1, len(self._stops) - 1)] - self._stops[k])
        angle = self._turn + 0.52 * t
        axis = np.sin(angle / 2) * self._up
        quat = (float(np.cos(angle / 2)), float(axis[0]), float(axis[1]), float(axis[2]))
        return PoseAt(int(1e3 * t), tuple(float(v) for v in place), quat).to_bytes()

    async def run(self, until: float) -> None:
        while time.monotonic() < until:
            try:
                await self._once(until)
            except (ConnectionClosed, OSError, asyncio.TimeoutError):
                await asyncio.sleep(0.1)

    async def _once(self, until: float) -> None:
        async with connect(
            self._url, compression=None, max_size=None, ping_interval=None, proxy=None, close_timeout=0.1
        ) as ws:
            await ws.send(Hello(VIEW).to_bytes())
            self.opened += 1
            self._last = time.monotonic()
            sending, later = asyncio.create_task(self._send_poses(ws)), deque[asyncio.TimerHandle]()
            try:
                while (now := time.monotonic()) < until and now - self._last < self._idle_s:
                    try:
                        data = await asyncio.wait_for(ws.recv(), 0.25)
                    except asyncio.TimeoutError:
                        continue
                    self._last = now = time.monotonic()
                    self._free = max(self._free, now) + len(data) / (MBIT * 125_000)
                    self.bytes += len(data)
                    self.note(data, self._free)
                    sequence, loop = int.from_bytes(data[4:8], "little"), asyncio.get_running_loop()
                    while later and later[0].when() < loop.time():
                        later.popleft()
                    later.append(loop.call_at(loop.time() + self._free - now, self._acknowledge, ws, sequence))
            finally:  # no task is left when the loop ends
                for handle in later:
                    handle.cancel()
                sending.cancel()
                await asyncio.gather(sending, *self._saying, return_exceptions=True)

    def _acknowledge(self, ws: Any, sequence: int) -> None:
        task = asyncio.ensure_future(self._send(ws, Ack(sequence).to_bytes()))
        self._saying.add(task)
        task.add_done_callback(self._saying.discard)

    async def _send(self, ws: Any, data: bytes) -> None:
        with suppress(ConnectionClosed):
            await ws.send(data)

    async def _send_poses(self, ws: Any) -> None:
        start = time.monotonic()
        while True:
            await self._send(ws, self.pose(time.monotonic() - start))
            await asyncio.sleep(0.1)


async def crowd(
    url: str, count: int, package: Path, seconds: float, warm: float, idle_s: float = IDLE_S
) -> dict[str, Any]:
    """Rates of viewers between the warm-up and the end, and what the server counted in between."""
    with Package.open(package) as opened:
        grid = opened.visibility.grid
        centers, up = grid.centers, grid.up
    viewers = [Viewer(url, centers, up, seed, idle_s) for seed in range(count)]
    begin = time.monotonic()
    running = [asyncio.create_task(viewer.run(begin + warm + seconds)) for viewer in viewers]
    await asyncio.sleep(warm)
    before, bytes_before, t0 = await asyncio.to_thread(counted, url), [v.bytes for v in viewers], time.monotonic()
    own = resource.getrusage(resource.RUSAGE_SELF)
    await asyncio.sleep(max(begin + warm + seconds - time.monotonic() - 0.2, 1.0))
    after, t1 = await asyncio.to_thread(counted, url), time.monotonic()
    got = np.array([v.bytes for v in viewers]) - np.array(bytes_before)
    mine = resource.getrusage(resource.RUSAGE_SELF)
    await asyncio.gather(*running)
    late = {k: after["late"][k] - before["late"].get(k, 0.0) for k in after["late"]}
    return {
        "seconds": t1 - t0,
        "mbit_per_s": (got / (t1 - t0) / 125_000).tolist(),
        "mbytes": float(got.sum() / 1e6),
        "late": late,
        "planning_s": after["planning"] - before["planning"],
        "batches": after["batches"] - before["batches"],
        "opened": sum(v.opened for v in viewers),
        "viewers_cpu_s": mine.ru_utime + mine.ru_stime - own.ru_utime - own.ru_stime,
    }


def counted(url: str) -> dict[str, Any]:
    """The metrics of the server that matter here."""
    with urllib.request.urlopen(url.replace("ws:", "http:").replace("/stream", "/metrics"), timeout=60) as answer:
        text = answer.read().decode()
    late = {bound: float(count) for bound, count in re.findall(r'gsvis_late_seconds_bucket\{le="(.*?)"\} (\S+)', text)}
    planning, batches = (
        float(re.search(rf"^{name} (\S+)$", text, re.MULTILINE)[1])
        for name in ("gsvis_planning_seconds_sum", "gsvis_batches_total")
    )
    return {"late": late, "planning": planning, "batches": batches}


def quantile(late: dict[str, float], share: float) -> float:
    """The bound of the histogram below which this share lies, seconds."""
    total = late["+Inf"]
    return next((float(bound) for bound, count in late.items() if bound != "+Inf" and count >= share * total), np.inf)


def cpu_of(pid: int) -> float:
    """Seconds of CPU of a process."""
    words = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")


def memory_of(pid: int) -> float:
    """Resident megabytes of a process."""
    return int(Path(f"/proc/{pid}/statm").read_text(encoding="utf-8").split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def other_cores(core: int) -> set[int]:
    """The cores for the viewers: those that share nothing with the server's, where this machine has more than two."""
    mine = os.sched_getaffinity(0)
    if core not in mine:
        raise SystemExit(f"--core: expected one of {sorted(mine)}, got {core}")
    topology = Path(f"/sys/devices/system/cpu/cpu{core}/topology/thread_siblings_list")
    shared = topology.read_text(encoding="utf-8") if topology.exists() else ""
    spans = [span.split("-") for span in shared.strip().split(",") if span]
    siblings = {number for span in spans for number in range(int(span[0]), int(span[-1]) + 1)} | {core}
    apart = mine - siblings
    return mine if len(mine) <= 2 else apart or mine - {core}


@contextmanager
def serving(package: Path, core: int, *options: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A fresh server on one core, and its address; it ends with the block."""
    command = [sys.executable, "-m", "gsvis", "serve", str(package), "--port", "0", "--json"]
    command += ["--clients", "400", "--per-address", "400", *options]  # all viewers are on this machine
    server = subprocess.Popen(
        ["taskset", "-c", str(core), *command],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        env=os.environ | {"NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
    )
    try:
        text = ""
        while not text.endswith("}\n"):
            line = server.stdout.readline()
            if not line:
                raise SystemExit(f"the server of {package.name} does not start; run: {' '.join(command)}")
            text += line
        yield server, json.loads(text)["url"]
    finally:
        server.terminate()
        server.wait(30)


def measured(package: Path, count: int, core: int, seconds: float, warm: float, idle_s: float) -> dict[str, Any]:
    """One number of viewers against a fresh server."""
    with serving(package, core) as (server, url):
        asyncio.run(crowd(url, 1, package, 3.0, 0.5))  # kernels and cells
        memory, marks = memory_of(server.pid), []

        async def both() -> dict[str, Any]:
            async def watch() -> None:
                await asyncio.sleep(warm)
                marks.append((time.monotonic(), cpu_of(server.pid)))
                await asyncio.sleep(max(seconds - 0.3, 0.5))
                marks.append((time.monotonic(), cpu_of(server.pid)))

            found, _ = await asyncio.gather(crowd(url, count, package, seconds, warm, idle_s), watch())
            return found

        found = asyncio.run(both())
        (t0, c0), (t1, c1) = marks
        rates = np.array(found["mbit_per_s"])
        cpu_per_mb = (c1 - c0) / (t1 - t0) / max(found["mbytes"] / found["seconds"], 1e-9)
        return {
            **found,
            "viewers": count,
            "median_mbit_per_s": float(np.median(rates)),
            "tenth_mbit_per_s": float(np.quantile(rates, 0.1)),
            "late_median_s": quantile(found["late"], 0.5),
            "late_95_s": quantile(found["late"], 0.95),
            "server_cpu_share": (c1 - c0) / (t1 - t0),
            "cpu_s_per_mb": cpu_per_mb,
            "viewers_by_cpu": 1.0 / (cpu_per_mb * MBIT / 8.0),
            "memory_mb_per_viewer": (memory_of(server.pid) - memory) / count,
        }


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("package", type=Path, nargs="?", help="what `gsvis prepare` made")
    parser.add_argument("--viewers", type=int, nargs="+", default=[10, 25, 50, 75, 100])
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--warm", type=float, default=10.0, help="seconds before anything counts")
    parser.add_argument("--stay", action="store_true", help="viewers that have everything do not begin again")
    parser.add_argument("--core", type=int, default=0, help="the core of the server")
    args = parser.parse_args()
    need(args.package, "what `gsvis prepare` made")
    viewers_on = other_cores(args.core)
    os.sched_setaffinity(0, viewers_on)
    figures, details = [], {"package": args.package.name, "mbit_per_s": MBIT, "load_before": os.getloadavg()[0]}
    details |= {"core_of_server": args.core, "cores_of_viewers": sorted(viewers_on)}
    for count in args.viewers:
        found = measured(args.package, count, args.core, args.seconds, args.warm, np.inf if args.stay else IDLE_S)
        details[str(count)] = found
        for label, key, target, unit, better in (
            ("median rate of a viewer", "median_mbit_per_s", 0.9 * MBIT if count <= 60 else None, "Mbit/s", "higher"),
            ("rate of the slowest tenth", "tenth_mbit_per_s", None, "Mbit/s", "higher"),
            ("looked after too late, 95th percentile", "late_95_s", None, "s", "lower"),
            ("server's CPU for a megabyte", "cpu_s_per_mb", None, "s", "lower"),
            ("viewers by CPU", "viewers_by_cpu", 60.0, "viewers a core", "higher"),
            ("memory", "memory_mb_per_viewer", None, "MB a viewer", "lower"),
        ):
            figures.append(
                {
                    "name": f"{count} viewers: {label}",
                    "target": target,
                    "reached": found[key],
                    "unit": unit,
                    "better": better,
                }
            )
    write_result(args.out, "How many viewers at 10 Mbit/s does one server core sustain?", figures, details)


if __name__ == "__main__":
    main()
