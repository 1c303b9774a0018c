"""What does a client with little memory still show, and what does the server pay for it?

A session and a receiver along a recorded walk, brought into the scene by a similarity: ten poses a second, two messages
at each, of 50 ms of a link of 10 Mbit/s. Memory is a share of what all records of the package take: 16 bytes a Gaussian
and the bits of a term. Images, 320 x 240, every two seconds, beside those of a client without a limit at the same pose:
infinite PSNR counts as 100 dB. Time of a message is of the thread.

Given: packages, a walk on which defaults of the scheduler were chosen, messages of 50 ms at 10 Mbit/s.
Measured: most bytes that the client held, PSNR against a client without a limit, milliseconds a message.
Defaults chosen on: no measurement; the share that is freed at a time (2%) was not varied.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from _harness import add_arguments, need, realdata, write_result
from _packaged import open_original

from gsvis.color.evaluate import evaluate
from gsvis.io.poses import load_path
from gsvis.package.layout import RECORD_BYTES
from gsvis.render import psnr, rasterize
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.paths import HeadPath
from gsvis.scene.retarget import RetargetConfig, retarget
from gsvis.simulate import ViewingConfig
from gsvis.stream import Receiver, Session, StreamedScene

WALK = "eyenav_rutgers/room/user108_room.csv.gz"
SHARES = (1.0, 0.5, 0.25, 0.1, 0.03)
SECONDS, MESSAGE = 20.0, 62_500.0
CONFIG = ViewingConfig(seconds=SECONDS)


@dataclass
class Visit:
    """What a client showed and held, and the server's milliseconds for each message."""

    images: list[np.ndarray]
    most_bytes: float
    evicted: int
    milliseconds: list[float]


def held_bytes(scene: StreamedScene, receiver: Receiver) -> float:
    _, colors = receiver.scene()
    return RECORD_BYTES * len(receiver.shown()) + scene.about.term_bits / 8 * int(colors.counts.sum())


def visit(scene: StreamedScene, path: HeadPath, memory: int) -> Visit:
    """Walk with a memory; 0 means no limit."""
    receiver = Receiver(scene.header, memory=memory)
    session, found = Session.from_hello(scene, receiver.hello(CONFIG.view)), Visit([], 0.0, 0, [])
    session.welcome(0.0)
    session.on_ack(0.04, 0)
    cameras = path.cameras(CONFIG.width, CONFIG.height, CONFIG.fov)
    for k in range(len(path)):
        t = 0.1 * (k + 1)
        session.on_pose(t, path.positions[k], path.quats[k])
        for _ in range(2):
            start = time.thread_time()
            message = session.next_message(t, MESSAGE)
            found.milliseconds.append(1e3 * (time.thread_time() - start))
            if message is not None:
                session.on_ack(t + 0.04, receiver.receive(message.data).sequence)
                found.evicted += len(message.batch.evicted)
        found.most_bytes = max(found.most_bytes, held_bytes(scene, receiver))
        if k % 20 == 19:
            g, colors = receiver.scene()
            rgb = evaluate(colors, g.means, cameras.viewpoints[k])
            found.images.append(rasterize(g, cameras[k], colors=rgb).images[0])
    return found


def figures_of(name: str, package: str) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Figures and details of a package."""
    original = open_original(package)
    full = original.gaussians
    recording = load_path(realdata() / "traces" / WALK)
    config = RetargetConfig(meters_per_unit=original.meters_per_unit, project=True, seed=0)
    path = retarget(recording.cut(0.0, SECONDS), NavigableSpace.from_scene(full), config).path
    path = path.resample(times=path.times[0] + 0.1 * np.arange(int(10 * SECONDS)))
    scene = StreamedScene.open(package)
    whole = RECORD_BYTES * len(scene) + scene.about.term_bits / 8 * scene.about.terms
    free, figures, details = visit(scene, path, 0), list[dict[str, Any]](), dict[str, Any]()
    for share in SHARES:
        found = visit(scene, path, int(share * whole))
        dbs = [min(100.0, float(psnr(a, b))) for a, b in zip(found.images, free.images, strict=True)]
        where = f"{name}, {100 * share:g}% of {whole / 1e6:.1f} MB"
        for label, target, reached, unit, better in (
            ("most bytes held, of the memory", 1.0, found.most_bytes / (share * whole), "", "lower"),
            ("PSNR against no limit, median", None, float(np.median(dbs)), "dB", "higher"),
            ("the same, worst", None, min(dbs), "dB", "higher"),
            ("a message, mean", None, float(np.mean(found.milliseconds)), "ms", "lower"),
            ("a message, 95th percentile", None, float(np.percentile(found.milliseconds, 95)), "ms", "lower"),
        ):
            keys = {"name": f"{where}: {label}", "target": target, "reached": reached, "unit": unit, "better": better}
            figures.append(keys)
        details[where] = {"psnr": dbs, "evicted": found.evicted}
    return figures, details


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("packages", nargs="*", metavar="NAME=PACKAGE", help="a package, under a name of your choice")
    options = parser.parse_args()
    need(options.packages, "what `gsvis prepare` made, as NAME=PACKAGE")
    figures, details = list[dict[str, Any]](), dict[str, Any]()
    for word in options.packages:
        name, _, package = word.partition("=")
        some, more = figures_of(name, package)
        figures, details = figures + some, {**details, **more}
    question = "What does a client with little memory still show, and what does the server pay for it?"
    write_result(options.out, question, figures, details)


if __name__ == "__main__":
    main()
