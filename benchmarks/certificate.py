"""How much light do visible sets miss, is the bound right, and how large are the sets?

Cells of showroom LOD 3 are drawn at random, and their sets are found as `gsvis pvs` finds them: from viewpoints that
the whole grid shares, some of which look finely, certified and mended by rays. Rays that no build uses then measure the
truth: twenty times as many as certified the cell. A bound that lies below is a violation. Of some of these rays, 2,048
and 8,192, three more are shown: by betting, an empirical Bernstein bound, and the normal approximation, which is no
bound. The sets of some cells are found by the rule that was before it, too: 6 to 24 spread viewpoints at 320 pixels,
until two grow the set by at most 1%. A sample of rays is traced a second time, through the proxy meshes by Open3D's
Embree.

Given: showroom LOD 3, its cells; no levels.
Measured: missed weight over all weight on random rays from free points outside everything solid, in the mean of cells
    and in the worst; violations of the bounds, with the probability of as many if each held with 95%; sizes of sets.
Defaults chosen on: ten other cells of showroom LOD 3 (seed 1), and the stakes of the bound on made-up samples.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from dataclasses import asdict
from typing import Any

import numpy as np
from _cells import DrawnCells, add_cell_arguments, draw_cells, find_sets
from _harness import add_arguments, write_result
from numba import get_num_threads
from numpy.typing import NDArray
from scipy.stats import binom

from gsvis.pvs.bound import upper_bound
from gsvis.pvs.cell_view import CellView
from gsvis.pvs.certificate import Certificate, CertificateConfig, Certifier
from gsvis.pvs.config import PvsConfig
from gsvis.pvs.look import Look
from gsvis.raycast import TAU, CrossCheck, EllipsoidProxies, Tracer, cross_check
from gsvis.scene.solid import buried

F64 = NDArray[np.float64]
FEW, MANY, TIMES = 2048, 8192, 20
LIMITS = (0.0005, 0.0015)  # targets: mean of the cells, worst cell
ERROR = 0.05
JUDGES = 5000  # stage of the rays that judge


def main() -> None:
    parser = add_cell_arguments(add_arguments(argparse.ArgumentParser(description=__doc__)))
    parser.add_argument("--size", type=int, default=PvsConfig.size, help="pixels of a face in building")
    parser.add_argument("--checked", type=int, default=64, help="rays of a cell that are traced twice")
    parser.add_argument("--before", type=int, default=40, help="cells that are also found by the rule before")
    options = parser.parse_args()
    drawn = draw_cells(options)
    tracer = Tracer(EllipsoidProxies.from_scene(drawn.scene))
    config = PvsConfig(size=options.size)
    start = time.perf_counter()
    views = find_sets(drawn, config)
    seconds_to_build = time.perf_counter() - start
    before = find_sets_before(drawn, list(views)[: options.before])
    certifier, true = Certifier(tracer), {}
    start, rays = time.perf_counter(), 0
    for cell, view in views.items():
        true[cell] = judge(certifier, drawn, cell, view, options)
        rays += len(true[cell])
    seconds = time.perf_counter() - start
    start = time.perf_counter()
    twice = [np.concatenate([getattr(each, name) for each in true.values()]) for name in ("checked_o", "checked_d")]
    check = cross_check(tracer, *twice) if options.checked else None
    details = {
        "gaussians": len(drawn.scene),
        "cells_of_the_grid": len(drawn.grid),
        "threads": get_num_threads(),
        "seconds_to_build": seconds_to_build,
        "seconds_for_rays": seconds,
        "seconds_to_cross_check": time.perf_counter() - start,
        "cells": [describe(view, true[cell], before.get(cell)) for cell, view in views.items()],
    }
    write_result(
        options.out,
        "How much light do visible sets miss, is the bound right, and how large are the sets?",
        figures(views, true, before, check, rays / seconds),
        details,
    )


def find_sets_before(drawn: DrawnCells, cells: list[int]) -> dict[int, int]:
    """Return the sizes of the sets by the rule before: spread viewpoints, until the set stops growing."""
    look = Look(drawn.scene, PvsConfig.method, 320, TAU)
    sizes = {}
    for cell in cells:
        held, used, calm = np.zeros(len(drawn.scene), bool), 0, 0
        eyes = drawn.viewpoints.spread(cell, 24)
        for eye in eyes[~buried(drawn.scene, eyes)]:
            ids, weights = look(eye)
            ids = ids[weights >= np.float32(TAU)]
            new = int(np.count_nonzero(~held[ids]))
            held[ids] = True
            used, calm = used + 1, calm + 1 if new <= 0.01 * np.count_nonzero(held) else 0
            if used >= 6 and calm >= 2:
                break
        sizes[cell] = int(np.count_nonzero(held))
        print(f"cell {cell} by the rule before: {sizes[cell]:,} Gaussians", file=sys.stderr, flush=True)
    return sizes


def judge(
    certifier: Certifier, drawn: DrawnCells, cell: int, view: CellView, options: argparse.Namespace
) -> Certificate:
    """Return the certificate of a set by fresh rays, twenty times as many as its own has."""
    config = CertificateConfig(
        limit=0.0, rays=TIMES * view.figures.rays, round_rays=MANY, checked=options.checked, seed=options.seed
    )
    found = certifier.certify(drawn.viewpoints.voxels(cell), view.ids, config, stage=JUDGES)
    if found is None:
        raise SystemExit(f"cell {cell} lies in something solid; take another seed")
    print(found, f"proven {view.figures.bound:.4%}", file=sys.stderr, flush=True)
    return found


def bounds(found: Certificate, count: int) -> dict[str, float]:
    """The estimate of the first `count` rays and three bounds of it."""
    part, whole = found.missed_weights[:count], found.weights[:count]
    share = part.sum() / whole.sum()
    residual = part / whole.mean() - share * whole / whole.mean()
    deviation, log = float(residual.std(ddof=1)), math.log(2.0 / ERROR)
    return {
        "missed": float(share),
        "betting": upper_bound(part, whole, error=ERROR),
        "bernstein": float(share + deviation * math.sqrt(2.0 * log / count) + 7.0 * log / (3.0 * (count - 1))),
        "normal": float(share + 1.645 * deviation / math.sqrt(count)),
        "deviation": deviation,
    }


def figures(
    views: dict[int, CellView],
    true: dict[int, Certificate],
    before: dict[int, int],
    check: CrossCheck | None,
    rate: float,
) -> list[dict[str, Any]]:
    shares = np.array([each.missed for each in true.values()])
    proven = np.array([view.figures.bound for view in views.values()])
    violated = int(np.count_nonzero(proven < shares))
    ratios = [len(views[cell].ids) / size for cell, size in before.items()]
    rows: list[tuple[str, float | None, float, str, str]] = [
        ("missed light, mean of the cells", LIMITS[0], float(shares.mean()), "share", "lower"),
        ("missed light, worst cell", LIMITS[1], float(shares.max()), "share", "lower"),
        ("bound of a cell, mean", None, float(proven.mean()), "share", "lower"),
        ("bound of a cell, worst", LIMITS[1], float(proven.max()), "share", "lower"),
        (f"bounds below the truth, of {len(proven)}", None, violated, "cells", "lower"),
        ("probability of as many if each held with 95%", 0.05, float(binom.sf(violated - 1, len(proven), ERROR)),
         "p", "higher"),
        ("rays that miss more than a hundredth", None, mean_of([e.heavy for e in true.values()]), "share", "lower"),
        ("size of a set over that by the rule before, mean", 1.1, mean_of(ratios), "ratio", "lower"),
        ("viewpoints of a cell", None, mean_of([v.figures.viewpoints for v in views.values()]), "viewpoints", "lower"),
        ("rays that certify a cell", None, mean_of([view.figures.rays for view in views.values()]), "rays", "lower"),
    ]  # fmt: skip
    if not before:
        rows = [row for row in rows if "rule before" not in row[0]]
    for count in (FEW, MANY):
        found = [bounds(each, count) for each in true.values()]
        for kind in ("betting", "bernstein", "normal"):
            rows.append((f"{kind}: bound of {count:,} rays, mean", None, mean(found, kind), "share", "lower"))
    rows.append(("rays a second", None, rate, "rays/s", "higher"))
    if check is not None:
        rows.append(("rays traced twice", None, check.rays, "rays", "higher"))
        rows.append(("rays on which both tracers agree", 1.0, check.agreeing / check.rays, "share", "higher"))
        rows.append(("largest difference of a weight", None, check.largest_difference, "weight", "lower"))
    return [dict(zip(("name", "target", "reached", "unit", "better"), row, strict=True)) for row in rows]


def mean_of(values: list[Any]) -> float:
    return float(np.mean(values)) if values else float("nan")


def mean(rows: list[dict[str, float]], kind: str) -> float:
    return float(np.mean([row[kind] for row in rows]))


def describe(view: CellView, true: Certificate, before: int | None) -> dict[str, Any]:
    return {
        "cell": true.cell,
        "kept": len(view.ids),
        "kept_by_the_rule_before": before,
        "found": asdict(view.figures),
        "truth": true.missed,
        "rays_of_truth": len(true),
        "heavy": true.heavy,
        "light": float(true.weights.mean()),
        "worst_ray": float(true.missed_weights.max()),
    }


if __name__ == "__main__":
    main()
