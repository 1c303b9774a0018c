"""How many seconds of a million Gaussians do levels take until they are as good as wanted?

Levels of 25 and 50% of showroom LOD 3 with few looks and steps, and with more, judged by the 48 views of
`levels_unseen.py`. 60 s a million on two cores are 120 s of processor time.

Given: the scene, shares and reuse, looks, steps, views.
Measured: PSNR against the full scene, mean and worst view; processor time of drawing views, choosing, merging and
    training.
Defaults chosen on: how rooms are looked at and trained was chosen on showroom, by other views.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import numba
import torch
from _harness import add_arguments, realdata, write_result
from levels_unseen import FOV, SCENES, draw, judged, judging_cameras

from gsvis.io.sources import load_source
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.view_sampling import ViewSampling
from gsvis.train.choosing import LOOKS
from gsvis.train.level_views import draw_views
from gsvis.train.levels import LevelsConfig, TrainedLevels, train_levels

STEPS = LevelsConfig().iterations
EFFORTS = ((30, 50, 100), (60, 100, 200), (LOOKS, STEPS, 400))  # looks, steps, views
ENOUGH = 25.0  # dB
WANTED = 120.0  # s of processor a million


def train(g: Gaussians, space: NavigableSpace, effort: tuple[int, int, int]) -> tuple[TrainedLevels, float]:
    """Return levels by some looks, steps and views, with the processor time they took."""
    looks, steps, count = effort
    begun = time.process_time()
    views = draw_views(g, space, ViewSampling(count, 480, 360, FOV), 0)
    config = LevelsConfig(preview=0.0, iterations=steps, looks=looks)
    made = train_levels(g, views.views, config, choose_by=views.choose_by, space=space)
    return made, time.process_time() - begun


def figures_of(effort: tuple[int, int, int], seconds: float, rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the time a million, with a target where the quarter has `ENOUGH`, and the PSNR of both levels."""
    looks, steps, _ = effort
    name = f"showroom LOD 3, {looks} looks and {steps} steps"
    enough = rows[0]["mean"] >= ENOUGH
    found = [
        {
            "name": f"{name}: seconds of processor a million",
            "target": WANTED if enough else None,
            "reached": seconds,
            "unit": "s",
            "better": "lower",
        }
    ]
    for share, row in zip((0.25, 0.5), rows, strict=True):
        for which in ("mean", "worst"):
            judged_by = f"{name}: {share:.0%}, {which} view"
            found.append({"name": judged_by, "target": None, "reached": row[which], "unit": "dB", "better": "higher"})
    return found


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    arguments = parser.parse_args()
    numba.set_num_threads(1)
    torch.set_num_threads(1)
    file, lod, up = SCENES["showroom"]
    g = load_source(str(realdata() / "scenes" / file), lod).gaussians
    space = NavigableSpace.from_scene(g, up=up)
    cameras = judging_cameras(g, space)
    target = {name: draw(g, each) for name, each in cameras.items()}
    figures: list[dict[str, Any]] = []
    details: list[dict[str, Any]] = []
    train(g[:: len(g) // 20_000], space, (5, 5, 5))  # kernels
    for effort in EFFORTS:
        made, seconds = train(g, space, effort)
        rows = [judged(made.levels.level(k), cameras, target) for k in range(2)]
        details.append({"looks, steps, views": effort, "cpu_s": seconds, "levels": rows})
        print(details[-1], flush=True)
        figures += figures_of(effort, seconds / len(g) * 1e6, rows)
    question = "How many seconds of a million Gaussians do levels take until they are as good as wanted?"
    write_result(arguments.out, question, figures, {"gaussians": len(g), "efforts": details})


if __name__ == "__main__":
    main()
