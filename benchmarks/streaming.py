"""What does a viewer see, and when, while a scene arrives: gsvis beside a whole file and Morton order?

Showroom LOD 3 and nika LOD 0 as packages, 8 recorded links and one of 10 Mbit/s, 8 walks that people made with a
headset (EyeNavGS), brought into the scenes. Each pair of a link and a walk is a viewer who spends 30 s in the first
scene and then 30 s in the second, which begins with nothing while the link goes on (SRBF-Gaussian, section 7.1.3).
Images of what clients hold, 320 x 240, against the full scene before it was packaged: every 100 ms for 3 s, then every
`--every`. Latency is the time from a pose until it is shown at 25 dB, in ticks of 100 ms, at most 1 s; QoE as in
`gsvis.abr.qoe`. Round trip 40 ms. Systems are compared by paired differences over all links and walks; 10 Mbit/s
stands apart and is not among them.

The baselines are given the benefit of every doubt: they fill the link without a pause; the whole file has the size of
the streamed SOG of that level of detail and shows the full scene as if it had lost nothing; Morton order has the
smaller of SPZ's bytes a Gaussian, as measured, and the package's own records with all terms.

Settings of the scheduler were chosen on the walks of other people (TUNING), never on these.

Given: packages of showroom and nika, recorded links and one of 10 Mbit/s, eight walks brought into the scenes by a
    similarity.
Measured: PSNR, latency and QoE of a viewer for each way to deliver; by class of link, since most recorded links are too
    slow for a whole file. A view in which the full scene shows nothing is left out of all of them, of the mean curves
    too: each step is the mean over the walks that see something then.
Defaults chosen on: four other walks, on the same scenes and with one of the links.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import sys
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from _harness import add_arguments, need, realdata, write_result
from _packaged import Packaged, open_original, spz_bytes

from gsvis.abr import AbrConfig, BandwidthTrace, UtilityConfig, load_trace, paired_difference
from gsvis.io.poses import load_path
from gsvis.package import Package
from gsvis.package.manifest import MANIFEST
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.paths import HeadPath
from gsvis.scene.retarget import RetargetConfig, retarget
from gsvis.simulate import (
    Adaptive,
    Link,
    MortonProgressive,
    Stage,
    ViewingConfig,
    WholeFile,
    play,
    watch,
)
from gsvis.stream import StreamedScene

WALKS = (
    "room/user103_room", "truck/user102_truck", "room/user105_room", "truck/user107_truck",
    "room/user111_room", "truck/user119_truck", "room/user118_room", "truck/user122_truck",
)  # fmt: skip
TUNING = ("room/user101_room", "room/user108_room", "truck/user110_truck", "truck/user116_truck")
KINDS = {"cooked_3gp": 3, "traces_oboe": 3, "5g_download": 2}  # how many links of each set
STEADY = 10.0  # Mbit/s
ROUND_TRIP = 0.04
OURS, WHOLE, MORTON = "gsvis", "whole file", "Morton order"
SEED = 7
SEEN = ("psnr", "latency", "qoe")
"""Curves that judge an image, so that they mean something only where the full scene shows something."""


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument(
        "packages", nargs="*", metavar="NAME=PACKAGE", help="in this order, each under a name of your choice"
    )
    parser.add_argument("--links", type=int, default=sum(KINDS.values()), help="how many of the recorded links")
    parser.add_argument("--walks", type=int, default=len(WALKS), help="how many of the walks")
    parser.add_argument("--every", type=float, default=0.5, help="seconds between images after the first 3 s")
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--policy", default=AbrConfig.policy)
    parser.add_argument("--estimator", default=AbrConfig.estimator)
    parser.add_argument("--peripheral", type=float, default=UtilityConfig.peripheral, help="factor of `utility`")
    parser.add_argument("--adjacent", type=float, default=UtilityConfig.adjacent, help="factor of `utility`")
    parser.add_argument("--beyond", type=float, default=UtilityConfig.beyond, help="factor of `utility`")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--cache", type=Path, help="folder where finished walks are kept: a killed run goes on")
    options = parser.parse_args()
    need(options.packages, "what `gsvis prepare` made, as NAME=PACKAGE")
    config = ViewingConfig(seconds=options.seconds, every=options.every)
    utility = UtilityConfig(peripheral=options.peripheral, adjacent=options.adjacent, beyond=options.beyond)
    scheduling = AbrConfig(policy=options.policy, estimator=options.estimator, utility=utility)
    named = [word.partition("=")[::2] for word in options.packages]
    links = recorded_links(options.links)
    begun = time.perf_counter()
    jobs = {}
    with ProcessPoolExecutor(options.workers, get_context("spawn")) as pool:
        for w in range(options.walks):
            for k, (name, package) in enumerate(named):
                job = pool.submit(walked, name, package, w, k, options.links, config, scheduling, options.cache)
                jobs[job] = name, w
        rows: list[dict[str, Any]] = []
        for job in as_completed(jobs):
            rows += job.result()
            name, w = jobs[job]
            print(f"{name}, {WALKS[w]}: {time.perf_counter() - begun:.0f} s", file=sys.stderr, flush=True)
    rows.sort(key=lambda row: (row["scene"], row["walk"], row["link"], row["system"]))
    blind = sorted({f"{row['scene']}, {row['walk']}" for row in rows if not any(row["curves"]["content"])})
    rows = [row for row in rows if any(row["curves"]["content"])]  # nothing to see, nothing to compare
    unseen = {f"{row['scene']}, {row['walk']}": row["curves"]["content"].count(0) for row in rows}
    details = {
        "config": asdict(config), "scheduler": asdict(scheduling), "round_trip": ROUND_TRIP,
        "walks": WALKS[: options.walks],
        "walks_that_see_nothing": blind,
        "views_without_content": {name: count for name, count in unseen.items() if count},
        "links": [{"name": link.trace.name, "mean_mbit_per_s": link.trace.bytes_between(0, 60) / 60 / 125e3}
                  for link in links],
        "scenes": {name: about(package) for name, package in named},
    }  # fmt: skip
    figures: list[dict[str, Any]] = []
    for name, _ in named:
        figures += steady_figures(name, [row for row in rows if row["scene"] == name])
    groups = [(name, [row for row in rows if row["scene"] == name]) for name, _ in named]
    groups += [("all scenes", rows)] if len(named) > 1 else []
    for name, some in groups:
        figures += compared(name, some, details)
    details["curves_at_steady_rate"] = {name: mean_curves(name, rows) for name, _ in named}
    details["paths"] = {f"{row['scene']}, {row['walk']}": row["path"] for row in rows}
    details["systems"] = {f"{row['scene']}, {row['system']}": row["about"] for row in rows}
    details["sessions"] = in_lines(rows)
    print(table(named, rows))
    question = "What does a viewer see, and when, while a scene arrives: gsvis beside a whole file and Morton order?"
    write_result(options.out, question, figures, details)


def recorded_links(count: int) -> list[Link]:
    """The links, drawn once and for all, and the steady one behind them."""
    rng, folder, drawn = np.random.default_rng(SEED), realdata() / "traces", []
    for kind, many in KINDS.items():
        files = sorted(path for path in (folder / kind).rglob("*") if path.is_file() and not path.name.startswith("."))
        files = [path for path in files if path.suffix != ".md"]
        drawn += [files[k] for k in sorted(rng.choice(len(files), many, replace=False).tolist())]
    traces = [load_trace(path) for path in drawn[:count]]
    return [Link(trace, ROUND_TRIP) for trace in (*traces, BandwidthTrace.constant(STEADY))]


def brought(original: Packaged, walk: int, start: float, seconds: float) -> tuple[HeadPath, dict[str, Any]]:
    """The part of a recording that is walked in a scene, and how it came there."""
    recording = load_path(realdata() / "traces" / "eyenav_rutgers" / f"{WALKS[walk]}.csv.gz")
    start = start if start + seconds <= recording.duration else 0.0
    config = RetargetConfig(meters_per_unit=original.meters_per_unit, project=True, seed=walk)
    moved = retarget(recording.cut(start, start + seconds), NavigableSpace.from_scene(original.gaussians), config)
    return moved.path, {"from_s": start, **moved.as_dict()}


def walked(
    name: str,
    package: str,
    walk: int,
    visit: int,
    count: int,
    config: ViewingConfig,
    scheduling: AbrConfig,
    cache: Path | None,
) -> list[dict[str, Any]]:
    """One walk through one scene, over all links, by all systems."""
    said = [
        name,
        hashlib.sha256((Path(package) / MANIFEST).read_bytes()).hexdigest(),
        WALKS[walk],
        visit,
        count,
        asdict(config),
        asdict(scheduling),
        SEED,
        "figures of views with content",
    ]
    key = hashlib.sha256(json.dumps(said).encode()).hexdigest()[:16]
    kept = None if cache is None else cache / f"{name}-{walk}-{key}.json"
    if kept is not None and kept.exists():
        found: list[dict[str, Any]] = json.loads(kept.read_text())
        return found
    original = open_original(package)
    g = original.gaussians
    file_size = original.file_bytes
    path, placed = brought(original, walk, visit * config.seconds, config.watched)
    with Package.open(package) as opened:
        scene = StreamedScene.open(opened)
        contents, stage = scene.contents, Stage(scene.contents, g)
        own = MortonProgressive(contents)
        per = spz_bytes(g) / len(g)
        if per * stage.highest.sum() < own.nbytes:
            per_gaussian = per - 1e-3 * len(contents.term_records) / len(contents)
            sizes: tuple[Any, ...] = (per_gaussian, 1e-3, "SPZ, as gsvis writes it")
        else:
            sizes = (16.0, None, "records of the package")
        playbacks, rows = [], []
        for link in recorded_links(count):
            later = link.from_time(visit * config.seconds)
            deliveries = (
                Adaptive(scene, config.view, scheduling, name=OURS),
                WholeFile(contents, file_size, original.file),
                MortonProgressive(contents, *sizes),
            )
            for delivery in deliveries:
                playbacks.append(play(delivery, later, path, stage.size, seconds=config.watched, tick=config.tick))
                rows.append({"scene": name, "walk": WALKS[walk], "link": link.trace.name, "path": placed})
        for row, session in zip(rows, watch(stage, playbacks, path, config), strict=True):
            row.update(session.as_dict())
    if kept is not None:
        cache.mkdir(parents=True, exist_ok=True)
        partial = kept.with_suffix(f".{os.getpid()}.partial")
        partial.write_text(json.dumps(rows))
        os.replace(partial, kept)
    return rows


def about(package: str) -> dict[str, Any]:
    with Package.open(package) as opened:
        m = opened.manifest
        sizes = {"gaussians": m.gaussians, "terms": m.terms, "levels": dict(zip(m.names, m.counts, strict=True))}
        cost = None if m.info.cost is None else asdict(m.info.cost)
        return {**sizes, "overhead_of_levels": m.gaussians / m.counts[-1] - 1.0, "cost_of_rounding": cost}


def chosen(rows: list[dict[str, Any]], system: str, steady: bool) -> list[dict[str, Any]]:
    name = f"{STEADY:g} Mbit/s"
    return [row for row in rows if row["system"] == system and (row["link"] == name) == steady]


def values(rows: list[dict[str, Any]], key: str) -> np.ndarray:
    """(M,) a figure of each session; what never happened is infinite."""
    return np.array([np.inf if row["figures"][key] is None else row["figures"][key] for row in rows], np.float64)


def steady_figures(name: str, rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Figures at 10 Mbit/s."""
    out = []
    for system in (OURS, WHOLE, MORTON):
        some = chosen(rows, system, True)
        for key, label, target in (
            ("seconds_to_first_image", "first image of 20 dB, median", 0.5),
            ("seconds_to_good_image", "image of 35 dB, median", 2.0),
        ):
            reached = float(np.median(values(some, key)))
            out.append(
                {"name": f"{label}, {STEADY:g} Mbit/s, {system}, {name}", "target": target if system == OURS else None,
                 "reached": reached if np.isfinite(reached) else 1e9, "unit": "s", "better": "lower"}
            )  # fmt: skip
        out.append(
            {"name": f"QoE of a step, {STEADY:g} Mbit/s, {system}, {name}", "target": None,
             "reached": values(some, "score").mean(), "unit": "at most 1", "better": "higher"}
        )  # fmt: skip
    ours = chosen(rows, OURS, True)
    for key, label, unit in (
        ("gaussian_share", "Gaussians sent in 30 s", "of all levels; paper 0.8685"),
        ("term_share", "SRBFs sent in 30 s", "of all; paper 0.2239"),
        ("unseen_share", "Gaussians sent that never reached a pixel", "of those sent"),
        ("replaced_share", "Gaussians sent and replaced since", "of those sent"),
    ):
        if key != "term_share" or values(ours, "terms").any():
            out.append(
                {"name": f"{label}, {STEADY:g} Mbit/s, {OURS}, {name}", "target": None,
                 "reached": values(ours, key).mean(), "unit": unit, "better": "lower"}
            )  # fmt: skip
    return out


