"""When should the harmonics of a bare static site come: how many dB does a page have after how many bytes?

Blocks of sets of harmonics come among the parts, by the squared change of color that they make, times a factor (`SETS`
of viewer/src/core/static-plan.ts). The page's own reader (TypeScript, run by node) reads a site behind a simulated link
of 10 Mbit/s with a round trip of 40 ms, with several factors in place of its own.

Given: nika LOD 1 (SH degree 3) and flowers LOD 1 (degree 2), --eyes eyes of the navigable space each, drawn by --seed.
Measured: PSNR of what has come against all that the site holds, 320 x 224, 90 degrees wide, capped at 60 dB: its mean
    over all bytes of the site from 5% to 95%, and bytes until 30 and 40 dB.
Defaults chosen on: flowers LOD 1, seed 3.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from _harness import add_arguments, first_reaching, realdata, write_result
from _reader import build_reader
from static_site import SIZE, TANGENTS, trace

from gsvis.export import StaticOptions, write_static
from gsvis.export.bare import encode_scene
from gsvis.export.harmonics import BLOCK
from gsvis.export.lights import areas_of
from gsvis.export.parts import divide_in_space
from gsvis.export.placing import Placing
from gsvis.io import load_scene
from gsvis.render import psnr, rasterize
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians, quats_from_rotations
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.view_sampling import ViewSampling

SCENES = {"flowers, LOD 1": "flowers_sh2/lod-meta.json", "nika, LOD 1": "nika_sh3/lod-meta.json"}
SHARES = np.linspace(0.05, 0.95, 10)
TARGETS = (30.0, 40.0)
CAP = 60.0


class Site:
    """A bare scene as its site holds it, and what a page draws of a part of it.

    Attributes:
        g: Its Gaussians, with the ids of the site.
        labels: (N,) the block of sets of each.
    """

    def __init__(self, scene: Gaussians) -> None:
        found = encode_scene(scene, StaticOptions().most_sets)
        assert found.palette is not None
        assert found.ranges is not None
        g = found.contents.gaussians()
        parts = divide_in_space(g.means.astype(np.float64), areas_of(g) * g.opacities)
        order = Placing.from_parts(parts, found.contents.chunks, len(g)).order
        shN = found.ranges.decode(found.palette.sets)[found.palette.labels]
        self.g = replace(g, shN=shN)[order]
        self.labels = found.palette.labels[order] // BLOCK

    def draw(self, camera: Cameras, held: np.ndarray, blocks: np.ndarray) -> np.ndarray:
        """Return the image of some Gaussians, with the harmonics of some blocks."""
        some = self.g[held]
        known = blocks[self.labels[held]]
        image = rasterize(replace(some, shN=some.shN * known[:, None, None]), camera).images[0]
        return np.asarray(np.clip(image, 0.0, 1.0))


def curve_of(site: Site, camera: Cameras, steps: list[dict[str, Any]], total: int) -> dict[str, Any]:
    """Return the PSNR at some shares of all bytes, and the bytes until it is good."""
    count = int(site.labels.max()) + 1
    whole = site.draw(camera, np.ones(len(site.g), bool), np.ones(count, bool))

    def quality(last: int) -> float:
        held = np.zeros(len(site.g), bool)
        blocks = np.zeros(count, bool)
        for step in steps[: last + 1]:
            held[step["ids"]] = True
            blocks[[first // BLOCK for first in step["sets"]]] = True
        return min(float(psnr(site.draw(camera, held, blocks), whole)), CAP)

    sizes = np.array([step["bytes"] for step in steps])
    ends = np.searchsorted(sizes, SHARES * total, side="right") - 1
    row: dict[str, Any] = {"psnr": [quality(int(end)) if end >= 0 else 0.0 for end in ends]}
    for target in TARGETS:
        first = first_reaching(quality, len(steps) - 1, target)
        row[str(target)] = int(sizes[-1 if first is None else first])
    return row


def views_of(g: Gaussians, count: int, seed: int) -> tuple[list[dict[str, Any]], list[Cameras]]:
    """Return eyes of the navigable space of a scene as the reader takes them, and their cameras."""
    space = NavigableSpace.from_scene(g, up="-y")
    cameras = ViewSampling(count, *SIZE, 90.0, seed, 1).cameras(g, space)
    left, right, top, bottom = TANGENTS
    views = []
    for viewmat, eye in zip(cameras.viewmats, cameras.viewpoints, strict=True):
        turn = quats_from_rotations(viewmat[None, :3, :3].transpose(0, 2, 1))[0]
        pose = {"position": eye.tolist(), "rotation": turn.tolist()}
        views.append({"pose": pose, "view": {"left": left, "right": right, "up": top, "down": bottom}})
    return views, [cameras[k] for k in range(len(cameras))]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add_arguments(parser)
    parser.add_argument("--factors", type=float, nargs="+", default=[1.0, 10.0, 100.0])
    parser.add_argument("--eyes", type=int, default=6)
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    args = parser.parse_args()
    figures: list[dict[str, Any]] = []
    rows = []
    with tempfile.TemporaryDirectory() as made_in:
        folder = Path(made_in)
        scripts = {factor: build_reader(folder, f"reader-{factor:g}", SETS=factor) for factor in args.factors}
        for name in args.scenes:
            g = load_scene(realdata() / "scenes" / SCENES[name], lod=1)
            static = write_static(folder / name.split(",")[0], g)
            site = Site(g)
            views, cameras = views_of(g, args.eyes, args.seed)
            for factor, script in scripts.items():
                found = []
                for camera, steps in zip(cameras, trace(static.path, views, script), strict=True):
                    found.append(curve_of(site, camera, steps, static.nbytes))
                rows.append({"scene": name, "factor": factor, "bytes": static.nbytes, "eyes": found})
                figures += figures_of(name, factor, found)
                print(figures[-3:], flush=True)
    write_result(args.out, __doc__.splitlines()[0], figures, {"seed": args.seed, "curves": rows})


def figures_of(name: str, factor: float, found: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the figures of one scene with one factor."""
    of = f"{name}, factor {factor:g}"
    means = np.array([row["psnr"] for row in found]).mean(axis=1)
    out: list[dict[str, Any]] = [
        {
            "name": f"{of}: dB, mean over bytes", "target": None, "reached": float(means.mean()),
            "worst": float(means.min()), "unit": "dB", "better": "higher",
        }
    ]  # fmt: skip
    for target in TARGETS:
        sizes = np.array([row[str(target)] for row in found]) / 1e6
        out.append(
            {
                "name": f"{of}: until {target:.0f} dB", "target": None, "reached": float(np.median(sizes)),
                "worst": float(sizes.max()), "unit": "MB", "better": "lower",
            }
        )  # fmt: skip
    return out


if __name__ == "__main__":
    main()
