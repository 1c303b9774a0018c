"""What share of a scene does a camera need, and what share has a walk of 30 s ever seen?

SRBF-Gaussian, section 3.1 (20.21% of the Gaussians visible per view on average, 33.58% in one view) and figure 13
(86.85% after 30 s of walking), beside walks that people made with a headset (EyeNavGS, `room` and `truck`), brought
into our scenes by the similarity transforms in the details. In the showroom they keep their size (a unit is a meter);
elsewhere, where the unit is not known, they are about as large as fits with 99% of the positions in navigable space,
and placed so that they look at the scene.

Weights of the rasterizer at the stated resolution, visible from 1/255. The first walk of each scene is watched at half
the rate, too, which shows what the rate leaves out.

Given: three scenes, recorded walks brought into them by a similarity.
Measured: share visible in a camera and ever seen in 30 s, at the stated resolution.
Defaults chosen on: no scene.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from _harness import add_arguments, realdata, write_result
from paper.walk import PAPER_WALK, WalkConfig, measure_walk

from gsvis.io import load_scene
from gsvis.io.poses import load_path
from gsvis.pvs.store import VisibilityStore
from gsvis.raycast import PAPER
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.retarget import RetargetConfig, retarget

SCENES = ("showroom:3", "nika_sh3:1", "flowers_sh2:1")
METERS = {"showroom": 1.0}
WALKS = ("room/user111_room", "truck/user107_truck", "room/user120_room", "truck/user122_truck")


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("scenes", nargs="*", default=SCENES, metavar="NAME:LOD", help="folders of scenes/, or paths")
    parser.add_argument("--walks", type=int, default=len(WALKS), help=f"how many of the {len(WALKS)} recordings")
    parser.add_argument("--rate", type=float, default=2.0, help="poses a second")
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--height", type=int, default=480)
    parser.add_argument("--fov", type=float, default=90.0)
    parser.add_argument("--store", type=Path, help="visible sets of the first scene: what their cells see, too")
    options = parser.parse_args()
    config = WalkConfig(rate=options.rate, width=options.width, height=options.height, fov=options.fov)
    stores = [options.store, *[None] * (len(options.scenes) - 1)]
    walks = WALKS[: options.walks]
    results = [measured(name, walks, config, store) for name, store in zip(options.scenes, stores, strict=True)]
    print(table(results))
    figures = [
        {"name": f"{label}, {result['scene']}", "target": None, "reached": result[key], "unit": unit, "better": better}
        for result in results
        for key, label, unit, better in (
            ("mean_visible", "visible per camera, mean", "of all Gaussians; paper 0.2021", "lower"),
            ("max_visible", "visible per camera, most", "of all Gaussians; paper 0.3358", "lower"),
            ("seen_at_end", "ever seen in 30 s, mean over walks", "of all Gaussians; paper 0.8685", "lower"),
        )
    ]
    for result in results:
        for key, label in (("cells_at_end", "of a 30 s walk, ever"), ("cells_mean", "of the poses of a walk, mean")):
            if key in result:
                figures.append(
                    {"name": f"seen by the cells {label}, {result['scene']}", "target": None, "reached": result[key],
                     "unit": "of all Gaussians" + ("; paper 0.8685" if key == "cells_at_end" else ""),
                     "better": "lower"}
                )  # fmt: skip
    question = "What share of a scene does a camera need, and what share has a walk of 30 s ever seen?"
    write_result(options.out, question, figures, {"paper": {**PAPER, "walk": dict(PAPER_WALK)}, "scenes": results})


def measured(name: str, walks: tuple[str, ...], config: WalkConfig, store: Path | None) -> dict[str, Any]:
    label, _, lod = name.partition(":")
    path = Path(label) if Path(label).exists() else realdata() / "scenes" / label / "lod-meta.json"
    g = load_scene(path, lod=int(lod) if lod else None)
    navigable = NavigableSpace.from_scene(g)
    taken: list[dict[str, Any]] = []
    for seed, walk in enumerate(walks):
        recording = load_path(realdata() / "traces" / "eyenav_rutgers" / f"{walk}.csv.gz").cut(0.0, config.seconds)
        placed = retarget(recording, navigable, RetargetConfig(meters_per_unit=METERS.get(label), seed=seed))
        start = time.perf_counter()
        seen = measure_walk(g, placed.path, config)
        seconds = time.perf_counter() - start
        taken.append({"walk": walk, "retarget": placed.as_dict(), "seconds": seconds, **seen.as_dict()})
        if store is not None:
            with VisibilityStore.open(store, scene=g) as sets:
                taken[-1]["cells"] = measure_walk(sets, placed.path, config).as_dict()
        if seed == 0:
            slower = WalkConfig(config.seconds, config.rate / 2.0, config.width, config.height, config.fov)
            taken[0]["seen_at_end_at_half_the_rate"] = float(measure_walk(g, placed.path, slower).seen[-1])
        text = f"{seen.visible.mean():.2%} per camera, {seen.seen[-1]:.2%} in all, {seconds:.1f} s"
        print(
            f"{label}: {walk}: {placed.similarity}, {placed.inside:.2%} inside, {placed.looking:.0%} looking: {text}",
            file=sys.stderr,
        )
    cells = [walk["cells"] for walk in taken if "cells" in walk]
    by_cells = {
        "cells_at_end": float(np.mean([each["seen_at_end"] for each in cells])),
        "cells_mean": float(np.mean([each["mean_visible"] for each in cells])),
    } if cells else {}  # fmt: skip
    return {
        **by_cells,
        "scene": label + (f" LOD {lod}" if lod else ""),
        "gaussians": len(g),
        "navigable": navigable.rule,
        "mean_visible": float(np.mean([w["mean_visible"] for w in taken])),
        "max_visible": float(np.max([w["max_visible"] for w in taken])),
        "seen_at_end": float(np.mean([w["seen_at_end"] for w in taken])),
        "least_seen_at_end": float(np.min([w["seen_at_end"] for w in taken])),
        "most_seen_at_end": float(np.max([w["seen_at_end"] for w in taken])),
        "walks": taken,
    }


def table(results: list[dict[str, Any]]) -> str:
    head = "| scene | visible per camera, mean | most | ever seen in 30 s, mean over walks (least to most) |"
    paper = f"| paper | {PAPER['mean_visible']:.2%} | {PAPER['one_view_visible']:.2%} | {PAPER_WALK['seen']:.2%} |"
    rows = [
        f"| {r['scene']} | {r['mean_visible']:.2%} | {r['max_visible']:.2%}"
        f" | {r['seen_at_end']:.2%} ({r['least_seen_at_end']:.2%} to {r['most_seen_at_end']:.2%}) |"
        for r in results
    ]
    return "\n".join([head, "|---|---|---|---|", *rows, paper])


if __name__ == "__main__":
    main()
