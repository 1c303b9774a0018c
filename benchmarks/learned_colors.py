"""What do colors gain that are learned from photographs: SRBF records beside SH, trained for the same steps?

A bonsai trained by `gsvis train` (SH of degree 3, every 8th photograph held out). SRBF colors are fitted where the
training cameras see each Gaussian, then learned from the training photographs; SH is learned from where it stands, by
the same loop for the same number of steps. Both are judged on the held-out photographs, SRBF as rounded records.

Given: --scene-file, a scene trained on the bonsai photographs; --steps of learning; --variant of the colors, `rgb` or
    the paper's `hsl`; --mean-terms a Gaussian; --size of the photographs.
Measured: PSNR on the held-out photographs, mean over views, clipped to [0, 1], for three seeds of the order of views;
    bytes of colors and terms as records and as SH of 32 bits; seconds of the steps of both.
Defaults chosen on: every eighth of the training photographs, which the choice of rates holds out. The rate of SH
    coefficients and the rates of SRBF colors (bases and intensities) are the best of four each; --default-rates leaves
    those of SRBF colors as `gsvis color --photos` has them.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from _harness import add_arguments, need, realdata, write_result

from gsvis.color import VARIANTS, FitConfig, SrbfColors, fit_srbf, quantize, record_bytes, sh_bytes
from gsvis.io import load_scene
from gsvis.prepare.importance import importance_from_views
from gsvis.render import psnr, rasterize
from gsvis.scene.gaussians import Gaussians
from gsvis.train.colors import LearnConfig, learn_colors, learn_sh
from gsvis.train.images import PosedImages
from gsvis.train.photos import load_photos

SEEDS = (0, 1, 2)
SH_RATES = (1e-3, 2e-3, 4e-3, 8e-3)
SRBF_RATES = (2.5e-3, 5e-3, 1e-2, 2e-2)


def judged(g: Gaussians, colors: SrbfColors | None, views: PosedImages) -> np.ndarray:
    """(C,) dB of each held-out photograph."""
    found = np.empty(len(views))
    for c in range(len(views)):
        image = rasterize(g, views.cameras[c], colors=colors).images[0].clip(0.0, 1.0)
        found[c] = float(psnr(image, views.image(c)))
    return found


def choose_rate(rates: Sequence[float], learn: Callable[[PosedImages, float], np.ndarray], few: PosedImages) -> float:
    """The rate with which what was learned from few photographs shows others best, mean of their dB."""
    found = {rate: float(learn(few, rate).mean()) for rate in rates}
    print("by rate", found, flush=True)
    return max(found, key=lambda rate: found[rate])


def choose_rates(g: Gaussians, fitted: SrbfColors, train: PosedImages, options: argparse.Namespace) -> LearnConfig:
    """The best rates of SH and of SRBF colors, by an eighth of the training photographs, learned from the others."""
    few, checked = train.split(8)
    usual = LearnConfig(steps=options.steps)

    def learned_sh(views: PosedImages, rate: float) -> np.ndarray:
        """(C,) dB of the photographs held out for SH of a rate."""
        return judged(learn_sh(g, views, replace(usual, sh_rate=rate)), None, checked)

    def learned_srbf(views: PosedImages, rate: float) -> np.ndarray:
        """(C,) dB of the same for SRBF records."""
        colors = learn_colors(g, fitted, views, replace(usual, base_rate=rate, intensity_rate=rate))
        return judged(g, quantize(colors, "wire").dequantize(), checked)

    chosen = replace(usual, sh_rate=choose_rate(SH_RATES, learned_sh, few))
    if options.default_rates:
        return chosen
    rate = choose_rate(SRBF_RATES, learned_srbf, few)
    return replace(chosen, base_rate=rate, intensity_rate=rate)


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--scene-file", type=Path, help="what gsvis train wrote")
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--mean-terms", type=float, default=1.9)
    parser.add_argument("--variant", choices=tuple(VARIANTS), default=FitConfig.variant)
    parser.add_argument("--size", type=int, nargs=2, default=(400, 266), metavar=("W", "H"))
    parser.add_argument("--seeds", type=int, nargs="+", default=SEEDS)
    parser.add_argument("--default-rates", action="store_true", help="do not choose the rates of SRBF colors")
    arguments = parser.parse_args()
    need(arguments.scene_file, "--scene-file, what gsvis train wrote")
    g = load_scene(arguments.scene_file)
    train, held_out = load_photos(realdata() / "photos/bonsai", size=tuple(arguments.size)).views.split(8)
    seen = importance_from_views(g, train.cameras)
    config = FitConfig(variant=arguments.variant, mean_terms=arguments.mean_terms)
    fitted = fit_srbf(g, seen.sets, config, importance=seen.importance).colors
    before = {"sh": judged(g, None, held_out), "srbf": judged(g, quantize(fitted, "wire").dequantize(), held_out)}
    print({name: round(float(each.mean()), 3) for name, each in before.items()}, flush=True)
    chosen = choose_rates(g, fitted, train, arguments)
    rows: list[dict[str, Any]] = []
    for seed in arguments.seeds:
        lesson = replace(chosen, seed=seed)
        began = time.process_time()
        colors = learn_colors(g, fitted, train, lesson)
        srbf_s = time.process_time() - began
        began = time.process_time()
        sh = learn_sh(g, train, replace(lesson, base_rate=LearnConfig.base_rate))
        sh_s = time.process_time() - began
        records = quantize(colors, "wire").dequantize()
        learned = {"sh": judged(sh, None, held_out), "srbf": judged(g, records, held_out)}
        row = {f"{name}_psnr": float(each.mean()) for name, each in learned.items()}
        row |= {f"{name}_worst": float(each.min()) for name, each in learned.items()}
        row |= {"seed": seed, "srbf_cpu_s": srbf_s, "sh_cpu_s": sh_s, "bytes": record_bytes(colors, "wire") / len(g)}
        rows.append(row)
        print({k: round(v, 3) for k, v in row.items()}, flush=True)
    srbf_db = float(np.mean([row["srbf_psnr"] for row in rows]))
    sh_db = float(np.mean([row["sh_psnr"] for row in rows]))
    size = rows[0]["bytes"]
    figures = [
        {"name": "learned SRBF records over learned SH, mean of seeds", "target": 0.0, "reached": srbf_db - sh_db},
        {
            "name": "learned SRBF records over the scene's own SH",
            "target": 0.1,
            "reached": srbf_db - float(before["sh"].mean()),
        },
        {
            "name": "learned SRBF records over fitted ones",
            "target": None,
            "reached": srbf_db - float(before["srbf"].mean()),
        },
    ]
    for figure in figures:
        figure |= {"unit": "dB", "better": "higher"}
    figures.append(
        {
            "name": "bytes of color and terms a Gaussian",
            "target": 12.0,
            "reached": size,
            "unit": "bytes",
            "better": "lower",
        }
    )
    if arguments.variant != FitConfig.variant:
        for figure in figures:
            figure["name"] = f"{arguments.variant}: {figure['name']}"
    details = {
        "gaussians": len(g),
        "variant": arguments.variant,
        "size": list(arguments.size),
        "steps": arguments.steps,
        "sh_rate": chosen.sh_rate,
        "srbf_rate": chosen.base_rate,
        "sh_bytes": sh_bytes(g.sh_degree, 32),
        "before": {name: {"psnr": float(each.mean()), "worst": float(each.min())} for name, each in before.items()},
        "rows": rows,
    }
    write_result(arguments.out, "What do colors gain that are learned from photographs?", figures, details)


if __name__ == "__main__":
    main()
