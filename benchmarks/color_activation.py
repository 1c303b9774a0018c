"""What does sending only the active terms save, and what does it cost in the image?

SRBF-Gaussian, section 7.3.1 and figure 13: 3.58% of the SRBFs sent at the start of a walk, 22.39% after 30 s, while
86.85% of the Gaussians have been sent. Three parts, on nika LOD 0:

Two rules. "gaussian", the paper's: a term is active where it changes the color of its Gaussian by more than epsilon.
"pixel": where it changes a pixel by more than epsilon, the change of the Gaussian times its largest blending weight (by
cells: the most that its weight class allows).

1. Held-out cameras (seeded, anywhere in navigable space): images with only the terms that are active for the eye
   against images with all terms, over epsilon; values are clipped to [0, 1] as a display does. Epsilon itself comes
   from the staircase with FLIP as its observer on other cameras, once for each rule, unless it is given; where it gives
   less than 45 dB, the epsilon that gives 45 dB is used in its place.
2. Walks that people made with a headset (EyeNavGS), brought into the scene as in `visibility_walk.py`: share and bytes
   of the terms sent so far. Once by cameras: a term is sent when it is first active for an eye whose camera (weights of
   the rasterizer at the stated resolution) sees its Gaussian. Once by cells, which is what a server that knows only
   the eye's cell sends, with all that is visible around the eye: visible sets of the cells along the walk (cubemaps of
   `--pvs-size` pixels, mended at most `--inner` times), and the terms active for any eye in the cell.
3. What the walker sees: at eight poses the image with the terms sent so far against all terms.

Without `--colors` the colors are fitted here: over all directions, terms where they count most in seeded cameras.

Given: nika LOD 0, its fitted terms, epsilon from the staircase, two to four recorded walks.
Measured: share of terms active by camera, which takes an oracle that knows every eye, and by cell, which is what a
    server sends; PSNR.
Defaults chosen on: nika LOD 2 (the paper's rule against the pixel rule).
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from _harness import add_arguments, measure, realdata, write_result
from numpy.typing import NDArray
from paper.walk import PAPER_WALK, WalkConfig
from paper.walk_terms import PAPER_TERMS, WalkTerms, terms_over_walk

from gsvis.color.activation import Activation
from gsvis.color.epsilon import FLIP_JND, MetricObserver, calibrate_epsilon
from gsvis.color.evaluate import Evaluator
from gsvis.color.fit import FitConfig, fit_srbf
from gsvis.color.records import bytes_per_term, record_bytes
from gsvis.color.srbf import SrbfColors
from gsvis.color.storage import load_srbf
from gsvis.io import load_scene
from gsvis.io.poses import load_path
from gsvis.prepare.active_terms import build_active_terms
from gsvis.pvs.build import build_pvs
from gsvis.pvs.cells import MAX_CELLS, CellGrid
from gsvis.pvs.config import PvsConfig
from gsvis.pvs.store import VisibilityStore
from gsvis.render import rasterize, view_weights
from gsvis.render.metrics import flip_map, psnr
from gsvis.scene.cameras import Cameras
from gsvis.scene.corridor import corridor
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.paths import HeadPath
from gsvis.scene.retarget import RetargetConfig, retarget

RULES = {"gaussian": False, "pixel": True}
EPSILONS = (0.001, 0.002, 0.005, 0.01, 0.02, 0.03, 0.05, 0.1)
WALKS = ("room/user111_room", "truck/user107_truck", "room/user120_room", "truck/user122_truck")
LEAST_PSNR = 45.0
SAID = {"cameras": "an oracle for every eye", "cells": "by cell, as a server sends them"}
CAP = 99.0


@dataclass(frozen=True)
class Subject:
    """A scene with its colors, ready to be drawn."""

    g: Gaussians
    colors: SrbfColors
    evaluator: Evaluator

    def image(self, camera: Cameras, active: NDArray[np.bool_] | None = None) -> NDArray[np.float32]:
        seen = self.evaluator.colors(self.g.means, camera.viewpoints[0], active=active)
        drawn = rasterize(self.g, camera, colors=seen, backend="cpu").images[0]
        return np.clip(drawn, 0.0, 1.0)


@dataclass(frozen=True)
class View:
    """A camera, what it sees, and its image with all terms."""

    camera: Cameras
    ids: NDArray[np.int64]
    weights: NDArray[np.float32]
    full: NDArray[np.float32]

    @classmethod
    def from_subject(cls, subject: Subject, camera: Cameras) -> View:
        largest = view_weights(subject.g, camera).largest[0]
        ids = np.flatnonzero(largest >= np.float32(WalkConfig.tau))
        return cls(camera, ids, np.minimum(largest[ids], 1.0), subject.image(camera))

    def active(self, activation: Activation, weighted: bool) -> NDArray[np.bool_]:
        """Active terms of the Gaussians it sees."""
        return activation.active(self.camera.viewpoints[0], self.ids, self.weights if weighted else None)


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--scene", default="nika_sh3:0", metavar="NAME:LOD", help="folder of scenes/, or a path")
    parser.add_argument("--colors", type=Path, help="SRBF colors of the scene, as `gsvis color` writes them")
    parser.add_argument("--variant", default=FitConfig.variant, help="of the fit, without --colors")
    parser.add_argument("--terms", type=float, default=4.0, help="mean terms a Gaussian, without --colors")
    parser.add_argument("--epsilon", type=float, help="threshold; without it, of the staircase with FLIP")
    parser.add_argument("--cameras", type=int, default=12, help="held-out cameras")
    parser.add_argument("--walks", type=int, default=len(WALKS), help=f"how many of the {len(WALKS)} recordings")
    parser.add_argument("--rate", type=float, default=2.0, help="poses a second")
    parser.add_argument("--cells", type=int, default=512, help="most cells of the navigable space")
    parser.add_argument("--pvs-size", type=int, default=160, help="pixels of a face in looking from the walk's cells")
    parser.add_argument("--inner", type=int, default=2, help="most times that the set of a cell is mended")
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--height", type=int, default=480)
    parser.add_argument("--fov", type=float, default=90.0)
    options = parser.parse_args()
    config = WalkConfig(rate=options.rate, width=options.width, height=options.height, fov=options.fov)
    label, _, lod = options.scene.partition(":")
    path = Path(label) if Path(label).exists() else realdata() / "scenes" / label / "lod-meta.json"
    g = load_scene(path, lod=int(lod) if lod else None)
    space = NavigableSpace.from_scene(g)
    size = {"width": config.width, "height": config.height, "fov": config.fov}
    fitted, colors = load_or_fit(g, space, options)
    subject = Subject(g, colors, Evaluator(colors))
    log(f"{g}, {colors}: {colors.num_terms / max(1, len(g)):.2f} terms a Gaussian")

    views = [View.from_subject(subject, camera) for camera in cameras_of(space, 4, 2, size)]
    found = {rule: calibration(subject, views, weighted, options.epsilon) for rule, weighted in RULES.items()}
    views = [View.from_subject(subject, camera) for camera in cameras_of(space, options.cameras, 1, size)]
    rows = {}
    for rule, weighted in RULES.items():
        curve = by_epsilon(subject, views, weighted, sorted({*EPSILONS, found[rule]["epsilon"]}))
        limit = float(np.interp(-LEAST_PSNR, [-r["psnr"] for r in curve], [np.log(r["epsilon"]) for r in curve]))
        used = min(found[rule]["epsilon"], 0.97 * float(np.exp(limit)))  # the curve between is not quite straight
        if used < found[rule]["epsilon"]:
            curve = sorted([*curve, *by_epsilon(subject, views, weighted, [used])], key=lambda r: r["epsilon"])
        rows[rule] = {"calibration": found[rule], "epsilon": used, "at_45_dB": float(np.exp(limit)), "curve": curve}
    side = CellGrid.over(space, max_cells=options.cells).cell_size
    pvs = PvsConfig(method="raster", size=options.pvs_size, max_inner=options.inner)
    walks = []
    for seed, name in enumerate(WALKS[: options.walks]):
        recording = load_path(realdata() / "traces" / "eyenav_rutgers" / f"{name}.csv.gz").cut(0.0, config.seconds)
        placed = retarget(recording, space, RetargetConfig(seed=seed))
        row: dict[str, Any] = {"walk": name, "retarget": placed.as_dict()}
        along = corridor(space, placed.path.positions)
        grid = CellGrid.over(along, cell_size=side, max_cells=MAX_CELLS)
        with tempfile.TemporaryDirectory() as folder:
            start = time.perf_counter()
            with build_pvs(g, grid, along, Path(folder) / "walk.pvs", pvs) as store:
                row["pvs"] = {"seconds": time.perf_counter() - start, "bytes": store.path.stat().st_size}
                for rule, weighted in RULES.items():
                    e = rows[rule]["epsilon"]
                    eye = terms_over_walk(colors, g, placed.path, e, config=config, weighted=weighted)
                    cell, stored = by_cells(subject, placed.path, store, e, weighted, config)
                    row[rule] = {
                        "epsilon": e, "cameras": eye.as_dict(), "cells": cell.as_dict(), "store": stored,
                        "shown": shown(subject, placed.path, eye), "shown_cells": shown(subject, placed.path, cell),
                    }  # fmt: skip
                    log(f"{name}, {rule}: {eye.terms[-1]:.2%} of the terms, by cells {cell.terms[-1]:.2%}")
        walks.append(row)

    figures = summarize(rows, walks)
    activation = Activation(colors, g.means, rows["gaussian"]["epsilon"])
    eye = views[0].camera.viewpoints[0]
    low, high = eye - 0.5 * side, eye + 0.5 * side
    times = {
        "active_s": measure(lambda: activation.active(eye), repeats=5).as_json(),
        "active_in_box_s": measure(lambda: activation.active_in_box(low, high), repeats=5).as_json(),
    }
    print(table(rows, walks))
    details = {
        "scene": options.scene, "gaussians": len(g), "terms": colors.num_terms, "variant": colors.variant,
        "fit": fitted, "term_bytes": bytes_per_term(colors.variant), "all_bytes": record_bytes(colors),
        "rules": rows, "walks": walks, "cell_size": side, "pvs": pvs.as_dict(),
        "times": times,
        "paper": {**PAPER_TERMS, "gaussians": PAPER_WALK["seen"]},
    }  # fmt: skip
    question = "What does sending only the active terms save, and what does it cost in the image?"
    write_result(options.out, question, figures, details)


def load_or_fit(g: Gaussians, space: NavigableSpace, options: argparse.Namespace) -> tuple[dict[str, Any], SrbfColors]:
    """The colors of the scene, and how they came about."""
    if options.colors is not None:
        loaded, colors = load_srbf(options.colors)
        if not np.array_equal(loaded.means, g.means):
            raise SystemExit(f"error: {options.colors}: expected the colors of {options.scene}, got those of another")
        return {"file": options.colors.name}, colors
    cameras = space.sample_cameras(24, np.random.default_rng(3), width=320, height=240, fov=options.fov)
    importance = view_weights(g, cameras).summed.sum(axis=0)
    start = time.perf_counter()
    fit = fit_srbf(
        g, None, FitConfig(variant=options.variant, mean_terms=options.terms), importance=importance, progress=progress
    )
    return {"seconds": time.perf_counter() - start, "mean_terms": options.terms, "directions": "all"}, fit.colors


def cameras_of(space: NavigableSpace, count: int, seed: int, size: dict[str, Any]) -> list[Cameras]:
    cameras = space.sample_cameras(count, np.random.default_rng(seed), **size)
    return [cameras[c] for c in range(count)]


def calibration(subject: Subject, views: Sequence[View], weighted: bool, given: float | None) -> dict[str, Any]:
    """Epsilon of the staircase; FLIP notices where the 99th percentile of its map is above the threshold."""
    if given is not None:
        return {"epsilon": given, "provenance": "given"}

    def difference(epsilon: float) -> float:
        activation = Activation(subject.colors, subject.g.means, epsilon)
        worst = 0.0
        for view in views:
            partial = subject.image(view.camera, view.active(activation, weighted))
            worst = max(worst, float(np.quantile(flip_map(partial, view.full), 0.99)))
        log(f"FLIP at epsilon {epsilon:.4g}: {worst:.4f}")
        return worst

    observer = MetricObserver(difference, FLIP_JND, images={"cameras": len(views), "quantile": 0.99})
    found = calibrate_epsilon(observer)
    return {
        "epsilon": found.epsilon, "converged": found.converged, "reason": found.reason, "observer": observer.name,
        "differences": {f"{e:.5g}": d for e, d in observer.differences.items()}, **observer.provenance,
    }  # fmt: skip


def by_epsilon(
    subject: Subject, views: Sequence[View], weighted: bool, epsilons: Sequence[float]
) -> list[dict[str, Any]]:
    """Images with the active terms of visible Gaussians against images with all terms, and the share that is active."""
    colors, rows = subject.colors, []
    for epsilon in epsilons:
        activation = Activation(colors, subject.g.means, epsilon)
        values, of_visible, of_all = [], [], []
        for view in views:
            active = view.active(activation, weighted)
            values.append(min(CAP, float(psnr(subject.image(view.camera, active), view.full))))
            count = int(np.count_nonzero(active))
            of_visible.append(count / max(1, int(colors.counts[view.ids].sum())))
            of_all.append(count / max(1, colors.num_terms))
        rows.append({
            "epsilon": epsilon, "psnr": float(np.mean(values)), "least_psnr": float(np.min(values)), "psnrs": values,
            "of_visible": float(np.mean(of_visible)), "of_all": float(np.mean(of_all)),
        })  # fmt: skip
        log(f"epsilon {epsilon:.4g}: {np.mean(values):.2f} dB, {np.mean(of_visible):.1%} of the terms of visible ones")
    return rows


def by_cells(
    subject: Subject, path: HeadPath, store: VisibilityStore, epsilon: float, weighted: bool, config: WalkConfig
) -> tuple[WalkTerms, dict[str, Any]]:
    """The walk by the visible sets of its cells, and what the store of active terms takes."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "walk.terms.arrow"
        start = time.perf_counter()
        with build_active_terms(subject.colors, subject.g, store, epsilon, file, weighted=weighted) as terms:
            seconds = time.perf_counter() - start
            walk = terms_over_walk(subject.colors, subject.g, path, terms, sets=store, config=config)
            shares = [terms.share(cell) for cell in range(len(terms))]
            pairs = sum(share.active for share in shares)
            record = {
                "build_s": seconds, "cells": len(shares), "bytes": file.stat().st_size, "pairs": pairs,
                "bits_per_pair": 8.0 * file.stat().st_size / max(1, pairs),
                "of_visible": float(np.mean([share.of_visible for share in shares])),
                "of_all": float(np.mean([share.of_all for share in shares])),
            }  # fmt: skip
    return walk, record


