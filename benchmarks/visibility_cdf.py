"""What share of a scene does a view need, and from how many of the 80 directions can its Gaussians be seen?

SRBF-Gaussian, section 3.1, on scenes of ours, beside the paper's figures. Three parts for each scene:

- views: the visible share of cameras sampled in navigable space, and how it grows with the resolution of the views;
- gathered (the paper's way): for a random sample of Gaussians, the directions in which any of V viewpoints, uniform in
  navigable space, sees them, after each doubling of V;
- traced outward from the same sample, with 1, 4, 16 and 64 rays over each face; agreement with the gathered sets.

- the share of directions by solid angle, from the same rays. Faces counted as soon as anything in them is seen grow
  with every refinement; this measure converges.

A way has settled when its last step (twice the viewpoints, four times the rays) moves no point of the CDF by 2%. The
first comes down to the second from above, slowly: the rare directions of a Gaussian are those that few places share.
Gathering casts one ray from each viewpoint to the center of each Gaussian of the sample: it has no resolution, and a
fixed sample is what lets many viewpoints be tried.

Given: three scenes, 32 views of 256 x 192 in navigable space, 16,384 viewpoints, 64 rays a face.
Measured: visible share a view at each resolution; faces over 80, which grow with the number of views; share by solid
    angle, which settles.
Defaults chosen on: no scene.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from _harness import add_arguments, realdata, write_result

from gsvis.io.sources import is_builtin, load_source
from gsvis.raycast import (
    FACE_LIMITS,
    PAPER,
    TAU,
    Agreement,
    AnalysisConfig,
    DirectionCdf,
    EllipsoidProxies,
    Tracer,
    analyze,
    directions,
    visible_from,
    visible_in,
)
from gsvis.raycast.analysis import SETTLED
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.place import find_place
from gsvis.scene.source import Source

SCENES = ("showroom:3", "nika_sh3:0", "flowers_sh2:1")
LOT = 64  # viewpoints at a time


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument(
        "scenes", nargs="*", default=SCENES, metavar="NAME:LOD", help="folders of scenes/, paths, builtin:NAME"
    )
    parser.add_argument("--views", type=int, default=64)
    parser.add_argument("--sample", type=int, default=1000, help="Gaussians whose directions are gathered and traced")
    parser.add_argument("--viewpoints", type=int, default=16384, help="rounded up to a power of two")
    options = parser.parse_args()
    results = []
    for name in options.scenes:
        results.append(measured(name, options))
        print(row(results[-1]), file=sys.stderr)
    print(table(results))
    changes = [
        {
            "name": f"change of the {way.replace('_', ' ')} CDF at the last step, {result['scene']}",
            "target": SETTLED,
            "reached": result[way][-1]["change"],
            "unit": "largest difference of two CDFs",
            "better": "lower",
        }
        for result in results
        for way in ("gathered", "traced", "solid_angle")
    ]
    question = "What does a view need, and from how many directions can Gaussians be seen?"
    write_result(options.out, question, changes, {"paper": dict(PAPER), "scenes": results})


def measured(name: str, options: argparse.Namespace) -> dict[str, Any]:
    label, lod, source = opened(name)
    g = source.gaussians
    stated = find_place(source).space if is_builtin(name) else None
    navigable = NavigableSpace.from_scene(g) if stated is None else stated
    tracer = Tracer(EllipsoidProxies.from_scene(g))
    rng = np.random.default_rng(0)
    sample = np.sort(rng.choice(len(g), min(options.sample, len(g)), replace=False))
    steps, gathered = gather(tracer, navigable.sample_viewpoints(power_of_two(options.viewpoints), rng), sample)
    traced: list[dict[str, Any]] = []
    before = None
    for rays in (1, 4, 16, 64):
        sets = directions.trace_directions(tracer, navigable, ids=sample, rays_per_face=rays)
        cdf, agreement = DirectionCdf.from_sets(sets), asdict(Agreement.from_sets(gathered, sets))
        traced.append({"rays_per_face": rays, **shares(cdf), "change": moved(before, cdf), "agreement": agreement})
        print(f"{label}: traced {traced[-1]}", file=sys.stderr)
        before = cdf
    measure = {
        rays: directions.solid_angle_fractions(tracer, navigable, ids=sample, rays_per_face=rays)
        for rays in (4, 16, 64)
    }
    solid = [
        {"rays_per_face": rays, **angle_shares(fractions), "change": farthest(measure.get(rays // 4), fractions)}
        for rays, fractions in measure.items()
    ]
    print(f"{label}: solid angle {solid}", file=sys.stderr)
    return {
        "scene": label + (f" LOD {lod}" if lod else ""),
        "gaussians": len(g),
        "navigable": navigable.rule,
        "views": views(tracer, navigable, options.views),
        "sample": len(sample),
        "gathered": steps,
        "gathered_has_settled": steps[-1]["change"] < SETTLED,
        "traced": traced,
        "traced_has_settled": traced[-1]["change"] < SETTLED,
        "solid_angle": solid,
    }


def opened(name: str) -> tuple[str, str, Source]:
    """Return the label, the level of detail as text, and the scene of NAME:LOD, of a path, or of builtin:NAME."""
    if is_builtin(name):
        return name, "", load_source(name, None)
    label, _, lod = name.partition(":")
    path = Path(label) if Path(label).exists() else realdata() / "scenes" / label / "lod-meta.json"
    return label, lod, load_source(str(path), int(lod) if lod else None)


def views(tracer: Tracer, navigable: NavigableSpace, count: int) -> dict[str, Any]:
    """Visible shares at 256 x 192 and 60 degrees, and of every eighth of these views at other resolutions."""
    g = tracer.proxies.gaussians
    cameras = navigable.sample_cameras(count, np.random.default_rng(0), width=256, height=192, fov=60.0)
    start = time.perf_counter()
    found = analyze(g, cameras, AnalysisConfig(traced_sample=0), tracer=tracer)
    seconds = time.perf_counter() - start
    some, by_width = cameras[::8], []
    for width, height in ((64, 48), (128, 96), (256, 192), (512, 384), (1024, 768)):
        seen = [visible_in(tracer, some[i].resize(width, height)) >= TAU for i in range(len(some))]
        by_width.append({"width": width, "height": height, "mean": float(np.mean(seen))})
    fractions = found.visible_fractions
    return {
        "count": count,
        "rays": "256 x 192, 60 degrees",
        "mean": float(fractions.mean()),
        "min": float(fractions.min()),
        "max": float(fractions.max()),
        "seconds": seconds,
        "resolution": {"views": len(some), "means": by_width},
    }


def gather(tracer: Tracer, points: np.ndarray, sample: np.ndarray) -> tuple[list[dict[str, Any]], np.ndarray]:
    """Direction sets (M, 10) of the sample from all points, and the figures after each doubling of their number."""
    part = tracer.proxies.gaussians[sample]
    sets = np.zeros((len(sample), 10), np.uint8)
    steps: list[dict[str, Any]] = []
    before, start = None, time.perf_counter()
    for first in range(0, len(points), LOT):
        eyes = points[first : first + LOT]
        weights = visible_from(tracer, eyes, sampling="gaussians", ids=sample)
        sets |= directions.seen_directions(part, weights, eyes)
        done = first + len(eyes)
        if done & (done - 1) == 0:  # a power of two
            cdf = DirectionCdf.from_sets(sets)
            seconds = time.perf_counter() - start
            steps.append({"viewpoints": done, "seconds": seconds, **shares(cdf), "change": moved(before, cdf)})
            print(f"gathered {steps[-1]}", file=sys.stderr)
            before = cdf
    return steps, sets


def shares(cdf: DirectionCdf) -> dict[str, float]:
    below = {f"below_{k}": cdf.below(k) for k in FACE_LIMITS}
    return {**below, **{f"below_{k}_of_seen": cdf.below(k, of_seen=True) for k in FACE_LIMITS}, "faces": cdf.mean_faces}


def moved(before: DirectionCdf | None, after: DirectionCdf) -> float | None:
    """Largest difference of two CDFs."""
    return None if before is None else float(np.abs(after.values - before.values).max())


def angle_shares(fractions: np.ndarray) -> dict[str, float]:
    """Shares of Gaussians seen from less than the paper's two shares of all directions, by solid angle."""
    return {f"below_{k}": float(np.mean(fractions < k / directions.NUM_FACES)) for k in FACE_LIMITS}


