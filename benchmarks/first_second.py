"""How good is the picture in the first second over a real link of 5 Mbit/s, for a client that has nothing yet?

A server and a client at the two ends of a cable between network namespaces, shaped by a token bucket. The client
connects, says hello, and stands. Time counts from before it connects. What arrived at each moment is drawn and compared
with the scene; so is what the simulator says has arrived over the same link. Kernels are compiled before. The cable has
no delay of its own. Needs Linux, root, `ip` and `tc`.

Given: packages, and the scenes they were made of (--scenes, each with :LOD where it has levels of detail; - for the
    package itself); --mbit; eyes in cells that see something.
Measured: PSNR at 0.3 s and at 1 s, mean and worst of the eyes; seconds until 20 and 30 dB; PSNR and bytes of the
    simulation beside them.
Defaults chosen on: no scene.
"""

from __future__ import annotations

import argparse
import asyncio
import logging
import time
from pathlib import Path
from typing import Any

import numpy as np
from _harness import add_arguments, need, write_result
from _shaped_link import PAYLOAD, SERVER, ShapedLink, shaped_link, why_not
from PIL import Image

from gsvis.abr.traces import BandwidthTrace
from gsvis.io import load_scene
from gsvis.scene.gaussians import quats_from_rotations
from gsvis.scene.paths import HeadPath
from gsvis.serve import Address, ClientConfig, Scenes, Server, StreamClient, open_scenes
from gsvis.simulate import Adaptive, Link, ViewingConfig, play
from gsvis.simulate.frames import Frame, Stage, psnr_of
from gsvis.simulate.playback import Playback
from gsvis.simulate.viewing import show_at
from gsvis.stream.receiver import Received

ROUND_TRIP = 0.002
TIMES = (0.3, 1.0)
FINE = np.round(np.arange(0.05, 3.0001, 0.05), 2)
CONFIG = ViewingConfig(seconds=3.0, width=320, height=240, fov=80.0)
SEED = 4545
MOST_WARM = 20
ASIDE = 0.3  # deviation of where an eye looks, about its way to the middle


def eyes_of(stage: Stage, centers: np.ndarray, up: np.ndarray, count: int) -> list[HeadPath]:
    """Return paths of clients that stand in cells, look along the ground to the middle, and see something."""
    rng = np.random.default_rng(SEED)
    middle = np.median(stage.drawn.means, axis=0)
    found: list[HeadPath] = []
    for cell in rng.permutation(len(centers)):
        ahead = middle - centers[cell]
        ahead = ahead / np.linalg.norm(ahead) + rng.normal(0.0, ASIDE, 3)
        ahead -= up * (ahead @ up)
        ahead /= np.linalg.norm(ahead)
        turn = np.stack([np.cross(-up, ahead), -up, ahead], axis=1)  # x right, y down, z forward
        quat = quats_from_rotations(turn[None])[0]
        path = HeadPath(
            np.array([0.0, 10.0]), np.repeat(centers[cell][None], 2, axis=0), np.repeat(quat[None], 2, axis=0)
        )
        cameras = HeadPath(np.zeros(1), centers[cell][None], quat[None]).cameras(
            CONFIG.width, CONFIG.height, CONFIG.fov
        )
        frame = Frame(stage, cameras[0])
        if frame.has_content and psnr_of(np.zeros_like(frame.reference), frame.reference) < 12.0:
            found.append(path)
        if len(found) == count:
            break
    return found


def exchange(link: ShapedLink, scenes: Scenes, size: tuple[int, int], path: HeadPath, mbit: float) -> Playback:
    """Return what a client without anything got, and when."""
    server = link.at("server", lambda: Server(scenes, address=Address(SERVER, 0)))()
    running = link.at("server", server.run)
    gaussian_at, gone_at, term_at = (np.full(n, np.inf, np.float32) for n in (size[0], size[0], size[1]))
    times: list[float] = []
    sizes: list[int] = []
    link.rate(mbit)

    async def stream() -> None:
        client = StreamClient(server.url, CONFIG.view, ClientConfig(poses_per_s=10.0))
        start = time.monotonic()

        def note(got: Received) -> None:
            now = time.monotonic() - start
            for at, ids in ((gaussian_at, got.gaussians), (gone_at, got.dropped), (term_at, got.terms)):
                at[ids] = np.minimum(at[ids], np.float32(now))
            times.append(now)
            sizes.append(got.nbytes)

        await client.run(path.at, seconds=CONFIG.seconds + 0.2, on_batch=note)

    try:
        link.at("client", lambda: asyncio.run(stream()))()
    finally:
        server.stop()
        running()
    return Playback(
        name="exchange",
        exact=False,
        link=Link(BandwidthTrace.constant(mbit), ROUND_TRIP),
        seconds=CONFIG.seconds,
        gaussian_at=gaussian_at,
        gone_at=gone_at,
        term_at=term_at,
        times=np.array(times),
        sizes=np.array(sizes, np.int64),
        filling=np.zeros(len(times), bool),
        filler=np.zeros(size[0], bool),
        twice=0,
        about={},
    )


