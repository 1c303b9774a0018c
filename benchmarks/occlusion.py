"""What tells a look cheapest which clusters are hidden: its own bits of light, or Embree's first hits before it?

A look opens clusters nearest first and skips one that has no pixel with light left under it; these bits are its coarse
pyramid. An occlusion pre-pass would decide before: rays through the pixels of coarse faces find the first opaque core,
a mesh where alpha is at least some value, and a cluster is left out if it lies behind the farthest hit under its
rectangle on each face. The list of clusters is cut by the pre-pass, the look does the rest as ever. The oracle's list
has only clusters of which the look finds a member: no pre-pass can do better without losing something.

Given: a scene, eyes of the grid that `gsvis pvs` lays out, one level; faces of 512 pixels for looks.
Measured: processor time of one thread of the look with each list and of the rays through embreex, one after the other
    from each eye; clusters left; the share of the weights found that the cut look loses, and its largest weight.
    Testing the clusters against the hits is not counted, nor is building the meshes, once a scene.
Defaults chosen on: nothing; faces of rays of a quarter of the look's size.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from _cells import add_cell_arguments, draw_cells
from _harness import add_arguments, write_result
from numba import set_num_threads
from numpy.typing import NDArray

from gsvis.hpr import Splats
from gsvis.hpr._kernels import clusters
from gsvis.hpr._kernels import splat as kernels
from gsvis.pvs.config import PvsConfig
from gsvis.raycast import TAU, EllipsoidProxies
from gsvis.raycast.engines import EmbreexEngine
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.solid import buried

QUESTION = "What tells a look cheapest which clusters are hidden: bits of light, or Embree's first hits?"
SIZE = PvsConfig.size
SPENT = 0.5 * TAU
CORES = (0.5, 0.9, 0.99)

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Mask = NDArray[np.bool_]


class Looks:
    """Looks from one eye, with all clusters or some."""

    def __init__(self, splats: Splats, eye: F64) -> None:
        count = len(splats.bounds)
        self.splats, self.at = splats, eye.astype(np.float32)
        self.nearest, self.boxes = np.empty(count, np.float32), np.empty((6, count, 4), np.int16)
        clusters.place_clusters(splats.bounds, self.at, SIZE, self.nearest, self.boxes)
        self.order = np.argsort(self.nearest, kind="stable")

    def see(self, kept: Mask) -> tuple[I64, F64, float]:
        """Return ids (K,) and weights (K,) by clusters of `kept` (B,) alone, and the milliseconds of splatting."""
        splats, count = self.splats, len(self.nearest)
        lists, counts = np.empty((6, count), np.int64), np.empty(6, np.int64)
        clusters.list_clusters(self.order[kept[self.order]], self.boxes, lists, counts)
        best, shape = np.zeros(2 * splats.total, np.float32), (6, SIZE, SIZE)
        light, depths = np.empty(shape, np.float32), np.empty(shape, np.float32)
        scene = splats.near, splats.covars, splats.columns, splats.ids
        began = time.thread_time()
        side = -(-SIZE // kernels.SQUARE)
        kernels.splat_squares(
            scene,
            (np.zeros(count, np.uint64), np.float32(0.0)),
            self.at,
            SIZE,
            np.float32(SPENT),
            self.nearest,
            self.boxes,
            lists,
            counts,
            np.ones((6, side, side), bool),
            best,
            1,
            light,
            depths,
        )
        taken = 1e3 * (time.thread_time() - began)
        ids, (weights, _) = kernels.take_found(best)
        return ids, weights.astype(np.float64), taken

    def before(self, hits: F64) -> Mask:
        """Return the clusters (B,) that are not behind the first hits (6, S, S) under their rectangles on all faces."""
        kept = np.zeros(len(self.nearest), bool)
        distances, scale = np.sqrt(self.nearest.astype(np.float64)), hits.shape[1] / SIZE
        for face in range(6):
            for c in np.flatnonzero((self.boxes[face, :, 0] <= self.boxes[face, :, 1]) & ~kept).tolist():
                x0, x1, y0, y1 = (int(v * scale) for v in self.boxes[face, c])
                under = hits[face, max(y0 - 1, 0) : y1 + 2, max(x0 - 1, 0) : x1 + 2]
                kept[c] = under.size > 0 and bool((under > distances[c]).any())
        return kept


def cast(engine: EmbreexEngine, eye: F64, size: int) -> tuple[F64, float]:
    """Return the distances (6, S, S) of the first hits around an eye, faces as looks have them, and milliseconds."""
    steps = (np.arange(size) + 0.5) * 2.0 / size - 1.0
    v, u = np.meshgrid(steps, steps, indexing="ij")
    rays = np.empty((6, size, size, 3))
    for face in range(6):
        axis, sign = face >> 1, 1.0 - 2.0 * (face & 1)
        across, down = (1 if axis == 0 else 0), (1 if axis == 2 else 2)
        rays[face, ..., axis], rays[face, ..., across], rays[face, ..., down] = sign, u, v
    rays_d = rays.reshape(-1, 3)
    rays_d /= np.linalg.norm(rays_d, axis=1, keepdims=True)
    rays_o = np.broadcast_to(eye, rays_d.shape)
    began = time.thread_time()
    distances, _ = engine.first_face(rays_o, rays_d)
    return distances.reshape(6, size, size), 1e3 * (time.thread_time() - began)


@dataclass
class Way:
    """What one list of clusters gave, a value for each eye."""

    look: list[float] = field(default_factory=list)
    rays: list[float] = field(default_factory=list)
    left: list[float] = field(default_factory=list)
    lost: list[float] = field(default_factory=list)
    heaviest: list[float] = field(default_factory=list)

    def add(self, looks: Looks, kept: Mask, found: tuple[I64, F64], rays: float) -> None:
        ids, weights, taken = looks.see(kept)
        whole, own = (np.zeros(looks.splats.total) for _ in range(2))
        whole[found[0]], own[ids] = found[1], weights
        gone = np.where((whole >= TAU) & (own < TAU), whole, 0.0)
        self.look.append(taken)
        self.rays.append(rays)
        self.left.append(float(kept.mean()))
        self.lost.append(float(gone.sum() / whole[whole >= TAU].sum()))
        self.heaviest.append(float(gone.max()))

    def as_dict(self) -> dict[str, float]:
        return {name: float(np.median(values)) for name, values in vars(self).items()}


def measure(g: Gaussians, eyes: F64, size: int) -> dict[str, Way]:
    splats = Splats.from_gaussians(g)
    engines = {}
    for alpha in CORES:
        proxies = EllipsoidProxies.from_scene(g, min_alpha=alpha)
        engines[f"cores of alpha {alpha:g}"] = EmbreexEngine(*proxies.meshes(), bodies=len(proxies))
    ways = {name: Way() for name in ("bits of light", "oracle", *engines)}
    everything = np.ones(len(splats.bounds), bool)
    Looks(splats, eyes[0]).see(everything)  # compile
    for eye in eyes:
        looks = Looks(splats, eye)
        ids, weights, _ = looks.see(everything)
        ways["bits of light"].add(looks, everything, (ids, weights), 0.0)
        rows = np.flatnonzero(np.isin(splats.ids, ids))
        some = np.zeros(len(everything), bool)
        some[rows // kernels.CLUSTER] = True
        ways["oracle"].add(looks, some, (ids, weights), 0.0)
        for name, engine in engines.items():
            hits, rays = cast(engine, eye, size)
            ways[name].add(looks, looks.before(hits), (ids, weights), rays)
    return ways


def main() -> None:
    parser = add_cell_arguments(add_arguments(argparse.ArgumentParser(description=__doc__)))
    parser.add_argument("--rays", type=int, default=SIZE // 4, help="rays along a side of the faces of the pre-pass")
    options = parser.parse_args()
    set_num_threads(1)
    drawn = draw_cells(options)
    eyes = np.concatenate([drawn.viewpoints.spread(cell, 1) for cell in drawn.cells])
    eyes = eyes[~buried(drawn.scene, eyes)]
    ways = {name: way.as_dict() for name, way in measure(drawn.scene, eyes, options.rays).items()}
    now = ways["bits of light"]["look"]
    figures: list[dict[str, Any]] = []
    for name, way in ways.items():
        rows = [("look and rays over the look now", (way["look"] + way["rays"]) / now, "ratio")]
        rows += [("rays alone over the look now", way["rays"] / now, "ratio")] if way["rays"] else []
        rows += [("clusters left", way["left"], "share"), ("weight lost", way["lost"], "share")]
        rows += [("largest weight lost", way["heaviest"], "weight")]
        for label, reached, unit in rows if name != "bits of light" else rows[2:2]:
            figures.append(
                {"name": f"{name}: {label}", "target": None, "reached": reached, "unit": unit, "better": "lower"}
            )
    write_result(options.out, QUESTION, figures, {"gaussians": len(drawn.scene), "eyes": len(eyes), "ways": ways})


if __name__ == "__main__":
    main()
