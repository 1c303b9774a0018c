"""Does listing what each ray sees cost less than listing every proxy face it crosses?

Showroom LOD 3 from inside: `Tracer.contributions` over Open3D's `list_intersections` alone, on the same rays and the
same proxies, in one run, lot by lot in turn. Then all hits against trimesh's `intersects_id(multiple_hits=True)`, whose
`max_hits` is high enough to find them all, among the 100k Gaussians nearest to an eye, because it is slow. Open3D and
gsvis use all cores; trimesh uses one. The figure is the median of the eyes' ratios, with the best and the worst eye
beside it: eyes differ by half.

Given: showroom LOD 3, six eyes, the same rays and proxies for each tracer.
Measured: time over Open3D's list in the same run, eye by eye.
Defaults chosen on: showroom LOD 3, other eyes.
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
    parser.add_argument("--eyes", type=int, default=6)
    parser.add_argument("--size", type=int, default=64, help="pixels along a cubemap face")
    options = parser.parse_args()
    folder = realdata()
    g = load_scene(folder / "scenes/showroom/lod-meta.json", lod=3)
    rng = np.random.default_rng(0)
    eyes = NavigableSpace.from_scene(g).sample_viewpoints(options.eyes, rng)
    tracer = Tracer(EllipsoidProxies.from_scene(g))
    scene, _ = tracer.embree, tracer.hierarchy
    ours, theirs, rows = [], [], []
    for eye in eyes:
        rays = Cameras.cubemap(eye[None], options.size).rays()
        packed = np.concatenate(rays, axis=1).astype(np.float32)
        a = measure(lambda rays=rays: tracer.contributions(*rays), repeats=3, warmup=1).median
        b = measure(lambda packed=packed: scene._scene.list_intersections(packed), repeats=3, warmup=1).median
        hits = len(tracer.contributions(*rays).gaussian_ids) / len(packed)
        faces = int(scene._scene.count_intersections(packed).numpy().sum()) / len(packed)
        ours.append(a)
        theirs.append(b)
        rows.append({"eye": eye.tolist(), "rays": len(packed), "hits_per_ray": hits, "faces_per_ray": faces,
                     "contributions_s": a, "list_intersections_s": b, "ratio": a / b})  # fmt: skip
        print(f"eye {np.round(eye, 2)}: {len(packed) / a:,.0f} rays/s against {len(packed) / b:,.0f}", file=sys.stderr)
    ratios = [row["ratio"] for row in rows]

    near = np.argsort(np.linalg.norm(g.means - eyes[0], axis=1))[:100_000]
    small = g[np.sort(near)]
    small_tracer = Tracer(EllipsoidProxies.from_scene(small))
    mesh = small_tracer.proxies.to_trimesh()
    from trimesh.ray.ray_pyembree import RayMeshIntersector

    intersector = RayMeshIntersector(mesh)
    rays = Cameras.cubemap(eyes[:1], 32).rays()
    packed = np.concatenate(rays, axis=1).astype(np.float32)
    most = int(small_tracer.embree._scene.count_intersections(packed).numpy().max())
    a = measure(lambda: small_tracer.contributions(*rays), repeats=5, warmup=1).median
    b = measure(
        lambda: intersector.intersects_id(*rays, multiple_hits=True, max_hits=2 * most), repeats=1, warmup=1
    ).median
    rays_total = sum(row["rays"] for row in rows)
    write_result(
        options.out,
        "What does it cost to list what each ray sees?",
        [
            {"name": f"contributions over list_intersections, showroom LOD 3, median of {len(rows)} eyes inside",
             "target": 1.5, "reached": float(np.median(ratios)), "unit": "ratio", "better": "lower"},
            {"name": "the same, worst eye", "target": None, "reached": max(ratios), "unit": "ratio", "better": "lower"},
            {"name": "the same, best eye", "target": None, "reached": min(ratios), "unit": "ratio", "better": "lower"},
            {"name": "speed over trimesh all hits, the 100k Gaussians nearest to an eye", "target": 10.0,
             "reached": b / a, "unit": "ratio", "better": "higher"},
        ],
        {"eyes": rows, "aim": 0.5, "contributions_rays_per_s": rays_total / sum(ours),
         "list_intersections_rays_per_s": rays_total / sum(theirs), "trimesh_max_hits": 2 * most},
    )  # fmt: skip


if __name__ == "__main__":
    main()
