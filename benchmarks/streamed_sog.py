"""How many bytes and splats does a streamed SOG need with the sidecar of needed leaves, and how many without?

Both orders load the same leaves, one level of detail, from the same folder; quality is against a drawing of everything
in it. With the sidecar: the order of `examples/engines/needed-leaves.js`, run by node on the written files, with
position and direction. Without: the order of PlayCanvas' engine 2.23 with its defaults, by squared distance to the box
of a leaf, boxes shrunk by three quarters of what they have beyond the median box, and 1.5 times as far straight behind
the eye. A third order shows what the direction alone does: the engine's, with the loader's leaves ahead first. Splats
drawn: the leaves of the eye's cell against all leaves.

Given: showroom LOD 3 or nika LOD 0 with visible sets (built in --work, or found there; coarse ones with --coarse), and
    two recorded walks
    (EyeNavGS `room`, users 110 and 119), retargeted to each scene by a similarity; 10 eyes evenly spaced in time on
    each.
Measured: bytes of the environment, the header, the sidecar (ours alone) and the first leaves that draw the eye's view
    at 35 dB, summed over eyes; splats in the leaves that the cell needs, and dB of drawing these; 480 x 360, 80 degrees
    wide.
Defaults chosen on: the share of light that a row leaves out, on 16 random eyes and a first view of showroom, ten
    eyes of nika.
"""

from __future__ import annotations

import argparse
import json
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
from _harness import first_reaching, write_result
from _leaves import facts_of, name_figures, open_scene, parse_arguments, visible_sets, walks

from gsvis.export.streamed import StreamedOptions, write_streamed_sog
from gsvis.io import load_scene
from gsvis.render import psnr, rasterize
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.paths import HeadPath

FIRST, DRAWN = 35.0, 45.0
EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "engines" / "needed-leaves.js"
PLAN = """
import { readFileSync } from "node:fs";
const [module, folder] = process.argv.slice(2);
const { NeededLeaves } = await import(module);
const meta = JSON.parse(readFileSync(folder + "lod-meta.json", "utf8"));
const data = readFileSync(folder + meta.gsvis.files[0]);
const scene = new NeededLeaves(folder, meta, data.buffer.slice(data.byteOffset, data.byteOffset + data.length));
const eyes = JSON.parse(readFileSync(0, "utf8"));
console.log(JSON.stringify(eyes.map(([position, forward]) => {
  const ahead = scene.leaves.map((_, leaf) => scene.ahead(leaf, position, forward) > 0);
  return { load: scene.plan(position, forward).load, ahead };
})));
"""


