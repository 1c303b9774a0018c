"""How long does it take to fit a million Gaussians, and how much memory?

Nika LOD 0 and as many turned copies of it as make a million Gaussians of SH degree 3, each with a direction set that
tracing gave (one Gaussian in eight is traced, its neighbors in the file borrow; turning a set would only rename its
faces). The variant is the paper's: two functions, hue fixed, up to 4 terms for each function of every Gaussian, no
thrift. The fit runs in a process of its own, whose peak memory is measured; so does the pursuit on atoms alone.

Given: nika LOD 0 in turned copies, direction sets, four terms for each of two functions.
Measured: seconds and peak memory of the fit.
Defaults chosen on: nika LOD 0, the scene that is measured too.
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

from gsvis.color import FitConfig, fit_srbf
from gsvis.io import load_scene
from gsvis.raycast import EllipsoidProxies, Tracer
from gsvis.raycast.directions import trace_directions
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace

COUNT, COPIES = 1_000_000, 4


def scene() -> tuple[Gaussians, np.ndarray]:
    """A million Gaussians and their direction sets."""
    g = load_scene(realdata() / "scenes/nika_sh3/lod-meta.json", lod=0)
    space = NavigableSpace.from_scene(g, up="-y")
    ids = np.arange(0, len(g), 8)
    sets = trace_directions(Tracer(EllipsoidProxies.from_scene(g)), space, ids=ids, rays_per_face=1)
    borrowed = sets[np.arange(len(g)) // 8]
    turns = [np.linalg.qr(np.random.default_rng(k).normal(size=(3, 3)))[0] for k in range(COPIES)]
    turned = Gaussians.concatenate([g.transform(turn * np.sign(np.linalg.det(turn))) for turn in turns])
    return turned[:COUNT], np.tile(borrowed, (COPIES, 1))[:COUNT]


def one(refine: bool) -> None:
    """Fit once, and say in JSON what it cost."""
    g, sets = scene()
    config = FitConfig(variant="hsl", max_terms=4, mean_terms=None, refine=refine)
    fit_srbf(g[:256], sets[:256], config)  # compile
    start, before = time.perf_counter(), time.process_time()
    fit = fit_srbf(g, sets, config)
    took, cpu = time.perf_counter() - start, time.process_time() - before
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    faces = np.unpackbits(sets, axis=1).sum(axis=1)
    print(
        json.dumps(
            {
                "seconds": took,
                "cpu_seconds": cpu,
                "peak_gb": peak / 1e9,
                "terms": fit.colors.num_terms,
                "mean_faces": float(faces.mean()),
                "error": float(fit.errors.mean()),
                "base_error": float(fit.base_errors.mean()),
            }
        )
    )


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--one", choices=("refined", "atoms"), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.one:
        one(arguments.one == "refined")
        return
    realdata()
    found = {}
    for how in ("refined", "atoms"):
        done = subprocess.run(
            [sys.executable, __file__, "--one", how], stdout=subprocess.PIPE, text=True, check=True, timeout=3600
        )
        found[how] = json.loads(done.stdout.splitlines()[-1])

    def figure(name: str, target: float | None, reached: float, unit: str) -> dict[str, object]:
        return {"name": name, "target": target, "reached": reached, "unit": unit, "better": "lower"}

    refined, atoms = found["refined"], found["atoms"]
    figures = [
        figure("fit of 1M Gaussians, masked, two functions, 4 terms, refined", 120.0, refined["seconds"], "s"),
        figure("peak memory of that fit, scene and result included", 8.0, refined["peak_gb"], "GB"),
        figure("the same on the atoms of orthogonal matching pursuit", 120.0, atoms["seconds"], "s"),
        figure("squared error left by refined terms over that of atoms", None, refined["error"] / atoms["error"], "x"),
    ]
    write_result(
        arguments.out, "How long does it take to fit a million Gaussians, and how much memory?", figures, found
    )


if __name__ == "__main__":
    main()
