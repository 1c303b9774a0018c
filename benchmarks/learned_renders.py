"""What do colors gain that are learned from renders of the scene, and what does a step of learning take?

Given: scenes with SH, fitted by the defaults of `gsvis color` without traced rays; 300 steps from 224 views, with full
    rates (the default) and with rates that follow the error of the fit, full up to 48 dB in the mean.
Measured: PSNR of exact colors against the SH colors in 24 views of another stream, mean and worst, before and after;
    processor time of a step.
Defaults chosen on: the rates follow flowers LOD 2 and copies of nika (0.6M); nika LOD 2 and smaller copies judge.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from _harness import add_arguments, realdata, write_result
from real_sizes import MILLION, build

from gsvis.io.ply import load_ply
from gsvis.io.sources import load_source
from gsvis.prepare.colors import ColorConfig, prepare_colors
from gsvis.prepare.learned_colors import RENDERS, ColorMeasure, draw_lesson
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.train.colors import LearnConfig, learn_colors

STEPS = 300
FULL = 48.0  # dB
JUDGES = replace(RENDERS, count=24, stream=11)


def main() -> None:
    """Measure each scene, write the record."""
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--size", type=float, default=0.3, metavar="M", help="millions of Gaussians of the copies")
    options = parser.parse_args()
    scenes = realdata() / "scenes"
    found: dict[str, Any] = {}
    for name, folder in (("flowers LOD 2", "flowers_sh2"), ("nika LOD 2", "nika_sh3")):
        found[name] = measure(load_source(str(scenes / folder / "lod-meta.json"), 2).gaussians)
    with tempfile.TemporaryDirectory() as work:
        path = Path(work) / "copies.ply"
        build(path, round(options.size * MILLION))
        found[f"{options.size:g}M"] = measure(load_ply(path))
    figures = []
    for name, row in found.items():
        for rates in ("full", "slowed"):
            figures += [
                figure(f"{name}, {rates} rates: gain in the mean", row[rates]["mean"] - row["fitted"]["mean"], "dB"),
                figure(f"{name}, {rates} rates: worst view", row[rates]["worst"] - row["fitted"]["worst"], "dB"),
            ]
        figures.append(figure(f"{name}: processor time of a step", row["slowed"]["step_ms"], "ms", better="lower"))
    write_result(options.out, "What do colors gain that are learned from renders?", figures, found)


def figure(name: str, reached: float, unit: str, better: str = "higher") -> dict[str, Any]:
    """Return one figure without a target."""
    return {"name": name, "target": None, "reached": round(reached, 3), "unit": unit, "better": better}


def measure(g: Gaussians) -> dict[str, Any]:
    """Return PSNR of the fit and of learned colors, with both rates."""
    space = NavigableSpace.from_scene(g)
    colors = prepare_colors(g, space, ColorConfig(rays_per_face=0)).fit.colors
    lesson = draw_lesson(g, space, STEPS)
    every = np.ones(len(g), bool)
    judges = ColorMeasure(g, every, JUDGES.cameras(g, space))
    row: dict[str, Any] = {"gaussians": len(g), "fitted": spread(judges.psnr_of(colors))}
    some = np.unique(np.linspace(0, len(lesson.views) - 1, 16).astype(int))
    slowed = slow_rates(lesson.config, ColorMeasure(g, every, lesson.views[some]).psnr_of(colors))
    learn_colors(g, colors, lesson.views, replace(lesson.config, steps=1))  # loads the kernels
    for name, config in (("full", lesson.config), ("slowed", slowed)):
        began = time.process_time()
        learned = learn_colors(g, colors, lesson.views, config)
        taken = time.process_time() - began
        row[name] = {**spread(judges.psnr_of(learned)), "step_ms": 1000.0 * taken / STEPS}
        row[name]["factor"] = config.base_rate / lesson.config.base_rate
    return row


def slow_rates(config: LearnConfig, found: np.ndarray[Any, Any]) -> LearnConfig:
    """Return rates in proportion to the error of the fit: `found` (C,) dB, with full rates up to `FULL`."""
    factor = min(float(10.0 ** (0.05 * (FULL - found.mean()))), 1.0)
    names = [each.name for each in fields(config) if each.name.endswith("_rate")]
    return replace(config, **{name: factor * getattr(config, name) for name in names})


def spread(values: np.ndarray[Any, Any]) -> dict[str, float]:
    """Return mean and least value."""
    return {"mean": float(values.mean()), "worst": float(values.min())}


if __name__ == "__main__":
    main()
