"""How much of a scene does a recorded walk need, and how well do its frames look without the rest?

A walk recorded in another scene is brought into this one. `gsvis cut` keeps what eyes near the walk see all around, and
in a second run what its frames show. Frames of the walk at even steps are then drawn from the scene and from what is
kept. As a peer, the same number of Gaussians is kept by their distance from the walk, as a crop would do.

Given: a scene, its LOD, a recording; the number of frames. Each run uses the defaults of the command.
Measured: share of the Gaussians kept; PSNR of every frame drawn against the scene, 640 x 480 at 90 degrees; seconds.
Defaults chosen on: limits, rays and size of looks are those of `gsvis pvs`. Two things were changed after trials on
    user101 in showroom: a reserve of 5 dB for held-out views, and looks from the walk itself, not only around it: a
    frame of 37 dB showed a slit beside a door that no look had seen. user107 was not looked at before.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np
from _harness import add_arguments, realdata, write_result
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gsvis.edit import Eyes, EyesInSpace, EyesOfCameras, cut
from gsvis.io import load_scene
from gsvis.io.poses import load_path
from gsvis.pvs.quality_result import PSNR_CAP
from gsvis.render import rasterize
from gsvis.render.metrics import psnr
from gsvis.scene.cameras import Cameras
from gsvis.scene.corridor import corridor
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.paths import HeadPath
from gsvis.scene.retarget import retarget

MOST, LEAST = 0.40, 45.0
SIZE, FOV = (640, 480), 90.0


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--scene", default="showroom", help="folder of scenes/")
    parser.add_argument("--lod", type=int, default=3)
    parser.add_argument("--walk", default="user101", help="of eyenav_rutgers/room")
    parser.add_argument("--ways", nargs="+", choices=("around", "frames"), default=["around", "frames"])
    parser.add_argument("--frames", type=int, default=240, help="drawn, at even steps of time")
    options = parser.parse_args()
    data = realdata()
    g = load_scene(data / "scenes" / options.scene / "lod-meta.json", lod=options.lod)
    recorded = load_path(data / "traces" / "eyenav_rutgers" / "room" / f"{options.walk}_room.csv.gz")
    space = NavigableSpace.from_scene(g)
    moved = retarget(recorded, space)
    frames = even_frames(moved.path, options.frames)
    near = EyesInSpace(corridor(space, moved.path.positions), moved.path)
    shown = EyesOfCameras(moved.path.resample(10.0).cameras(960, 720, FOV), looks=240)
    kept: dict[str, NDArray[np.bool_]] = {}
    details: dict[str, Any] = {"gaussians": len(g), "retarget": moved.as_dict(), "frames": len(frames), "runs": {}}
    for name, eyes in (("around", near), ("frames", shown)):
        if name not in options.ways:
            continue
        kept[name], details["runs"][name] = timed_cut(g, eyes)
        print(name, details["runs"][name])
    kept["nearest"] = nearest(g, moved.path, int(next(iter(kept.values())).sum()))
    values = compare(g, kept, frames)
    figures = []
    for name in kept:
        share, worst = float(kept[name].mean()), float(values[name].min())
        bounded = name != "nearest"
        details["runs"].setdefault(name, {})["psnr"] = np.round(values[name], 2)
        figures += [
            {"name": f"{name}: share of the Gaussians kept", "target": MOST if bounded else None, "reached": share,
             "unit": "of all", "better": "lower"},
            {"name": f"{name}: worst frame", "target": LEAST if bounded else None, "reached": worst, "unit": "dB",
             "better": "higher"},
            {"name": f"{name}: mean frame", "target": None, "reached": float(values[name].mean()), "unit": "dB",
             "better": "higher"},
        ]  # fmt: skip
        if bounded:
            figures.append({"name": f"{name}: time", "target": None, "reached": details["runs"][name]["seconds"],
                            "unit": "s", "better": "lower"})  # fmt: skip
    write_result(options.out, "How much of a scene does a recorded walk need?", figures, details)


def even_frames(path: HeadPath, count: int) -> Cameras:
    """Return frames in the middle of `count` equal parts of the time of a walk."""
    times = path.duration * (np.arange(count) + 0.5) / count
    return path.resample(times=times).cameras(*SIZE, FOV)


def timed_cut(g: Gaussians, eyes: Eyes) -> tuple[NDArray[np.bool_], dict[str, Any]]:
    """Return what is kept, and the figures of the cut with its seconds."""
    start = time.perf_counter()
    found = cut(g, eyes)
    return found.kept, {"seconds": time.perf_counter() - start, **found.as_dict()}


def nearest(g: Gaussians, path: HeadPath, count: int) -> NDArray[np.bool_]:
    """Return the `count` Gaussians whose centers are nearest to a walk."""
    away, _ = cKDTree(path.positions).query(g.means)
    kept = np.zeros(len(g), bool)
    kept[np.argsort(away, kind="stable")[:count]] = True
    return kept


def compare(g: Gaussians, kept: dict[str, NDArray[np.bool_]], frames: Cameras) -> dict[str, NDArray[np.float64]]:
    """Return the PSNR of each frame of each part against the scene, dB."""
    parts = {name: g[mask] for name, mask in kept.items()}
    values = {name: np.empty(len(frames)) for name in parts}
    for c in range(len(frames)):
        wanted = rasterize(g, frames[c], backend="cpu").images[0]
        for name, part in parts.items():
            got = rasterize(part, frames[c], backend="cpu").images[0]
            values[name][c] = min(float(psnr(got, wanted)), PSNR_CAP)
    return values


if __name__ == "__main__":
    main()
