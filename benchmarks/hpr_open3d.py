"""Is hidden point removal at least as fast as Open3D's on a million points, and what is it worth on Gaussians?

Three kinds of cloud from inside and a shell from outside, at two radii, ours and Open3D's in turn, the sets compared
index by index (and by position where points coincide). Then showroom LOD 3 and nika LOD 2 from eyes in their navigable
space: weighted recall and precision against traced weights (a ray to every Gaussian) of the operator on the centers,
with a radius calibrated on those very weights, and of its adaptation to Gaussians with its defaults; and the time of
tracing a cubemap beside theirs.

Given: clouds of a million points, eyes inside and outside, two radii.
Measured: time over Open3D's in the same run; on Gaussians recall and precision against rays.
Defaults chosen on: showroom LOD 3 and nika LOD 2, the scenes that are measured too.
"""

from __future__ import annotations

import argparse
import sys
from typing import Any

import numpy as np
from _harness import add_arguments, measure, measure_in_turn, realdata, write_result
from numba import get_num_threads
from paper.radius import calibrate_radius

from gsvis.hpr import hidden_point_removal, visible_gaussians
from gsvis.io import load_scene
from gsvis.raycast import TAU, EllipsoidProxies, Tracer, visible_from
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace

get_num_threads()  # starts numba's threads before open3d brings a TBB that numba finds too old, and says so
import open3d as o3d  # noqa: E402

Cloud = tuple[np.ndarray, np.ndarray]


def clouds(count: int, g: Gaussians, eye: np.ndarray) -> dict[str, Cloud]:
    """A volume, a room's walls, a real scene with more points drawn inside its Gaussians, a shell seen from outside."""
    rng = np.random.default_rng(0)
    volume = rng.uniform(-1.0, 1.0, (count, 3))
    walls = rng.uniform(-1.0, 1.0, (count, 3))
    axis = rng.integers(0, 3, count)
    walls[np.arange(count), axis] = np.sign(walls[np.arange(count), axis])
    again = rng.integers(0, len(g), max(count - len(g), 0))
    spread = np.einsum("nij,nj->ni", g[again].rotations(), g.scales[again] * rng.normal(size=(len(again), 3)))
    scene = np.concatenate([g.means[:count].astype(np.float64), g.means[again] + spread])
    inside = np.array([0.1, 0.2, 0.3])
    shell = rng.normal(size=(count, 3))
    shell /= np.linalg.norm(shell, axis=1, keepdims=True)
    outside = np.array([3.0, 0.2, 0.3])
    return {
        "volume": (volume, inside),
        "room": (walls, inside),
        "showroom": (scene, eye),
        "shell from outside": (shell, outside),
    }


def against_open3d(points: np.ndarray, eye: np.ndarray, times: float, repeats: int) -> dict[str, Any]:
    """Both on one cloud, at `times` the distance of the farthest point."""
    radius = times * float(np.linalg.norm(points - eye, axis=1).max()) * (1 + 1e-12)
    theirs = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    sets: dict[str, np.ndarray] = {}

    def ours() -> None:
        sets["ours"] = hidden_point_removal(points, eye, radius)

    def open3d() -> None:
        sets["open3d"] = np.sort(np.asarray(theirs.hidden_point_removal(eye, radius)[1], np.int64))

    taken = measure_in_turn({"ours": ours, "open3d": open3d}, repeats, warmup=0)
    if not np.array_equal(sets["ours"], sets["open3d"]):  # then they may differ in coincident points only
        a, b = (np.unique(points[ids], axis=0) for ids in sets.values())
        if len(sets["ours"]) != len(sets["open3d"]) or not np.array_equal(a, b):
            raise SystemExit(f"the sets differ: {len(sets['ours'])} and {len(sets['open3d'])} points")
    ratio = taken["ours"].median / taken["open3d"].median
    return {"points": len(points), "radius_over_farthest": times, "visible": len(sets["ours"]), "ratio": ratio, **taken}


def worth(ids: np.ndarray, weights: np.ndarray) -> dict[str, Any]:
    held = weights[ids]
    return {
        "count": len(ids),
        "weighted_recall": float(held.sum() / weights.sum()),
        "precision": float(np.mean(held >= TAU)) if len(ids) else 0.0,
    }


