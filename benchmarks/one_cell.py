"""What does a visitor lose when the visible sets of an object are joined to fewer cells, or to one?

Around an object a walk sees nearly all, so that sets save fewer bytes on a walk than they take. Here cells of packages
are joined to cubes until one is left, and visitors walk around the object over constant links. A visitor needs the
first images, and what a cell does not see need not come first.

Given: packages of objects that `gsvis prepare` wrote (`--packages`), without `--join-cells`.
Measured: bytes of sets without direction sets, bytes that they save on a walk (`JoinedCells`), PSNR of images against
    all that a package has, mean over 10 s of three quarter turns, and seconds until the first image of 35 dB.
Defaults chosen on: nothing; walks are circles at the median distance of the cells.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from _harness import NEVER, add_arguments, need, write_result
from numpy.typing import NDArray

from gsvis.abr import AbrConfig, BandwidthTrace
from gsvis.package import Package
from gsvis.pvs.cells import Cells
from gsvis.pvs.joined import join_cells, measure_sets
from gsvis.pvs.store import VisibilityStore
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import quats_from_rotations
from gsvis.scene.paths import HeadPath
from gsvis.simulate import Adaptive, Link, Stage, ViewingConfig, play, watch
from gsvis.stream import StreamedScene
from gsvis.stream.source import PackageSets, PackageSource, class_weights

QUESTION = "What does a visitor lose when the visible sets of an object are joined to fewer cells?"
ROUND_TRIP = 0.04
SECONDS = 10.0
STARTS = (0.0, 120.0, 240.0)
"""Degrees along the circle where a visitor begins."""


class Joined(PackageSource):
    """A package with the visible sets of another store, and no lists of active terms."""

    def __init__(self, package: Package, store: VisibilityStore) -> None:
        super().__init__(package)
        self.store = store

    def piece_order(self, piece: int) -> NDArray[np.int32]:
        return self.store.order

    def read_cells(self) -> tuple[Cells, NDArray[np.float32]]:
        return self.store.grid, class_weights(self.store)

    def sets(self, *_: Any) -> PackageSets:
        return PackageSets(self.store)

    def active(self) -> None:
        return None


def circle(package: Package, start: float) -> HeadPath:
    """Return a quarter turn around the object in `SECONDS`, at the median distance of the cells from its middle."""
    grid = package.visibility.grid
    middle = np.median(package.contents.gaussians().means, axis=0)
    up = np.asarray(grid.up) / np.linalg.norm(grid.up)
    aside = np.cross(up, np.roll(up, 1))
    ahead = np.cross(up, aside)
    apart = grid.centers - middle
    radius = float(np.median(np.linalg.norm(apart - np.outer(apart @ up, up), axis=1)))
    times = np.arange(0.0, SECONDS + 2.0, 0.1)
    angles = np.radians(start + 90.0 * times / SECONDS)
    eyes = middle + radius * (np.cos(angles)[:, None] * aside + np.sin(angles)[:, None] * ahead)
    poses = Cameras.look_at(eyes, middle, up=up).viewmats[:, :3, :3]
    return HeadPath(times, eyes, quats_from_rotations(poses.transpose(0, 2, 1)), up)


def sessions(source: PackageSource, walks: list[HeadPath], mbit: float) -> dict[str, float]:
    """Return mean figures of visitors over a constant link."""
    streamed = StreamedScene.open(source)
    stage = Stage(streamed.contents)
    config = ViewingConfig(seconds=SECONDS, every=0.5, fine=2.0)
    found = []
    for walk in walks:
        link = Link(BandwidthTrace.constant(mbit), ROUND_TRIP)
        sent = Adaptive(streamed, config.view, AbrConfig())
        played = play(sent, link, walk, stage.size, seconds=config.watched, tick=config.tick)
        found += [seen.figures() for seen in watch(stage, [played], walk, config)]
    good = [NEVER if each["seconds_to_good_image"] is None else each["seconds_to_good_image"] for each in found]
    return {"psnr": float(np.mean([each["psnr"] for each in found])), "good": float(np.mean(good))}


def measure(path: Path, options: argparse.Namespace) -> list[dict[str, Any]]:
    """Return a row for each size of the cells of a package, as built first."""
    rows: list[dict[str, Any]] = []
    with Package.open(path) as package, tempfile.TemporaryDirectory() as folder:
        walks = [circle(package, start) for start in STARTS]
        longest = max(package.visibility.grid.shape)
        for factor in sorted({1, *(each for each in (2, 4) if each < longest), longest}):
            file = Path(folder) / f"{factor}.pvs"
            join_cells(package.visibility, file, factor)
            with VisibilityStore.open(file) as store:
                sets = measure_sets(store)
                row = {"scene": path.stem, "factor": factor, "cells": sets.cells, "nbytes": sets.nbytes}
                row["records"] = sum(package.manifest.sizes()[name] for name in ("records", "terms"))
                if factor == 1:
                    row["saved"] = sets.saved
                for mbit in options.mbit:
                    row |= {f"{name}_{mbit:g}": v for name, v in sessions(Joined(package, store), walks, mbit).items()}
            rows.append(row)
            print(row, flush=True)
    return rows


def figures_of(row: dict[str, Any], options: argparse.Namespace) -> list[dict[str, Any]]:
    """Return the figures of one size of cells."""
    named = f"{row['scene']}, {row['cells']} cells"
    found = [(f"{named}: sets over records", row["nbytes"] / row["records"], "of the bytes", "lower")]
    if "saved" in row:
        found.append((f"{named}: bytes saved on a walk over bytes taken", row["saved"] / row["nbytes"], "", "higher"))
    for mbit in options.mbit:
        found.append((f"{named}, {mbit:g} Mbit/s: mean of 10 s", row[f"psnr_{mbit:g}"], "dB", "higher"))
        found.append((f"{named}, {mbit:g} Mbit/s: first image of 35 dB", row[f"good_{mbit:g}"], "s", "lower"))
    return [{"name": n, "target": None, "reached": float(v), "unit": unit, "better": b} for n, v, unit, b in found]


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--packages", type=Path, nargs="+", help="of objects, with small cells")
    parser.add_argument("--mbit", type=float, nargs="+", default=[1.0, 3.0, 10.0], help="constant links")
    options = parser.parse_args()
    need(options.packages, "--packages, what gsvis prepare wrote")
    rows = [row for path in options.packages for row in measure(path, options)]
    figures = [figure for row in rows for figure in figures_of(row, options)]
    write_result(options.out, QUESTION, figures, {"rows": rows})


if __name__ == "__main__":
    main()
