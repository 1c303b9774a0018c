"""Are our levels better than a decimator outside of rooms, from near and from far?

For each scene: levels of 25 and 50% by `train_levels`, with a share of 90 and 96% reused, beside both decimations of
splat-transform at the same counts. All are judged by views that no level saw: 16 where eyes may be, and 16 that look at
detail from near (both rules also give views to choose and train by, with other seeds). Processor time is that of this
process: drawing views, choosing, merging and training.

Given: scenes, shares and reuse, steps.
Measured: PSNR of held-out views against the full scene, mean and worst; processor time.
Defaults chosen on: massa (near views, pairs instead of voxels), and the price of color by these views of all three.
"""

from __future__ import annotations

import argparse
import pickle
import time
from pathlib import Path
from typing import Any

import numba
import numpy as np
import torch
from _harness import add_arguments, realdata, write_result
from _rivals import decimated
from numpy.typing import NDArray

from gsvis.io import load_scene
from gsvis.render import psnr, rasterize
from gsvis.render.judges import find_judges
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.view_sampling import ViewSampling
from gsvis.train.level_views import draw_views
from gsvis.train.levels import LevelsConfig, train_levels

SCENES = {
    "massa": ("statues/massa.sog", None),
    "nika": ("nika_sh3/lod-meta.json", 2),
    "flowers": ("flowers_sh2/lod-meta.json", 2),
}
JUDGES = ViewSampling(16, 320, 240, 75.0, 99)
STREAMS = 3, 7
FOV = 77.3


def judged(g: Gaussians, cameras: Cameras, target: NDArray[np.float32]) -> dict[str, Any]:
    """PSNR of all views, of which the first half are where eyes may be, and the others near detail."""
    each = np.minimum(np.asarray(psnr(rasterize(g, cameras).images.clip(0.0, 1.0), target)), 100.0)
    far = each[: JUDGES.count]
    near = each[JUDGES.count :]
    parts = {"": each, "far_": far, "near_": near}
    found: dict[str, Any] = {"count": len(g)}
    for name, values in parts.items():
        found |= {f"{name}mean": float(values.mean()), f"{name}worst": float(values.min())}
    return found


def compare(name: str, arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """Rows of one scene, one for each level and method."""
    file, lod = SCENES[name]
    path = realdata() / "scenes" / file
    g = load_scene(path) if lod is None else load_scene(path, lod=lod)
    space = NavigableSpace.from_scene(g, up="-y")
    one, two = STREAMS
    far = ViewSampling(16, 320, 240, 75.0, 99, one).cameras(g, space)
    near = find_judges(g, ViewSampling(16, 320, 240, 75.0, 99, two), space.witnesses).cameras
    cameras = Cameras(np.concatenate([far.viewmats, near.viewmats]), np.concatenate([far.Ks, near.Ks]), 320, 240)
    target = rasterize(g, cameras).images.clip(0.0, 1.0)
    begun = time.process_time()
    views = draw_views(g, space, ViewSampling(arguments.views, 480, 360, FOV), 0)
    config = LevelsConfig(preview=0.0, iterations=arguments.steps, looks=arguments.looks)
    levels = train_levels(g, views.views, config, choose_by=views.choose_by, space=space).levels
    seconds = time.process_time() - begun
    rows = []
    for k, share in enumerate(config.shares):
        rows.append({"method": "ours", **judged(levels.level(k), cameras, target), "reuse": levels.reuse[k]})
        for adaptive in (False, True):
            less = decimated(g, levels.counts[k], adaptive, arguments.cache)
            rows.append({"method": ("decimate", "decimate-adaptive")[adaptive], **judged(less, cameras, target)})
        for row in rows[-3:]:
            row |= {"scene": name, "gaussians": len(g), "share": share, "cpu_s": seconds}
            print(row, flush=True)
    return rows


def figures(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Our PSNR less that of the better decimation, for each scene and share."""
    found = []
    for ours in (row for row in rows if row["method"] == "ours"):
        same = [r for r in rows if (r["scene"], r["share"]) == (ours["scene"], ours["share"]) and r is not ours]
        for which in ("mean", "worst"):
            name = f"{ours['scene']}, {ours['share']:.0%}: our level over the better decimation, {which} view"
            reached = ours[which] - max(row[which] for row in same)
            found.append({"name": name, "target": 0.0, "reached": reached, "unit": "dB", "better": "higher"})
    return found


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    parser.add_argument("--steps", type=int, default=LevelsConfig().iterations)
    parser.add_argument("--views", type=int, default=400)
    parser.add_argument("--looks", type=int, help="looks of the choice, as in LevelsConfig")
    parser.add_argument("--cache", type=Path, default=Path("/tmp/rivals"), help="keeps what is slow")
    arguments = parser.parse_args()
    numba.set_num_threads(1)
    torch.set_num_threads(1)
    arguments.cache.mkdir(parents=True, exist_ok=True)
    rows: list[dict[str, Any]] = []
    for name in arguments.scenes:
        kept = arguments.cache / f"{name}-{arguments.steps}-{arguments.views}-{arguments.looks}.pickle"
        if not kept.exists():
            kept.write_bytes(pickle.dumps(compare(name, arguments)))
        rows += pickle.loads(kept.read_bytes())
    question = "Are our levels better than a decimator outside of rooms, from near and from far?"
    details = {"steps": arguments.steps, "views": arguments.views, "looks": arguments.looks, "rows": rows}
    write_result(arguments.out, question, figures(rows), details)


if __name__ == "__main__":
    main()
