"""How good does a scene become in half an hour on two cores, and what does a training step cost beyond the rasterizer?

Bonsai, 292 photographs at 400 x 266, every 8th held out; rules and rates of 3DGS with the schedule shortened and the
number of Gaussians bounded. Time counts from the start of the process' work: reading photographs, training, measuring
and checkpoints all count, compiling kernels does not (one step is taken before). The step is compared with the
rasterizer's own forward plus backward pass over the same views, turn by turn, at the end of training.

Given: bonsai, its photographs and COLMAP model, at most 200,000 Gaussians.
Measured: PSNR of every 8th photograph over time; a step over the rasterizer's own passes.
Defaults chosen on: bonsai, the scene that is measured too.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch
from _harness import add_arguments, measure_in_turn, realdata, write_result

from gsvis.io import save_scene
from gsvis.render import GaussianTensors, flip, rasterize, ssim
from gsvis.train.densify import DensifyConfig
from gsvis.train.history import Record
from gsvis.train.initial import gaussians_from_points
from gsvis.train.photos import load_photos
from gsvis.train.trainer import TrainConfig, Trainer

SIZE = (400, 266)
MINUTES = 30.0


def config_of(arguments: argparse.Namespace) -> TrainConfig:
    rules = DensifyConfig(start=300, stop=arguments.iterations // 2, most_count=arguments.most)
    return TrainConfig(iterations=arguments.iterations, densify=rules, evaluate_every=250)


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--iterations", type=int, default=6_000)
    parser.add_argument("--most", type=int, default=200_000, help="Gaussians beyond which none is added")
    parser.add_argument("--scene", type=Path, help="PLY to write the trained scene to")
    arguments = parser.parse_args()
    config = config_of(arguments)
    folder = realdata() / "photos/bonsai"
    warm = load_photos(folder, size=(100, 66))
    assert warm.points is not None
    Trainer(warm.views, gaussians_from_points(warm.points), config).advance()

    began = time.perf_counter()
    photos = load_photos(folder, size=SIZE)
    assert photos.points is not None
    views, held_out = photos.views.split(8)
    trainer = Trainer(views, gaussians_from_points(photos.points), config, held_out=held_out)
    curve = []
    while trainer.step < config.iterations:
        trainer.advance()
        if trainer.step % config.evaluate_every == 0 or trainer.step == config.iterations:
            now: Record = trainer.record()
            curve.append({**asdict(now), "wall_s": time.perf_counter() - began})
            print({key: round(value, 4) for key, value in curve[-1].items()}, flush=True)
    g = trainer.gaussians()
    if arguments.scene:
        save_scene(g, arguments.scene)
    within = [point for point in curve if point["wall_s"] <= 60.0 * MINUTES]
    reached = [point["wall_s"] for point in curve if point["psnr"] >= 27.0]

    images = rasterize(g, held_out.cameras).images.clip(0, 1)
    targets = np.stack([held_out.image(k) for k in range(len(held_out))])
    quality = {
        "ssim": float(np.mean(ssim(images, targets))),
        "flip": float(np.mean(flip(images, targets))),
        "brightness": float(images.mean() / targets.mean()),
    }
    step, alone = Trainer(views, g, config), Trainer(views, g, config)

    def raster() -> None:
        camera = views.cameras[alone.view_of(alone.step)]
        alone.step += 1
        tensors = GaussianTensors.from_gaussians(g, requires_grad=True)
        drawn = rasterize(tensors, camera).images
        drawn.backward(torch.full_like(drawn, 1e-6))  # type: ignore[no-untyped-call]

    copying = measure_in_turn({"copy": lambda: GaussianTensors.from_gaussians(g, requires_grad=True)}, repeats=15)
    times = measure_in_turn({"step": step.advance, "raster": raster}, repeats=31, warmup=3)
    bare = times["raster"].median - copying["copy"].median
    figures = [
        {
            "name": f"held-out PSNR on bonsai after at most {MINUTES:.0f} minutes",
            "target": 27.0,
            "reached": max((point["psnr"] for point in within), default=0.0),
            "unit": "dB",
            "better": "higher",
        },
        {
            "name": "time to 27 dB",
            "target": None,
            "reached": min(reached, default=float("inf")) / 60.0 if reached else -1.0,
            "unit": "min",
            "better": "lower",
        },
        {
            "name": f"training step over the rasterizer's forward plus backward, {len(g):,} Gaussians",
            "target": 1.6,
            "reached": times["step"].median / bare,
            "unit": "x",
            "better": "lower",
        },
    ]
    details = {
        "size": SIZE,
        "views": len(views),
        "held_out": len(held_out),
        "config": asdict(config),
        "count": len(g),
        "curve": curve,
        **quality,
        "step": times["step"].as_json(),
        "rasterizer": times["raster"].as_json(),
        "copy": copying["copy"].as_json(),
    }
    write_result(arguments.out, "How good does a scene become in half an hour on two cores?", figures, details)


if __name__ == "__main__":
    main()
