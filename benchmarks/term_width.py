"""What does a price for the width of terms save, and what does it cost?

Colors of scenes with SH, fitted as `gsvis color` fits them (directions traced outward and seen by 256 views), with
prices for width that may cost nothing, a little or anything, and learned from renders for --steps more. All are judged
as records.

Two rules choose the views that judge, and neither chose a view of the fit: sampled views of another seed and stream,
and eyes of recorded walks (EyeNavGS, brought into the scene by a similarity).

One eye: the share of all terms that change a channel of their Gaussian by more than 0.02, as the report of `gsvis
color` counts it. A walk: the terms that change the image by more than a threshold at one of 30 poses in 30 s (change of
the Gaussian times the root of its summed squared blending weights, which is what a server estimates). The threshold is
the largest at which images of what came so far lose at most 0.1 dB against the scene.

Given: --scenes, --losses of the fit that a price of 3 for width may cost (0: no price; inf: as much as it does),
    --mean-terms, --steps of learning, --precision of the records.
Measured: PSNR, SSIM and FLIP against SH, mean and worst; bytes of colors and terms in a package beyond those of the
    geometry; shares of terms; visible Gaussians by their number of active terms. Walks that do not see a scene are
    left out.
Defaults chosen on: the price of 3 on LOD 2 of nika and flowers; the loss of 0.02 dB on LOD 3 of them, the box in a
    room and two rooms, so that images lose 0.2 dB at most. LOD 2 judges the loss, LOD 1 price and loss.
"""

from __future__ import annotations

import argparse
import math
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from _harness import add_arguments, realdata, write_result
from numpy.typing import NDArray

from gsvis.color import PRECISIONS, Activation, FitConfig, QuantizedColors, SrbfColors, fit_srbf, quantize, sh_bytes
from gsvis.color.evaluate import Evaluator
from gsvis.io import load_scene
from gsvis.io.poses import load_path
from gsvis.package import PackageOrder, in_package_order, write_package
from gsvis.prepare.importance import direction_weights, importance_from_views
from gsvis.prepare.learned_colors import draw_lesson
from gsvis.raycast import EllipsoidProxies, Tracer
from gsvis.raycast.directions import trace_directions
from gsvis.render import flip, psnr, rasterize, ssim, view_weights
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.procedural import builtin_scene
from gsvis.scene.retarget import RetargetConfig, retarget
from gsvis.scene.view_sampling import ViewSampling

SCENES = {"nika": "nika_sh3", "flowers": "flowers_sh2"}
WALKS = ("room/user120_room", "truck/user107_truck")
SIZE = {"width": 320, "height": 240}
EPSILON = 0.02
POSES = 30
LOOKS = (4, 9, 14, 19, 24, 29)
LOST = 0.1
CAP = 70.0
_FOOTPRINT = 3.6e-5  # steradians, the area to which a server relates changes

Image = NDArray[np.float32]


@dataclass(frozen=True)
class View:
    """A camera, the image of SH, and what it sees: ids, and the root of summed squared weights by solid angle."""

    camera: Cameras
    exact: Image
    ids: NDArray[np.int64]
    weights: NDArray[np.float64]

    @classmethod
    def of(cls, g: Gaussians, camera: Cameras) -> View:
        seen = view_weights(g, camera)
        ids = np.flatnonzero(seen.largest[0] > 1.0 / 255.0)
        pixel = 1.0 / float(camera.Ks[0, 0, 0] * camera.Ks[0, 1, 1])
        squared = seen.summed[0][ids].astype(np.float64) * np.minimum(seen.largest[0][ids], 1.0)
        return cls(camera, drawn(g, camera, None), ids, np.sqrt(squared * pixel / _FOOTPRINT))

    @property
    def eye(self) -> NDArray[np.float64]:
        return self.camera.viewpoints[0]


def drawn(g: Gaussians, camera: Cameras, colors: NDArray[np.float32] | None) -> Image:
    """Return an image, clipped to [0, 1]."""
    return np.clip(rasterize(g, camera, colors=colors).images[0], 0.0, 1.0)


def sees_something(walk: list[View]) -> bool:
    """Return whether most eyes of a walk see the scene; a walk of rooms passes by a plant on a table."""
    return float(np.median([len(view.ids) for view in walk])) > 100


