"""Does the paper's epsilon of 0.01 to 0.05 come out of the staircase, with FLIP in place of a person?

SRBF-Gaussian, section 6.2. The scene is drawn from seeded cameras in navigable space, with all terms of its colors and
with those that are active at epsilon. The observer notices the difference where the 99th percentile of a view's FLIP
map is above `FLIP_JND` in any view. That is a convention (see `gsvis.color.FLIP_JND`), so the same images are judged by
other thresholds, percentiles, viewing distances and by the middle view instead of the worst, and by observers with a
spread who guess, as people in a two-alternative test do. These take the differences between measured epsilons from
straight lines in logarithms.

PSNR and the share of active terms at each epsilon are over the same cameras; values are clipped to [0, 1] as a display
does. Without `--colors` the colors are fitted here, over the directions and by the importance of other seeded cameras.

Given: rendered views, the FLIP metric as observer, the threshold on its 99th percentile.
Measured: the epsilon at which the staircase settles; PSNR and share of active terms there.
Defaults chosen on: nika LOD 0 and flowers LOD 1, the scenes that are measured too: the threshold is a convention, not a
    finding.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from _harness import add_arguments, realdata, write_result
from numpy.typing import NDArray
from paper.staircase import PERSON_RULE, draw_ladder, write_staircase_page

from gsvis.color.epsilon import FLIP_JND, EpsilonCalibration, MetricObserver, StaircaseRule, calibrate_epsilon
from gsvis.color.fit import FitConfig, fit_srbf
from gsvis.color.srbf import SrbfColors
from gsvis.color.storage import load_srbf
from gsvis.io import load_scene
from gsvis.prepare.approximations import Approximations
from gsvis.prepare.importance import importance_from_views
from gsvis.render.metrics import flip_map, psnr
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace

SCENES = ("nika_sh3:0", "flowers_sh2:1")
PAPER = (0.01, 0.05)
GRID = tuple(StaircaseRule().rungs[StaircaseRule().above % 4 :: 4][1:20].tolist())  # two an octave, 0.57 to 0.0011
DISTANCES = (67.0, 30.0)  # pixels per degree: the first is FLIP's default, the second a screen near the eye
POOLS = {"mean": None, "p95": 95.0, "p99": 99.0, "most": 100.0}
THRESHOLDS = (0.058, FLIP_JND, 0.2)
SEEDS = 50
CAP = 99.0


class Views:
    """What the views of a scene say of an epsilon, worked out once for each."""

    def __init__(self, pictures: Approximations) -> None:
        self.pictures = pictures
        self.rows: dict[float, dict[str, Any]] = {}

    def at(self, epsilon: float, distances: tuple[float, ...] = DISTANCES[:1]) -> dict[str, Any]:
        row = self.rows.get(epsilon, {"flip": {}})
        missing = [ppd for ppd in distances if ppd not in row["flip"]]
        if not missing:
            return row
        images = np.clip(self.pictures.images(epsilon), 0.0, 1.0)
        reference = np.clip(self.pictures.reference, 0.0, 1.0)
        for ppd in missing:
            maps = flip_map(images, reference, ppd)
            row["flip"][ppd] = {
                name: (maps.mean(axis=(1, 2)) if q is None else np.percentile(maps, q, axis=(1, 2))).tolist()
                for name, q in POOLS.items()
            }
        row["psnr"] = np.minimum(np.asarray(psnr(images, reference)), CAP).tolist()
        row["shares"] = self.pictures.shares(epsilon).tolist()
        self.rows[epsilon] = row
        log(
            f"epsilon {epsilon:.4g}: FLIP p99 {max(row['flip'][distances[0]]['p99']):.4f} in the worst view,"
            f" {np.mean(row['psnr']):.2f} dB, {np.mean(row['shares']):.1%} active"
        )
        return row

    def difference(self, pool: str, ppd: float, over: Callable[[Any], Any]) -> Callable[[float], float]:
        """Of any epsilon, by straight lines in logarithms between those that were measured at this distance."""
        known = sorted(epsilon for epsilon, row in self.rows.items() if ppd in row["flip"])
        values = np.maximum([float(over(self.rows[e]["flip"][ppd][pool])) for e in known], 1e-9)

        def interpolated(epsilon: float) -> float:
            return float(np.exp(np.interp(np.log(epsilon), np.log(known), np.log(values))))

        return interpolated


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("scenes", nargs="*", default=SCENES, metavar="NAME:LOD", help="folders of scenes/, or paths")
    parser.add_argument("--colors", type=Path, help="SRBF colors of the one scene, as `gsvis color` writes them")
    parser.add_argument("--variant", default=FitConfig.variant, help="of the fit, without --colors")
    parser.add_argument("--terms", type=float, default=4.0, help="mean terms a Gaussian, without --colors")
    parser.add_argument("--views", type=int, default=6)
    parser.add_argument("--width", type=int, default=480)
    parser.add_argument("--height", type=int, default=360)
    parser.add_argument("--fov", type=float, default=60.0)
    parser.add_argument("--page", type=Path, help="write the person's test there, of the first scene and three views")
    options = parser.parse_args()
    results = [measured(name, options, page=options.page if k == 0 else None) for k, name in enumerate(options.scenes)]
    print(table(results))
    figures = []
    for result in results:
        scene, found = result["scene"], result["staircase"]
        figures += [
            figure(f"epsilon, {scene}", found["epsilon"], "change of a channel; paper 0.01 to 0.05"),
            figure(f"active terms against all at that epsilon, {scene}", result["psnr"], "dB", 45.0),
            figure(f"active terms at that epsilon, {scene}", result["share"], "of all, mean over the views"),
            figure(f"epsilon by threshold, {scene}", result["exponent"], "d log epsilon / d log threshold"),
        ]
    question = "Does the paper's epsilon of 0.01 to 0.05 come out of the staircase, with FLIP in place of a person?"
    details = {"paper": PAPER, "threshold": FLIP_JND, "rule": StaircaseRule().as_dict(), "scenes": results}
    write_result(options.out, question, figures, details)


def measured(name: str, options: argparse.Namespace, page: Path | None) -> dict[str, Any]:
    label, _, lod = name.partition(":")
    path = Path(label) if Path(label).exists() else realdata() / "scenes" / label / "lod-meta.json"
    g = load_scene(path, lod=int(lod) if lod else None)
    space = NavigableSpace.from_scene(g)
    fitted, colors = load_or_fit(g, space, options)
    scene = label + (f" LOD {lod}" if lod else "")
    log(f"{scene}: {colors}, {colors.num_terms / max(1, len(g)):.2f} terms a Gaussian")
    size = {"width": options.width, "height": options.height, "fov": options.fov}
    cameras = space.sample_cameras(options.views, np.random.default_rng(11), **size)
    pictures = Approximations(g, colors, cameras)
    views = Views(pictures)

    about = {"scene": scene, "cameras": f"{len(cameras)} in navigable space, seed 11", "percentile": 99, **size}
    observer = MetricObserver(lambda e: max(views.at(e)["flip"][DISTANCES[0]]["p99"]), FLIP_JND, images=about)
    found = calibrate_epsilon(observer)
    log(f"{scene}: {found}")
    for epsilon in GRID:
        views.at(epsilon, DISTANCES)
    row = views.at(nearest(found.epsilon, views))
    others = sensitivity(views)
    by_threshold = [other["epsilon"] for other in others if other["default"]]
    if page is not None:
        write_page(page, Approximations(g, colors, cameras[:3]), scene)
    return {
        "scene": scene, "gaussians": len(g), "terms": colors.num_terms, "variant": colors.variant, "fit": fitted,
        "staircase": found.as_dict(), "within_paper": PAPER[0] <= found.epsilon <= PAPER[1],
        "psnr": float(np.mean(row["psnr"])), "least_psnr": float(np.min(row["psnr"])),
        "share": float(np.mean(row["shares"])),
        "exponent": math.log(by_threshold[-1] / by_threshold[0]) / math.log(THRESHOLDS[-1] / THRESHOLDS[0]),
        "observers": others, "people": people(views),
        "by_epsilon": [{"epsilon": epsilon, **views.rows[epsilon]} for epsilon in sorted(views.rows)],
    }  # fmt: skip


def sensitivity(views: Views) -> list[dict[str, Any]]:
    """Epsilon by what is taken for noticing: pool, threshold, distance, worst or middle view."""
    rows = []
    rule = StaircaseRule(lowest=min(GRID), highest=max(GRID))
    for ppd in DISTANCES:
        for pool in POOLS:
            for name, over in (("worst", np.max), ("middle", np.median)):
                difference = views.difference(pool, ppd, over)
                for threshold in THRESHOLDS:
                    found = calibrate_epsilon(MetricObserver(difference, threshold), rule)
                    usual = (ppd, pool, name) == (DISTANCES[0], "p99", "worst")
                    rows.append({
                        "pixels_per_degree": ppd, "pool": pool, "view": name, "threshold": threshold, "default": usual,
                        "epsilon": found.epsilon, "converged": found.converged,
                    })  # fmt: skip
    return rows


def people(views: Views) -> list[dict[str, Any]]:
    """Observers with a spread: how far single runs lie from the threshold, by our rule and by the page's for people."""
    difference = views.difference("p99", DISTANCES[0], np.max)
    rows = []
    for label, rule in (("default rule", StaircaseRule(lowest=min(GRID), highest=max(GRID))), ("page", PERSON_RULE)):
        for guess in (0.0, 0.5):
            runs = [calibrate_epsilon(MetricObserver(difference, FLIP_JND, 0.3, guess, k), rule) for k in range(SEEDS)]
            rows.append({"rule": label, "guess": guess, "slope": 0.3, **spread(runs)})
    return rows


