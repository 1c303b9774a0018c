"""Do the eyes that a person would choose lie in the cells that gsvis finds?

Thirty eyes a scene were chosen by hand, with the kinds and up axes that are right. Each scene is tried as it is, and
turned at random, scaled between 1e-3 and 1e3, with a shell of large outliers out to 5,000 times its core.
A kind or an up axis is right, or gsvis says that it is not sure; confidently wrong is counted apart.

Given: scenes, eyes chosen by hand, seeds of the transforms.
Measured: share of the eyes in cells; kind and up axis with their confidences. `chosen_images.py` draws what they see.
Defaults chosen on: other seeds; the eyes were chosen from renders before anything was measured.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from _chosen_eyes import CHOSEN, Chosen, bonsai, load_chosen
from _harness import add_arguments, realdata, write_result
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gsvis.errors import SceneError
from gsvis.pvs.cells import CellGrid
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.upright import SURE, find_up

F64 = NDArray[np.float64]

QUESTION = "Do the eyes that a person would choose lie in the cells that gsvis finds?"
OUTLIERS = 0.02  # of the Gaussians
FARTHEST = 5000.0  # sizes of the core
DEGREES = 10.0


@dataclass(frozen=True)
class Moved:
    """A scene after a random transform, and what a person says of it."""

    gaussians: Gaussians
    chosen: Chosen
    name: str


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--seed", type=int, default=20261128)
    parser.add_argument("--scenes", nargs="*", help="names; all by default")
    parser.add_argument("--bonsai", help="a scene trained on the photographs of bonsai")
    parser.add_argument("--as-is", action="store_true", help="without transforms")
    options = parser.parse_args()
    folder = realdata()
    every = [*CHOSEN, *([bonsai(options.bonsai, folder)] if options.bonsai else [])]
    rows = []
    for number, chosen in enumerate(every):
        if options.scenes and chosen.name not in options.scenes:
            continue
        g = load_chosen(chosen, folder)
        tries = [Moved(g, chosen, chosen.name)]
        if not options.as_is:
            tries.append(move(g, chosen, np.random.default_rng([options.seed, number])))
        for tried in tries:
            row = judge(tried)
            rows.append(row)
            print(" ".join(f"{key}={value}" for key, value in row.items()), flush=True)
    write_result(options.out, QUESTION, summarize(rows), {"seed": options.seed, "scenes": rows})


def summarize(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the figures."""
    shares = [row["eyes_in_cells"] for row in rows]
    right = sum(row["kind_verdict"] != "wrong" and row["up_verdict"] != "wrong" for row in rows)
    wrong = len(rows) - right
    enough = sum(share >= 0.9 for share in shares)
    return [
        figure("scenes with kind and up right, or not sure, of 26", 24, 26 * right / len(rows), "scenes", "higher"),
        figure("scenes confidently wrong", 0, wrong, "scenes", "lower"),
        figure("share of scenes with 90% of the eyes in cells", 1.0, enough / len(rows), "", "higher"),
        figure("median share of eyes in cells", 0.9, float(np.median(shares)), "", "higher"),
        figure("least share of eyes in cells", 0.9, min(shares), "", "higher"),
    ]


def figure(name: str, target: float, reached: float, unit: str, better: str) -> dict[str, Any]:
    return {"name": name, "target": target, "reached": reached, "unit": unit, "better": better}


def move(g: Gaussians, chosen: Chosen, rng: np.random.Generator) -> Moved:
    """Return a scene that is turned, scaled, and inside a shell of outliers."""
    turn = Rotation.random(random_state=int(rng.integers(1 << 31))).as_matrix()
    scale = float(10.0 ** rng.uniform(-3.0, 3.0))
    shelled = Gaussians.concatenate([g, shell(g, rng)])
    eyes, targets = (scale * points @ turn.T for points in (chosen.eyes, chosen.targets))
    up = tuple(tuple(float(v) for v in turn @ np.array(each)) for each in chosen.up)
    moved = replace(chosen, eyes=eyes, targets=targets, up=up)
    return Moved(shelled.transform(turn, scale=scale), moved, f"{chosen.name}, moved")


def shell(g: Gaussians, rng: np.random.Generator) -> Gaussians:
    """Return outliers around a scene: log-uniform from 3 to 5,000 sizes of its middle half, large as they are far."""
    low, high = np.quantile(g.means, [0.25, 0.75], axis=0).astype(np.float64)
    size, middle = float(np.linalg.norm(high - low)), 0.5 * (low + high)
    count = max(20, round(OUTLIERS * len(g)))
    ways = rng.normal(size=(count, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    distances = size * np.exp(rng.uniform(np.log(3.0), np.log(FARTHEST), count))
    scales = distances[:, None] * np.exp(rng.uniform(np.log(0.002), np.log(0.05), (count, 3)))
    color = np.pad(rng.normal(0.0, 1.0, (count, 1, 3)), ((0, 0), (0, g.shN.shape[1]), (0, 0)))
    return Gaussians(
        middle + distances[:, None] * ways,
        rng.normal(size=(count, 4)),
        scales,
        rng.uniform(0.05, 1.0, count),
        color[:, :1],
        color[:, 1:] if g.shN.shape[1] else None,
    )


def judge(tried: Moved) -> dict[str, Any]:
    """Return what gsvis says of a scene beside what a person says."""
    g, chosen = tried.gaussians, tried.chosen
    began = time.perf_counter()
    found = find_up(g)
    row: dict[str, Any] = {"scene": tried.name, "gaussians": len(g)}
    off = min((degrees(found.up, np.array(up)) for up in chosen.up), default=0.0)
    row |= {"up_off_degrees": round(off, 1), "up_confidence": round(found.confidence, 2)}
    row["up_verdict"] = verdict(off <= DEGREES, found.confidence)
    try:
        space = NavigableSpace.from_scene(g)
    except SceneError as error:
        return row | {"kind": "none", "kind_verdict": "not sure", "eyes_in_cells": 0.0, "error": error.problem}
    row["seconds"] = round(time.perf_counter() - began, 1)
    kind = space.kind
    fits = any(each in kind.kind for each in chosen.kinds)
    row |= {"kind": kind.kind, "kind_confidence": round(kind.confidence, 2)}
    row["kind_verdict"] = verdict(fits, kind.confidence)
    grid = CellGrid.over(space)
    held = grid.cell_at(chosen.eyes) >= 0
    row |= {"cells": len(grid), "eyes_in_cells": round(float(held.mean()), 3)}
    return row


def verdict(right: bool, confidence: float) -> str:
    """Return "right", "not sure", or "wrong" for what is confidently wrong."""
    if right:
        return "right"
    return "not sure" if confidence < SURE else "wrong"


def degrees(one: F64, other: F64) -> float:
    """Return the angle between two directions."""
    cosine = float(one @ other) / float(np.linalg.norm(one) * np.linalg.norm(other))
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


if __name__ == "__main__":
    main()
