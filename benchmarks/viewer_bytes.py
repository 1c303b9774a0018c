"""Does a page get the bytes of a scene as soon as the Python client does, on a shaped link?

A server and its viewers at the two ends of a cable between network namespaces, its rate shaped by a token bucket. First
headless Chromium opens the page: its network Worker reports each message when it arrives. Then the Python client asks
for the same view from the same place; they take turns. Time begins with the first pose, before which no Gaussian is
sent. Needs Linux, root, `ip` and `tc`, and Chromium.

Given: a package (`--package`), a rate (`--rate`, Mbit/s).
Measured: bytes of messages over time, in steps of 0.25 s, in the median of the visits; the largest difference from 1 s
    on, until either has 98% of its bytes; seconds until then.
Defaults chosen on: no scene.
"""

from __future__ import annotations

import argparse
import asyncio
import logging
import shutil
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from _harness import add_arguments, need, write_result
from _shaped_link import PAYLOAD, SERVER, ShapedLink, shaped_link, why_not
from _watched import FLAGS, heard, watch

from gsvis.serve import Address, ClientConfig, Scenes, Server, StreamClient, open_scenes
from gsvis.stream.wire import Hello, PoseAt

STEP = 0.25


def visit_by_page(server: Server, name: str, seconds: float, size: list[int]) -> tuple[np.ndarray, Hello, PoseAt]:
    """Open the page; return seconds and sizes of its messages, and what it asked for."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=list(FLAGS))
        page = browser.new_page(viewport={"width": size[0], "height": size[1]})
        watch(page)
        page.goto(server.url.replace("ws", "http", 1).replace("/stream", "") + f"/view/{name}")
        page.wait_for_timeout(1000 * seconds)
        sent, came = heard(page)
        browser.close()
    hello = next(message for _, message in sent if isinstance(message, Hello))
    start, pose = next((at, message) for at, message in sent if isinstance(message, PoseAt))
    return np.array([(at - start, size) for at, size in came]), hello, pose


def visit_by_client(server: Server, hello: Hello, pose: PoseAt, seconds: float) -> np.ndarray:
    """Ask for the same with the Python client; return seconds and sizes of its batches."""
    found: list[tuple[float, int]] = []

    async def stream() -> None:
        start: list[float] = []

        def at(_: float) -> tuple[Any, Any]:
            start.append(time.monotonic())
            return np.array(pose.position), np.array(pose.quat)

        client = StreamClient(server.url, hello.view, ClientConfig(poses_per_s=10.0))
        await client.run(
            at, seconds=seconds, on_batch=lambda got: found.append((time.monotonic() - start[0], got.nbytes))
        )

    asyncio.run(stream())
    return np.array(found)


def bytes_over_time(found: np.ndarray, steps: np.ndarray) -> np.ndarray:
    return np.array([found[found[:, 0] <= step, 1].sum() for step in steps])


def visits(link: ShapedLink, scenes: Scenes, args: argparse.Namespace) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return the messages of each visit, by page and by client."""
    server = link.at("server", lambda: Server(scenes, address=Address(SERVER, 0)))()
    running = link.at("server", server.run)
    (name, served), pages, clients = next(iter(scenes.items())), [], []
    try:
        for k in range(args.repeats + 1):
            found, hello, pose = link.at("client", lambda: visit_by_page(server, name, args.seconds, args.size))()
            theirs = link.at("client", partial(visit_by_client, server, hello, pose, args.seconds))()
            if k:  # the first loads everything anew
                pages.append(found[found[:, 1] != len(served.scene.header)])
                clients.append(theirs)
    finally:
        server.stop()
        running()
    return pages, clients


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--package", type=Path)
    parser.add_argument("--rate", type=float, default=10.0, help="Mbit/s")
    parser.add_argument("--seconds", type=float, default=12.0)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--size", type=int, nargs=2, default=[640, 360])
    args = parser.parse_args()
    need(args.package, "a package: --package scene.gsvis")
    need(shutil.which("chromium"), "Chromium on the PATH")
    reason = why_not()
    if reason is not None:
        print(f"skipped: {reason}")
        return
    logging.disable(logging.INFO)
    steps = np.arange(STEP, args.seconds, STEP)
    with open_scenes([args.package]) as scenes, shaped_link() as link:
        link.rate(args.rate)
        pages, clients = visits(link, scenes, args)
    page, client = (np.median([bytes_over_time(one, steps) for one in some], axis=0) for some in (pages, clients))
    ends = [float(steps[np.argmax(of >= 0.98 * of[-1])]) for of in (page, client)]
    within = (steps >= 1.0) & (steps <= min(ends))
    apart = (page - client)[within] / client[within]
    figures = [
        {"name": "largest difference in bytes, from 1 s on", "target": 0.1, "reached": float(np.abs(apart).max()),
         "unit": "of the client's", "better": "lower"},
        {"name": "mean difference", "target": None, "reached": float(apart.mean()), "unit": "of the client's",
         "better": "higher"},
        {"name": "page: 98% of its bytes", "target": None, "reached": ends[0], "unit": "s", "better": "lower"},
        {"name": "client: 98% of its bytes", "target": None, "reached": ends[1], "unit": "s", "better": "lower"},
    ]  # fmt: skip
    carried = args.rate * 125_000 * PAYLOAD * steps
    details = {
        "package": args.package.name, "rate": args.rate, "seconds": steps, "page": page, "client": client,
        "carried": carried, "last of page": [float(one[-1, 0]) for one in pages],
        "last of client": [float(one[-1, 0]) for one in clients],
    }  # fmt: skip
    write_result(args.out, (__doc__ or "").splitlines()[0], figures, details)


if __name__ == "__main__":
    main()
