"""Does an idle link end with all records, inside and outside of cells, and what does it cost inside?

A viewer stands still until the link is idle: in the middle of three cells, and outside of all cells along the axes, at
1.5 and 3 times half the extent of the cells. With `--chosen`, also at the eyes that a person chose. Messages of a
session are played over a link of a constant rate with the widened sets and with the nearest cell's set alone.

Given: packages made with `gsvis prepare --cells 24 --steps 20 --views 60 --limit 0.02 --max-inner 2`, a rate.
Measured: share of the highest level's records at the end; PSNR against all records; bytes until 35 dB.
Defaults chosen on: nothing; steps and shares were set before anything was measured.
"""

from __future__ import annotations

import argparse
import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from _chosen_eyes import CHOSEN
from _harness import add_arguments, need, write_result
from numpy.typing import NDArray

from gsvis.abr import AbrConfig, FieldOfView
from gsvis.abr.outside import distance_step
from gsvis.package import Package
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import quats_from_rotations
from gsvis.simulate import Stage
from gsvis.simulate.frames import Frame
from gsvis.stream import Session, StreamedScene

F64 = NDArray[np.float64]

QUESTION = "Does an idle link end with all records, inside and outside of cells, and what does it cost inside?"
WIDTH, HEIGHT, FOV = 160, 120, 70.0
ENOUGH = 35.0  # dB
VIEW = FieldOfView.from_degrees(FOV, 56.0, margin=8.0)


@dataclass(frozen=True, eq=False)
class Eye:
    """Where a viewer stands, and what it looks at."""

    kind: str
    position: F64
    target: F64


@dataclass(frozen=True, eq=False)
class Visit:
    """What came: bytes and PSNR after each message, and shares at the end."""

    sizes: NDArray[np.int64]
    psnrs: F64
    gaussians: float
    terms: float
    digest: str

    def until(self, least: float) -> float:
        """Return the bytes until an image has a PSNR for good."""
        below = np.flatnonzero(self.psnrs < least)
        place = 0 if len(below) == 0 else below[-1] + 1
        return float(self.sizes[place]) if place < len(self.sizes) else np.inf

    def mean(self) -> float:
        """Return the mean PSNR over the bytes, at most 60 dB."""
        steps = np.diff(self.sizes, prepend=0)
        return float((np.minimum(self.psnrs, 60.0) * steps).sum() / steps.sum())


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--packages", nargs="*", metavar="NAME=PACKAGE")
    parser.add_argument("--rate", type=float, default=1e6, help="bytes a second")
    parser.add_argument("--chosen", type=int, default=0, help="eyes of a person outside of cells, at most")
    options = parser.parse_args()
    need(options.packages, "--packages NAME=PACKAGE, as `gsvis prepare` made them")
    rows = []
    for given in options.packages:
        name, _, folder = given.partition("=")
        with Package.open(Path(folder)) as package:
            scene = StreamedScene.open(package)
            stage = Stage(scene.contents)
            for eye in [*eyes_of(scene, stage), *chosen_eyes(scene, name, options.chosen)]:
                rows.append({"scene": name, **measure(scene, stage, eye, options.rate)})
                print(rows[-1], flush=True)
    write_result(options.out, QUESTION, summarize(rows), {"rate": options.rate, "eyes": rows})


def eyes_of(scene: StreamedScene, stage: Stage) -> Iterator[Eye]:
    """Yield the eyes of a scene."""
    grid = scene.index.grid
    target = np.median(stage.drawn.means[stage.highest], axis=0).astype(np.float64)
    for cell in np.linspace(0, len(grid) - 1, 5).round().astype(int)[1:4]:
        yield Eye("inside", grid.centers[cell], target)
    low, high = grid.centers.min(axis=0) - grid.cell_size / 2, grid.centers.max(axis=0) + grid.cell_size / 2
    middle = 0.5 * (low + high)
    for away in (1.5, 3.0):
        for axis in range(3):
            for side in (-1.0, 1.0):
                step = np.zeros(3)
                step[axis] = side * away * (high - low)[axis] / 2
                yield Eye("outside", middle + step, target)


def chosen_eyes(scene: StreamedScene, name: str, most: int) -> Iterator[Eye]:
    """Yield the eyes that a person chose and that are in no cell."""
    for chosen in CHOSEN:
        if chosen.name == name:
            for position, target in zip(chosen.eyes, chosen.targets, strict=True):
                if most and distance_step(scene.index, scene.index.grid.nearest(position), position):
                    most -= 1
                    yield Eye("chosen, outside", position, target)


