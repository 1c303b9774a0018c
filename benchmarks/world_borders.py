"""What does a border between tiles cost in image quality?

A walk along the built-in street, across the borders of its tiles. Each frame is drawn of what the cell of the eye
needs: from the world, the set of the tile and what it sees beyond; from one package of the whole street, its set. Both
are compared with all Gaussians.

Given: the built-in street.
Measured: PSNR of each frame against the whole street, for the world and for one package.
Defaults chosen on: no scene.
"""

from __future__ import annotations

import argparse
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from _harness import add_arguments, need, write_result
from _worlds import small_street

from gsvis.io import load_scene
from gsvis.io.ply import save_ply
from gsvis.package import Package
from gsvis.prepare import PrepareConfig, prepare_package
from gsvis.progress import silent
from gsvis.pvs.config import PvsConfig
from gsvis.render.metrics import psnr
from gsvis.render.rasterizer import rasterize
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.view_sampling import ViewSampling
from gsvis.world import TilingConfig, World, WorldConfig, prepare_world

FRAMES, FOV, SIZE = 60, 75.0, (320, 240)
LOW = 35.0


def main() -> None:
    """Make both, walk, compare."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--angle", type=float, default=WorldConfig.angle)
    parser.add_argument("--far", type=int, default=512)
    parser.add_argument("--houses", type=int, default=4)
    parser.add_argument("--work", type=Path, help="folder for the world and the package")
    given = add_arguments(parser).parse_args()
    need(given.work, "a folder with --work")
    path = given.work / "street.ply"
    given.work.mkdir(parents=True, exist_ok=True)
    save_ply(small_street(given.houses), path)
    street = load_scene(path)
    views = ViewSampling(2, 64, 48, 60.0)
    config = PrepareConfig(
        levels=None, cells=4, sets=PvsConfig(size=128, limit=0.003),
        cost_views=replace(views, stream=3), fidelity_views=replace(views, stream=5),
    )  # fmt: skip
    tiling = TilingConfig(most=3000, up="+z")
    out = given.work / "street.gsworld"
    shutil.rmtree(out, ignore_errors=True)
    world_config = WorldConfig(tiling, config, given.far, given.angle, resolution=64)
    prepare_world([(str(path), None)], out, world_config)
    world = World.open(out)
    cells = sum(tile.cells for tile in world.manifest.tiles)
    space = NavigableSpace.from_scene(street, up="+z", resolution=96)
    prepare_package(street, given.work / "street.gsvis", space, replace(config, cells=cells), progress=silent)
    with Package.open(given.work / "street.gsvis") as single:
        rows = walk(street, world, single, given.houses)
    report(given, world, rows)


def walk(street: Gaussians, world: World, single: Package, houses: int) -> list[dict[str, Any]]:
    """Frames of a walk along the street, there and back, looking ahead and to the sides."""
    packages: dict[int, Package] = {}
    rows = []
    for k in range(FRAMES):
        x = 6.0 * houses * (0.04 + 0.92 * k / (FRAMES - 1))
        eye = np.array([x, 1.5 + 0.8 * np.sin(k), 1.4])
        turn = 0.9 * k
        ahead = np.array([np.cos(turn), np.sin(turn), -0.05])
        camera = Cameras.look_at(
            eye[None], (eye + ahead)[None], up=(0.0, 0.0, 1.0), width=SIZE[0], height=SIZE[1], fov=FOV
        )[0]
        tile = world.tile_at(eye)
        if tile < 0:
            continue
        for node in range(len(world)):
            if node not in packages:
                packages[node] = world.package(node)
        own = packages[tile].visibility if world.manifest.tiles[tile].cells else None
        cell, alone = -1 if own is None else own.cell_at(eye), single.visibility.cell_at(eye)
        if own is None or cell < 0 or alone < 0:
            continue
        parts = [packages[tile].contents.gaussians(own.visible_ids(cell))]
        beyond = world.beyond(tile)
        if beyond is not None:
            parts += [packages[seen.node].contents.gaussians(seen.ids) for seen in beyond.of_cell(cell)]
            beyond.close()
        whole = np.clip(rasterize(street, camera).images[0], 0.0, 1.0)
        images = [Gaussians.concatenate(parts), single.contents.gaussians(single.visibility.visible_ids(alone))]
        of_world, of_package = (
            min(100.0, float(psnr(np.clip(rasterize(g, camera).images[0], 0.0, 1.0), whole))) for g in images
        )
        rows.append({"tile": tile, "world": of_world, "package": of_package, "ids": sum(map(len, parts))})
    for package in packages.values():
        package.close()
    return rows


def report(given: argparse.Namespace, world: World, rows: list[dict[str, Any]]) -> None:
    """Write the figures."""
    of_world, of_package = (np.array([row[name] for row in rows]) for name in ("world", "package"))
    lost = int(((of_world < LOW) & (of_package >= LOW)).sum())
    borders = int(np.count_nonzero(np.diff([row["tile"] for row in rows])))
    figures = [
        {"name": "frames below 35 dB that one package has above", "target": 0, "reached": lost, "unit": "",
         "better": "lower"},
        {"name": "median PSNR of the world less that of one package", "target": None,
         "reached": float(np.median(of_world - of_package)), "unit": "dB", "better": "higher"},
    ]  # fmt: skip
    details = {
        "angle": given.angle, "far": given.far, "frames": len(rows), "borders": borders,
        "tiles": len(world.manifest.tiles), "worst_world": float(of_world.min()),
        "worst_package": float(of_package.min()), "rows": rows,
    }  # fmt: skip
    write_result(given.out, "What does a border between tiles cost in image quality?", figures, details)


if __name__ == "__main__":
    main()