def shown(subject: Subject, path: HeadPath, walk: WalkTerms) -> dict[str, float]:
    """Images at eight poses with the terms sent until then, against all terms."""
    times = walk.times[np.unique(np.linspace(0, len(walk.times) - 1, 8).round().astype(int))]
    config, values = walk.config, []
    cameras = path.resample(times=times).cameras(config.width, config.height, config.fov)
    for i, seconds in enumerate(times):
        held = walk.first_active <= np.float32(seconds)
        values.append(min(CAP, float(psnr(subject.image(cameras[i], held), subject.image(cameras[i])))))
    return {"psnr": float(np.mean(values)), "least_psnr": float(np.min(values))}


def summarize(rows: dict[str, Any], walks: list[dict[str, Any]]) -> list[dict[str, Any]]:
    def figure(name: str, reached: float, unit: str, target: float | None = None) -> dict[str, Any]:
        better = "lower" if target is None else "higher"
        return {"name": name, "target": target, "reached": reached, "unit": unit, "better": better}

    figures = []
    for rule, row in rows.items():
        at = next(r for r in row["curve"] if r["epsilon"] == row["epsilon"])
        figures += [
            figure(f"{rule}: epsilon of the staircase", row["calibration"]["epsilon"], "of 1; paper 0.01 to 0.05"),
            figure(f"{rule}: epsilon at which images have 45 dB", row["at_45_dB"], "of 1"),
            figure(f"{rule}: active terms against all, held-out cameras, mean", at["psnr"], "dB", LEAST_PSNR),
            figure(f"{rule}: active, of the terms of visible Gaussians", at["of_visible"], "share"),
        ]
        for way in ("cameras", "cells") if walks else ():
            start = float(np.mean([walk[rule][way]["terms_at_start"] for walk in walks]))
            end = float(np.mean([walk[rule][way]["terms_at_end"] for walk in walks]))
            size = float(np.mean([walk[rule][way]["bytes"][-1] for walk in walks]))
            figures += [
                figure(f"{rule}: terms active at the start, {SAID[way]}", start, "of all; paper 0.0358"),
                figure(f"{rule}: terms active in 30 s, {SAID[way]}", end, "of all; paper 0.2239"),
                figure(f"{rule}: bytes of terms active in 30 s, {SAID[way]}", size / 1e6, "MB"),
            ]
        if walks:
            least = min(walk[rule]["shown"]["psnr"] for walk in walks)
            figures.append(figure(f"{rule}: images along a walk with the terms sent so far", least, "dB", LEAST_PSNR))
    for way in ("cameras", "cells") if walks else ():
        seen = float(np.mean([walk["gaussian"][way]["gaussians_at_end"] for walk in walks]))
        figures.append(figure(f"Gaussians seen in 30 s, {SAID[way]}", seen, "of all; paper 0.8685"))
        without = float(np.mean([walk["gaussian"][way]["unpruned_at_end"] for walk in walks]))
        figures.append(figure(f"all terms of Gaussians seen in 30 s, {SAID[way]}", without, "of all terms"))
    return figures