def on_gaussians(g: Gaussians, eyes: np.ndarray) -> dict[str, Any]:
    """Operator on centers and adaptation, each beside traced weights, averaged over the eyes."""
    tracer = Tracer(EllipsoidProxies.from_scene(g))
    visible_from(tracer, eyes[:1], size=16)
    rows = []
    for eye in eyes:
        traced = measure(lambda e=eye: visible_from(tracer, e[None], size=128), 1, 0).median
        weights = visible_from(tracer, eye[None], sampling="gaussians")[0]
        found = calibrate_radius(g.means, eye, weights, steps=3)
        wanted = calibrate_radius(g.means, eye, weights, recall=0.99, steps=3)
        adapted = visible_gaussians(g, eye)
        rows.append(
            {
                "eye": eye.tolist(),
                "truly_visible": int(np.count_nonzero(weights >= TAU)),
                "centers, best F1": worth(hidden_point_removal(g.means, eye, found.radius), weights),
                "centers, recall 0.99": worth(hidden_point_removal(g.means, eye, wanted.radius), weights),
                "centers, radius of best F1 over the farthest": found.radius / found.tried[0].radius,
                "adapted": worth(adapted, weights),
                "trace_s": traced,
                "centers_s": measure(lambda e=eye, r=found.radius: hidden_point_removal(g.means, e, r), 3, 0).median,
                "adapted_s": measure(lambda e=eye: visible_gaussians(g, e), 3, 0).median,
            }
        )
        print(rows[-1], file=sys.stderr)

    def mean(way: str, figure: str) -> float:
        return float(np.mean([row[way][figure] for row in rows]))

    ways = ("centers, best F1", "centers, recall 0.99", "adapted")
    means = {way: {name: mean(way, name) for name in ("weighted_recall", "precision", "count")} for way in ways}
    seconds = {name: float(np.median([row[name] for row in rows])) for name in ("trace_s", "centers_s", "adapted_s")}
    return {"gaussians": len(g), "means": means, "seconds": seconds, "eyes": rows}


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--points", type=int, default=1_000_000)
    parser.add_argument("--repeats", type=int, default=2)
    parser.add_argument("--eyes", type=int, default=3)
    options = parser.parse_args()
    folder = realdata()
    scenes, eyes = {}, {}
    for name, lod in (("showroom", 3), ("nika_sh3", 2)):
        scenes[name] = load_scene(folder / "scenes" / name / "lod-meta.json", lod=lod)
        space = NavigableSpace.from_scene(scenes[name])
        eyes[name] = space.sample_viewpoints(options.eyes, np.random.default_rng(7))
    warm = scenes["nika_sh3"].means
    hidden_point_removal(warm, eyes["nika_sh3"][0], 1e4)
    rows = {}
    for name, (points, eye) in clouds(options.points, scenes["showroom"], eyes["showroom"][0]).items():
        for times in (1.0, 30.0):
            rows[f"{name} x{times:g}"] = row = against_open3d(points, eye, times, options.repeats)
            text = f"{row['ours'].median:.2f} s against {row['open3d'].median:.2f} s"
            print(f"{name} x{times:g}: {row['visible']:,} visible, {text}", file=sys.stderr)
    inside = [row["ratio"] for name, row in rows.items() if "outside" not in name]
    outside = [row["ratio"] for name, row in rows.items() if "outside" in name]
    found = {name: on_gaussians(scenes[name], eyes[name]) for name in scenes}
    figures = [
        {"name": "time over Open3D's, eye inside, geometric mean of three clouds at two radii", "target": 1.0,
         "reached": float(np.exp(np.mean(np.log(inside)))), "unit": "ratio", "better": "lower"},
        {"name": "time over Open3D's, eye inside, worst of the six", "target": 1.0, "reached": max(inside),
         "unit": "ratio", "better": "lower"},
        {"name": "time over Open3D's, a shell from outside, worse of two radii", "target": 1.0, "reached": max(outside),
         "unit": "ratio", "better": "lower"},
    ]  # fmt: skip
    for name, result in found.items():
        for way, means in result["means"].items():
            for figure in ("weighted_recall", "precision"):
                figures.append({"name": f"{name}, {way}: {figure.replace('_', ' ')}", "target": None,
                                "reached": means[figure], "unit": "share", "better": "higher"})  # fmt: skip
        share = result["seconds"]["adapted_s"] / result["seconds"]["trace_s"]
        figures.append({"name": f"{name}, adapted: time over tracing a cubemap of 128 x 128 rays a face",
                        "target": None, "reached": share, "unit": "ratio", "better": "lower"})  # fmt: skip
    write_result(
        options.out,
        "Is hidden point removal as fast as Open3D's on a million points, and what is it worth on Gaussians?",
        figures,
        {"clouds": rows, "equal_sets": True, "gaussians": found},
    )


if __name__ == "__main__":
    main()
