"""The choice of levels in plain Python, as examples/engines/level-choice.js makes it, and cases for both.

python -m tests.export.choosing --write     # after a change of what is chosen
"""

from __future__ import annotations

import itertools
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

CASES = Path(__file__).with_name("level_choice.json")
ROOTS = (1.0, 1.189207115002721, 1.4142135623730951, 1.681792830507429)
Step = tuple[int, int]


def power(quarters: int) -> float:
    """Return 2 to the power of so many quarters, bit for bit as the program does."""
    return float(ROOTS[quarters % 4] * 2.0 ** (quarters // 4))


def choose(
    case: dict[str, Any], *, guard: bool = True, quality: float = float("inf"), fill: bool = True, turned: bool = False
) -> tuple[list[int], int]:
    """Return the level of each leaf within the splats of a case, -1 for not drawn, and the splats.

    Args:
        case: A case.
        guard: Begin with the choice by distance for what is seen, and serve that first.
        quality: PSNR at which to end.
        fill: Spend what is left in each phase on what the cell does not see; not for a PSNR.
        turned: Look at the leaves that `ahead` names, not at all.
    """
    count = len(case["lights"])
    guarded = guard and case["splats"] < float("inf")
    ahead = [not turned or leaf in case["ahead"] for leaf in range(count)]
    fills = fill and case["splats"] < float("inf") and quality == float("inf")
    sees = [light > 0 or (fills and beside > 0) for light, beside in zip(case["lights"], case["beside"], strict=True)]
    seen = [guarded and a and s for a, s in zip(ahead, sees, strict=True)]
    distance = by_distance(case, turned) if guarded else [-1] * count
    lods = [lod if s else -1 for lod, s in zip(distance, seen, strict=True)]
    splats = sum(case["counts"][leaf][lod] for leaf, lod in enumerate(lods) if lod >= 0)
    lights = worths(case, False, turned)
    turns = [lights, worths(case, True, turned)] if fills else [lights]
    enough = 10.0 ** (-quality / 10.0) * sum(lights) if quality < float("inf") else -1.0
    coarsest = [max((lod for lod, n in enumerate(row) if n), default=-1) for row in case["counts"]]
    back = [d if a and d >= 0 else c for d, a, c in zip(distance, ahead, coarsest, strict=True)]
    phases = [[0 if s else c for s, c in zip(seen, rest, strict=True)] for rest in (coarsest, back)] if guarded else []
    for last, some in itertools.product([*phases, [0] * count], turns):
        for leaf, lod, paid in steps(case, "counts", case["splats"] - splats, last, lods, some):
            if sum(light * error(case, k, lods[k]) for k, light in enumerate(lights)) <= enough:
                break
            lods[leaf] = lod
            splats += paid
    return lods, splats


def worths(case: dict[str, Any], fill: bool, turned: bool) -> list[float]:
    """Return the worth of each leaf: its light, and a little of that in neighboring cells and in any cell."""
    parts = [(1.0, case["lights"]), *([(1 / 64, case["beside"]), (1 / 4096, case["everywhere"])] if fill else [])]
    near = [1.0 if not turned or leaf in case["ahead"] else 1 / 16 for leaf in range(len(case["lights"]))]
    return [max(n * share * light_of(row[leaf]) for share, row in parts) for leaf, n in enumerate(near)]


def light_of(byte: int) -> float:
    """Return the light of a byte; 0 is none."""
    return power(byte - 255) if byte else 0.0


def by_distance(case: dict[str, Any], turned: bool = False) -> list[int]:
    """Return the levels that an engine chooses by distance from the origin, -1 for all if the coarsest do not fit."""
    counts, boxes = np.array(case["counts"]), np.array(case["boxes"])
    levels = [[lod for lod, count in enumerate(row) if count] for row in case["counts"]]
    lods = [own[-1] if own else -1 for own in levels]
    left = case["splats"] - sum(int(counts[leaf, lod]) for leaf, lod in enumerate(lods) if lod >= 0)
    if left < 0:
        return [-1] * len(levels)
    half = (boxes[:, 1] - boxes[:, 0]) / 2.0
    shrunk = 0.75 * np.maximum(half - np.sort(half, axis=0)[len(half) // 2], 0.0)
    away = np.clip(0.0, boxes[:, 0] + shrunk, boxes[:, 1] - shrunk)
    distances = np.maximum(np.sqrt(np.square(away).sum(axis=1)), 1e-6)
    if turned:  # to +x
        distances = distances * np.where(distances > 1e-2, 1.0 + np.maximum(-away[:, 0] / distances, 0.0) / 2.0, 1.0)
    finer = [(leaf, k) for leaf, own in enumerate(levels) for k in range(len(own) - 1)]
    for leaf, k in sorted(finer, key=lambda step: distances[step[0]] / 3.0 ** (levels[step[0]][step[1]] + 1)):
        paid = int(counts[leaf, levels[leaf][k]] - counts[leaf, levels[leaf][k + 1]])
        if paid > left:
            break
        left -= paid
        lods[leaf] = levels[leaf][k]
    return lods


def order(case: dict[str, Any], lods: list[int]) -> list[Step]:
    """Return the files in the order to load, within the bytes of a case."""
    left = case["most_bytes"]
    found: list[Step] = []
    there = [-1] * len(lods)
    for fill in (False, True):
        for leaf, lod, paid in steps(case, "bytes", left, lods, there, worths(case, fill, False)):
            found.append((leaf, lod))
            there[leaf] = lod
            left -= paid
    for leaf, lod in enumerate(lods):  # what has no less error than a coarser level comes last
        if lod >= 0 and (leaf, lod) not in found and case["bytes"][leaf][lod] <= left:
            found.append((leaf, lod))
            left -= case["bytes"][leaf][lod]
    return found


def steps(
    case: dict[str, Any], unit: str, left: float, last: list[int], first: list[int], lights: list[float]
) -> list[tuple[int, int, int]]:
    """Take one step after the other: of all that fit, the one that removes most error for its cost."""
    at = list(first)
    taken = []
    while True:
        best: tuple[float, int, int, int] | None = None
        for leaf, light in enumerate(lights):
            own = best_step(case, leaf, light, at[leaf], unit, left, last[leaf])
            if own is not None and (best is None or own[0] > best[0]):
                best = own
        if best is None:
            return taken
        _, leaf, lod, paid = best
        left -= paid
        at[leaf] = lod
        taken.append((leaf, lod, paid))


def best_step(
    case: dict[str, Any], leaf: int, light: float, at: int, unit: str, left: float, last: int
) -> tuple[float, int, int, int] | None:
    """Return (gain, leaf, level, cost) of the best step of one leaf that fits."""
    if light == 0.0 or last < 0:
        return None
    costs = case[unit][leaf]
    now = error(case, leaf, at)
    best: tuple[float, int, int, int] | None = None
    for lod in range((len(costs) if at < 0 else at) - 1, last - 1, -1):
        if case["counts"][leaf][lod] == 0 or error(case, leaf, lod) >= now:
            continue
        paid = costs[lod] - (costs[at] if at >= 0 and unit == "counts" else 0)
        gain = light * (now - error(case, leaf, lod)) / max(paid, 1)
        if paid <= left and (best is None or gain > best[0]):
            best = (gain, leaf, lod, paid)
    return best


def error(case: dict[str, Any], leaf: int, lod: int) -> float:
    """Return the error of a leaf at a level, -1 for not drawn."""
    byte = int(case["errors"][leaf][lod])
    if lod < 0:
        return float(case["absent"])
    return power(byte - 255) if byte else 0.0


def make_case(seed: int) -> dict[str, Any]:
    """Return a random case: leaves with levels, some of them missing, and budgets for a part of them."""
    rng = np.random.default_rng(seed)
    leaves, levels = int(rng.integers(1, 12)), int(rng.integers(1, 5))
    finest = rng.integers(50, 8000, leaves)
    counts = np.maximum(finest[:, None] // 3 ** np.arange(levels), 1)
    counts[rng.random(counts.shape) < 0.1] = 0
    errors = np.minimum(255, rng.integers(120, 200, leaves)[:, None] + rng.integers(4, 16, levels).cumsum())
    errors[:, 0] = 0
    low = rng.uniform(-10.0, 10.0, (leaves, 3)).round(3)
    high = (low + rng.uniform(0.5, 6.0, (leaves, 3))).round(3)
    return {
        "absent": 0.125,
        "boxes": np.stack([low, high], axis=1).tolist(),
        "lights": (rng.integers(1, 255, leaves) * (rng.random(leaves) < 0.8)).tolist(),
        "beside": (rng.integers(1, 255, leaves) * (rng.random(leaves) < 0.5)).tolist(),
        "everywhere": rng.integers(1, 256, leaves).tolist(),
        "ahead": np.flatnonzero(rng.random(leaves) < 0.6).tolist(),
        "counts": counts.tolist(),
        "bytes": (counts * 9 + (counts > 0) * 800).tolist(),
        "errors": (errors * (counts > 0)).tolist(),
        "splats": int(rng.uniform(0.1, 1.2) * finest.sum()),
        "most_bytes": int(rng.uniform(0.1, 1.2) * 9 * finest.sum()),
    }


def solved(case: dict[str, Any]) -> dict[str, Any]:
    """Return a case with what is to be chosen."""
    lods, splats = choose(case)
    return {**case, "lods": lods, "drawn": splats, "order": [list(step) for step in order(case, lods)]}


if __name__ == "__main__" and sys.argv[1:] == ["--write"]:
    lines = ",\n".join(json.dumps(solved(make_case(seed))) for seed in range(24))
    CASES.write_text(f"[\n{lines}\n]\n")
