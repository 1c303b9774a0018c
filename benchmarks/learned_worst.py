"""Do colors that are learned from renders lose in the worst view?

Given: scenes with SH, fitted by the defaults of `gsvis color` without traced rays; 300 steps from 224 views.
Measured: PSNR of exact colors against the SH colors in two sets of 24 views, mean and worst: of another seed and
    stream by the rule of the lesson, and around the detail of the scene (`find_judges`). Colors are the fitted ones,
    all of the change, and the share of it that the guard keeps by the held-out views of the lesson.
Defaults chosen on: the shares and what the worst view may lose follow the held-out views of copies of nika (0.6M); all
    other scenes judge, and all views here are others.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from _harness import add_arguments, realdata, write_result
from real_sizes import MILLION, build

from gsvis.io.ply import load_ply
from gsvis.io.sources import load_source
from gsvis.prepare.colors import ColorConfig, prepare_colors
from gsvis.prepare.learned_colors import RENDERS, ColorMeasure, draw_lesson, learn_lesson
from gsvis.render.judges import find_judges
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.procedural import two_rooms
from gsvis.train.colors import learn_colors

STEPS = 300
OTHER = replace(RENDERS, count=24, stream=11, seed=7)
SCENES = ("two rooms", "nika LOD 1", "flowers LOD 1", "copies")


def main() -> None:
    """Measure each scene, write the record."""
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--size", type=float, default=0.6, metavar="M", help="millions of Gaussians of the copies")
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    options = parser.parse_args()
    found = {name: measure(scene(name, options.size)) for name in options.scenes}
    figures = []
    for name, row in found.items():
        for judges in ("other seed", "around detail"):
            fitted, kept = row[judges]["fitted"], row[judges]["kept"]
            figures += [
                figure(f"{name}, {judges}: gain in the mean", kept["mean"] - fitted["mean"], 0.0),
                figure(f"{name}, {judges}: gain of the worst view", kept["worst"] - fitted["worst"], -0.25),
            ]
    write_result(options.out, "Do colors that are learned from renders lose in the worst view?", figures, found)


def figure(name: str, reached: float, target: float) -> dict[str, Any]:
    """Return one figure in dB."""
    return {"name": name, "target": target, "reached": round(reached, 3), "unit": "dB", "better": "higher"}


def scene(name: str, size: float) -> Gaussians:
    """Return a scene by its name; copies of nika have `size` million Gaussians."""
    if name == "two rooms":
        return two_rooms().gaussians
    if name == "copies":
        with tempfile.TemporaryDirectory() as work:
            path = Path(work) / "copies.ply"
            build(path, round(size * MILLION))
            return load_ply(path)
    folder = {"nika LOD 1": "nika_sh3", "flowers LOD 1": "flowers_sh2"}[name]
    return load_source(str(realdata() / "scenes" / folder / "lod-meta.json"), 1).gaussians


def measure(g: Gaussians) -> dict[str, Any]:
    """Return PSNR of the fit, of all that is learned, and of what the guard keeps."""
    space = NavigableSpace.from_scene(g)
    colors = prepare_colors(g, space, ColorConfig(rays_per_face=0)).fit.colors
    lesson = draw_lesson(g, space, STEPS)
    kept, about = learn_lesson(g, colors, lesson, lambda exact: exact)
    whole = kept if about.share == 1.0 else learn_colors(g, colors, lesson.views, lesson.config)
    every = np.ones(len(g), bool)
    row: dict[str, Any] = {"gaussians": len(g), "share": about.share, "held out": about.as_dict()["psnr"]}
    for name, cameras in (("other seed", OTHER.cameras(g, space)), ("around detail", find_judges(g, OTHER).cameras)):
        judges = ColorMeasure(g, every, cameras)
        measured = dict(zip(("fitted", "whole", "kept"), judges.psnr_of(colors, whole, kept), strict=True))
        row[name] = {each: spread(values) for each, values in measured.items()}
        row[name]["views"] = len(cameras)
        row[name]["most lost by a view"] = {
            each: float((measured[each] - measured["fitted"]).min()) for each in ("whole", "kept")
        }
    print(row, flush=True)
    return row


def spread(values: np.ndarray[Any, Any]) -> dict[str, float]:
    """Return mean and least value."""
    return {"mean": float(values.mean()), "worst": float(values.min())}


if __name__ == "__main__":
    main()
