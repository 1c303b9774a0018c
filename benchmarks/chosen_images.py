"""What does a person at an eye that they chose see of the set of their cell, at the size of a display?

Of the eyes of `_chosen_eyes.py`, a few in different cells are drawn. Each scene is read from a file and its cells and
their sets are found as `gsvis pvs` finds them without options; only the cells of these eyes are. The images are drawn
from the chosen eye, and from the corner of the free part of its cell that is farthest from it. Small images in eight
directions find the worst one; that one, and toward what the person looks at, are drawn at 1920 x 1080, from the set and
from the whole scene, values clipped to [0, 1] as a display does. Equal images count as 100 dB.

Given: scenes, eyes chosen by hand, seeds of the transforms, as in `chosen_eyes.py`.
Measured: worst and median PSNR of the 1080p images of a scene; processor time of all of it.
Defaults chosen on: nothing; the options of `gsvis pvs` are the product's.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from _cells import DrawnCells, find_sets
from _chosen_eyes import CHOSEN, Chosen, bonsai, load_chosen
from _harness import add_arguments, realdata, write_result
from chosen_eyes import Moved, move
from numpy.typing import NDArray

from gsvis.cli.options import Where
from gsvis.cli.pvs import CELLS, FEWER_CELLS
from gsvis.cli.where import find_place
from gsvis.io import save_scene
from gsvis.io.sources import load_source
from gsvis.pvs.cell_count import fitting_cells
from gsvis.pvs.cell_view import CellView
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.config import PvsConfig
from gsvis.pvs.viewpoints import CellViewpoints, FreeVoxels
from gsvis.render import psnr, rasterize
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.solid import buried
from gsvis.scene.source import Source

F64 = NDArray[np.float64]

QUESTION = "What does a person at an eye that they chose see of the set of their cell, at the size of a display?"
LEAST = 40.0  # dB
MOST = 100.0  # dB, of equal images
SMALL, LARGE, FOV = (480, 270), (1920, 1080), 75.0
NEAR, ANYWHERE = 3, 4  # directions within 30 degrees of the target, and around the eye
CORNER = 0.01  # voxels from a corner to its eye


@dataclass(frozen=True, eq=False)
class Place:
    """An eye in a cell, and what it looks at first."""

    name: str
    eye: F64
    target: F64


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--seed", type=int, default=20261128)
    parser.add_argument("--eyes", type=int, default=4, help="eyes a scene, in different cells")
    parser.add_argument("--scenes", nargs="*", help="names, or 'NAME, moved' for that alone; all by default")
    parser.add_argument("--earlier", type=Path, help="result with the rows of scenes that are not tried now")
    parser.add_argument("--bonsai", help="a scene trained on the photographs of bonsai")
    parser.add_argument("--as-is", action="store_true", help="without transforms")
    options = parser.parse_args()
    folder, rows = realdata(), []
    every = [*CHOSEN, *([bonsai(options.bonsai, folder)] if options.bonsai else [])]
    for number, chosen in enumerate(every):
        if options.scenes and not {chosen.name, f"{chosen.name}, moved"} & set(options.scenes):
            continue
        for tried, source in read_scenes(chosen, folder, [options.seed, number], options.as_is):
            if options.scenes and not {chosen.name, tried.name} & set(options.scenes):
                continue
            began = time.process_time()
            row = {"scene": tried.name, **judge(tried.chosen, source, options)}
            row["processor_seconds"] = round(time.process_time() - began, 1)
            rows.append(row)
            print(" ".join(f"{key}={value}" for key, value in row.items() if key != "views"), flush=True)
    if options.earlier:
        rows += read_earlier(options.earlier, {row["scene"] for row in rows})
    write_result(options.out, QUESTION, summarize(rows), {"seed": options.seed, "scenes": rows})


def read_earlier(path: Path, known: set[str]) -> list[dict[str, Any]]:
    """Return the rows of an earlier result whose scenes are not known, marked as such."""
    rows = json.loads(path.read_text(encoding="utf-8"))["details"]["scenes"]
    return [{"earlier": True, **row} for row in rows if row["scene"] not in known]


def read_scenes(chosen: Chosen, folder: Path, seed: list[int], as_is: bool) -> Iterator[tuple[Moved, Source]]:
    """Yield a scene as it is and moved, each as the command reads it from a file."""
    g = load_chosen(chosen, folder)
    with tempfile.TemporaryDirectory() as made:
        path = chosen.path if chosen.path.startswith("builtin:") else str(folder / chosen.path)
        if path.endswith(".npz"):
            path = str(Path(made) / "points.ply")
            save_scene(g, path)
        yield Moved(g, chosen, chosen.name), load_source(path, chosen.lod)
        if not as_is:
            moved = move(g, chosen, np.random.default_rng(seed))
            path = str(Path(made) / "moved.ply")
            save_scene(moved.gaussians, path)
            yield moved, load_source(path, None)


def judge(chosen: Chosen, source: Source, options: argparse.Namespace) -> dict[str, Any]:
    """Return how far images from the sets of the eyes' cells are from those of the whole scene."""
    rng = np.random.default_rng([options.seed, 42])
    g = source.gaussians
    space = find_place(source, Where()).required("")
    grid = CellGrid.over(space, max_cells=fitting_cells(g, space, CELLS, FEWER_CELLS))
    drawn = draw_eyes(grid.cell_at(chosen.eyes), options.eyes, rng)
    row: dict[str, Any] = {"gaussians": len(g), "kind": space.kind.kind, "cells": len(grid)}
    row["eyes_in_cells"] = round(float(np.mean(grid.cell_at(chosen.eyes) >= 0)), 3)
    if not drawn:
        return row | {"worst_db": 0.0, "median_db": 0.0, "views": []}
    viewpoints = CellViewpoints(grid, space)
    views = find_sets(DrawnCells(g, viewpoints, tuple(sorted(drawn.values()))), PvsConfig())
    found = []
    for number, cell in drawn.items():
        eye, target = chosen.eyes[number], chosen.targets[number]
        corner = farthest_corner(g, viewpoints.voxels(cell), eye)
        for place in (Place("eye", eye, target), *([Place("corner", corner, target)] if corner is not None else [])):
            directions = draw_directions(place, space.up, rng)
            for each in measure_place(g, views[cell], place, directions, space.up):
                found.append({"eye": number, "cell": cell, **each})
    quality = [each["db"] for each in found]
    row |= {"worst_db": min(quality), "median_db": round(float(np.median(quality)), 1), "images": len(quality)}
    row["set_share"] = round(float(np.mean([len(view.ids) for view in views.values()])) / len(g), 3)
    row["bound"] = round(max(view.figures.bound for view in views.values()), 5)
    return row | {"views": found}