@dataclass(frozen=True)
class Judge:
    """A scene in the order of a package, and the views that judge its colors."""

    g: Gaussians
    levels: Levels
    sampled: list[View]
    walks: list[list[View]]

    @classmethod
    def of(cls, g: Gaussians, levels: Levels, space: NavigableSpace, views: int) -> Judge:
        cameras = ViewSampling(views, **SIZE, seed=4242, stream=6).cameras(g, space)
        sampled = [View.of(g, cameras[c]) for c in range(len(cameras))]
        walks = []
        for seed, name in enumerate(WALKS):
            recording = load_path(realdata() / "traces/eyenav_rutgers" / f"{name}.csv.gz").cut(0.0, 30.0)
            path = retarget(recording, space, RetargetConfig(seed=seed)).path
            times = np.linspace(path.times[0], path.times[-1], POSES)
            cameras = path.resample(times=times).cameras(SIZE["width"], SIZE["height"], 90.0)
            walks.append([View.of(g, cameras[c]) for c in range(len(cameras))])
        return cls(g, levels, sampled, [walk for walk in walks if sees_something(walk)])

    def judge(self, colors: SrbfColors, precision: str) -> dict[str, Any]:
        """Return all figures of colors, as records of a precision."""
        packed = quantize(colors, precision)
        records = packed.dequantize()
        seen = Evaluator(records)

        def likeness(views: list[View], prefix: str) -> dict[str, float]:
            images = [drawn(self.g, view.camera, seen.colors(self.g.means, view.eye)) for view in views]
            pairs = list(zip(images, [view.exact for view in views], strict=True))
            decibels = [min(CAP, float(psnr(*pair))) for pair in pairs]
            return {
                f"{prefix}_psnr": float(np.mean(decibels)),
                f"{prefix}_worst": float(np.min(decibels)),
                f"{prefix}_ssim": float(np.mean([float(ssim(*pair)) for pair in pairs])),
                f"{prefix}_flip": float(np.mean([float(flip(*pair)) for pair in pairs])),
            }

        looked = [walk[i] for walk in self.walks for i in LOOKS]
        return {
            "precision": precision,
            "terms": records.num_terms / len(records),
            "bytes": self.color_bytes(packed),
            "median_decay": float(np.median(records.decays)),
            **likeness(self.sampled, "sampled"),
            **(likeness(looked, "walked") if looked else {}),
            **self.active_at_one_eye(records),
            **(self.needed_by_walks(records, seen) if looked else {}),
        }

    def color_bytes(self, packed: QuantizedColors) -> float:
        """Return the bytes a Gaussian of a package that its colors and terms take."""
        plain = quantize(SrbfColors.without_terms(np.full((len(self.g), 3), 0.5)), "wire")
        sizes = []
        for colors in (packed, plain):
            with (
                tempfile.TemporaryDirectory() as folder,
                write_package(Path(folder) / "one.gsvis", self.levels, colors) as package,
            ):
                found = package.manifest.sizes()
            sizes.append(found["records"] + found["terms"])
        return (sizes[0] - sizes[1]) / len(self.g)

    def active_at_one_eye(self, colors: SrbfColors) -> dict[str, Any]:
        """Return the share of active terms, and the shares of visible Gaussians with 0, 1, ... of them."""
        activation = Activation(colors, self.g.means, EPSILON)
        shares = []
        counts = np.zeros(6)
        for view in self.sampled:
            active = activation.active(view.eye)
            shares.append(float(active.mean()))
            numbers = np.bincount(colors.gaussian_ids[active], minlength=len(colors))[view.ids]
            counts += np.bincount(np.minimum(numbers, 5), minlength=6) / max(1, len(numbers))
        return {"one_eye": float(np.mean(shares)), "active_counts": (counts / len(self.sampled)).tolist()}

    def needed_by_walks(self, colors: SrbfColors, seen: Evaluator) -> dict[str, float]:
        """Return the mean share of terms that walks need for images that lose at most LOST, and its threshold."""
        activation = Activation(colors, self.g.means, 0.0)
        found = []
        for walk in self.walks:
            changes = np.zeros((len(walk), colors.num_terms), np.float32)
            for i, view in enumerate(walk):
                weights = np.zeros(len(colors), np.float32)
                weights[view.ids] = view.weights
                changes[i] = activation.contributions(view.eye) * weights[colors.gaussian_ids]
            ever = np.maximum.accumulate(changes, axis=0)

            def quality(threshold: float, walk: list[View] = walk, ever: NDArray[np.float32] = ever) -> float:
                values = []
                for i in LOOKS:
                    view = walk[i]
                    shown = seen.colors(self.g.means, view.eye, active=ever[i] > threshold)
                    values.append(min(CAP, float(psnr(drawn(self.g, view.camera, shown), view.exact))))
                return float(np.mean(values))

            whole = quality(-1.0)
            low, high = 1e-4, 0.1
            for _ in range(8):
                middle = float(np.sqrt(low * high))
                low, high = (middle, high) if whole - quality(middle) <= LOST else (low, middle)
            found.append((float((ever[-1] > low).mean()), low / EPSILON))
        share, threshold = np.mean(found, axis=0)
        return {"walk": float(share), "walk_threshold": float(threshold)}