def in_lines(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """The figures of all sessions, one line each."""
    keys, names = ("scene", "walk", "link", "system"), list(rows[0]["figures"])
    lines = [[row[key] for key in keys] + [_short(row["figures"][name]) for name in names] for row in rows]
    return {"columns": [*keys, *names], "rows": lines}


def _short(value: float | int | None) -> float | int | None:
    return float(f"{value:.5g}") if isinstance(value, float) else value


def compared(name: str, rows: list[dict[str, Any]], details: dict[str, Any]) -> list[dict[str, Any]]:
    """Paired differences over the recorded links."""
    out, kept = [], details.setdefault("differences", {}).setdefault(name, {})
    ours = chosen(rows, OURS, False)
    if len(ours) < 2:
        return out
    out.append(
        {"name": f"records sent twice, {name}", "target": 0, "reached": values(ours, "records_twice").max(),
         "unit": "in the worst session", "better": "lower"}
    )  # fmt: skip
    for other, least in ((WHOLE, 0.05), (MORTON, 0.02)):
        theirs = chosen(rows, other, False)
        assert [(r["walk"], r["link"]) for r in ours] == [(r["walk"], r["link"]) for r in theirs]
        for key in ("score", "quality", "delay", "latency", "psnr", "stall"):
            kept[f"{key}, {OURS} minus {other}"] = paired_difference(values(ours, key), values(theirs, key)).as_dict()
        score = kept[f"score, {OURS} minus {other}"]
        out.append(
            {"name": f"QoE of a step over the recorded links, {OURS} minus {other}, {name}", "target": least,
             "reached": score["mean"],
             "unit": f"95% CI {score['low']:.3f} to {score['high']:.3f}", "better": "higher"}
        )  # fmt: skip
        never = np.mean(~np.isfinite(values(theirs, "seconds_to_first_image")))
        out.append(
            {"name": f"sessions over the recorded links in which {other} never reached 20 dB, {name}", "target": None,
             "reached": float(never), "unit": f"of {len(theirs)}: where it is large, the QoE says little of us",
             "better": "lower"}
        )  # fmt: skip
        latency = kept[f"latency, {OURS} minus {other}"]
        mine, base = values(ours, "latency").mean(), values(theirs, "latency").mean()
        out.append(
            {"name": f"latency below {other}'s, {name}", "target": 0.59 if other == WHOLE else None,
             "reached": 1.0 - mine / base, "better": "higher",
             "unit": f"share; {mine:.3f} against {base:.3f} s, 95% CI of the difference {latency['low']:.3f} to"
                     f" {latency['high']:.3f} s"}
        )  # fmt: skip
    return out


def mean_curves(name: str, rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Curves at 10 Mbit/s, means over the walks at each step.

    What is judged by an image (SEEN) is the mean over the walks whose view has content at that step, and None where
    no view has: a black view of nothing says nothing of a system. What has arrived is the mean over all walks.
    `content` becomes the number of walks whose view has content.
    """
    out = {}
    for system in (OURS, WHOLE, MORTON):
        some = [row["curves"] for row in chosen([row for row in rows if row["scene"] == name], system, True)]
        content = np.array([curves["content"] for curves in some], bool)
        counts = content.sum(axis=0)
        out[system] = {"content": counts.tolist()}
        for key in some[0].keys() - {"content"}:
            curves = np.array([row[key] for row in some], np.float64)
            if key in SEEN:
                sums = np.where(content, curves, 0.0).sum(axis=0)
                means = [s / n if n else None for s, n in zip(sums.tolist(), counts.tolist(), strict=True)]
            else:
                means = curves.mean(axis=0).tolist()
            out[system][key] = [None if mean is None else round(mean, 5) for mean in means]
    return out


def table(named: list[Any], rows: list[dict[str, Any]]) -> str:
    head = "| scene | system | links | QoE | PSNR | latency | first 20 dB | 35 dB | MB | stalled |"
    out = [head, "|---|---|---|---|---|---|---|---|---|---|"]
    for name, _ in named:
        for steady in (True, False):
            for system in (OURS, WHOLE, MORTON):
                some = chosen([row for row in rows if row["scene"] == name], system, steady)
                if not some:
                    continue
                first, good = (np.median(values(some, f"seconds_to_{k}_image")) for k in ("first", "good"))
                score, psnr, latency, nbytes, stalled = (
                    values(some, key).mean() for key in ("score", "psnr", "latency", "bytes", "stall")
                )
                links = f"{STEADY:g} Mbit/s" if steady else "recorded"
                out.append(
                    f"| {name} | {system} | {links} | {score:.3f} | {psnr:.1f} dB | {latency:.3f} s | {first:.1f} s"
                    f" | {good:.1f} s | {nbytes / 1e6:.1f} | {stalled:.1f} s |"
                )
    return "\n".join(out)


if __name__ == "__main__":
    main()
