"""What does a walk across the borders of a world cost, against the same scene as one package?

A street of houses is prepared twice with the same options: as a world of tiles, and as one package. A viewer walks its
whole length and back, looking along it, then across it. Every need of a view is sent before the next step, so links
play no part; nothing fills idle time. Counted: bytes of all messages, Gaussians that come twice, and at every third
step the PSNR of what the client draws against the scene as it was.

Given: a built-in street, looked at by 4 eyes a cell at 64 px.
Measured: bytes of messages, repeats, PSNR of frames of 160 x 120.
Defaults chosen on: the street.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from _harness import add_arguments, write_result
from _worlds import small_street

from gsvis.abr.classes import FieldOfView
from gsvis.abr.config import AbrConfig
from gsvis.io.ply import save_ply
from gsvis.prepare.config import PrepareConfig
from gsvis.prepare.prepare import prepare_package
from gsvis.pvs.config import PvsConfig
from gsvis.render import psnr, rasterize
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians, rotations_from_quats
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.view_sampling import ViewSampling
from gsvis.stream import Receiver, Session, StreamedScene
from gsvis.world.config import WorldConfig
from gsvis.world.prepare import prepare_world
from gsvis.world.streamed import open_world
from gsvis.world.tiling import TilingConfig

VIEW = FieldOfView.from_degrees(90.0, 70.0, margin=8.0)
ALONG, BACK, ACROSS = (0.5, -0.5, 0.5, -0.5), (0.5, -0.5, -0.5, 0.5), (0.7071, -0.7071, 0.0, 0.0)


def options(cell: float) -> PrepareConfig:
    views = {
        "level_views": ViewSampling(4, 48, 36, 90.0),
        "cost_views": ViewSampling(1, 32, 24, 60.0, stream=3),
        "fidelity_views": ViewSampling(1, 32, 24, 60.0, stream=5),
    }
    sets = PvsConfig(size=64, lower_size=32, limit=0.02, rays=256, max_inner=4)
    return PrepareConfig(levels=None, level_held_out=0, cell_size=cell, cells=400, sets=sets, **views)


def steps_of(low: np.ndarray, high: np.ndarray, count: int) -> list[tuple[np.ndarray, tuple[float, ...]]]:
    """Poses along x and back, at eye height."""
    xs = np.linspace(low[0], high[0], count)
    there = [(np.array([x, 2.0, 1.5]), ALONG) for x in xs]
    back = [(np.array([x, 1.0, 1.5]), BACK) for x in xs[::-1]]
    return [*there, *back, *((np.array([x, 3.0, 1.5]), ACROSS) for x in xs)]


def walked(scene: StreamedScene, steps: list[tuple[np.ndarray, tuple[float, ...]]], whole: Gaussians) -> dict[str, Any]:
    session = Session(scene, VIEW, AbrConfig(fill=False, start_rate=1e8))
    receiver = Receiver(scene.header)
    total, came, frames, cells = len(session.welcome(0.0).data), list[int](), list[float](), list[int]()
    session.on_ack(0.0, 0)
    for k, (eye, quat) in enumerate(steps):
        for turn in range(40):
            t = 4.1 * k + 0.1 * turn + 0.1
            session.on_pose(t, eye, quat)
            message = session.next_message(t, 2e5)
            if message is None:
                break
            total += len(message.data)
            came += receiver.receive(message.data).gaussians.tolist()
            session.on_ack(t + 0.001, message.sequence)
        cells.append(session.planner.cell)
        if k % 3 == 0:
            frames.append(float(frame_psnr(receiver.scene()[0], whole, eye, quat)))
    return {"bytes": total, "gaussians": len(came), "twice": len(came) - len(set(came)), "frames": frames,
            "cells": len(set(cells)), "crossed": crossings(scene, cells)}  # fmt: skip


def crossings(scene: StreamedScene, cells: list[int]) -> int:
    tiles = getattr(scene.index.grid, "tiles", np.zeros(len(scene.index.grid), int))[cells]
    return int(np.count_nonzero(np.diff(tiles)))


def frame_psnr(shown: Gaussians, whole: Gaussians, eye: np.ndarray, quat: tuple[float, ...]) -> float:
    ahead = rotations_from_quats(np.array([quat]))[0][:, 2]
    cameras = Cameras.look_at(eye[None], eye + ahead, up=(0.0, 0.0, 1.0), width=160, height=120, fov=90.0)
    images = [np.clip(rasterize(g, cameras, backend="cpu").images[0], 0.0, 1.0) for g in (shown, whole)]
    return min(float(psnr(*images)), 100.0)


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--houses", type=int, default=10)
    parser.add_argument("--step", type=float, default=0.3)
    parser.add_argument("--most", type=int, default=1500, help="Gaussians of a tile, about")
    parser.add_argument("--cell", type=float, default=2.0)
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--keep", type=Path, help="folder for what is prepared")
    args = parser.parse_args()
    street = small_street(houses=args.houses, step=args.step, flyaways=12)
    with tempfile.TemporaryDirectory() as temporary:
        folder = args.keep or Path(temporary)
        folder.mkdir(exist_ok=True)
        config = options(args.cell)
        if not (folder / "one.gsvis").exists():
            space = NavigableSpace.from_scene(street, up=(0.0, 0.0, 1.0), resolution=160)
            prepare_package(street, folder / "one.gsvis", space, config)
        if not (folder / "city.gsworld").exists():
            save_ply(street, folder / "street.ply")
            tiles = TilingConfig(args.most, up="+z")
            world = WorldConfig(tiles, replace(config), far=256, angle=0.02, looks=12, resolution=48)
            prepare_world([(str(folder / "street.ply"), None)], folder / "city.gsworld", world)
        one, city = StreamedScene.open(folder / "one.gsvis"), open_world(folder / "city.gsworld")[0]
        centers = one.index.grid.centers
        steps = steps_of(centers.min(axis=0), centers.max(axis=0), args.steps)
        runs = {name: walked(scene, steps, street) for name, scene in (("one", one), ("world", city))}
    single, world = (np.array(runs[name]["frames"]) for name in ("one", "world"))
    worse = int(((world < 35.0) & (single >= 35.0)).sum())
    figures = [
        {"name": "bytes of the walk over those of one package", "target": 1.03,
         "reached": runs["world"]["bytes"] / runs["one"]["bytes"], "unit": "", "better": "lower"},
        {"name": "Gaussians that came twice", "target": 0, "reached": runs["world"]["twice"], "unit": "",
         "better": "lower"},
        {"name": "frames below 35 dB that one package does not have", "target": 0, "reached": worse, "unit": "frames",
         "better": "lower"},
        {"name": "worst frame, world", "target": None, "reached": float(world.min()), "unit": "dB", "better": "higher"},
        {"name": "worst frame, one package", "target": None, "reached": float(single.min()), "unit": "dB",
         "better": "higher"},
        {"name": "borders crossed", "target": 20, "reached": runs["world"]["crossed"], "unit": "", "better": "higher"},
    ]  # fmt: skip
    details = {"gaussians": len(street), "options": vars(args) | {"keep": None, "out": None}, "runs": runs}
    write_result(args.out, "What does a walk across the borders of a world cost?", figures, details)


if __name__ == "__main__":
    main()
