"""What does a walk across the borders of a world cost, against the same scene as one package?

A scene is prepared twice with the same options: as a world of tiles, and as one package. A viewer walks through both.
Every need of a view is sent before the next step, so links play no part; nothing fills idle time. Counted: bytes of all
messages and what they are for, Gaussians that come twice, and the PSNR of what the client draws against the scene as it
was.

Given: a built-in street, walked along and back and looked across, by sets of 4 eyes a cell at 64 px; with `--scene` two
    copies of a real scene merged to fewer Gaussians, turned, mirrored, jittered, with doors and a street between them,
    walked from room to room (`_walks.py`), in two levels. A district has the share of a tile, and stands from as many
    pixels of the sets on, that the defaults give it. Eyes are near the walk; with `--found`, where the place has room.
Measured: bytes of messages, repeats, PSNR of frames of 160 x 120.
Defaults chosen on: the street.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from _harness import add_arguments, realdata, write_result
from _walks import Pose, poses_along, two_copies, walk_of
from _worlds import small_street

from gsvis.abr.classes import FieldOfView
from gsvis.abr.config import AbrConfig
from gsvis.io import load_scene
from gsvis.io.ply import save_ply
from gsvis.jobs.workers import Workers
from gsvis.prepare.config import PrepareConfig
from gsvis.prepare.prepare import prepare_package
from gsvis.pvs.config import PvsConfig
from gsvis.render import psnr, rasterize
from gsvis.scene.cameras import Cameras
from gsvis.scene.corridor import space_along
from gsvis.scene.gaussians import Gaussians, rotations_from_quats
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.view_sampling import ViewSampling
from gsvis.stream import Receiver, Session, StreamedScene
from gsvis.stream.batch import Sections
from gsvis.stream.header import SceneHeader
from gsvis.train.levels import LevelsConfig
from gsvis.world.config import WorldConfig
from gsvis.world.prepare import prepare_world
from gsvis.world.streamed import WorldSource, open_world
from gsvis.world.tiling import TilingConfig

VIEW = FieldOfView.from_degrees(90.0, 70.0, margin=8.0)
ALONG, BACK, ACROSS = (0.5, -0.5, 0.5, -0.5), (0.5, -0.5, -0.5, 0.5), (0.7071, -0.7071, 0.0, 0.0)
UP = (0.0, 0.0, 1.0)
SIZE, MARGIN = 192, 1.0  # pixels of the sets of a real scene; how far from its walk eyes may be


@dataclass(frozen=True, eq=False)
class Case:
    """What is walked: the scene, where eyes may be, the options of both, the poses, and each how many are drawn."""

    whole: Gaussians
    space: NavigableSpace
    config: WorldConfig
    poses: Callable[[StreamedScene], list[Pose]]
    drawn: int


def street_case(args: argparse.Namespace) -> Case:
    """The built-in street."""
    street = small_street(houses=args.houses, step=args.step, flyaways=12)
    views = {
        "level_views": ViewSampling(4, 48, 36, 90.0),
        "cost_views": ViewSampling(1, 32, 24, 60.0, stream=3),
        "fidelity_views": ViewSampling(1, 32, 24, 60.0, stream=5),
    }
    sets = PvsConfig(size=64, lower_size=32, limit=0.02, rays=256, max_inner=4)
    package = PrepareConfig(levels=None, level_held_out=0, cell_size=args.cell, cells=400, sets=sets, **views)
    config = WorldConfig(TilingConfig(args.most, up="+z"), package, far=256, angle=0.02, looks=12, resolution=48)

    def poses(one: StreamedScene) -> list[Pose]:
        centers = one.index.grid.centers
        return steps_of(centers.min(axis=0), centers.max(axis=0), args.steps)

    return Case(street, NavigableSpace.from_scene(street, up=UP, resolution=160), config, poses, 3)


def real_case(args: argparse.Namespace) -> Case:
    """Two copies of a real scene, walked along their rooms."""
    scene = load_scene(realdata() / "scenes" / args.scene / "lod-meta.json", args.lod)
    whole, rooms = two_copies(scene, args.gaussians)
    walk = walk_of(whole, rooms, args.step, args.seed)
    views = {
        "level_views": ViewSampling(24, 160, 120, 90.0),
        "cost_views": ViewSampling(2, 160, 120, 60.0, stream=3),
        "fidelity_views": ViewSampling(2, 160, 120, 60.0, stream=5),
    }
    levels = LevelsConfig((0.3,), (0.9,), ("low", "high"), iterations=20, preview=0.0)
    sets = PvsConfig(size=SIZE, lower_size=2 * SIZE // 3, rays=2048)
    package = PrepareConfig(levels=levels, level_held_out=0, cell_size=args.cell, cells=400, sets=sets, **views)
    default, tiles = WorldConfig(), TilingConfig(args.most, up="+z")
    config = WorldConfig(
        tiles, package, far=default.far * args.most // default.tiling.most,
        angle=default.angle * default.package.sets.size / SIZE, looks=12, resolution=96,
        walk=None if args.found else tuple(map(tuple, walk.tolist())), margin=MARGIN,
    )  # fmt: skip
    if args.found:
        space = NavigableSpace.from_scene(whole, mixed=True, resolution=384, up=UP)
    else:
        space = space_along(whole, walk, MARGIN, resolution=384, up=UP)
    return Case(whole, space, config, lambda one: poses_along(walk), 1)


def steps_of(low: np.ndarray, high: np.ndarray, count: int) -> list[Pose]:
    """Poses along x and back, at eye height."""
    xs = np.linspace(low[0], high[0], count)
    there = [(np.array([x, 2.0, 1.5]), ALONG) for x in xs]
    back = [(np.array([x, 1.0, 1.5]), BACK) for x in xs[::-1]]
    return [*there, *back, *((np.array([x, 3.0, 1.5]), ACROSS) for x in xs)]


def stream_walk(scene: StreamedScene, steps: list[Pose], truth: list[np.ndarray], drawn: int) -> dict[str, Any]:
    session = Session(scene, VIEW, AbrConfig(fill=False, start_rate=1e8))
    receiver, welcome = Receiver(scene.header), session.welcome(0.0).data
    about = SceneHeader.parse(welcome)
    nbytes = {"welcome": len(welcome), "records": 0, "rows of chunks": 0, "ids and heads": 0}
    counts = {"messages": 0, "chunks": 0, "gone": 0, "evicted": 0}
    came, frames, cells = list[int](), list[float](), list[int]()
    session.on_ack(0.0, 0)
    for k, (eye, quat) in enumerate(steps):
        for turn in range(40):
            t = 4.1 * k + 0.1 * turn + 0.1
            session.on_pose(t, eye, quat)
            message = session.next_message(t, 2e5)
            if message is None:
                break
            sections = Sections.parse(message.data, about)
            records, rows = sections.records.nbytes + sections.term_records.nbytes, sections.rows.nbytes
            for name, more in (("records", records), ("rows of chunks", rows)):
                nbytes[name] += more
            nbytes["ids and heads"] += len(message.data) - records - rows
            counts["messages"] += 1
            for name in ("chunks", "gone", "evicted"):
                counts[name] += len(getattr(sections, name))
            came += receiver.receive(message.data).gaussians.tolist()
            session.on_ack(t + 0.001, message.sequence)
        cells.append(session.planner.cell)
        if k % drawn == 0:
            frames.append(min(float(psnr(frame(receiver.scene()[0], (eye, quat)), truth[k // drawn])), 100.0))
    return {"bytes": sum(nbytes.values()), "bytes of": nbytes, "gaussians": len(came),
            "twice": len(came) - len(set(came)), "of nodes": node_counts(scene, came), **counts, "frames": frames,
            "cells": len(set(cells)), **crossings(scene, cells)}  # fmt: skip


def node_counts(scene: StreamedScene, came: list[int]) -> dict[str, int]:
    """How many of the Gaussians that came are of districts and of each level of tiles, by the lowest that has them."""
    ids, index = np.array(came, np.int64), scene.index
    package = scene.source
    district = np.zeros(len(ids), bool)
    if isinstance(package, WorldSource):
        district = ids >= package.bases[len(package.world.manifest.tiles)]
    named = {
        name: int(np.count_nonzero(~district & (index.first[ids] == k))) for k, name in enumerate(index.level_names)
    }
    return {**named, "district": int(np.count_nonzero(district))}


def crossings(scene: StreamedScene, cells: list[int]) -> dict[str, int]:
    """How often the walk crosses a border between tiles, and how many different ones."""
    tiles = getattr(scene.index.grid, "tiles", np.zeros(len(scene.index.grid), int))[cells]
    at = np.flatnonzero(np.diff(tiles))
    return {"crossed": len(at), "borders": len({frozenset(tiles[k : k + 2].tolist()) for k in at})}


def frame(g: Gaussians, pose: Pose) -> np.ndarray:
    eye, quat = pose
    ahead = rotations_from_quats(np.array([quat]))[0][:, 2]
    cameras = Cameras.look_at(eye[None], eye + ahead, up=UP, width=160, height=120, fov=90.0)
    return np.clip(rasterize(g, cameras, backend="cpu").images[0], 0.0, 1.0)


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--scene", help="a scene of the real data, such as showroom; without it the built-in street")
    parser.add_argument("--lod", type=int, default=3)
    parser.add_argument("--gaussians", type=int, default=100_000, help="of a copy of a real scene")
    parser.add_argument("--found", action="store_true", help="prepare a real scene without its walk")
    parser.add_argument("--seed", type=int, default=0, help="of the places that the walk through a real scene visits")
    parser.add_argument("--houses", type=int, default=10)
    parser.add_argument("--step", type=float, default=0.3, help="of the lattice of the street; of the real walk")
    parser.add_argument("--most", type=int, default=1500, help="Gaussians of a tile, about")
    parser.add_argument("--cell", type=float, default=2.0)
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--keep", type=Path, help="folder for what is prepared")
    args = parser.parse_args()
    case = real_case(args) if args.scene else street_case(args)
    with tempfile.TemporaryDirectory() as temporary:
        folder, workers = args.keep or Path(temporary), Workers(args.workers)
        folder.mkdir(exist_ok=True)
        if not (folder / "one.gsvis").exists():
            prepare_package(case.whole, folder / "one.gsvis", case.space, case.config.package, workers=workers)
        if not (folder / "city.gsworld").exists():
            save_ply(case.whole, folder / "city.ply")
            prepare_world([(str(folder / "city.ply"), None)], folder / "city.gsworld", case.config, workers=workers)
        one, city = StreamedScene.open(folder / "one.gsvis"), open_world(folder / "city.gsworld")[0]
        steps = case.poses(one)
        truth = [frame(case.whole, pose) for pose in steps[:: case.drawn]]
        runs = {name: stream_walk(scene, steps, truth, case.drawn) for name, scene in (("one", one), ("world", city))}
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
        {"name": "different borders", "target": None, "reached": runs["world"]["borders"], "unit": "",
         "better": "higher"},
    ]  # fmt: skip
    details = {"gaussians": len(case.whole), "options": vars(args) | {"keep": None, "out": None}, "runs": runs}
    write_result(args.out, "What does a walk across the borders of a world cost?", figures, details)


if __name__ == "__main__":
    main()
