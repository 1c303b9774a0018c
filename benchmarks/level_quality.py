"""How many splats does a wanted PSNR need, as the sidecar of Streamed SOG expects it, and is it there?

Given: scenes, visible sets, eyes and exports of `level_choice.py` (--work of that benchmark), every second eye.
Measured: splats of the choice of `examples/engines/level-choice.js` that ends at an expected PSNR, against all at the
    finest level, with no other budget; its PSNR against a picture of everything at the finest level. The choice counts
    what is behind the eye a sixteenth, so it keeps something there; an engine culls it either way.
Defaults chosen on: none; the expected PSNR of 50 was looked at on the walks through nika, with 35, 40 and 45.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from _harness import add_arguments, need, write_result
from _leaves import name_figures
from level_choice import CELLS, Eyes, Written, ask, find_eyes, open_scene

from gsvis.render import psnr

WANTED = (40.0, 50.0)
EACH = 20  # eyes on each of two walks, of which every second is used


def measure(folder: Path, eyes: Eyes) -> list[dict[str, Any]]:
    """Return splats and PSNR of every second eye at each wanted PSNR."""
    written = Written(folder)
    finest = np.zeros(written.counts.shape[1], np.int64)
    chosen = {wanted: ask(folder, eyes, [None] * len(eyes.positions), wanted) for wanted in WANTED}
    rows = []
    for k in range(0, len(eyes.positions), 2):
        full = written.draw(finest, eyes.cameras[k])
        row: dict[str, Any] = {"eye": k}
        for wanted in WANTED:
            lods = np.array(chosen[wanted][k]["lods"])
            row[f"splats_{wanted:g}"] = written.splats(lods) / written.splats(finest)
            row[f"db_{wanted:g}"] = min(float(psnr(written.draw(lods, eyes.cameras[k]), full)), 100.0)
        rows.append(row)
        print(eyes.kind, rows[-1], flush=True)
    return rows


def figures_of(scene: str, kind: str, rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the figures of the eyes of one kind."""
    least = 0.4 if scene == "showroom" else 0.25
    out: list[tuple[Any, ...]] = []
    for wanted in WANTED:
        db = np.array([row[f"db_{wanted:g}"] for row in rows])
        fewer = 1.0 - float(np.mean([row[f"splats_{wanted:g}"] for row in rows]))
        out += [
            (f"{wanted:g} dB: splats drawn, fewer than all", least, fewer, "share", "higher"),
            (f"{wanted:g} dB: eyes that have it", None, float((db >= wanted).mean()), "share", "higher"),
            (f"{wanted:g} dB: median eye", wanted, float(np.median(db)), "dB", "higher"),
            (f"{wanted:g} dB: worst eye", None, float(db.min()), "dB", "higher"),
        ]
    return name_figures(f"{scene}, {kind}", out)


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--work", type=Path, help="folder with the exports that level_choice.py wrote")
    args = parser.parse_args()
    need(args.work, "--work DIR: the folder of level_choice.py")
    figures: list[dict[str, Any]] = []
    details: dict[str, Any] = {}
    for scene in CELLS:
        _, space = open_scene(scene)
        for eyes in find_eyes(space, EACH):
            found = measure(args.work / f"{scene}-levels", eyes)
            details[f"{scene}, {eyes.kind}"] = found
            figures += figures_of(scene, eyes.kind, found)
    question = "How many splats does a wanted PSNR need, as the sidecar of Streamed SOG expects it, and is it there?"
    write_result(args.out, question, figures, details)


if __name__ == "__main__":
    main()