def engine_order(bounds: np.ndarray, eye: np.ndarray, forward: np.ndarray) -> np.ndarray:
    """Leaves by the distance that the engine gives them, nearest first."""
    half = (bounds[:, 1] - bounds[:, 0]) / 2.0
    excess = np.maximum(half - np.sort(half, axis=0)[len(half) // 2], 0.0)
    low, high = bounds[:, 0] + 0.75 * excess, bounds[:, 1] - 0.75 * excess
    away = np.clip(eye, low, high) - eye
    squared = (away**2).sum(axis=1)
    behind = np.maximum(-(away @ forward) / np.sqrt(np.maximum(squared, 1e-8)), 0.0) * (squared > 1e-4)
    return np.argsort(squared * (1.0 + 0.5 * behind) ** 2, kind="stable")


def plans(folder: Path, walk: HeadPath) -> list[dict[str, Any]]:
    eyes = json.dumps([[p.tolist(), f.tolist()] for p, f in zip(walk.positions, walk.forwards, strict=True)])
    script = folder.with_name(f"{folder.name}-plan.mjs")
    script.write_text(PLAN)
    command = ["node", script, EXAMPLE, f"{folder}/"]
    found = subprocess.run(command, input=eyes, capture_output=True, text=True, check=True)
    return json.loads(found.stdout)


class View:
    """One eye, and how well a part of the leaves draws what it sees."""

    def __init__(self, g: Gaussians, of: np.ndarray, leaves: int, camera: Cameras) -> None:
        self.g, self.of, self.leaves, self.camera = g, of, leaves, camera
        self.full = self.draw(np.arange(leaves))

    def draw(self, some: np.ndarray) -> np.ndarray:
        held = np.zeros(self.leaves + 1, np.bool_)
        held[some] = held[-1] = True  # the last is the environment
        return np.clip(rasterize(self.g[held[self.of]], self.camera).images[0], 0.0, 1.0)

    def quality(self, some: np.ndarray) -> float:
        return min(float(psnr(self.draw(some), self.full)), 100.0)

    def first(self, order: np.ndarray, least: float) -> int:
        """Leaves of an order until its drawing has so many dB: by halving, as more leaves hardly ever draw worse."""
        count = first_reaching(lambda k: self.quality(order[:k]), len(order), least)
        return len(order) + 1 if count is None else count


def read_leaves(folder: Path) -> tuple[Gaussians, np.ndarray, np.ndarray, np.ndarray]:
    """Return all Gaussians as written, the leaf of each (-1: environment), and boxes and bytes of leaves."""
    meta = json.loads((folder / "lod-meta.json").read_text())
    found: list[dict[str, Any]] = []

    def walk(node: dict[str, Any]) -> None:
        for child in node.get("children", []):
            walk(child)
        if "lods" in node:
            found.append(node)

    walk(meta["tree"])
    parts, of, sizes = [], [], []
    for k, leaf in enumerate(found):
        place = folder / meta["filenames"][leaf["lods"]["0"]["file"]]
        parts.append(load_scene(place))
        of.append(np.full(len(parts[-1]), k))
        sizes.append(sum(file.stat().st_size for file in place.parent.iterdir()))
    if "environment" in meta:
        parts.append(load_scene(folder / meta["environment"]))
        of.append(np.full(len(parts[-1]), -1))
        sizes.append(sum(file.stat().st_size for file in (folder / meta["environment"]).parent.iterdir()))
    else:
        sizes.append(0)
    bounds = np.array([[leaf["bound"]["min"], leaf["bound"]["max"]] for leaf in found])
    return Gaussians.concatenate(parts), np.concatenate(of), bounds, np.array(sizes)


def measure(name: str, work: Path, args: argparse.Namespace) -> dict[str, Any]:
    g, space = open_scene(name)
    out = work / f"{name}-streamed"
    with visible_sets(work, name, g, space, args.cells, args.coarse) as store:
        options = StreamedOptions(leaf=args.leaf, name=name)
        report = write_streamed_sog(out, g, options, visibility=store, overwrite=True)
        inside = store.grid.cell_at
        again, of, bounds, sizes = read_leaves(out)
        header = (out / "lod-meta.json").stat().st_size
        rows = []
        for user, walk, cameras in walks(space, args.eyes):
            for k, plan in enumerate(plans(out, walk)):
                view = View(again, of, report.leaves, cameras[k])
                load = np.array(plan["load"], np.int64)
                theirs = engine_order(bounds, walk.positions[k], walk.forwards[k])
                rest = np.setdiff1d(np.arange(report.leaves), load)
                ours = np.concatenate([load, rest])  # 35 dB that the row does not reach is paid with all others
                turned = theirs[np.argsort(~np.array(plan["ahead"])[theirs], kind="stable")]
                firsts = [view.first(order, FIRST) for order in (ours, theirs, turned)]
                always = int(sizes[-1]) + header
                rows.append(
                    {
                        "user": user,
                        "in_cell": bool(inside(walk.positions[k][None])[0] >= 0),
                        "bytes_ours": always + report.sidecar_nbytes + int(sizes[ours[: firsts[0]]].sum()),
                        "bytes_engine": always + int(sizes[theirs[: firsts[1]]].sum()),
                        "bytes_ahead": always + int(sizes[turned[: firsts[2]]].sum()),
                        "leaves_ours": firsts[0],
                        "leaves_engine": firsts[1],
                        "needed": len(load),
                        "drawn": float((np.isin(of, load) | (of < 0)).mean()),
                        "db": view.quality(load),
                    }
                )
                print(name, rows[-1], flush=True)
    return {"eyes": rows, "cell": float(store.grid.cell_size), "scene": facts_of(report)}


def figures_of(name: str, found: dict[str, Any]) -> list[dict[str, Any]]:
    eyes, scene = found["eyes"], found["scene"]
    saved = 1.0 - sum(e["bytes_ours"] for e in eyes) / sum(e["bytes_engine"] for e in eyes)
    ahead = 1.0 - sum(e["bytes_ours"] for e in eyes) / sum(e["bytes_ahead"] for e in eyes)
    each = [1.0 - e["bytes_ours"] / e["bytes_engine"] for e in eyes]
    db = np.array([e["db"] for e in eyes])
    fewer = 1.0 - float(np.mean([e["drawn"] for e in eyes]))
    good = [1.0 - e["drawn"] for e in eyes if e["db"] >= DRAWN]
    rows = [
        ("bytes until 35 dB, fewer than in the engine's order", 0.4, saved, "share", "higher"),
        ("the same, against the engine's order with leaves ahead first", None, ahead, "share", "higher"),
        ("bytes as in the first line, median eye", None, float(np.median(each)), "share", "higher"),
        ("bytes as in the first line, worst eye", None, min(each), "share", "higher"),
        ("splats drawn, fewer than without the sidecar", 0.4, fewer, "share", "higher"),
        ("the same, eyes with 45 dB alone", None, float(np.mean(good)) if good else 0.0, "share", "higher"),
        ("eyes that have 45 dB with them", None, float((db >= DRAWN).mean()), "share", "higher"),
        ("worst eye with them", 45.0, float(db.min()), "dB", "higher"),
        ("sidecar, of the scene's bytes", 0.01, scene["sidecar_nbytes"] / scene["nbytes"], "share", "lower"),
    ]
    return name_figures(name, rows)


def main() -> None:
    args = parse_arguments(__doc__)
    found = measure(args.scene, args.work, args)
    question = (
        "How many bytes and splats does a streamed SOG need with the sidecar of needed leaves, and how many without?"
    )
    write_result(args.out, question, figures_of(args.scene, found), {"leaf": args.leaf, "cells": args.cells, **found})


if __name__ == "__main__":
    main()