def measure(link: ShapedLink, package: Path, reference: Any, options: argparse.Namespace) -> dict[str, Any]:
    """Return the rows of a package."""
    with open_scenes([package]) as scenes:
        (served,) = scenes.values()
        scene = served.scene
        size = scene.about.gaussians, scene.about.terms
        stage = Stage(scene.contents, reference)
        grid = scene.index.grid
        paths = eyes_of(stage, grid.centers, np.asarray(grid.up, float), options.eyes)
        for _ in range(MOST_WARM):  # until kernels are compiled
            if exchange(link, scenes, size, paths[0], 100.0).bytes_at(1.0) > 0:
                break
        rows = []
        for k, path in enumerate(paths):
            real = exchange(link, scenes, size, path, options.mbit)
            trace = BandwidthTrace.constant(options.mbit * PAYLOAD)
            said = play(Adaptive(scene, CONFIG.view), Link(trace, ROUND_TRIP), path, size, seconds=CONFIG.seconds)
            dbs: dict[str, list[float]] = {"real": [], "said": []}
            for t in FINE.tolist():
                full, images = show_at(stage, [real, said], path, t, CONFIG)
                for name, image in zip(dbs, images, strict=True):
                    dbs[name].append(0.0 if image is None else min(psnr_of(image, full), 99.0))
                if options.pictures is not None and t in (0.3, 0.5, 1.0):
                    shown = [np.zeros_like(full) if image is None else image for image in images]
                    both = np.concatenate([full, *shown], axis=1)
                    picture = Image.fromarray(np.round(255 * np.clip(both, 0, 1)).astype(np.uint8))
                    picture.save(options.pictures / f"{package.stem}-{k}-{t}.png")
            nbytes = {name: p.bytes_at(np.array(TIMES)).tolist() for name, p in (("real", real), ("said", said))}
            rows.append({"eye": k, "psnr": dbs, "bytes": nbytes})
            print(package.stem, k, {n: [v[int(20 * t) - 1] for t in TIMES] for n, v in dbs.items()}, nbytes, flush=True)
    return {"package": package.name, "gaussians": size[0], "terms": size[1], "rows": rows}


def until(values: list[float], least: float) -> float:
    """Return the seconds until a PSNR; 3 s for never."""
    found = np.flatnonzero(np.array(values) >= least)
    return float(FINE[found[0]]) if len(found) else float(FINE[-1])


def figures_of(found: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the figures of a package."""
    name = found["package"]
    figures = []
    for t, least in zip(TIMES, (20.0, 30.0), strict=True):
        place = round(20 * t) - 1
        real = np.array([row["psnr"]["real"][place] for row in found["rows"]])
        said = np.array([row["psnr"]["said"][place] for row in found["rows"]])
        figures += [
            (f"{name}: {t:g} s, mean of the eyes", least, real.mean(), "dB", "higher"),
            (f"{name}: {t:g} s, worst eye", least, real.min(), "dB", "higher"),
            (f"{name}: {t:g} s, mean of the eyes as simulated", None, said.mean(), "dB", "higher"),
        ]
        seconds = {who: np.array([until(row["psnr"][who], least) for row in found["rows"]]) for who in ("real", "said")}
        figures.append((f"{name}: until {least:g} dB, median of the eyes", t, np.median(seconds["real"]), "s", "lower"))
        figures.append(
            (f"{name}: until {least:g} dB, as simulated", None, np.median(seconds["said"]), "s", "lower"),
        )
    apart = [abs(row["bytes"]["real"][1] / row["bytes"]["said"][1] - 1.0) for row in found["rows"]]
    figures.append(
        (f"{name}: bytes in 1 s, apart from the simulation, median", 0.2, np.median(apart), "of those", "lower")
    )
    return [{"name": n, "target": g, "reached": float(v), "unit": u, "better": b} for n, g, v, u, b in figures]


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("packages", type=Path, nargs="*", help="what `gsvis prepare` made")
    parser.add_argument("--scenes", nargs="*", default=[], help="the scene of each, with :LOD for a level of detail")
    parser.add_argument("--mbit", type=float, default=5.0)
    parser.add_argument("--eyes", type=int, default=8)
    parser.add_argument("--pictures", type=Path, help="folder for pictures: the scene, the exchange, the simulation")
    options = parser.parse_args()
    need(options.packages[0] if options.packages else None, "what `gsvis prepare` made")
    reason = why_not()
    if reason is not None:
        print(f"skipped: {reason}")
        return
    logging.disable(logging.INFO)
    found = []
    with shaped_link() as link:
        for package, scene in zip(options.packages, options.scenes, strict=True):
            path, _, lod = scene.rpartition(":") if ":" in scene else (scene, "", "")
            reference = None if scene == "-" else load_scene(path, lod=int(lod) if lod else None)
            found.append(measure(link, package, reference, options))
    figures = [figure for each in found for figure in figures_of(each)]
    question = "How good is the picture in the first second over a real link of 5 Mbit/s?"
    write_result(options.out, question, figures, {"packages": found})


if __name__ == "__main__":
    main()
