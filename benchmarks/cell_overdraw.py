"""How near are figures of overdraw from one pixel in sixteen to those of all pixels, and what do they cost?

Given: packages with visible sets (--package, more than once), cells evenly among all of them.
Measured: mean fill, worst fill and splats of the largest of six views around the middle of a cell, by
    `sample_fill_around` over those by `fill_around`; processor time of both, in one thread.
Defaults chosen on: twelve cells of showroom LOD 3 (every fourth pixel in place of every second or eighth).
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
from _harness import add_arguments, need, write_result

from gsvis._kernels.threads import one_thread
from gsvis.package import Package
from gsvis.render import fill_around
from gsvis.render.fill import sample_fill_around


def measure_package(path: str, count: int) -> list[dict[str, Any]]:
    """Return a row for each of `count` cells."""
    rows: list[dict[str, Any]] = []
    with Package.open(path) as package:
        levels = package.contents.levels()
        store = package.visibility
        top = levels.member(len(levels) - 1)
        cells = np.unique(np.linspace(0, len(store) - 1, min(count, len(store))).round().astype(np.int64))
        for cell in [int(cells[0]), *cells.tolist()]:  # the first one twice: it warms up
            ids = store.visible_ids(cell)
            seen = levels.union[ids[top[ids]]]
            eye = store.grid.centers[cell][None]
            began = time.process_time()
            exact = fill_around(seen, eye)
            between = time.process_time()
            sampled = sample_fill_around(seen, eye)
            ended = time.process_time()
            row: dict[str, Any] = {"cell": cell, "seconds": ended - between, "exact_seconds": between - began}
            for name in ("mean", "worst", "splats"):
                row[name] = float(getattr(sampled, name)[0])
                row[f"exact_{name}"] = float(getattr(exact, name)[0])
            rows.append(row)
    return rows[1:]


def figures_of(name: str, rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the figures of one package."""
    ratios = {key: np.array([row[key] / max(row[f"exact_{key}"], 1e-9) for row in rows]) for key in ("mean", "worst")}
    splats = np.array([row["splats"] / max(row["exact_splats"], 1.0) for row in rows])
    apart = np.abs(ratios["mean"] - 1.0)
    seconds = np.array([row["seconds"] for row in rows])
    exact = np.array([row["exact_seconds"] for row in rows])
    of = f"{name}, {len(rows)} cells"
    return [
        {
            "name": f"{of}: mean fill, apart from that of all pixels", "target": 0.03,
            "reached": float(np.median(apart)), "worst": float(apart.max()), "unit": "of it", "better": "lower",
        },
        {
            "name": f"{of}: worst fill over that of all pixels", "target": 0.9,
            "reached": float(np.median(ratios["worst"])), "worst": float(ratios["worst"].min()), "unit": "times",
            "better": "higher",
        },
        {
            "name": f"{of}: splats in a view over those that cover a pixel", "target": None,
            "reached": float(np.median(splats)), "worst": float(splats.max()), "unit": "times", "better": "lower",
        },
        {
            "name": f"{of}: processor time a cell", "target": 0.1, "reached": float(np.median(seconds)),
            "worst": float(seconds.max()), "unit": "s", "better": "lower",
        },
        {
            "name": f"{of}: processor time a cell, all pixels", "target": None, "reached": float(np.median(exact)),
            "worst": float(exact.max()), "unit": "s", "better": "lower",
        },
    ]  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add_arguments(parser)
    parser.add_argument("--package", nargs="+", help="folders of packages with visible sets")
    parser.add_argument("--cells", type=int, default=24)
    args = parser.parse_args()
    need(args.package, "--package, that `gsvis prepare` makes")
    figures: list[dict[str, Any]] = []
    found = {}
    with one_thread():
        for path in args.package:
            name = Path(path).stem
            found[name] = measure_package(path, args.cells)
            figures += figures_of(name, found[name])
    write_result(args.out, __doc__.splitlines()[0], figures, {"cells": found})


if __name__ == "__main__":
    main()