def spread(runs: list[EpsilonCalibration]) -> dict[str, Any]:
    logarithms = np.log([run.epsilon for run in runs])
    return {
        "epsilon": float(np.exp(logarithms.mean())),
        "deviation": float(logarithms.std()),
        "standard_error": float(np.mean([run.standard_error for run in runs if run.converged])),
        "trials": float(np.mean([len(run.epsilons) for run in runs])),
        "converged": float(np.mean([run.converged for run in runs])),
    }


def nearest(epsilon: float, views: Views) -> float:
    known: NDArray[np.float64] = np.asarray(list(views.rows))
    return float(known[np.abs(np.log(known / epsilon)).argmin()])


def load_or_fit(g: Gaussians, space: NavigableSpace, options: argparse.Namespace) -> tuple[dict[str, Any], SrbfColors]:
    """The colors of the scene, and how they came about."""
    if options.colors is not None:
        loaded, colors = load_srbf(options.colors)
        if not np.array_equal(loaded.means, g.means):
            raise SystemExit(f"error: {options.colors}: expected the colors of the scene, got those of another")
        return {"file": options.colors.name}, colors
    cameras = space.sample_cameras(64, np.random.default_rng(3), width=320, height=240, fov=90.0)
    seen = importance_from_views(g, cameras)
    start = time.perf_counter()
    config = FitConfig(variant=options.variant, mean_terms=options.terms)
    fit = fit_srbf(g, seen.sets, config, importance=seen.importance, progress=progress)
    return {"seconds": time.perf_counter() - start, "mean_terms": options.terms, "cameras": len(cameras)}, fit.colors