def draw_eyes(cells: NDArray[np.int64], count: int, rng: np.random.Generator) -> dict[int, int]:
    """Return the numbers of a few eyes, with their cells, each cell once."""
    drawn: dict[int, int] = {}
    for number in rng.permutation(np.flatnonzero(cells >= 0)).tolist():
        if len(drawn) < count and int(cells[number]) not in drawn.values():
            drawn[number] = int(cells[number])
    return drawn


def farthest_corner(g: Gaussians, voxels: FreeVoxels, eye: F64) -> F64 | None:
    """Return the corner of the free voxels of a cell that is farthest from an eye; None if all are inside something."""
    steps = np.stack(np.meshgrid(*[[CORNER, 1.0 - CORNER]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    corners = (voxels.voxels[:, None] + steps).reshape(-1, 3)
    points = voxels.origin + voxels.voxel_size * corners
    order = np.argsort(-np.linalg.norm(points - eye, axis=1), kind="stable")[:256]
    free = points[order][~buried(g, points[order])]
    return free[0] if len(free) else None


def draw_directions(place: Place, up: F64, rng: np.random.Generator) -> F64:
    """Return (D, 3) unit directions: toward the target, near that, and around the eye, not far from level."""
    ahead = (place.target - place.eye) / np.linalg.norm(place.target - place.eye)
    some = rng.normal(size=(NEAR, 3))
    some /= np.linalg.norm(some, axis=1, keepdims=True)
    near = ahead + np.tan(np.radians(30.0)) * rng.random((NEAR, 1)) * some
    east = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    east /= np.linalg.norm(east)
    north = np.cross(up, east)
    turns = 2.0 * np.pi * (np.arange(ANYWHERE) + rng.random()) / ANYWHERE
    pitches = np.tan(np.radians(rng.uniform(-35.0, 35.0, ANYWHERE)))
    around = np.cos(turns)[:, None] * east + np.sin(turns)[:, None] * north + pitches[:, None] * up
    directions = np.concatenate([ahead[None], near, around])
    return np.asarray(directions / np.linalg.norm(directions, axis=1, keepdims=True))


def measure_place(g: Gaussians, view: CellView, place: Place, directions: F64, up: F64) -> Iterator[dict[str, Any]]:
    """Yield the PSNR toward the target and, if that is another direction, in the worst one by small images."""
    kept, count = without_the_rest(g, view), len(directions)
    eyes = np.tile(place.eye, (count, 1))
    small, large = (
        Cameras.look_at(eyes, eyes + directions, up=up, width=width, height=height, fov=FOV)
        for width, height in (SMALL, LARGE)
    )
    worst = int(np.argmin([compare(g, kept, small[k : k + 1]) for k in range(count)]))
    for k in sorted({0, worst}):
        yield {"place": place.name, "direction": k, "db": round(compare(g, kept, large[k : k + 1]), 1)}


def without_the_rest(g: Gaussians, view: CellView) -> Gaussians:
    """Return the scene with all outside of a set invisible, so that the near plane stays that of the whole scene."""
    opacities = np.zeros_like(g.opacities)
    opacities[view.ids] = g.opacities[view.ids]
    return Gaussians(g.means, g.quats, g.scales, opacities, g.sh0, g.shN, facts=g.facts)


def compare(g: Gaussians, kept: Gaussians, camera: Cameras) -> float:
    """Return the PSNR of an image of a set against that of the whole scene, dB."""
    full, part = (np.clip(rasterize(each, camera, backend="cpu").images[0], 0.0, 1.0) for each in (g, kept))
    return min(MOST, float(psnr(part, full)))


def summarize(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the figures."""
    worst = np.array([row["worst_db"] for row in rows])
    seconds = np.array([row["processor_seconds"] for row in rows])
    return [
        figure("worst 1080p image of all scenes", LEAST, float(worst.min()), "dB", "higher"),
        figure("share of scenes whose worst image has 40 dB", 1.0, float(np.mean(worst >= LEAST)), "", "higher"),
        figure("worst image of a scene, median of the scenes", LEAST, float(np.median(worst)), "dB", "higher"),
        figure("processor time of a scene, most", 120.0, float(seconds.max()), "s", "lower"),
        figure("processor time of a scene, median", 120.0, float(np.median(seconds)), "s", "lower"),
    ]


def figure(name: str, target: float, reached: float, unit: str, better: str) -> dict[str, Any]:
    return {"name": name, "target": target, "reached": reached, "unit": unit, "better": better}


if __name__ == "__main__":
    main()