def table(rows: dict[str, Any], walks: list[dict[str, Any]]) -> str:
    lines = [
        "| rule | epsilon | PSNR, mean | least | active, of the terms of visible Gaussians |",
        "|---|---|---|---|---|",
    ]
    lines += [
        f"| {rule} | {r['epsilon']:.4g} | {r['psnr']:.1f} dB | {r['least_psnr']:.1f} dB | {r['of_visible']:.1%} |"
        for rule, row in rows.items()
        for r in row["curve"]
    ]
    lines += ["", "| walk | rule | epsilon | Gaussians | terms | all terms of them | by cells: the same three | | |"]
    lines += ["|---|---|---|---|---|---|---|---|---|"]
    for walk in walks:
        for rule in rows:
            cells = [
                f"{way['gaussians_at_end']:.1%} | {way['terms_at_start']:.2%} to {way['terms_at_end']:.2%}"
                f" | {way['unpruned_at_end']:.2%}"
                for way in (walk[rule]["cameras"], walk[rule]["cells"])
            ]
            lines.append(f"| {walk['walk']} | {rule} | {walk[rule]['epsilon']:.4g} | {' | '.join(cells)} |")
    return "\n".join(lines)


def progress(stage: str, done: int, total: int) -> None:
    if done == total or done % 50_000 < 2048:
        log(f"{stage}: {done:,} of {total:,}")


def log(text: str) -> None:
    print(text, file=sys.stderr)


if __name__ == "__main__":
    main()
