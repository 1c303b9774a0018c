"""What does a frame of a large scene cost, in time and memory, and how does cost grow with Gaussians and pixels?

Showroom LOD 2 (1.5M) at 1920 x 1080 from inside: seconds a frame, and the memory that rendering adds to a process that
holds the scene, over the scene's own bytes. Then random subsets of 50k to 1.5M, and 0.1 to 8 megapixels.

Given: showroom LOD 2, its subsets, image sizes.
Measured: seconds and added memory of a frame.
Defaults chosen on: garden_points.npz.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys

import numba
import numpy as np
from _harness import add_arguments, measure, realdata, write_result

from gsvis.io import load_scene
from gsvis.render import rasterize
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians

EYES = [[-3.0, -10.0, 1.5], [1.0, -5.0, 1.5], [-6.0, -14.0, 1.5], [2.0, -12.0, 1.5]]
TARGETS = [[-6.0, -12.0, 1.0], [-3.0, -8.0, 1.0], [-2.0, -10.0, 1.2], [-4.0, -9.0, 1.0]]


def cameras(width: int, height: int) -> Cameras:
    return Cameras.look_at(EYES, TARGETS, width=width, height=height, fov=70)


def draw(g: Gaussians, views: Cameras) -> None:
    for c in range(len(views)):
        rasterize(g, views[c])


def peak_over_scene() -> float:
    """Rise of the peak resident size while four frames are drawn, over the bytes of the scene."""
    small = Gaussians([[0, 0, 2.0]], [[1, 0, 0, 0]], [[0.1] * 3], [0.5], np.zeros((1, 1, 3)))
    draw(small, cameras(64, 48))  # compiled code and libraries are not the frame's
    g = load_scene(realdata() / "scenes/showroom/lod-meta.json", lod=2)
    before = _resident()
    with open("/proc/self/clear_refs", "w", encoding="ascii") as clear:
        clear.write("5")  # forget the peak so far: loading had its own
    draw(g, cameras(1920, 1080))
    rise = _peak() - before
    return rise / g.nbytes


def _status(key: str) -> int:
    with open("/proc/self/status", encoding="ascii") as status:
        return next(int(line.split()[1]) * 1024 for line in status if line.startswith(key))


def _resident() -> int:
    return _status("VmRSS:")


def _peak() -> int:
    return _status("VmHWM:")


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--plot", help="PNG to draw")
    parser.add_argument("--memory", action="store_true", help="measure memory in this process and print it")
    options = parser.parse_args()
    if options.memory:
        print(json.dumps({"over_scene": peak_over_scene(), "peak": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss}))
        return
    found = subprocess.run([sys.executable, __file__, "--memory"], check=True, capture_output=True, text=True)
    memory = json.loads(found.stdout)["over_scene"]
    g = load_scene(realdata() / "scenes/showroom/lod-meta.json", lod=2)
    full = measure(lambda: draw(g, cameras(1920, 1080)), repeats=5, warmup=1)
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    one = measure(lambda: draw(g, cameras(1920, 1080)), repeats=3, warmup=0)
    numba.set_num_threads(threads)
    order = np.random.default_rng(0).permutation(len(g))
    by_count, by_pixels = [], []
    for n in (50_000, 100_000, 200_000, 400_000, 800_000, len(g)):
        some = g[np.sort(order[:n])]
        seconds = measure(lambda t=some: draw(t, cameras(1920, 1080)), repeats=3, warmup=1).median / len(EYES)
        by_count.append({"gaussians": n, "seconds": seconds})
        print(f"N {n:>9,}: {seconds:.3f} s", file=sys.stderr)
    for height in (240, 540, 1080, 1620, 2160):
        views = cameras(height * 16 // 9, height)
        seconds = measure(lambda v=views: draw(g, v), repeats=3, warmup=1).median / len(EYES)
        by_pixels.append({"megapixels": views.width * height / 1e6, "seconds": seconds})
        print(f"{views.width} x {height}: {seconds:.3f} s", file=sys.stderr)
    write_result(
        options.out,
        "What does a frame of a large scene cost?",
        [
            {"name": "showroom LOD 2 at 1920 x 1080: a frame", "target": 2.0, "reached": full.median / len(EYES),
             "unit": "s", "better": "lower"},
            {"name": "showroom LOD 2 at 1920 x 1080: memory a frame adds, over the scene", "target": 3.0,
             "reached": memory, "unit": "times the scene", "better": "lower"},
            {"name": f"showroom LOD 2 at 1920 x 1080: speed-up from 1 to {threads} threads", "target": None,
             "reached": one.median / full.median, "unit": "times", "better": "higher"},
        ],
        {"by_count": by_count, "by_pixels": by_pixels, "four_frames": full, "four_frames_one_thread": one},
    )  # fmt: skip
    if options.plot:
        plot(by_count, by_pixels, options.plot)


def plot(by_count: list[dict[str, float]], by_pixels: list[dict[str, float]], path: str) -> None:
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), constrained_layout=True)
    axes[0].loglog([r["gaussians"] for r in by_count], [r["seconds"] for r in by_count], "o-")
    axes[0].set(xlabel="Gaussians", ylabel="seconds a frame", title="Showroom LOD 2 subsets, 1920 x 1080")
    axes[1].loglog([r["megapixels"] for r in by_pixels], [r["seconds"] for r in by_pixels], "o-")
    axes[1].set(xlabel="megapixels", title="1.5M Gaussians")
    figure.savefig(path, dpi=140)


if __name__ == "__main__":
    main()
