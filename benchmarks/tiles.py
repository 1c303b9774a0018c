"""How many bytes of 3D Tiles does a viewer request with volumes from visible sets, and how many without?

`gsvis export --format 3dtiles --request-volumes` gives each leaf the box of all cells that need it. A viewer requests a
tile only with the eye in its box (3D Tiles, viewerRequestVolume). Boxes are loose: a row of the sidecar of streamed SOG
says what the cell of the eye needs exactly. Both draw the same tiles, decoded from the same files; what they draw is
against a drawing of all tiles.

Given: showroom LOD 3 or nika LOD 0 with visible sets (built in --work, or found there), and two recorded walks
    (EyeNavGS `room`, users 110 and 119), retargeted to each scene by a similarity; 10 eyes evenly spaced in time on
    each. SPZ-compressed contents, leaves of at most 8,192.
Measured: bytes of the tiles that the eye requests, for any direction and for those in view alone, with volumes, with
    exact rows and with neither; dB of drawing these; 480 x 360, 80 degrees wide. Then bytes and dB of the compression:
    the tiles against the scene itself.
Defaults chosen on: none of these eyes; the light that a cell may lose is that of `streamed_sog.py`.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from _harness import write_result
from _leaves import facts_of, name_figures, open_scene, parse_arguments, visible_sets, walks

from gsvis.export.leaves import cut_leaves
from gsvis.export.needs import find_needs
from gsvis.export.tiles import TilesOptions, write_tiles
from gsvis.export.tileset import DEVIATIONS, find_volumes
from gsvis.io import load_scene
from gsvis.render import psnr, rasterize
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels

GLTF_TO_SCENE = {
    "showroom": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),  # +z is up
    "nika": np.diag([1.0, -1.0, -1.0]),  # -y is up
}


def in_view(boxes: np.ndarray, camera: Cameras) -> np.ndarray:
    """Return whether each box may be in view: not all of its corners lie outside of one side of the frustum."""
    view, k = camera.viewmats[0], camera.Ks[0]
    sides = np.array([[a, b, c] for a in (0, 1) for b in (0, 1) for c in (0, 1)])
    corners = np.stack([boxes[:, sides[:, axis], axis] for axis in range(3)], axis=2)
    x, y, z = np.moveaxis(corners @ view[:3, :3].T + view[:3, 3], 2, 0)
    wide, high = camera.width / 2.0 / k[0, 0], camera.height / 2.0 / k[1, 1]
    outside = [x < -wide * z, x > wide * z, y < -high * z, y > high * z, z < 0.0]
    return ~np.any([side.all(axis=1) for side in outside], axis=0)


class Tiles:
    """The tiles as written: Gaussians in the frame of the scene, and bytes."""

    def __init__(self, folder: Path, name: str, leaves: int) -> None:
        files = {int(path.name.split("-")[0].split("_")[1]): path for path in folder.glob("0_*.glb")}
        parts = [load_scene(files[leaf]).transform(GLTF_TO_SCENE[name]) for leaf in range(leaves)]
        self.sizes = np.array([files[leaf].stat().st_size for leaf in range(leaves)])
        self.of = np.repeat(np.arange(leaves), [len(part) for part in parts])
        far = list(folder.glob("env-*.glb"))
        parts += [load_scene(path).transform(GLTF_TO_SCENE[name]) for path in far]
        self.always = sum(path.stat().st_size for path in far)
        self.g = Gaussians.concatenate(parts)
        self.of = np.concatenate([self.of, np.full(len(self.g) - len(self.of), leaves)])

    def draw(self, requested: np.ndarray, camera: Cameras) -> np.ndarray:
        held = np.append(requested, True)[self.of]
        return np.clip(rasterize(self.g[held], camera).images[0], 0.0, 1.0)


def measure(name: str, work: Path, args: argparse.Namespace) -> dict[str, Any]:
    g, space = open_scene(name)
    up = tuple(space.up.tolist())
    with visible_sets(work, name, g, space, args.cells, args.coarse) as store:
        options = TilesOptions(leaf=args.leaf, up=up)
        whole = write_tiles(work / f"{name}-tiles", g, options, overwrite=True)
        bounded = TilesOptions(leaf=args.leaf, up=up, request_volumes=True)
        report = write_tiles(work / f"{name}-volumes", g, bounded, visibility=store, overwrite=True)
        leaves = cut_leaves(Levels.single(g), most=args.leaf)
        needs = find_needs(leaves, store)
        cell_at = store.grid.cell_at
    volumes, boxes = find_volumes(needs), leaves.boxes(DEVIATIONS)
    tiles = Tiles(work / f"{name}-tiles", name, len(leaves))
    rows = []
    for user, walk, cameras in walks(space, args.eyes):
        for k, eye in enumerate(walk.positions):
            cell = int(cell_at(eye[None])[0])
            if cell < 0:
                continue
            inside = ((eye >= volumes.boxes[:, 0]) & (eye <= volumes.boxes[:, 1])).all(axis=1)
            asked = {"all": np.ones(len(leaves), np.bool_), "exact": needs.needed[cell]}
            asked["volumes"] = volumes.needed & (inside | ~volumes.bounded)
            view, full = in_view(boxes, cameras[k]), tiles.draw(asked["all"], cameras[k])
            row: dict[str, Any] = {"user": user}
            for way, some in asked.items():
                row[f"bytes_{way}"] = tiles.always + int(tiles.sizes[some].sum())
                row[f"bytes_in_view_{way}"] = tiles.always + int(tiles.sizes[some & view].sum())
                row[f"db_{way}"] = min(float(psnr(tiles.draw(some & view, cameras[k]), full)), 100.0)
            row["db_compressed"] = float(psnr(full, np.clip(rasterize(g, cameras[k]).images[0], 0.0, 1.0)))
            rows.append(row)
            print(name, row, flush=True)
    facts = facts_of(report)
    return {"eyes": rows, "cell": float(needs.size), "bytes": whole.nbytes, "tiles": whole.tiles, "with_volumes": facts}


def figures_of(name: str, found: dict[str, Any]) -> list[dict[str, Any]]:
    eyes, facts = found["eyes"], found["with_volumes"]

    def fewer(kind: str, way: str) -> float:
        return 1.0 - sum(e[f"{kind}_{way}"] for e in eyes) / sum(e[f"{kind}_all"] for e in eyes)

    rows = [
        ("bytes requested with volumes, fewer than without", None, fewer("bytes", "volumes"), "share", "higher"),
        ("the same with the exact rows of cells", None, fewer("bytes", "exact"), "share", "higher"),
        ("bytes in view with volumes, fewer than without", None, fewer("bytes_in_view", "volumes"), "share", "higher"),
        ("bytes in view with exact rows, fewer", None, fewer("bytes_in_view", "exact"), "share", "higher"),
        ("worst eye with volumes", 45.0, min(e["db_volumes"] for e in eyes), "dB", "higher"),
        ("worst eye with exact rows", None, min(e["db_exact"] for e in eyes), "dB", "higher"),
        ("leaves with a volume", None, facts["volumes"], "leaves", "higher"),
        ("leaves that no cell needs", None, facts["unneeded"], "leaves", "higher"),
        ("worst eye of SPZ tiles against the scene", None, min(e["db_compressed"] for e in eyes), "dB", "higher"),
    ]
    return name_figures(name, rows)


def main() -> None:
    args = parse_arguments(__doc__)
    found = measure(args.scene, args.work, args)
    question = "How many bytes of 3D Tiles does a viewer request with volumes from visible sets, and how many without?"
    write_result(args.out, question, figures_of(args.scene, found), {"leaf": args.leaf, "cells": args.cells, **found})


if __name__ == "__main__":
    main()
