"""What does it gain, and cost, to spend the rest of a budget of splats on leaves that the cell does not see?

`examples/engines/level-choice.js` with `fill` and without, at the budgets of `level_choice.py` and on its exports.

Given: the scenes and visible sets of `level_choice.py` (--work of that benchmark), its walks, and as many random eyes
    of --seed.
Measured: PSNR of both choices against a picture of everything at the finest level, counted up to 50 dB; splats of both,
    of the budget; 480 x 360, 80 degrees wide.
Defaults chosen on: random eyes of seeds 2033 and 2028 and some of each walk: that what is seen comes first in each
    phase, and that `fill` is on where nobody says so. Unseen leaves took part in every step before: 1.3 and 3.4 dB.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from _harness import add_arguments, need, write_result
from _leaves import name_figures
from level_choice import BUDGETS, EVEN, Eyes, Written, ask, find_eyes, open_scene, write

from gsvis.render import psnr


def measure(folder: Path, eyes: Eyes, budget: int) -> list[dict[str, float]]:
    """Return what each eye shows with and without `fill`."""
    written = Written(folder)
    choices = {fill: ask(folder, eyes, [budget] * len(eyes.positions), fill=fill) for fill in (False, True)}
    rows = []
    for k, camera in enumerate(eyes.cameras):
        full = written.draw(np.zeros(written.counts.shape[1], np.int64), camera)
        row: dict[str, float] = {}
        for fill, found in choices.items():
            lods = np.array(found[k]["lods"])
            name = "with" if fill else "without"
            row[f"db_{name}"] = min(float(psnr(written.draw(lods, camera), full)), EVEN)
            row[f"splats_{name}"] = written.splats(lods) / budget
        rows.append(row)
    return rows


def figures_of(name: str, rows: list[dict[str, float]]) -> list[dict[str, Any]]:
    """Return the figures of the eyes of one kind at one budget."""
    columns = {key: np.array([row[key] for row in rows]) for key in rows[0]}
    gained = columns["db_with"] - columns["db_without"]
    out: list[tuple[Any, ...]] = [
        ("mean dB gained", None, float(gained.mean()), "dB", "higher"),
        ("most dB gained", None, float(gained.max()), "dB", "higher"),
        ("most dB lost", None, float(-gained.min()), "dB", "lower"),
    ]
    for kind in ("without", "with"):
        out += [
            (f"worst eye {kind}", None, float(columns[f"db_{kind}"].min()), "dB", "higher"),
            (f"splats {kind}, of the budget", None, float(columns[f"splats_{kind}"].mean()), "share", "lower"),
        ]
    return name_figures(name, out)


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--work", type=Path, help="folder of level_choice.py with its visible sets")
    parser.add_argument("--eyes", type=int, default=6, help="on each of the two walks; twice as many random ones")
    parser.add_argument("--seed", type=int, default=2037, help="of the random eyes")
    args = parser.parse_args()
    need(args.work, "--work DIR: that of level_choice.py")
    figures: list[dict[str, Any]] = []
    details: dict[str, Any] = {}
    for scene, budgets in BUDGETS.items():
        levels, space = open_scene(scene)
        folder, _ = write(args.work, scene, levels, space)
        for eyes in find_eyes(space, args.eyes, args.seed):
            for budget in budgets:
                name = f"{scene}, {eyes.kind}, {budget:,} splats"
                details[name] = measure(folder, eyes, budget)
                figures += figures_of(name, details[name])
                print(name, figures[-7:], flush=True)
    question = "What does it gain to spend the rest of a budget on leaves that the cell does not see?"
    write_result(args.out, question, figures, details)


if __name__ == "__main__":
    main()
