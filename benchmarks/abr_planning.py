"""How long does it take to decide what a client gets next, cold and along a walk, on one core?

Synthetic cells: showroom LOD 3 in the order of a package, levels by opacity times cross-section (18.7% and 34.9%),
nested; each cell sees the given share of the scene that is nearest to it, in four weight classes at random (so most
words have four units), and a tenth of three terms for each Gaussian. `--package` measures a prepared scene with the
visible sets of its cells as well. Cold: candidates of the cell (sets of cells in memory), a new client, its first 100
ms at 10 Mbit/s; for a package, also with sets and classes still to be decoded. Along recorded walks, their middle moved
to the middle cell: every tick of 100 ms with all that belongs to it, from pose to acknowledgement, cells entered
included; alone, and for 50 clients turn by turn. Thread time, so that what else the machine does counts less; walks are
walked three times, and a tick is the median (or, where said, the least) of its three. The bare measure: one pass over
what ranking must read, as a sum in NumPy. The yardstick: a loop of Python, its median over its least, which shows how
much others slowed the machine.

Given: synthetic cells and levels, or a prepared package; recorded walks moved to the middle cell; a link of 10 Mbit/s.
Measured: thread time of a cold plan and of a tick.
Defaults chosen on: showroom LOD 3, the scene that is measured too; four walks of other people.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
from _harness import add_arguments, realdata, write_result

from gsvis.abr.candidate_sets import Candidates
from gsvis.abr.candidates import CandidateIndex
from gsvis.abr.classes import FieldOfView
from gsvis.abr.config import AbrConfig
from gsvis.abr.estimate import ThroughputEstimator, estimator
from gsvis.abr.index import CellSets, SceneIndex, SceneTerms, extents
from gsvis.abr.planner import Planner
from gsvis.abr.policies import POLICIES
from gsvis.io import load_scene
from gsvis.io.eyenav import read_eyenav
from gsvis.package.order import in_package_order
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.codec import pack_some
from gsvis.scene.levels import Levels
from gsvis.scene.paths import HeadPath

BUDGET = 125e3  # 100 ms at 10 Mbit/s
CLIENTS = 50
VIEW = FieldOfView.from_degrees(90, 70, margin=8)


class NearestCells(CellSets):
    """Cells that see what is nearest to them."""

    def __init__(self, means: np.ndarray, centers: np.ndarray, share: float, terms: int) -> None:
        rng = np.random.default_rng(0)
        self._members = []
        self._masks = []
        for center in centers:
            apart = np.linalg.norm(means - center, axis=1)
            ids = np.flatnonzero(apart <= np.partition(apart, int(share * len(apart)) - 1)[int(share * len(apart)) - 1])
            classes = rng.integers(0, 4, len(ids)).astype(np.uint8)
            self._members.append((ids, classes))
            self._masks.append(pack_some(ids))
        self._terms = np.flatnonzero(rng.random(terms) < 0.1)

    def classes(self, cell: int) -> tuple[np.ndarray, np.ndarray]:
        return self._members[cell]

    def visible_masks(self, cell: int) -> tuple[np.ndarray, np.ndarray]:
        return self._masks[cell]

    def active_ids(self, cell: int) -> np.ndarray:
        return self._terms


def levels_of(scene) -> Levels:
    strength = scene.opacities * extents(scene)[1]
    rank = np.argsort(np.argsort(-strength)) / len(scene)
    first = np.digitize(rank, [0.187, 0.349]).astype(np.uint8)
    return in_package_order(Levels(scene, first, np.full(len(scene), 2, np.uint8), ("low", "medium", "high")))


def synthetic(levels: Levels, shares: list[float]) -> dict[str, SceneIndex]:
    low, high = levels.union.bounds(0.9)
    boxes, means = np.array([5, 5, 2]), levels.union.means
    coords = np.argwhere(np.ones(boxes, bool)).astype(np.int32)
    side = float(((high - low) / boxes).max())
    grid = CellGrid(low, side, tuple(int(n) for n in boxes), coords, np.array([0.0, 0.0, 1.0]))
    offsets, weights = 3 * np.arange(len(means) + 1), [0.008, 0.03, 0.12, 0.5]
    made = {}
    for share in shares:
        cells = NearestCells(means, grid.centers, share, 3 * len(means))
        made[f"cells see {100 * share:g}%"] = SceneIndex.from_levels(
            levels, grid, cells, terms=SceneTerms(offsets, active=cells), class_weights=weights
        )
    return made


def walks_of(data: Path, index: SceneIndex, seconds: float, count: int) -> list[HeadPath]:
    """Recorded walks, ten poses a second, their middle where the middle cell has its center."""
    files = sorted((data / "traces" / "eyenav_rutgers" / "room").glob("*.csv.gz"))[:count]
    out, grid = [], index.grid
    for file in files:
        walk = read_eyenav(file).cut(0.0, seconds).resample(10.0)
        shift = grid.centers[len(grid) // 2] - walk.positions.mean(axis=0)
        out.append(HeadPath(walk.times - walk.times[0], walk.positions + shift, walk.quats))
    return out


def milliseconds(work) -> float:
    start = time.thread_time()
    work()
    return 1e3 * (time.thread_time() - start)


def cold(index: SceneIndex, policy: str, walk: HeadPath, repeats: int) -> list[float]:
    """The first batch in a cell nobody has been in."""
    samples = []
    shared = CandidateIndex(index)

    def first() -> None:
        shared.cache.clear()
        planner = Planner(shared, VIEW, AbrConfig(policy=policy))
        planner.on_pose(0.0, walk.positions[0], walk.quats[0])
        assert len(planner.next_batch(0.0, BUDGET, 10 * BUDGET))

    for _ in range(repeats + 2):
        samples.append(milliseconds(first))
    return samples[2:]


def tick(planner: Planner, throughput: ThroughputEstimator, t: float, position, quat) -> float:
    """Bytes of the batch of one tick, from pose to acknowledgement."""
    planner.on_pose(t, position, quat)
    batch = planner.next_batch(t, BUDGET, throughput.estimate())
    if batch.bytes:
        throughput.observe(batch.bytes, batch.bytes / BUDGET * 0.1)
    return batch.bytes


def ticks(index: SceneIndex, policy: str, walk: HeadPath) -> tuple[list[float], Planner, float]:
    out, sent = [], []
    planner = Planner(CandidateIndex(index), VIEW, AbrConfig(policy=policy))
    throughput = estimator("harmonic", 10 * BUDGET)
    for t, position, quat in zip(walk.times, walk.positions, walk.quats, strict=True):
        out.append(milliseconds(lambda t=t, p=position, q=quat: sent.append(tick(planner, throughput, float(t), p, q))))
    return out, planner, sum(sent)


def together(index: SceneIndex, walks: list[HeadPath], seconds: float) -> list[float]:
    """Milliseconds of each 100 ms in which 50 clients have their turn."""
    shared, out = CandidateIndex(index), []
    clients = [(Planner(shared, VIEW), estimator("harmonic", 10 * BUDGET)) for _ in range(CLIENTS)]
    for k in range(int(10 * seconds)):

        def round_of(k: int = k) -> None:
            for c, client in enumerate(clients):
                walk = walks[c % len(walks)]
                place = (k + 29 * (c // len(walks))) % len(walk)
                tick(*client, 0.1 * k, walk.positions[place], walk.quats[place])

        out.append(milliseconds(round_of))
    return out


def yardstick() -> dict[str, float]:
    """Milliseconds of one loop, again and again over a second or more."""
    taken = [milliseconds(lambda: sum(range(100_000))) for _ in range(400)]
    return {"least_ms": min(taken), "median_ms": float(np.median(taken))}


def bare(c: Candidates) -> float:
    """Milliseconds of reading once what ranking all must read: units, and words with what is held of them."""
    arrays = [*c.units, c.places, *[c.owing] * 4]
    return min(milliseconds(lambda: [np.add.reduce(a, axis=None) for a in arrays]) for _ in range(20))


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--package", type=Path, help="a prepared scene to measure as well")
    args = parser.parse_args()
    data, figures = realdata(), []
    levels = levels_of(load_scene(data / "scenes" / "showroom" / "lod-meta.json", lod=3))
    indices = synthetic(levels, [0.3, 1.0])
    details: dict[str, object] = {"budget_bytes": BUDGET, "clients": CLIENTS, "yardstick before": yardstick()}

    def say(name: str, value: float, target: float | None) -> None:
        figures.append({"name": name, "target": target, "reached": value, "unit": "ms", "better": "lower"})

    if args.package:
        from gsvis.stream import StreamedScene

        scene = StreamedScene.open(args.package)
        indices[args.package.stem] = scene.index
        start = [milliseconds(lambda cell=cell: scene.candidates.build(cell)) for cell in range(len(scene.index.grid))]
        say(f"{args.package.stem}: cold cell with its sets to decode, median", np.median(start[1:]), None)
        say(f"{args.package.stem}: the same, most", max(start[1:]), None)
        details["decoded_ms"] = start
    for scene_name, index in indices.items():
        walks = walks_of(data, index, args.seconds, 8)
        details[scene_name] = {
            "scene": index.as_dict(),
            "cells": index.grid.as_dict(),
            "walks": [repr(w) for w in walks],
        }
        for policy in POLICIES:
            ticks(index, policy, walks[0].cut(0.0, 3.0))  # compiles
            first = cold(index, policy, walks[0], args.repeats)
            runs = [ticks(index, policy, walks[0]) for _ in range(3)]
            along, least = (np.quantile([run[0] for run in runs], at, axis=0) for at in (0.5, 0.0))
            _, planner, sent = runs[0]
            name = f"{scene_name}, {policy}"
            say(f"{name}: cold, median", np.median(first), 10.0)
            say(f"{name}: cold, least", min(first), None)
            say(f"{name}: a tick, mean over the walk", np.mean(along), 1.0)
            say(f"{name}: a tick, mean over the walk, least of three", np.mean(least), None)
            say(f"{name}: a tick, 95th percentile", np.percentile(along, 95), None)
            details[name] = {"cold_ms": first, "ticks_ms": along, "plans": planner.plans, "ticks": len(along)}
            details[name]["sent_bytes"] = sent
        rounds = [together(index, walks, min(args.seconds, 10.0)) for _ in range(3)]
        say(f"{scene_name}: 50 clients, a tick of one, mean", np.mean(np.median(rounds, axis=0)) / CLIENTS, 0.5)
        say(f"{scene_name}: the same, least of three", np.mean(np.min(rounds, axis=0)) / CLIENTS, None)
        candidates = CandidateIndex(index).in_cell(index.grid.nearest(walks[0].positions[0]))
        say(f"{scene_name}: bare, reading once what is ranked", bare(candidates), None)
        details[f"{scene_name}, 50 clients"] = {"rounds_ms": rounds, "units": len(candidates)}
        details[f"{scene_name}, yardstick after it"] = yardstick()
    write_result(args.out, "How long does planning for 750k Gaussians take?", figures, details)


if __name__ == "__main__":
    main()
