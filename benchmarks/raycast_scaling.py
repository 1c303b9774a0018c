"""How does the cost of a ray grow with the number of Gaussians?

Random subsets of showroom LOD 2, 50k to 1.5M, opacity kept, seen from the same eyes inside. If cost is a logarithm
times the hits, then cost / (hits per ray * log2 N) does not rise while N grows thirtyfold.

Given: random subsets of showroom LOD 2.
Measured: cost a ray against the number of Gaussians.
Defaults chosen on: no scene.
"""

from __future__ import annotations

import argparse
import sys

import numpy as np
from _harness import add_arguments, measure, realdata, write_result

from gsvis.io import load_scene
from gsvis.raycast import EllipsoidProxies, Tracer
from gsvis.scene.cameras import Cameras
from gsvis.scene.navigable import NavigableSpace


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--plot", help="PNG to draw")
    options = parser.parse_args()
    g = load_scene(realdata() / "scenes/showroom/lod-meta.json", lod=2)
    rng = np.random.default_rng(0)
    eyes = NavigableSpace.from_scene(g).sample_viewpoints(4, rng)
    rays = Cameras.cubemap(eyes, 48).rays()
    order = rng.permutation(len(g))
    rows = []
    for n in (50_000, 100_000, 200_000, 400_000, 800_000, len(g)):
        tracer = Tracer(EllipsoidProxies.from_scene(g[np.sort(order[:n])]))
        _ = tracer.hierarchy
        timing = measure(lambda tracer=tracer: tracer.contributions(*rays), repeats=3, warmup=1)
        hits = len(tracer.contributions(*rays).gaussian_ids) / len(rays[0])
        micro = 1e6 * timing.median / len(rays[0])
        rows.append({"gaussians": n, "hits_per_ray": hits, "microseconds_per_ray": micro,
                     "nanoseconds_per_hit_and_level": 1e3 * micro / (hits * np.log2(n))})  # fmt: skip
        print(f"N {n:>9,}: {micro:6.1f} us a ray, {hits:5.1f} hits", file=sys.stderr)
    first, last = rows[0], rows[-1]
    growth = last["microseconds_per_ray"] / first["microseconds_per_ray"]
    hits = last["hits_per_ray"] / first["hits_per_ray"]
    logarithm = np.log2(last["gaussians"]) / np.log2(first["gaussians"])
    exponent = np.log(growth) / np.log(last["gaussians"] / first["gaussians"])
    write_result(
        options.out,
        "How does the cost of a ray grow with N?",
        [
            {"name": "growth of a ray's cost over growth of hits x log2 N, 50k to 1.5M", "target": 1.0,
             "reached": float(growth / (hits * logarithm)), "unit": "ratio", "better": "lower"},
            {"name": "exponent of a ray's cost in N over that range (1 would be linear)", "target": None,
             "reached": float(exponent), "unit": "exponent", "better": "lower"},
        ],
        {"rows": rows},
    )  # fmt: skip
    if options.plot:
        draw(rows, options.plot)


def draw(rows: list[dict[str, float]], path: str) -> None:
    import matplotlib.pyplot as plt

    n = [row["gaussians"] for row in rows]
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), constrained_layout=True)
    axes[0].loglog(n, [row["microseconds_per_ray"] for row in rows], "o-", label="cost per ray (µs)")
    axes[0].loglog(n, [row["hits_per_ray"] for row in rows], "s--", label="hits per ray")
    first = rows[0]["microseconds_per_ray"]
    axes[0].loglog(n, [first * k / n[0] for k in n], ":", color="gray", label="linear in N")
    axes[0].set(xlabel="Gaussians", title="Cost of a ray, showroom LOD 2 subsets")
    axes[0].legend()
    axes[1].semilogx(n, [row["nanoseconds_per_hit_and_level"] for row in rows], "o-")
    axes[1].set(
        xlabel="Gaussians", ylabel="ns / (hit · log2 N)", ylim=(0, None), title="Not rising means: logarithm times hits"
    )
    figure.savefig(path, dpi=140)


if __name__ == "__main__":
    main()
