"""How much light do visible sets miss, and how tight is the bound?

Cells of showroom LOD 3 are drawn at random and built as `gsvis pvs` builds them. The light that each set misses is
bounded by 2,048 and by 8,192 random rays. Twenty times as many other rays stand in for the truth. Beside the bound by
betting are an empirical Bernstein bound of the same rays and the normal approximation, which is no bound. Each 8,192
of the many rays give a bound, too, which is held against all of them. A sample of the rays is traced a second time,
through the proxy meshes by Open3D's Embree.

Given: showroom LOD 3, its cells, sets built with the defaults of `gsvis pvs`.
Measured: missed weight over all weight on random rays from free points outside everything solid, in the mean of cells
    and in the worst; the 95% bound less the estimate; rays a second with one thread or as many as numba has.
Defaults chosen on: the stakes of the bound on made-up samples with a mean of 0.1% and a deviation of 1%.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from typing import Any

import numpy as np
from _cells import DrawnCells, add_cell_arguments, draw_cells
from _harness import add_arguments, write_result
from numba import get_num_threads
from numpy.typing import NDArray

from gsvis.pvs.bound import upper_bound
from gsvis.pvs.cell_view import Finder
from gsvis.pvs.certificate import Certificate, CertificateConfig, Certifier, CrossCheck, cross_check
from gsvis.pvs.config import PvsConfig
from gsvis.pvs.viewpoints import FreeVoxels, SharedViewpoints
from gsvis.raycast import EllipsoidProxies, Tracer
from gsvis.scene.levels import Levels

F64 = NDArray[np.float64]
FEW, MANY, TIMES = 2048, 8192, 20
LIMITS = (0.0005, 0.0015)  # targets: mean of the cells, worst cell
ERROR = 0.05
_TRUTH = 1000  # stage of the rays that stand in for the truth; a build uses 1, 2, ...


def main() -> None:
    parser = add_cell_arguments(add_arguments(argparse.ArgumentParser(description=__doc__)))
    parser.add_argument("--size", type=int, default=PvsConfig.size, help="pixels of a face in building")
    parser.add_argument("--checked", type=int, default=64, help="rays of a cell that are traced twice")
    options = parser.parse_args()
    drawn = draw_cells(options)
    tracer = Tracer(EllipsoidProxies.from_scene(drawn.scene))
    certifier, voxels = Certifier(tracer), drawn.viewpoints.voxels
    config = PvsConfig(size=options.size)
    start = time.perf_counter()
    sets = build_sets(drawn, config)
    seconds_to_build = time.perf_counter() - start
    certifier.certify(voxels(drawn.cells[0]), [], CertificateConfig(limit=0.0, rays=64))  # loads the kernels
    many = CertificateConfig(limit=0.0, rays=MANY, round_rays=FEW, checked=options.checked, seed=options.seed)
    start = time.perf_counter()
    found = [certify(certifier, voxels(cell), ids, many) for cell, ids in sets.items()]
    seconds = time.perf_counter() - start
    truth = CertificateConfig(limit=0.0, rays=TIMES * MANY, round_rays=MANY, seed=options.seed)
    true = [certify(certifier, voxels(cell), ids, truth, stage=_TRUTH) for cell, ids in sets.items()]
    start = time.perf_counter()
    rays = [np.concatenate([getattr(each, name) for each in found]) for name in ("checked_o", "checked_d")]
    check = cross_check(tracer, *rays) if options.checked else None
    seconds_to_check = time.perf_counter() - start
    details = {
        "gaussians": len(drawn.scene),
        "cells_of_the_grid": len(drawn.grid),
        "threads": get_num_threads(),
        "seconds_to_build": seconds_to_build,
        "seconds_for_certificates": seconds,
        "seconds_to_cross_check": seconds_to_check,
        "cells": [describe(*each, len(ids)) for *each, ids in zip(found, true, sets.values(), strict=True)],
    }
    rate = len(found) * MANY / seconds
    write_result(
        options.out,
        "How much light do visible sets miss, and how tight is the bound?",
        figures(found, true, check, rate),
        details,
    )


def build_sets(drawn: DrawnCells, config: PvsConfig) -> dict[int, NDArray[np.int32]]:
    """Return the visible set of each drawn cell, by number."""
    finder, shared = Finder(Levels.single(drawn.scene), config), SharedViewpoints(drawn.viewpoints)
    sets = {}
    for cell in drawn.cells:
        sightings = [finder.look(shared.points[k]) for k in shared.of_cell(cell).tolist()]
        sets[cell] = finder.find_cell(drawn.viewpoints.voxels(cell), sightings).ids
        print(f"cell {cell}: {len(sets[cell]):,} Gaussians", file=sys.stderr, flush=True)
    return sets


def certify(
    certifier: Certifier, voxels: FreeVoxels, ids: NDArray[np.int32], config: CertificateConfig, stage: int = 0
) -> Certificate:
    found = certifier.certify(voxels, ids, config, stage=stage)
    if found is None:
        raise SystemExit(f"cell {voxels.cell} lies in something solid; take another seed")
    print(found, file=sys.stderr, flush=True)
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
    found: list[Certificate], true: list[Certificate], check: CrossCheck | None, rate: float
) -> list[dict[str, Any]]:
    few, many = ([bounds(each, count) for each in found] for count in (FEW, MANY))
    shares = [each.missed for each in true]
    violated = [bounds_below(each) for each in true]
    rows: list[tuple[str, float | None, float, str, str]] = [
        ("missed light, mean of the cells", LIMITS[0], float(np.mean(shares)), "share", "lower"),
        ("missed light, worst cell", LIMITS[1], max(shares), "share", "lower"),
        ("rays that miss more than a hundredth", None, float(np.mean([each.heavy for each in true])), "share", "lower"),
        (f"bounds of 8,192 rays below the truth, of {TIMES * len(true)}", 0.05, mean_of(violated), "share", "lower"),
    ]
    for count, each in ((FEW, few), (MANY, many)):
        for kind in ("betting", "bernstein", "normal"):
            rows.append((f"{kind}: bound of {count:,} rays, mean", None, mean(each, kind), "share", "lower"))
    rows.append(("betting: bound of 8,192 rays, worst cell", None, max(e["betting"] for e in many), "share", "lower"))
    rows.append(("rays a second", None, rate, "rays/s", "higher"))
    if check is not None:
        rows.append(("rays traced twice", None, check.rays, "rays", "higher"))
        rows.append(("rays on which both tracers agree", 1.0, check.agreeing / check.rays, "share", "higher"))
        rows.append(("largest difference of a weight", None, check.largest_difference, "weight", "lower"))
    return [dict(zip(("name", "target", "reached", "unit", "better"), row, strict=True)) for row in rows]


def bounds_below(true: Certificate) -> float:
    """Return the share of bounds of 8,192 of these rays at a time that lie below the share on all of them."""
    parts = zip(np.split(true.missed_weights, TIMES), np.split(true.weights, TIMES), strict=True)
    return mean_of([upper_bound(*part, error=ERROR) < true.missed for part in parts])


def mean_of(values: list[float] | list[bool]) -> float:
    return float(np.mean(values))


def mean(rows: list[dict[str, float]], kind: str) -> float:
    return float(np.mean([row[kind] for row in rows]))


def describe(found: Certificate, true: Certificate, kept: int) -> dict[str, Any]:
    return {
        "cell": found.cell,
        "kept": kept,
        "truth": true.missed,
        "rays_of_truth": len(true),
        "few": bounds(found, FEW),
        "many": bounds(found, MANY),
        "heavy": true.heavy,
        "light": float(true.weights.mean()),
        "worst_ray": float(true.missed_weights.max()),
        "missed_gaussians": len(found.ids),
    }


if __name__ == "__main__":
    main()