def farthest(before: np.ndarray | None, after: np.ndarray) -> float | None:
    """Largest difference of the distributions of two samples, at the borders of 80 bins."""
    if before is None:
        return None
    borders = np.linspace(0.0, 1.0, 81)
    curves = [np.searchsorted(np.sort(values), borders, side="right") / len(values) for values in (before, after)]
    return float(np.abs(curves[0] - curves[1]).max())


def power_of_two(count: int) -> int:
    return max(2 * LOT, 1 << (count - 1).bit_length())


def table(results: list[dict[str, Any]]) -> str:
    head = (
        "| scene | visible in a view: mean (min to max) | gathered < 41.25% | < 60% | settled"
        " | traced < 41.25% | < 60% | settled | mean Jaccard | solid angle < 41.25% | < 60% | settled |\n"
        "|---|---|---|---|---|---|---|---|---|---|---|---|"
    )
    paper = (
        f"| paper (Tanks & Temples) | {PAPER['mean_visible']:.2%} (one view {PAPER['one_view_visible']:.2%})"
        f" | {PAPER['below_33_faces']:.1%} | {PAPER['below_48_faces']:.1%} | | | | | | | | |"
    )
    return "\n".join([head, paper, *map(row, results)])


def row(result: dict[str, Any]) -> str:
    seen, gathered, traced = result["views"], result["gathered"][-1], result["traced"][-1]
    settled = [
        f"{'yes' if result[f'{way}_has_settled'] else 'no'} ({last['change']:.1%})"
        for way, last in (("gathered", gathered), ("traced", traced))
    ]
    solid = result["solid_angle"][-1]
    steady = "yes" if solid["change"] < SETTLED else "no"
    return (
        f"| {result['scene']} | {seen['mean']:.2%} ({seen['min']:.2%} to {seen['max']:.2%})"
        f" | {gathered['below_33']:.1%} | {gathered['below_48']:.1%} | {settled[0]}"
        f" | {traced['below_33']:.1%} | {traced['below_48']:.1%} | {settled[1]}"
        f" | {traced['agreement']['mean_jaccard']:.3f}"
        f" | {solid['below_33']:.1%} | {solid['below_48']:.1%} | {steady} ({solid['change']:.1%}) |"
    )


if __name__ == "__main__":
    main()
