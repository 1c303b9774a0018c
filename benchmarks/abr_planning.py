"""How long does it take to decide what a client gets next, cold and along a walk, on one core?

Showroom LOD 3 with levels by opacity times cross-section (18.7% and 34.9%), nested, and synthetic cells: each sees the
given share of the scene that is nearest to it, in four weight classes at random, and a tenth of three terms for each
Gaussian. Cold: candidates of the cell (sets of cells in memory), a new client, its first 100 ms at 10 Mbit/s. Along a
recorded walk: every tick of 100 ms with all that belongs to it, cells entered included. Thread time, so that what else
the machine does counts less.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from _harness import add_arguments, realdata, write_result

from gsvis.abr.candidates import CandidateStore
from gsvis.abr.classes import FieldOfView
from gsvis.abr.index import CellMembers, SceneIndex, extents, streaming_order
from gsvis.abr.policies import POLICIES
from gsvis.abr.scheduler import Scheduler, SchedulerConfig
from gsvis.io import load_scene
from gsvis.io.eyenav import read_eyenav
from gsvis.scene.levels import Levels
from gsvis.visibility.cells import CellGrid

BUDGET = 125e3  # 100 ms at 10 Mbit/s


class NearestCells:
    """Cells that see what is nearest to them."""

    def __init__(self, means: np.ndarray, centres: np.ndarray, share: float, terms: int) -> None:
        rng = np.random.default_rng(0)
        self._members = []
        for centre in centres:
            apart = np.linalg.norm(means - centre, axis=1)
            ids = np.flatnonzero(apart <= np.partition(apart, int(share * len(apart)) - 1)[int(share * len(apart)) - 1])
            classes = rng.integers(0, 4, len(ids)).astype(np.uint8)
            self._members.append(CellMembers.of(ids, len(means), classes))
        self._terms = np.flatnonzero(rng.random(terms) < 0.1).astype(np.uint32)

    def members(self, cell: int) -> CellMembers:
        return self._members[cell]

    def words(self, cell: int) -> np.ndarray:
        return self._members[cell].words

    def terms(self, cell: int) -> np.ndarray:
        return self._terms


def levels_of(scene) -> Levels:
    strength = scene.opacities * extents(scene)[1]
    rank = np.argsort(np.argsort(-strength)) / len(scene)
    first = np.digitize(rank, [0.187, 0.349]).astype(np.uint8)
    made = Levels(scene, first, np.full(len(scene), 2, np.uint8), ("low", "medium", "high"))
    order = streaming_order(made)
    return Levels(scene[order], first[order], np.full(len(scene), 2, np.uint8), made.names)


def milliseconds(work) -> float:
    start = time.thread_time()
    work()
    return 1e3 * (time.thread_time() - start)


def cold(index: SceneIndex, policy: str, walk, repeats: int) -> list[float]:
    """The first batch in a cell nobody has been in."""
    view, samples = FieldOfView.of_degrees(90, 70, margin=8), []
    shared = CandidateStore(index)

    def first() -> None:
        shared._kept.clear()
        scheduler = Scheduler(shared, view, SchedulerConfig(policy=policy))
        scheduler.on_pose(0.0, walk.positions[0], walk.quats[0])
        assert len(scheduler.next_batch(0.0, BUDGET))

    for _ in range(repeats + 2):
        samples.append(milliseconds(first))
    return samples[2:]


def ticks(index: SceneIndex, policy: str, walk) -> tuple[list[float], Scheduler]:
    store, out = CandidateStore(index), []
    scheduler = Scheduler(store, FieldOfView.of_degrees(90, 70, margin=8), SchedulerConfig(policy=policy))

    def tick(t: float, position, quat) -> None:
        scheduler.on_pose(t, position, quat)
        batch = scheduler.next_batch(t, BUDGET)
        scheduler.on_sent(t, batch.bytes)
        scheduler.on_ack(t + 0.1, max(batch.bytes, 1.0), max(batch.bytes, 1.0) / BUDGET * 0.1)

    for t, position, quat in zip(walk.times, walk.positions, walk.quats, strict=True):
        out.append(milliseconds(lambda t=t, p=position, q=quat: tick(float(t), p, q)))
    return out, scheduler


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--seconds", type=float, default=30.0)
    args = parser.parse_args()
    data = realdata()
    levels = levels_of(load_scene(data / "scenes" / "showroom" / "lod-meta.json", lod=3))
    means = levels.union.means
    low, high = levels.union.bounds(0.9)
    boxes = np.array([5, 5, 2])
    side = float(((high - low) / boxes).max())
    coords = np.argwhere(np.ones(boxes, bool)).astype(np.int32)
    grid = CellGrid(low, side, tuple(int(n) for n in boxes), coords, np.array([0.0, 0.0, 1.0]))
    recorded = read_eyenav(sorted((data / "traces" / "eyenav_rutgers" / "room").glob("*.csv.gz"))[0])
    recorded = recorded.cut(0.0, args.seconds).resampled(10.0)
    centre = grid.centres[len(grid) // 2] - recorded.positions.mean(axis=0)
    walk = type(recorded)(recorded.times, recorded.positions + centre, recorded.quats)
    figures, details = [], {"cells": grid.as_dict(), "walk": repr(walk), "budget_bytes": BUDGET}
    for share in (0.3, 1.0):
        cells = NearestCells(means, grid.centres, share, 3 * len(means))
        offsets = 3 * np.arange(len(means) + 1)
        index = SceneIndex.from_levels(
            levels, grid, cells, term_offsets=offsets, class_weights=[0.008, 0.03, 0.12, 0.5]
        )
        for policy in POLICIES:
            first, (along, scheduler) = cold(index, policy, walk, args.repeats), ticks(index, policy, walk)
            name = f"{policy}, cells see {100 * share:g}%"
            for told, value, target in (
                ("cold, median", np.median(first), 10.0),
                ("cold, least", min(first), None),
                ("a tick, mean over the walk", np.mean(along), 1.0),
                ("a tick, 95th percentile", np.percentile(along, 95), None),
            ):
                figures.append(
                    {"name": f"{name}: {told}", "target": target, "reached": value, "unit": "ms", "better": "lower"}
                )
            details[name] = {"cold_ms": first, "ticks_ms": along, "plans": scheduler.plans, "ticks": len(along)}
            details[name]["sent_bytes"] = scheduler.sent_bytes
    write_result(args.out, "How long does planning for 750k Gaussians take?", figures, details)


if __name__ == "__main__":
    main()
