"""What is each idea of the stream worth, and how do the ways of others deliver the same scene over the same links?

Each system of `_delivery_systems.py` delivers one scene to viewers who walk for 30 s. Links: four classes, 1, 3, 10 and
30 Mbit/s; for each class a constant link and a recorded one, scaled so that its first 31 s have that mean. Walks:
people with a headset in both groups of EyeNavGS, brought into the scene by a similarity. Images of what clients hold
against the full scene before it was packaged; every 100 ms for 3 s, then every `--every`. Latency and QoE as in
`streaming.py`.

The best rival of a class is the one with the highest mean QoE of a step. We are compared with it by paired differences:
the mean over the links of the class for each walk, with Student's 95% interval over walks. Rivals have every benefit of
the doubt (docs/rivals.md): sizes of SPZ or published SOG, no loss of their codecs, no time to decode. Systems that are
known by published sizes alone have no curve and are not here.

Given: packages with visible sets and levels; recorded links scaled to a class and constant ones; walks of both groups
    of EyeNavGS that no default was chosen on.
Measured: QoE, PSNR, latency, bytes, throughput over time; seconds until 20 and 35 dB, bytes until 35 dB; SSIM and FLIP
    beside PSNR on ten frames of two walks.
Defaults chosen on: four other walks (`streaming.py`, TUNING) in the same scenes, and their links.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import sys
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from _delivery_figures import CLASSES, figures_of, means_of_frames, report, targets_of
from _delivery_systems import OURS, SYSTEMS, Scene
from _harness import add_arguments, need, realdata, write_result
from _packaged import open_original

from gsvis.abr import AbrConfig, BandwidthTrace, load_trace
from gsvis.io.poses import load_path
from gsvis.package import Package
from gsvis.package.manifest import MANIFEST
from gsvis.render import flip, psnr, ssim
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.paths import HeadPath
from gsvis.scene.retarget import RetargetConfig, retarget
from gsvis.simulate import Link, Playback, Stage, ViewingConfig, play, show_at, watch

WALKS = (
    "eyenav_rutgers/room/user103_room", "eyenav_nthu/user1_berlin", "eyenav_rutgers/truck/user107_truck",
    "eyenav_nthu/user1_alameda", "eyenav_rutgers/room/user111_room", "eyenav_nthu/user2_alameda",
    "eyenav_rutgers/truck/user119_truck", "eyenav_rutgers/room/user118_room",
)  # fmt: skip
RECORDED = {
    1: "cooked_3gp/norway_bus_11", 3: "traces_oboe/oboe_trace_42.txt", 10: "cooked_3gp/norway_ferry_20",
    30: "5g_download/Driving/B_2020.02.14_07.29.00.csv",
}  # fmt: skip
"""The recording of each class, drawn once by hand of three sets, before any was run."""
KINDS = ("constant", "recorded")
ROUND_TRIP = 0.04
FRAMES, FRAME_WALKS = 10, 2


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("packages", nargs="*", metavar="NAME=PACKAGE", help="a package, under a name of your choice")
    parser.add_argument("--systems", nargs="*", default=list(SYSTEMS), choices=SYSTEMS, help="which; default all")
    parser.add_argument("--walks", type=int, default=len(WALKS), help="how many of the walks")
    parser.add_argument("--classes", type=int, nargs="*", default=list(CLASSES), choices=CLASSES, help="Mbit/s")
    parser.add_argument("--links", choices=("both", *KINDS), default="both")
    parser.add_argument("--recorded-walks", type=int, help="how many of the walks on recorded links; default all")
    parser.add_argument("--every", type=float, default=1.0, help="seconds between images after the first 3 s")
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--width", type=int, default=320, help="pixels; the height is three quarters of it")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--quick", action="store_true", help="two walks, constant links of 3 and 10 Mbit/s")
    parser.add_argument("--cache", type=Path, default=Path("out/streaming_rivals"), help="sizes and finished walks")
    options = parser.parse_args()
    need(options.packages, "what `gsvis prepare` made, as NAME=PACKAGE")
    if options.quick:
        options.walks, options.classes, options.links = min(options.walks, 2), [3, 10], "constant"
    if OURS not in options.systems:
        parser.error(f"--systems: expected {OURS} among them, all others are compared with it")
    config = ViewingConfig(
        seconds=options.seconds, every=options.every, width=options.width, height=options.width * 3 // 4
    )
    named = [word.partition("=")[::2] for word in options.packages]
    for name, package in named:  # once, not once in each worker
        open_scene(name, package, options.cache, lambda scene: scene.measured)
    begun, rows, frames = time.perf_counter(), list[dict[str, Any]](), list[dict[str, Any]]()
    with ProcessPoolExecutor(options.workers, get_context("spawn")) as pool:
        jobs = {
            pool.submit(run_walk, name, package, w, kind, config, options): (name, w)
            for kind in (KINDS if options.links == "both" else (options.links,))
            for w in range(_walks(options, kind))
            for name, package in named
        }
        for job in as_completed(jobs):
            found = job.result()
            rows, frames = rows + found["rows"], frames + found["frames"]
            name, w = jobs[job]
            print(f"{name}, {WALKS[w]}: {time.perf_counter() - begun:.0f} s", file=sys.stderr, flush=True)
    blind = sorted({f"{row['scene']}, {row['walk']}" for row in rows if not any(row["curves"]["content"])})
    rows = sorted(
        (row for row in rows if any(row["curves"]["content"])),
        key=lambda row: (row["scene"], row["walk"], row["class"], row["link"], row["system"]),
    )
    details = {
        "config": asdict(config), "scheduler": asdict(AbrConfig()), "round_trip": ROUND_TRIP,
        "walks": WALKS[: options.walks], "walks_that_see_nothing": blind,
        "sessions_of_links": dict(Counter(f"{row['class']} Mbit/s: {row['link']}" for row in rows)),
        "paths": {f"{row['scene']}, {row['walk']}": row["path"] for row in rows},
        "systems": {f"{row['scene']}, {row['system']}": row["about"] for row in rows},
        "frames": means_of_frames(frames),
        **report(rows, options.classes),
    }  # fmt: skip
    question = (
        "What is each idea of the stream worth, and how do the ways of others deliver the same scene over the same"
        " links?"
    )
    figures = figures_of(rows, options.classes) + targets_of(rows, options.classes)
    write_result(options.out, question, figures, details)


def _walks(options: argparse.Namespace, kind: str) -> int:
    """How many walks go over a kind of links."""
    fewer = options.recorded_walks if kind == "recorded" else None
    return int(options.walks if fewer is None else min(fewer, options.walks))


def link_of(rate: float, kind: str) -> Link:
    """The link of a class: constant, or recorded and scaled to its mean."""
    if kind == "constant":
        return Link(BandwidthTrace.constant(rate), ROUND_TRIP)
    recorded = load_trace(realdata() / "traces" / RECORDED[int(rate)])
    factor = rate / (recorded.bytes_between(0.0, 31.0) / 31.0 / 125e3)
    scaled = recorded.scaled(factor)
    return Link(BandwidthTrace(scaled.times, scaled.mbit_per_s, f"{recorded.name} x {factor:.2f}"), ROUND_TRIP)


def brought(g: Gaussians, meters: float | None, walk: int, seconds: float) -> tuple[HeadPath, dict[str, Any]]:
    """The first seconds of a recording, in a scene."""
    recording = load_path(realdata() / "traces" / f"{WALKS[walk]}.csv.gz")
    config = RetargetConfig(meters_per_unit=meters, project=True, seed=walk)
    moved = retarget(recording.cut(0.0, seconds), NavigableSpace.from_scene(g), config)
    return moved.path, moved.as_dict()


def open_scene(name: str, package: str, work: Path, use: Any) -> Any:
    with Package.open(package) as opened:
        return use(Scene(name, opened, open_original(package), work, AbrConfig()))


def run_walk(
    name: str, package: str, walk: int, kind: str, config: ViewingConfig, options: argparse.Namespace
) -> dict[str, Any]:
    """One walk through one scene, over a kind of links, by all systems; from the cache if it is there."""
    manifest = (Path(package) / MANIFEST).read_bytes()
    said = [name, hashlib.sha256(manifest).hexdigest(), WALKS[walk], asdict(config), asdict(AbrConfig())]
    said += [options.systems, options.classes, kind, walk < FRAME_WALKS]
    key = hashlib.sha256(json.dumps(said).encode()).hexdigest()[:16]
    kept = options.cache / f"{name}-{walk}-{key}.json"
    if kept.exists():
        found: dict[str, Any] = json.loads(kept.read_text())
        return found
    found = open_scene(name, package, options.cache, lambda scene: walk_through(scene, walk, kind, config, options))
    partial = kept.with_suffix(f".{os.getpid()}.partial")
    partial.write_text(json.dumps(found))
    os.replace(partial, kept)
    return found


def walk_through(
    scene: Scene, walk: int, kind: str, config: ViewingConfig, options: argparse.Namespace
) -> dict[str, Any]:
    path, placed = brought(scene.full, scene.meters_per_unit, walk, config.watched)
    stage = Stage(scene.streamed.contents, scene.full)
    playbacks, rows = list[Playback](), list[dict[str, Any]]()
    for rate in options.classes:
        link = link_of(rate, kind)
        for system in options.systems:
            delivery = scene.system(system, config.view)
            playbacks.append(play(delivery, link, path, stage.size, seconds=config.watched, tick=config.tick))
            row = {"scene": scene.name, "walk": WALKS[walk], "class": rate, "link": link.trace.name}
            rows.append({**row, "system": system, "path": placed})
    for row, playback, session in zip(rows, playbacks, watch(stage, playbacks, path, config), strict=True):
        row.update({key: value for key, value in session.as_dict().items() if key != "system"})
        good = session.time_of(35.0)
        row["bytes_to_35"] = float(playback.bytes_at(good)) if np.isfinite(good) else None
    framed = walk < FRAME_WALKS and kind == "constant"
    frames = compared_frames(stage, playbacks, rows, path, config) if framed else []
    return {"rows": rows, "frames": frames}


def compared_frames(
    stage: Stage, playbacks: list[Playback], rows: list[dict[str, Any]], path: HeadPath, config: ViewingConfig
) -> list[dict[str, Any]]:
    """PSNR, SSIM and FLIP of the same frames, on constant links of 3 Mbit/s, or of the first class that was run."""
    rate = 3 if any(row["class"] == 3 for row in rows) else rows[0]["class"]
    chosen = [k for k, row in enumerate(rows) if row["class"] == rate and row["link"] == f"{rate:g} Mbit/s"]
    out: list[dict[str, Any]] = []
    for t in np.geomspace(0.3, config.seconds - 0.1, FRAMES).tolist():
        reference, images = show_at(stage, [playbacks[k] for k in chosen], path, t, config)
        for k, image in zip(chosen, images, strict=True):
            shown = np.zeros_like(reference) if image is None else image
            out.append({
                "scene": rows[k]["scene"], "walk": rows[k]["walk"], "system": rows[k]["system"], "t": round(t, 2),
                "psnr": round(min(float(psnr(shown, reference)), 100.0), 2),
                "ssim": round(float(ssim(shown, reference)), 4), "flip": round(float(flip(shown, reference)), 4),
            })  # fmt: skip
    return out


if __name__ == "__main__":
    main()