def write_page(path: Path, pictures: Approximations, scene: str) -> None:
    start = time.perf_counter()
    ladder = draw_ladder(pictures, PERSON_RULE.rungs, progress=progress)
    size = write_staircase_page(path, pictures.reference, ladder, title=scene, progress=progress)
    log(f"{path.name}: {size / 1e6:.1f} MB, {time.perf_counter() - start:.0f} s")


def figure(name: str, reached: float, unit: str, target: float | None = None) -> dict[str, Any]:
    better = "lower" if target is None else "higher"
    return {"name": name, "target": target, "reached": reached, "unit": unit, "better": better}


def table(results: list[dict[str, Any]]) -> str:
    lines = ["| scene | pixels per degree | pool | view | " + " | ".join(f"threshold {t:g}" for t in THRESHOLDS) + " |"]
    lines.append("|---|---|---|---|" + "---|" * len(THRESHOLDS))
    for result in results:
        rows = result["observers"]
        for k in range(0, len(rows), len(THRESHOLDS)):
            cells = " | ".join(
                f"{row['epsilon']:.4f}" if row["converged"] else "none"  # beyond the epsilons that were drawn
                for row in rows[k : k + len(THRESHOLDS)]
            )
            first = rows[k]
            named = f"{first['pool']} | {first['view']}{' (ours)' if first['default'] else ''}"
            lines.append(f"| {result['scene']} | {first['pixels_per_degree']:g} | {named} | {cells} |")
    lines += [
        "",
        "| scene | epsilon | FLIP p99, worst view | PSNR, mean | least | active |",
        "|---|---|---|---|---|---|",
    ]
    for result in results:
        for row in result["by_epsilon"]:
            flip = max(row["flip"][DISTANCES[0]]["p99"])
            lines.append(
                f"| {result['scene']} | {row['epsilon']:.4f} | {flip:.4f} | {np.mean(row['psnr']):.1f} dB"
                f" | {np.min(row['psnr']):.1f} dB | {np.mean(row['shares']):.1%} |"
            )
    return "\n".join(lines)


def progress(stage: str, done: int, total: int) -> None:
    if done == total or (total > 1000 and done % 50_000 < 2048):
        log(f"{stage}: {done:,} of {total:,}")


def log(text: str) -> None:
    print(text, file=sys.stderr)


if __name__ == "__main__":
    main()
