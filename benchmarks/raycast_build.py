"""How long and how much memory do proxies and their trees take for 1.5 million Gaussians?

Showroom LOD 2 in a fresh process each: (1) what contributions need, proxies and the ellipsoid hierarchy; (2) the Embree
tree of all 30 million proxy triangles, which first hits need, with each engine. Compilation is warmed up before.

Given: showroom LOD 2.
Measured: seconds and memory of proxies and trees.
Defaults chosen on: no scene.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time

import numpy as np
from _harness import add_arguments, realdata, write_result

from gsvis.io import load_scene
from gsvis.raycast import EllipsoidProxies, Tracer
from gsvis.scene.gaussians import Gaussians


def build(what: str, lod: int) -> dict[str, float]:
    g = load_scene(realdata() / "scenes/showroom/lod-meta.json", lod=lod)
    one = Gaussians([[0, 0, 0]], [[1, 0, 0, 0]], [[1, 1, 1]], [0.5], np.zeros((1, 1, 3)))
    engine = "embreex" if what == "embreex" else "open3d"
    warm = Tracer(EllipsoidProxies.from_scene(one), engine)
    _ = warm.hierarchy if what == "hierarchy" else warm.embree
    start = time.perf_counter()
    tracer = Tracer(EllipsoidProxies.from_scene(g), engine)
    _ = tracer.hierarchy if what == "hierarchy" else tracer.embree
    seconds = time.perf_counter() - start
    return {
        "gaussians": len(g),
        "seconds": seconds,
        "peak_bytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
    }


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument(
        "--what", choices=["hierarchy", "open3d", "embreex"], help="measure one of them in this process"
    )
    parser.add_argument("--lod", type=int, default=2)
    options = parser.parse_args()
    if options.what:
        print(json.dumps(build(options.what, options.lod)))
        return
    details = {}
    for what in ("hierarchy", "open3d", "embreex"):
        command = [sys.executable, __file__, "--what", what, "--lod", str(options.lod)]
        details[what] = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
        print(f"{what}: {details[what]['seconds']:.1f} s, {details[what]['peak_bytes'] / 1e9:.2f} GB", file=sys.stderr)
    figures = []
    for what, name in (("hierarchy", "proxies and hierarchy"), ("open3d", "proxies and Embree tree (Open3D)"),
                       ("embreex", "proxies and Embree tree (embreex)")):  # fmt: skip
        figures += [
            {"name": f"{name}, showroom LOD {options.lod}: time", "target": 60.0, "reached": details[what]["seconds"],
             "unit": "s", "better": "lower"},
            {"name": f"{name}, showroom LOD {options.lod}: peak memory", "target": 8.0,
             "reached": details[what]["peak_bytes"] / 1e9, "unit": "GB", "better": "lower"},
        ]  # fmt: skip
    write_result(options.out, "What do proxies and trees cost for 1.5 million Gaussians?", figures, details)


if __name__ == "__main__":
    main()
