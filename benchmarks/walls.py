"""Does a visitor who walks by the keys pass a wall?

The page's navigator and walker (TypeScript, run by node) walk at random over the grid that exports and servers send:
keys are held for 0.1 to 2.1 s, mostly ahead, often with a turn, at times running; frames take 1/60 s, and one in fifty
takes 0.2 s. Starts are the standing places nearest to random points. The voxels do not judge: the way of the eye is cut
into straight pieces of at most a third of its height, which overlap by half, and each is traced through the Gaussians.

Given: scenes (--scenes: a path, PATH@LOD or builtin:NAME), --walks walks of --seconds each.
Measured: pieces that lose more than 90% of the light (wall passes), and walks with one; the way, which says that
    nobody stands still; bytes of the grid, and seconds to find it.
Defaults chosen on: showroom LOD 3 and two_rooms: the thickness of a body and the finest voxel.
"""

from __future__ import annotations

import argparse
import subprocess
import tempfile
import time
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from _harness import add_arguments, write_result

from gsvis.io.sources import load_source
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.walk import WalkGrid, find_walk
from gsvis.raycast import EllipsoidProxies, Tracer
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.place import find_place

OPAQUE = 0.9
PIECE = 1.0 / 3.0  # eye heights
STRAIGHT = 0.995  # least length of a chord in that of its way
BATCH = 1 << 15
VIEWER = Path(__file__).resolve().parents[1] / "viewer"


def walk(grid: bytes, walks: int, seconds: int) -> np.ndarray:
    """Return the eyes (walks, frames, 3) of random walks over a grid."""
    with tempfile.TemporaryDirectory() as folder:
        script = Path(folder) / "walks.mjs"
        build = ["npx", "esbuild", "tools/random-walks.ts", "--bundle", "--platform=node", "--format=esm"]
        subprocess.run([*build, f"--outfile={script}", "--log-level=error"], cwd=VIEWER, check=True)
        (Path(folder) / "grid").write_bytes(zlib.decompress(grid))
        out = Path(folder) / "eyes"
        subprocess.run(
            ["node", script, Path(folder) / "grid", str(walks), str(seconds), out],
            check=True,
            stdout=subprocess.DEVNULL,
        )
        return np.fromfile(out, np.float64).reshape(walks, -1, 3)


def pieces_of(eyes: np.ndarray, longest: float) -> list[tuple[int, int]]:
    """Return first and last frame of straight pieces of a walk (F, 3), at most `longest`, that overlap by half."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(eyes, axis=0), axis=1))])
    found = []
    start = 0
    while start < len(eyes) - 1:
        stop = max(start + 1, int(np.searchsorted(along, along[start] + longest)) - 1)
        stop = min(stop, len(eyes) - 1)
        while stop > start + 1 and np.linalg.norm(eyes[stop] - eyes[start]) < STRAIGHT * (along[stop] - along[start]):
            stop = start + (stop - start) // 2
        if along[stop] > along[start]:
            found.append((start, stop))
        start = max(start + 1, (start + stop) // 2) if along[stop] > along[start] else stop
    return found


def lost_light(g: Gaussians, starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Return the share of light (P,) that is lost between two points each, through the Gaussians."""
    tracer = Tracer(EllipsoidProxies.from_scene(g))
    lost = np.zeros(len(starts))
    for first in range(0, len(starts), BATCH):
        some = slice(first, first + BATCH)
        way = ends[some] - starts[some]
        lengths = np.linalg.norm(way, axis=1)
        hits = tracer.contributions(starts[some], way / lengths[:, None])
        rays = hits.ray_ids
        near = hits.depths <= lengths[rays]
        logs = np.bincount(rays[near], np.log1p(-hits.alphas[near].astype(np.float64)), minlength=len(lengths))
        lost[some] = -np.expm1(logs)
    return lost


def judge(g: Gaussians, grid: WalkGrid, eyes: np.ndarray) -> dict[str, Any]:
    """Return the figures of walks (walks, frames, 3)."""
    ends = [(k, *piece) for k, way in enumerate(eyes) for piece in pieces_of(way, PIECE * grid.eye)]
    which, first, last = np.array(ends).T
    lost = lost_light(g, eyes[which, first], eyes[which, last])
    passes = lost > OPAQUE
    return {
        "walks": len(eyes),
        "pieces": len(lost),
        "passes": int(passes.sum()),
        "walks_with_a_pass": len(np.unique(which[passes])),
        "passes_of_half_the_light": int((lost > 0.5).sum()),
        "way_in_eye_heights": float(np.linalg.norm(np.diff(eyes, axis=1), axis=2).sum(axis=1).mean() / grid.eye),
        "where": np.round(eyes[which, first][passes][:20], 3).tolist(),
    }


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--scenes", nargs="+", default=["builtin:two_rooms", "builtin:flat"])
    parser.add_argument("--walks", type=int, default=500)
    parser.add_argument("--seconds", type=int, default=60)
    options = parser.parse_args()
    found: dict[str, Any] = {}
    figures = []
    for scene in options.scenes:
        path, _, lod = scene.partition("@")
        source = load_source(path, int(lod) if lod else None)
        place = find_place(source.thin())
        start = time.perf_counter()
        cells = CellGrid.over(place.required("name another scene"))
        grid = find_walk(source.union, cells, source.gaussians.facts.meters_per_unit or 0.0)
        assert grid is not None, f"{scene}: nobody can walk there"
        seconds = time.perf_counter() - start
        data = grid.to_bytes()
        row = judge(source.union, grid, walk(data, options.walks, options.seconds))
        row |= {
            "gaussians": len(source.union),
            "bytes": len(data),
            "seconds": seconds,
            "voxel": grid.size,
            "eye": grid.eye,
        }
        name = source.name
        found[name] = row
        figures += [
            {"name": f"wall passes, {name}", "target": 0, "reached": row["passes"], "unit": "", "better": "lower"},
            {"name": f"size, {name}", "target": 22.5, "reached": len(data) / 1000, "unit": "kB", "better": "lower"},
        ]
    write_result(options.out, "Does a visitor who walks by the keys pass a wall?", figures, found)


if __name__ == "__main__":
    main()
