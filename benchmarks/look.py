"""How long does one look take, and how well does it use two threads?

Eyes in showroom LOD 3, one in each of some cells of the grid of 255. A look is `look_around` at 320 pixels a face. One
and two threads take turns from the same eyes; figures are medians over eyes of ratios taken one after the other, so
that what else the machine does disturbs both sides. Waiting threads sleep (`OMP_WAIT_POLICY=passive`): where they spin,
they take the processor from the others. Parts of a look are processor time of one thread.

Given: showroom LOD 3, eyes of the grid that `gsvis pvs` lays out.
Measured: one thread over two, parts of a look.
Defaults chosen on: showroom LOD 3, the scene that is measured too.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # before numba starts its threads

import numpy as np
from _harness import add_arguments, realdata, write_result
from numba import set_num_threads
from numpy.typing import NDArray

from gsvis.hpr import Splats, hybrid, look_around
from gsvis.hpr._kernels import clusters
from gsvis.hpr._kernels import splat as kernels
from gsvis.io import load_scene
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.viewpoints import CellViewpoints
from gsvis.render import rasterize
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.solid import buried

SIZE, SPENT = 320, 1.0 / 255.0

F64 = NDArray[np.float64]


def choose_eyes(g: Gaussians, count: int) -> F64:
    """Free eyes (E, 3), one in each of the first `count` of a random choice of cells."""
    space = NavigableSpace.from_scene(g)
    grid = CellGrid.over(space, max_cells=256)
    places = CellViewpoints(grid, space)
    cells = np.random.default_rng(0).permutation(len(grid))[: 2 * count]
    eyes = np.concatenate([places.spread(int(cell), 1) for cell in cells])
    return eyes[~buried(g, eyes)][:count]


def clock(fn: Callable[[], object]) -> float:
    began = time.perf_counter()
    fn()
    return time.perf_counter() - began


def in_turn(eyes: F64, ways: dict[str, Callable[[F64], object]], repeats: int) -> dict[str, F64]:
    """Seconds (repeats * E,) of each way with one and with two threads, turn by turn from each eye."""
    for way in ways.values():
        way(eyes[0])
    taken: dict[str, list[float]] = {f"{name}, {threads}": [] for name in ways for threads in (1, 2)}
    for _ in range(repeats):
        for eye in eyes:
            for name, way in ways.items():
                for threads in (1, 2):
                    set_num_threads(threads)
                    taken[f"{name}, {threads}"].append(clock(lambda w=way, e=eye: w(e)))
    set_num_threads(2)
    return {name: np.asarray(seconds) for name, seconds in taken.items()}


def share_out(splats: Splats, eye: F64, threads: tuple[int, ...]) -> dict[int, float]:
    """How many times faster squares are done by some threads that each take the next as they come free.

    From the processor time of each square with one thread, so that the load of the machine does not count.
    """
    set_num_threads(1)
    at, count, shape = eye.astype(np.float32), len(splats.bounds), (6, SIZE, SIZE)
    nearest, boxes = np.empty(count, np.float32), np.empty((6, count, 4), np.int16)
    clusters.place_clusters(splats.bounds, at, SIZE, nearest, boxes)
    lists, counts = np.empty((6, count), np.int64), np.empty(6, np.int64)
    listed = np.empty_like(boxes)
    clusters.list_clusters(np.argsort(nearest, kind="stable"), boxes, lists, listed, counts)
    light, depths = np.empty(shape, np.float32), np.empty(shape, np.float32)
    scene, best = (splats.near, splats.covars, splats.columns, splats.ids), np.zeros(2 * splats.total, np.float32)
    wanted = every_square()
    everyone = np.zeros(count, np.uint64), np.float32(0.0)

    def seconds_from(first: int) -> float:
        taken = np.full(1, first, np.int64)
        began = time.thread_time()
        kernels.splat_squares.kernel(
            taken,
            scene,
            everyone,
            at,
            SIZE,
            np.float32(SPENT),
            nearest,
            listed,
            lists,
            counts,
            wanted,
            best,
            1,
            light,
            depths,
        )
        return time.thread_time() - began

    rest = [min(seconds_from(first) for _ in range(2)) for first in range(wanted.size + 1)]
    costs = -np.diff(np.minimum.accumulate(rest))
    set_num_threads(2)
    faster = {}
    for many in threads:
        busy = np.zeros(many)
        for cost in costs:
            busy[busy.argmin()] += cost
        faster[many] = float(costs.sum() / busy.max())
    return faster


def every_square() -> NDArray[np.bool_]:
    """Return the mask of all squares of the faces."""
    side = -(-SIZE // kernels.SQUARE)
    return np.ones((6, side, side), bool)


def measure_parts(splats: Splats, eyes: F64) -> dict[str, float]:
    """Median milliseconds of processor time of the parts of a look, with one thread."""
    taken: dict[str, list[float]] = {}

    def part(name: str, fn: Callable[[], Any]) -> Any:
        began = time.thread_time()
        made = fn()
        taken.setdefault(name, []).append(1e3 * (time.thread_time() - began))
        return made

    set_num_threads(1)
    count, shape = len(splats.bounds), (6, SIZE, SIZE)
    for eye in eyes:
        at = eye.astype(np.float32)
        nearest, boxes = np.empty(count, np.float32), np.empty((6, count, 4), np.int16)
        lists, counts = np.empty((6, count), np.int64), np.empty(6, np.int64)
        listed = np.empty_like(boxes)
        part("place clusters", lambda: clusters.place_clusters(splats.bounds, at, SIZE, nearest, boxes))  # noqa: B023
        order = part("sort clusters", lambda: np.argsort(nearest, kind="stable"))  # noqa: B023
        part("list clusters", lambda: clusters.list_clusters(order, boxes, lists, listed, counts))  # noqa: B023
        scene = splats.near, splats.covars, splats.columns, splats.ids
        best = part("room", lambda: np.zeros(2 * splats.total, np.float32))
        light, depths = np.empty(shape, np.float32), np.empty(shape, np.float32)
        eye_and_spent = at, SIZE, np.float32(SPENT)
        lists_of = nearest, listed, lists, counts, every_square()
        everyone = np.zeros(count, np.uint64), np.float32(0.0)
        buffers = best, 1, light, depths
        part("splat", lambda: kernels.splat_squares(scene, everyone, *eye_and_spent, *lists_of, *buffers))  # noqa: B023
        part("collect", lambda: kernels.take_found(best))  # noqa: B023
    set_num_threads(2)
    return {name: float(np.median(values)) for name, values in taken.items()}


def same_for_any_threads(splats: Splats, eyes: F64) -> bool:
    same = True
    for eye in eyes:
        made = []
        for threads in (1, 2):
            set_num_threads(threads)
            seen = look_around(splats, eye, size=SIZE, spent=SPENT)
            arrays = seen.ids, seen.weights, seen.light, seen.zbuffer.depths, seen.zbuffer.light
            made.append([a.tobytes() for a in arrays])
        same = same and made[0] == made[1]
    return same


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--eyes", type=int, default=16)
    parser.add_argument("--repeats", type=int, default=2)
    options = parser.parse_args()
    g = load_scene(Path(realdata()) / "scenes/showroom/lod-meta.json", lod=3)
    eyes, splats = choose_eyes(g, options.eyes), Splats.from_gaussians(g)
    ways: dict[str, Callable[[F64], object]] = {
        "look": lambda eye: look_around(splats, eye, size=SIZE, spent=SPENT),
        "hybrid": lambda eye: hybrid(g, splats, eye, size=SIZE),
    }
    seconds = in_turn(eyes, ways, options.repeats)
    cubes = in_turn(eyes[:4], {"cubemap": lambda eye: rasterize(g, Cameras.cubemap(eye[None], SIZE), sh_degree=0)}, 2)
    seconds |= cubes
    parts = measure_parts(splats, eyes)
    same = same_for_any_threads(splats, eyes[:4])
    figures: list[dict[str, Any]] = []

    def figure(name: str, reached: float, unit: str, target: float | None = None, better: str = "lower") -> None:
        figures.append({"name": name, "target": target, "reached": reached, "unit": unit, "better": better})

    def ratio(over: str, under: str) -> float:
        return float(np.median(seconds[over] / seconds[under]))

    figure("a look: one thread over two", ratio("look, 1", "look, 2"), "ratio", 1.7, "higher")
    figure("a look with the hull: one thread over two", ratio("hybrid, 1", "hybrid, 2"), "ratio", 1.7, "higher")
    figure(
        "a cubemap of the rasterizer: one thread over two", ratio("cubemap, 1", "cubemap, 2"), "ratio", 1.7, "higher"
    )
    for name in ("look, 1", "look, 2", "hybrid, 2", "cubemap, 2"):
        threads = "one thread" if name.endswith("1") else "two threads"
        figure(f"{name[:-3]}, {threads}", 1e3 * float(np.median(seconds[name])), "ms")
    for threads, faster in share_out(splats, eyes[0], (2, 4, 8)).items():
        figure(
            f"squares shared out among {threads} threads, simulated from their costs", faster, "times", None, "higher"
        )
    for name, taken in parts.items():
        figure(f"part of a look: {name}", taken, "ms")
    figure("same bytes with one and two threads", float(same), "fact", 1.0, "higher")
    details = {"eyes": len(eyes), "seconds": {k: np.round(v, 4) for k, v in seconds.items()}}
    write_result(options.out, "How long does one look take, and how well does it use two threads?", figures, details)


if __name__ == "__main__":
    main()