def opened(scene: str) -> tuple[Levels, NavigableSpace]:
    """Return a scene as one level, and where its eyes are, by NAME:LOD of `SCENES` or builtin:NAME."""
    name, which = scene.split(":")
    if name == "builtin":
        made = builtin_scene(which)
        return Levels.single(made.gaussians), made.navigable
    g = load_scene(realdata() / f"scenes/{SCENES[name]}/lod-meta.json", lod=int(which))
    return Levels.single(g), NavigableSpace.from_scene(g, up="-y")


def measure(scene: str, options: argparse.Namespace) -> dict[str, Any]:
    """Fit and judge one scene at all losses."""
    single, space = opened(scene)
    levels = in_package_order(single)
    g = single.union[PackageOrder.from_levels(single).permutation]
    seen = importance_from_views(g, ViewSampling(256).cameras(g, space))
    sets = trace_directions(Tracer(EllipsoidProxies.from_scene(g)), space, rays_per_face=1) | seen.sets
    judge = Judge.of(g, levels, space, options.views)
    rows: list[dict[str, Any]] = []

    def add(colors: SrbfColors, made: dict[str, Any], began: float, learned: bool) -> None:
        """Keep and print the row of colors whose making began at a time of this process."""
        row = {**made, "learned": learned, "cpu_s": time.process_time() - began}
        rows.append(row | judge.judge(colors, options.precision))
        print(scene, {k: round(v, 3) if isinstance(v, float) else v for k, v in rows[-1].items()}, flush=True)

    for loss in options.losses:
        config = FitConfig(mean_terms=options.mean_terms, width_loss=loss)
        began = time.process_time()
        fit = fit_srbf(g, direction_weights(sets, seen.shares), config, importance=seen.importance)
        made = {"loss": f"{loss:g}", "price": fit.width_price}
        add(fit.colors, made, began, False)
        if options.steps:
            from gsvis.train.colors import learn_colors

            began = time.process_time()
            lesson = draw_lesson(g, space, options.steps)
            add(learn_colors(g, fit.colors, lesson.views, lesson.config), made, began, True)
    return {"gaussians": len(g), "sh_bytes": sh_bytes(g.sh_degree, 32), "rows": rows}


def figures_of(scene: str, row: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the figures of one row."""
    how = f"{scene}, width may cost {row['loss']} dB" + (", learned" if row["learned"] else "")
    how += "" if row["precision"] == "wire" else f", {row['precision']}"
    wanted = (
        ("sampled_psnr", "PSNR of sampled views against SH", "dB", "higher", 49.0),
        ("sampled_worst", "the worst of them", "dB", "higher", None),
        ("walked_psnr", "PSNR of eyes of walks against SH", "dB", "higher", None),
        ("bytes", "color and terms on disk", "bytes a Gaussian", "lower", 10.0),
        ("one_eye", "terms active for one eye", "of all", "lower", 0.25),
        ("walk", "terms that a walk needs", "of all", "lower", 0.24),
    )
    return [
        {"name": f"{how}: {words}", "target": target, "reached": row[key], "unit": unit, "better": better}
        for key, words, unit, better, target in wanted
        if key in row
    ]


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--scenes", nargs="+", default=["nika:1", "flowers:1"], metavar="NAME:LOD")
    parser.add_argument("--losses", nargs="+", type=float, default=[0.0, FitConfig.width_loss, math.inf], metavar="DB")
    parser.add_argument("--mean-terms", type=float, default=FitConfig.mean_terms)
    parser.add_argument("--steps", type=int, default=0, help="steps of learning from renders, beside the fit")
    parser.add_argument("--precision", choices=tuple(PRECISIONS), default="wire", help="of the records")
    parser.add_argument("--views", type=int, default=12)
    options = parser.parse_args()
    found = {scene: measure(scene, options) for scene in options.scenes}
    figures = [each for scene, result in found.items() for row in result["rows"] for each in figures_of(scene, row)]
    write_result(options.out, "What does a price for the width of terms save, and what does it cost?", figures, found)


if __name__ == "__main__":
    main()
