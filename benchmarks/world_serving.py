"""How much memory does a server of 10^8 Gaussians take with 20 viewers, and when does each see its first image?

A world of 130 copies of a package, moved side by side, each a tile of its own with the levels, cells and visible sets
of the package. All centers of that package are in boxes of chunks: those on a lattice of logarithms cannot be moved.
What a cell sees ends with its tile; neighbors of cells go across borders. Records of the copies share their files by
hard links. Tables of the tiles that viewers come near are computed as a server does; those of all other tiles are holes
in the file of tables, which read as zeros and take no disk: a server that looks there fails. Every viewer begins in
another cell of another tile, stands still for three seconds and walks along x, most across a border. The same viewers
visit the package alone, in a server of its own: first one at a time, package and world in turn, then all 20 at once. A
viewer does not decode while it visits; afterwards all bytes are compared with the records of the package, and images
are drawn.

Given: showroom LOD 3 as a package of three levels with 255 cells, links of 10 Mbit/s, no round trip.
Measured: PSS and RSS of the server, its open files, seconds from before the connection until what a link has brought
    is an image of 20 dB against the whole tile, wrong bytes, records that came twice.
Defaults chosen on: no scene.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from _harness import add_arguments, need, write_result
from _large_world import lattice, linear, write_tables
from _memory import pss
from server_load import Viewer, cpu_of, memory_of, other_cores, serving

from gsvis.package import Package
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import quats_from_rotations
from gsvis.simulate.frames import Frame, Stage
from gsvis.stream import PoseAt, StreamedScene
from gsvis.stream.batch import Sections
from gsvis.stream.kept import open_kept
from gsvis.world.streamed import open_world

STANDS_S, SPEED = 3.0, 1.5  # seconds before a viewer walks; units a second
FIRST_DB = 20.0
SIZE = 192, 134  # pixels of an image


class Visitor(Viewer):
    """A viewer who stands at an eye, looks along x or y, and then walks along x."""

    def __init__(self, url: str, eye: np.ndarray, forward: np.ndarray) -> None:
        super().__init__(url, eye[None], np.array([0.0, 0.0, 1.0]), 0, np.inf)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        turn = np.stack([right, np.cross(forward, right), forward], axis=1)
        self._quat = tuple(float(v) for v in quats_from_rotations(turn[None])[0])
        self._eye = eye
        self.messages: list[tuple[float, bytes]] = []
        self.began = 0.0

    def note(self, data: bytes, at: float) -> None:
        self.messages.append((at - self.began, data))

    def pose(self, t: float) -> bytes:
        place = self._eye + np.array([max(0.0, t - STANDS_S) * SPEED, 0.0, 0.0])
        return PoseAt(int(1e3 * t), tuple(float(v) for v in place), self._quat).to_bytes()

    async def run(self, until: float) -> None:
        self.began = time.monotonic()
        await super().run(until)


@dataclass
class Watch:
    """What a server takes while a block runs."""

    pss: list[int] = field(default_factory=list)
    rss: list[float] = field(default_factory=list)
    files: int = 0


@contextmanager
def watching(pid: int) -> Iterator[Watch]:
    """Look at a process four times a second."""
    found, done = Watch(), threading.Event()

    def look() -> None:
        while not done.wait(0.25):
            found.pss.append(pss(pid))
            found.rss.append(1e6 * memory_of(pid))
            found.files = max(found.files, len(os.listdir(f"/proc/{pid}/fd")))

    thread = threading.Thread(target=look, daemon=True)
    thread.start()
    try:
        yield found
    finally:
        done.set()
        thread.join()


@dataclass(frozen=True)
class Views:
    """Eyes in the package, and what the whole package looks like from each."""

    eyes: list[np.ndarray]
    forwards: list[np.ndarray]
    frames: list[Frame]

    @classmethod
    def of(cls, package: Path, count: int) -> Views:
        """Views from the centers of cells spread over the package; those of which black is no picture."""
        with Package.open(package) as opened:
            stage, centers = Stage(opened.contents), opened.visibility.grid.centers
        found = cls([], [], [])
        for k, center in enumerate(centers[np.random.default_rng(0).permutation(len(centers))]):
            forward = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]][k % 4])
            fx = SIZE[0] / 2.0
            matrix = np.array([[fx, 0.0, SIZE[0] / 2], [0.0, fx, SIZE[1] / 2], [0.0, 0.0, 1.0]])
            right = np.cross(forward, [0.0, 0.0, 1.0])
            pose = np.eye(4)
            pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
            pose[:3, 3] = -pose[:3, :3] @ center
            frame = Frame(stage, Cameras(pose[None], matrix[None], *SIZE))
            if frame.has_content:
                found.eyes.append(center)
                found.forwards.append(forward)
                found.frames.append(frame)
            if len(found.eyes) == count:
                return found
        return found


def first_image(visitor: Visitor, frame: Frame, base: int, scene: StreamedScene, size: int) -> float:
    """Seconds until the link has brought an image of `FIRST_DB` of the tile whose ids begin at a base."""
    shown, none = np.zeros(size, bool), np.zeros(0, bool)
    for at, data in visitor.messages:
        if at > STANDS_S:
            return np.inf
        if data[0] != 130:
            continue
        s = Sections.parse(data, scene.about)
        for ids, value in ((s.gaussians, True), (s.gone, False)):
            mine = np.asarray(ids, np.int64) - base
            shown[mine[(mine >= 0) & (mine < size)]] = value
        if frame.psnr(shown[frame.ids], none) >= FIRST_DB:
            return at
    return np.inf


def checked(visitors: Sequence[Visitor], scene: StreamedScene) -> dict[str, int]:
    """Compare all that came with the records of a scene whose ids are the same."""
    found = {"bytes": 0, "wrong": 0, "twice": 0, "gaussians": 0}
    for visitor in visitors:
        held = np.zeros(len(scene), bool)
        for _, data in visitor.messages:
            found["bytes"] += len(data)
            if data[0] != 130:
                continue
            s = Sections.parse(data, scene.about)
            ids = np.asarray(s.gaussians, np.int32)
            found["twice"] += int(held[ids].sum())
            held[ids] = True
            found["gaussians"] += len(ids)
            same = scene.coding.encode_some(
                scene.records.parts, ids, scene.records.chunks[ids], scene.records.chunk_numbers
            )
            records = np.frombuffer(bytes(s.records), np.uint8)
            wrong = len(records) if len(records) != len(same) else int((records != same).sum())
            rows = scene.records.chunk_rows[scene.records.chunks[s.chunks]]
            found["wrong"] += wrong + int((np.asarray(s.rows) != rows).sum())
    return found


def visit(url: str, guests: Sequence[tuple[np.ndarray, np.ndarray]], seconds: float) -> list[Visitor]:
    """Visits at the same time."""
    visitors = [Visitor(url, *guest) for guest in guests]

    async def run() -> None:
        until = time.monotonic() + seconds
        await asyncio.gather(*(visitor.run(until) for visitor in visitors))

    asyncio.run(run())
    return visitors


def main() -> None:
    """Make the world, serve it, and serve the package alone."""
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("package", type=Path, nargs="?", help="what `gsvis prepare` made")
    parser.add_argument("--work", type=Path, help="folder for the world and its tables, some 6 GB")
    parser.add_argument("--columns", type=int, default=26)
    parser.add_argument("--rows", type=int, default=5)
    parser.add_argument("--near", type=int, default=6, help="first columns, whose tables are computed")
    parser.add_argument("--viewers", type=int, default=20)
    parser.add_argument("--alone", type=int, default=6, help="visits of one viewer at a time")
    parser.add_argument("--seconds", type=float, default=16.0)
    parser.add_argument("--settled", type=float, default=10.0, help="seconds after the last viewer")
    parser.add_argument("--core", type=int, default=0, help="the core of the server")
    args = parser.parse_args()
    need(args.package, "what `gsvis prepare` made")
    need(args.work, "a folder with --work")
    args.work.mkdir(parents=True, exist_ok=True)
    package = linear(args.package, args.work / "linear.gsvis")
    whole = lattice(package, args.work / f"city-{args.columns}-{args.rows}.gsworld", args.columns, args.rows)
    near = lattice(package, args.work / f"near-{args.near}-{args.rows}.gsworld", args.near, args.rows)
    tables = args.work / "tables"
    write_tables(whole, near, tables)
    os.sched_setaffinity(0, other_cores(args.core))
    views = Views.of(package, args.viewers)
    alone, _ = open_kept(Package.open(package), tables)
    world, _ = open_world(whole, tables=tables)
    size, step = len(alone), alone.index.grid.cell_size * np.array(alone.index.grid.shape) * (1.0, 0.0, 0.0)
    across = alone.index.grid.cell_size * np.array(alone.index.grid.shape) * (0.0, 1.0, 0.0)

    def guest(k: int, *, moved: bool) -> tuple[np.ndarray, np.ndarray]:
        """The guest of tile k, and in the package the same one, who walks out of it."""
        at, by = k % len(views.eyes), k // args.rows * step + k % args.rows * across
        return views.eyes[at] + moved * by, views.forwards[at]

    figures: list[dict[str, Any]] = []
    details: dict[str, Any] = {"package": args.package.name, "load_before": os.getloadavg()[0], "viewers": args.viewers}
    firsts: dict[str, list[float]] = {}
    sums = {"bytes": 0, "wrong": 0, "twice": 0, "gaussians": 0}
    options = ("--tables", str(tables))
    began = time.perf_counter()
    with serving(whole, args.core, *options) as (server, url):
        details["seconds_to_serve"] = time.perf_counter() - began
        with serving(package, args.core, *options) as (other, package_url):
            places = (("package", package_url, other, False, alone), ("world", url, server, True, world))
            visit(package_url, [guest(0, moved=False)], 3.0)  # kernels
            visit(url, [guest(4 * args.rows - 1, moved=True)], 3.0)
            details["before"] = {name: pss(process.pid) for name, _, process, _, _ in places}
            for k in range(args.alone):
                for name, to, _, moved, scene in places:
                    (visitor,) = visit(to, [guest(k, moved=moved)], STANDS_S)
                    base = k * size if moved else 0
                    at = first_image(visitor, views.frames[k % len(views.eyes)], base, scene, size)
                    firsts.setdefault(f"{name}, alone", []).append(at)
            for name, to, process, moved, scene in places:
                cpu = cpu_of(process.pid)
                with watching(process.pid) as watch:
                    visitors = visit(to, [guest(k, moved=moved) for k in range(args.viewers)], args.seconds)
                    cpu = cpu_of(process.pid) - cpu
                    time.sleep(args.settled)
                for k, visitor in enumerate(visitors):
                    frame, base = views.frames[k % len(views.eyes)], k * size if moved else 0
                    at = first_image(visitor, frame, base, scene, size)
                    firsts.setdefault(f"{name}, together", []).append(at)
                sums = {key: value + sums[key] for key, value in checked(visitors, scene).items()}
                details[name] = {
                    "peak_pss": max(watch.pss), "peak_rss": max(watch.rss), "settled_pss": watch.pss[-1],
                    "settled_rss": watch.rss[-1], "open_files": watch.files, "pss": watch.pss[::4],
                    "cpu_share": cpu / args.seconds, "connections": sum(visitor.opened for visitor in visitors),
                    "welcome_bytes": len(visitors[0].messages[0][1]),
                    "mbit_per_s": [visitor.bytes / args.seconds / 125_000 for visitor in visitors],
                }  # fmt: skip
    details |= {"first_image_s": firsts, "compared": sums}
    apart = {
        how: float(np.median(firsts[f"world, {how}"]) - np.median(firsts[f"package, {how}"]))
        for how in ("alone", "together")
    }
    of_world = details["world"]
    for name, target, reached, unit, better in (
        ("Gaussians of the world", 100.0, args.columns * args.rows * size / 1e6, "million", "higher"),
        (f"RSS of its server with {args.viewers} viewers, peak", 2.0, of_world["peak_rss"] / 1e9, "GB", "lower"),
        ("PSS, peak", None, of_world["peak_pss"] / 1e9, "GB", "lower"),
        ("PSS, settled", None, of_world["settled_pss"] / 1e9, "GB", "lower"),
        ("PSS of the package's server with as many, peak", None, details["package"]["peak_pss"] / 1e9, "GB", "lower"),
        ("first image of 20 dB, one viewer: world minus package", 0.2, apart["alone"], "s", "lower"),
        (f"the same, {args.viewers} viewers at once", 0.2, apart["together"], "s", "lower"),
        ("open files", None, of_world["open_files"], "", "lower"),
        ("wrong bytes", 0.0, sums["wrong"], "", "lower"),
        ("records that came twice", 0.0, sums["twice"], "", "lower"),
    ):
        figures.append({"name": name, "target": target, "reached": reached, "unit": unit, "better": better})
    write_result(args.out, "How much memory does a server of 10^8 Gaussians take with 20 viewers?", figures, details)


if __name__ == "__main__":
    main()