def measure(scene: StreamedScene, stage: Stage, eye: Eye, rate: float) -> dict[str, Any]:
    """Return the figures of one eye, by both rules."""
    up = np.asarray(scene.source.manifest.info.up, np.float64)
    camera = Cameras.look_at(eye.position[None], eye.target, up=up, width=WIDTH, height=HEIGHT, fov=FOV)
    frame, row = Frame(stage, camera), {}
    step = distance_step(scene.index, scene.index.grid.nearest(eye.position), eye.position)
    for rule, of in (("widened", distance_step), ("nearest", lambda *_: 0)):
        with patch("gsvis.abr.planner.distance_step", of):
            visit = play(scene, frame, camera, rate)
        row[rule] = {
            "records": visit.gaussians, "terms": visit.terms, "end_db": float(min(visit.psnrs[-1], 99.0)),
            "bytes_until_35_db": visit.until(ENOUGH), "mean_db": visit.mean(), "bytes": int(visit.sizes[-1]),
            "digest": visit.digest,
        }  # fmt: skip
    return {"kind": eye.kind, "position": eye.position.round(4).tolist(), "step": step, **row}


def play(scene: StreamedScene, frame: Frame, camera: Cameras, rate: float) -> Visit:
    """Send to a viewer who stands still until nothing is left."""
    contents = scene.contents
    session, digest = Session(scene, VIEW, AbrConfig(start_rate=rate)), hashlib.sha256()
    session.welcome(0.0)
    session.on_ack(0.0, 0)
    quat = quats_from_rotations(camera.viewmats[0, :3, :3].T[None])[0]
    t, sizes, psnrs, drawn = 0.0, [], [], 0
    session.on_pose(1e-3, camera.viewpoints[0], quat)
    shown, terms = np.zeros(len(contents), bool), np.zeros(len(contents.term_records), bool)
    while (message := session.next_message(t)) is not None:
        t += len(message.data) / rate
        session.on_ack(t, message.sequence)
        digest.update(message.data)
        shown[message.batch.gaussians], terms[message.batch.terms] = True, True
        shown[message.batch.gone] = False
        if session.wire_bytes > 1.05 * drawn or session.done:  # an image for each twentieth more
            drawn = session.wire_bytes
            sizes.append(drawn)
            psnrs.append(frame.psnr(shown[frame.ids], terms))
    wanted = contents.last == len(contents.names) - 1
    received = np.zeros(len(contents), bool)
    received[session.holdings.received] = True
    owned = np.repeat(wanted, contents.term_counts)
    shares = float(received[wanted].mean()), float(terms[owned].mean()) if owned.any() else 1.0
    return Visit(np.array(sizes), np.array(psnrs), *shares, digest.hexdigest()[:16])


def summarize(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the figures."""
    figures = []
    for name in dict.fromkeys(row["scene"] for row in rows):
        for kind in ("inside", "outside", "chosen, outside"):
            some = [row for row in rows if (row["scene"], row["kind"]) == (name, kind)]
            if not some:
                continue
            ours, before = ([row[rule] for row in some] for rule in ("widened", "nearest"))
            figures.append(
                figure(f"{name}, {kind}: least share of records at the end", 1.0, min(r["records"] for r in ours), "")
            )
            figures.append(
                figure(f"{name}, {kind}: least share of terms at the end", 1.0, min(r["terms"] for r in ours), "")
            )
            figures.append(
                figure(f"{name}, {kind}: worst image at the end", 60.0, min(r["end_db"] for r in ours), "dB")
            )
            ratios = [a["bytes_until_35_db"] / b["bytes_until_35_db"] for a, b in zip(ours, before, strict=True)]
            target = 1.01 if kind == "inside" else 1.0
            figures.append(
                figure(
                    f"{name}, {kind}: bytes until 35 dB, against the nearest cell's set, median",
                    target,
                    float(np.median(ratios)),
                    "",
                    "lower",
                )
            )
            gains = [a["mean_db"] - b["mean_db"] for a, b in zip(ours, before, strict=True)]
            figures.append(
                figure(
                    f"{name}, {kind}: mean PSNR over the bytes, more than from the nearest cell's set",
                    0.0,
                    float(np.mean(gains)),
                    "dB",
                )
            )
    return figures


def figure(name: str, target: float, reached: float, unit: str, better: str = "higher") -> dict[str, Any]:
    """Return a figure for `write_result`."""
    return {"name": name, "target": target, "reached": reached, "unit": unit, "better": better}


if __name__ == "__main__":
    main()
