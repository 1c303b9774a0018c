"""Does the simulation of an exchange agree with the exchange, in bytes over time, on a real link of the same rate?

A server and a client at the two ends of a cable between network namespaces, its rate shaped by a token bucket after a
recorded trace; the same package, path and trace in the simulator. The bucket counts frames, the simulator bytes of
messages: its trace is scaled by the share of a frame that TCP delivers. Needs Linux, root, `ip` and `tc`.

Given: a package, a recorded trace, a path.
Measured: largest difference in bytes over time between exchange and simulation.
Defaults chosen on: no scene.
"""

from __future__ import annotations

import argparse
import asyncio
import logging
import threading
import time
from pathlib import Path

import numpy as np
from _harness import add_arguments, need, realdata, write_result
from _shaped_link import PAYLOAD, SERVER, ShapedLink, shaped_link, why_not

from gsvis.abr.classes import FieldOfView
from gsvis.abr.traces import BandwidthTrace, load_trace
from gsvis.scene.paths import HeadPath
from gsvis.serve import Address, ClientConfig, Scenes, Server, StreamClient, open_scenes
from gsvis.simulate import Adaptive, Link, play

VIEW = FieldOfView.from_degrees(90, 70, margin=8)
TRACES = (
    "cooked_3gp/norway_bus_1",
    "cooked_3gp/norway_tram_10",
    "cooked_3gp/norway_car_2",
    "traces_oboe/oboe_trace_10.txt",
)


def walk(scenes: Scenes, seconds: float) -> HeadPath:
    """From cell to cell, turning about: nothing recorded, so that it needs no retargeting."""
    grid = next(iter(scenes.values())).scene.index.grid
    rng = np.random.default_rng(0)
    start = grid.centers[rng.integers(len(grid.centers))]
    near = np.argsort(np.linalg.norm(grid.centers - start, axis=1))[: min(6, len(grid.centers))]
    stops = grid.centers[near]
    times = np.linspace(0.0, seconds, max(len(stops), 2))
    turns = np.linspace(0.0, 2.0, len(times))
    up = grid.up
    quats = np.concatenate([np.cos(turns / 2)[:, None], np.sin(turns / 2)[:, None] * up], axis=1)
    return HeadPath(times, stops if len(stops) > 1 else np.repeat(stops, 2, axis=0), quats)


def exchange(
    link: ShapedLink, scenes: Scenes, trace: BandwidthTrace, path: HeadPath, seconds: float
) -> tuple[np.ndarray, np.ndarray]:
    """Arrival times and sizes of the batches, by the client's clock from when it asks."""
    server = link.at("server", lambda: Server(scenes, address=Address(SERVER, 0)))()
    running = link.at("server", server.run)
    stopped, found = threading.Event(), []

    async def stream() -> float:
        client = StreamClient(server.url, VIEW, ClientConfig(poses_per_s=10.0))
        start = time.monotonic()
        threading.Thread(target=link.follow, args=(trace, start, stopped), daemon=True).start()
        await client.run(
            path.at, seconds=seconds, on_batch=lambda got: found.append((time.monotonic() - start, got.nbytes))
        )
        return start

    link.rate(trace.rate_at(0.0))
    try:
        link.at("client", lambda: asyncio.run(stream()))()
    finally:
        stopped.set()
        server.stop()
        running()
    times, sizes = np.array(found).reshape(-1, 2).T
    return times, sizes


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("package", type=Path, nargs="?", help="what `gsvis prepare` made")
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--traces", nargs="+", default=TRACES, help="under the folder of traces")
    parser.add_argument("--round-trip", type=float, default=0.002, help="of the cable, as the simulator takes it")
    args = parser.parse_args()
    need(args.package, "what `gsvis prepare` made")
    reason = why_not()
    if reason is not None:
        print(f"skipped: {reason}")
        return
    logging.disable(logging.INFO)
    folder = realdata() / "traces"
    figures, details = [], {"package": args.package.name, "seconds": args.seconds, "payload_share": PAYLOAD}
    seconds = np.arange(1.0, args.seconds + 0.5)
    with open_scenes([args.package]) as scenes, shaped_link() as link:
        (served,) = scenes.values()
        path = walk(scenes, args.seconds)
        size = served.scene.about.gaussians, served.scene.about.terms
        exchange(link, scenes, BandwidthTrace.constant(100.0), path, 2.0)  # kernels
        for name in args.traces:
            trace = load_trace(folder / name)
            simulated = play(
                Adaptive(served.scene, VIEW), Link(trace.scaled(PAYLOAD), args.round_trip), path, size,
                seconds=args.seconds, tick=0.1,
            )  # fmt: skip
            wanted = simulated.bytes_at(seconds)
            times, sizes = exchange(link, scenes, trace, path, args.seconds)
            real = np.array([sizes[times <= t].sum() for t in seconds]) + len(served.scene.header)
            apart = (real - wanted) / wanted
            figures.append(
                {
                    "name": f"{name}: largest difference in bytes, from 2 s on",
                    "target": 0.1,
                    "reached": float(np.abs(apart[1:]).max()),
                    "unit": "of the simulated",
                    "better": "lower",
                }
            )
            carried = [trace.scaled(PAYLOAD).bytes_between(0.0, float(t)) for t in seconds]
            details[name] = {"seconds": seconds, "real": real, "simulated": wanted, "carried": carried}
    write_result(args.out, "Does the simulation agree with a real exchange over a shaped link?", figures, details)


if __name__ == "__main__":
    main()
