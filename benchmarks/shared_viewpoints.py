"""Within which distance should viewpoints near the corners of cells be one?

The fewer viewpoints, the fewer looks, and the more a cell must be mended: its certificate asks for rays and inner
viewpoints. Cells are drawn at random and found as `gsvis pvs` finds them, with viewpoints merged within some distances.
Rays that no build uses judge the sets. Processor time is that of one process; the time of all cells is estimated from a
look and a cell, since neighbors that were not drawn share looks too.

<<<<<<< HEAD
Given: showroom LOD 3, or a folder of levels (`--levels`); its cells.
Measured: viewpoints of all cells; inner ones; missed weight over all weight on fresh rays, of the highest level; the
    size of the sets; processor seconds of a look, of a cell, and of all.
Defaults chosen on: showroom LOD 3 with levels of 25 and 50%, cells of seed 1: the distance of 3.5 voxels.
=======
Cells of showroom LOD 3 are drawn at random. Their sets from corners alone are certified, with faces of several sizes.
Then inner viewpoints are added one by one, where the worst ray of a certificate began, with what this certificate found
missing; beside it, with what it found alone, and with viewpoints spread over the cell.

Given: showroom LOD 3, its cells, the hybrid method.
Measured: missed weight over all weight on rays that no step has used; the size of the sets; looks.
Defaults chosen on: showroom LOD 3, the scene that is measured, at 0, 1.8 and 3.5 voxels.
>>>>>>> 60238c0e481806a6c04b17787689d9b04eed06ba
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from _cells import add_cell_arguments, draw_cells
from _harness import add_arguments, write_result
from numpy.typing import NDArray

from gsvis.io.levels import load_levels
from gsvis.pvs.cell_view import CellView, Finder, Sighting
from gsvis.pvs.certificate import CertificateConfig, Certifier
from gsvis.pvs.config import PvsConfig
<<<<<<< HEAD
from gsvis.pvs.viewpoints import CellViewpoints, SharedViewpoints
from gsvis.raycast import EllipsoidProxies, Tracer
from gsvis.scene.levels import Levels
=======
from gsvis.pvs.look import Look
from gsvis.pvs.viewpoints import CellViewpoints, FreeVoxels
from gsvis.raycast import TAU, EllipsoidProxies, Tracer
>>>>>>> 60238c0e481806a6c04b17787689d9b04eed06ba

JUDGE = CertificateConfig(limit=0.0, rays=16384, round_rays=8192)
_JUDGED = 5000  # stage of the rays that judge
QUESTION = "Within which distance should viewpoints near the corners of cells be one?"


@dataclass
class Trial:
    """Cells found with viewpoints merged within one distance."""

    viewpoints: int
    cells: int
    views: dict[int, CellView] = field(default_factory=dict)
    missed: list[float] = field(default_factory=list)
    kept: list[int] = field(default_factory=list)
    looking: list[float] = field(default_factory=list)
    finding: list[float] = field(default_factory=list)

    def rows(self) -> list[tuple[str, float, str]]:
        look, cell = float(np.mean(self.looking)), float(np.mean(self.finding))
        inner = [view.figures.inner for view in self.views.values()]
        return [
            ("viewpoints of all cells", self.viewpoints, "viewpoints"),
            ("inner viewpoints a cell", float(np.mean(inner)), "viewpoints"),
            ("missed light, mean", float(np.mean(self.missed)), "share"),
            ("missed light, worst cell", max(self.missed), "share"),
            ("Gaussians of a set", float(np.mean(self.kept)), "Gaussians"),
            ("processor time of a look", look, "s"),
            ("processor time of a cell", cell, "s"),
            ("processor time of all cells", look * self.viewpoints + cell * self.cells, "s"),
        ]


def main() -> None:
    parser = add_cell_arguments(add_arguments(argparse.ArgumentParser(description=__doc__)))
    parser.add_argument("--levels", help="folder that `gsvis levels` made of the scene")
    parser.add_argument("--merged", type=float, nargs="+", default=[1.8, 3.5, 5.0], help="distances, voxels")
    options = parser.parse_args()
    drawn = draw_cells(options)
<<<<<<< HEAD
    levels = load_levels(options.levels) if options.levels else Levels.single(drawn.scene)
    finder = Finder(levels, PvsConfig())
    finder.warm()
    judge = Certifier(Tracer(EllipsoidProxies.from_scene(levels.level(len(levels) - 1))))
    listed: list[dict[str, Any]] = []
    for merged in options.merged:
        trial = run(finder, judge, drawn.viewpoints, drawn.cells, merged)
        for name, value, unit in trial.rows():
            row = {"name": f"within {merged:g} voxels: {name}", "target": None, "reached": value, "unit": unit}
            listed.append({**row, "better": "lower"})
            print(f"within {merged:g}: {name} {value:.4g} {unit}", file=sys.stderr, flush=True)
    details = {"gaussians": len(levels.union), "levels": levels.counts, "cells_of_the_grid": len(drawn.grid)}
    write_result(options.out, QUESTION, listed, details)


def run(finder: Finder, judge: Certifier, viewpoints: CellViewpoints, cells: tuple[int, ...], merged: float) -> Trial:
    """Find the sets of cells with viewpoints merged within a distance."""
    shared = SharedViewpoints(viewpoints, merged=merged)
    trial = Trial(len(shared), len(viewpoints.grid))
    seen: dict[int, Sighting] = {}
    top = finder.levels.member(len(finder.levels) - 1)
    for cell in cells:
        for k in shared.of_cell(cell).tolist():
            if k not in seen:
                began = time.process_time()
                seen[k] = finder.look(shared.points[k], lower=bool(shared.lower[k]))
                trial.looking.append(time.process_time() - began)
        began = time.process_time()
        view = finder.find_cell(viewpoints.voxels(cell), [seen[k] for k in shared.of_cell(cell).tolist()])
        trial.finding.append(time.process_time() - began)
        trial.views[cell] = view
        held: NDArray[np.bool_] = np.zeros(len(finder.levels.union), bool)
        held[view.ids] = True
        trial.kept.append(int(np.count_nonzero(held & top)))
        found = judge.certify(viewpoints.voxels(cell), np.flatnonzero(held[top]), JUDGE, stage=_JUDGED)
        if found is None:
            raise SystemExit(f"cell {cell} lies in something solid; take another seed")
        trial.missed.append(found.missed)
    return trial
=======
    corners = Corners(drawn.viewpoints, options.rule, options.merge)
    lattice, distinct = corners.count()
    print(f"{lattice} corners of the grid, {distinct} viewpoints", file=sys.stderr)
    certifier = Certifier(Tracer(EllipsoidProxies.from_scene(drawn.scene)))
    trials: dict[str, list[dict[str, Any]]] = {}
    for size in options.sizes:
        look = Look(drawn.scene, PvsConfig.method, size, TAU)
        for cell in drawn.cells:
            inner = options.inner if size == options.sizes[0] else 0
            for name, row in try_cell(look, certifier, corners, cell, inner):
                trials.setdefault(name, []).append(row)
                print(f"cell {cell}, {name}: {row['missed']:.4%}, {row['kept']:,}", file=sys.stderr, flush=True)
    rows = [
        ("corners of the grid", lattice, "corners", "lower"),
        ("viewpoints on corners, all cells", distinct, "viewpoints", "lower"),
        ("viewpoints on corners, of one cell", distinct / len(drawn.grid), "looks a cell", "lower"),
    ]
    for name, trial in trials.items():
        rows.append((f"{name}: missed light, mean", mean(trial, "missed"), "share", "lower"))
        rows.append((f"{name}: missed light, worst cell", max(row["missed"] for row in trial), "share", "lower"))
        rows.append((f"{name}: Gaussians of a set", mean(trial, "kept"), "Gaussians", "lower"))
        rows.append((f"{name}: looks a cell", mean(trial, "looks"), "looks", "lower"))
    write_result(
        options.out,
        "What do viewpoints on the corners of cells see, and what do inner ones add?",
        [{"name": n, "target": None, "reached": v, "unit": u, "better": b} for n, v, u, b in rows],
        {
            "gaussians": len(drawn.scene),
            "rule": options.rule,
            "merge": options.merge,
            "cells_of_the_grid": len(drawn.grid),
            "trials": trials,
        },
    )


class Corners:
    """The viewpoints on the corners of cells, by one of two rules."""

    def __init__(self, viewpoints: CellViewpoints, rule: str, merge: float) -> None:
        self.viewpoints, self.rule = viewpoints, rule
        self._side = round(viewpoints.grid.cell_size / viewpoints.space.voxel_size)
        self._free = np.argwhere(viewpoints.space.free)
        self._moved: dict[tuple[int, ...], tuple[tuple[int, ...], F64]] = {}
        self._stands_for: dict[tuple[int, ...], tuple[tuple[int, ...], F64]] = {}
        if merge:
            self._stands_for = self._merge(merge * viewpoints.space.voxel_size)

    def of_cell(self, cell: int) -> dict[tuple[int, ...], F64]:
        """Return the viewpoints on the corners of a cell, by a key that cells share with the viewpoint."""
        some = self.viewpoints.voxels(cell).voxels if self.rule == "own" else self._free
        found = {}
        for offset in _CORNERS:
            corner = (self.viewpoints.grid.coords[cell] + np.array(offset)) * self._side
            name = (*corner.tolist(), cell if self.rule == "own" else -1)
            if name not in self._moved:
                self._moved[name] = self._nearest(corner, some)
            key, point = self._moved[name]
            key, point = self._stands_for.get(key, (key, point))
            found[key] = point
        return found

    def _merge(self, near: float) -> dict[tuple[int, ...], tuple[tuple[int, ...], F64]]:
        """Return the viewpoint that stands for each: the first one not farther away."""
        known = {key: point for cell in range(len(self.viewpoints.grid)) for key, point in self.of_cell(cell).items()}
        keys, points = list(known), np.array(list(known.values()))
        merged: dict[tuple[int, ...], tuple[tuple[int, ...], F64]] = {}
        for key, point in known.items():
            if key not in merged:
                for k in np.flatnonzero(np.linalg.norm(points - point, axis=1) <= near).tolist():
                    merged.setdefault(keys[k], (key, point))
        return merged

    def _nearest(self, corner: NDArray[np.int64], voxels: NDArray[np.int64]) -> tuple[tuple[int, ...], F64]:
        """Return the free point nearest to a corner, in voxels, and its key."""
        near = np.clip(corner, voxels + _INSIDE, voxels + 1.0 - _INSIDE)
        apart = np.sum((near - corner) ** 2, axis=1)
        best = np.lexsort((*voxels.T[::-1], np.round(apart, 6)))[0]
        space = self.viewpoints.space
        touches = apart[best] < 3.1 * _INSIDE**2
        point = corner if touches else near[best]
        key = (*corner.tolist(), *((-1, -1, -1) if touches else voxels[best].tolist()))
        return key, np.asarray(space.origin + space.voxel_size * point)

    def count(self) -> tuple[int, int]:
        """Return the number of corners, and of viewpoints, of all cells."""
        keys = {key for cell in range(len(self.viewpoints.grid)) for key in self.of_cell(cell)}
        coords = self.viewpoints.grid.coords
        corners = {tuple((box + np.array(offset)).tolist()) for box in coords for offset in _CORNERS}
        return len(corners), len(keys)


def try_cell(
    look: Look, certifier: Certifier, corners: Corners, cell: int, inner: int
) -> list[tuple[str, dict[str, Any]]]:
    """Return what some ways to find the set of a cell miss, by name."""
    eyes, voxels = np.array(list(corners.of_cell(cell).values())), corners.viewpoints.voxels(cell)
    eyes = eyes[~certifier._solid.buries(eyes)]
    held = np.zeros(len(look.gaussians), bool)
    start = time.perf_counter()
    for eye in eyes:
        add(look, held, eye)
    seconds = (time.perf_counter() - start) / max(1, len(eyes))
    ways = [(f"corners at {look.size}", judge(certifier, voxels, held, len(eyes), seconds))]
    if not inner:
        return ways
    guided, rays_alone, spread = held.copy(), held.copy(), held.copy()
    for step in range(1, inner + 1):
        found = certifier.certify(voxels, np.flatnonzero(guided), GUIDE, stage=step)
        assert found is not None
        guided[found.ids] = True
        if len(found.worst_o):
            add(look, guided, found.worst_o[0])
        found = certifier.certify(voxels, np.flatnonzero(rays_alone), GUIDE, stage=step)
        assert found is not None
        rays_alone[found.ids] = True
        ways.append((f"and {step} guided", judge(certifier, voxels, guided, len(eyes) + step, seconds)))
        ways.append((f"and {step} rounds of rays", judge(certifier, voxels, rays_alone, len(eyes), seconds)))
    for eye in corners.viewpoints.spread(cell, 8 + inner)[8:]:
        if not certifier._solid.buries(eye[None])[0]:
            add(look, spread, eye)
    ways.append((f"and {inner} spread", judge(certifier, voxels, spread, len(eyes) + inner, seconds)))
    return ways


def add(look: Look, held: Mask, eye: F64) -> None:
    ids, weights = look(eye)
    held[ids[weights >= np.float32(look.floor)]] = True


def judge(certifier: Certifier, voxels: FreeVoxels, held: Mask, looks: int, seconds: float) -> dict[str, Any]:
    found = certifier.certify(voxels, np.flatnonzero(held), JUDGE, stage=_JUDGED)
    assert found is not None
    return {
        "cell": voxels.cell,
        "missed": found.missed,
        "bound": found.bound,
        "heavy": found.heavy,
        "kept": int(np.count_nonzero(held)),
        "looks": looks,
        "seconds_a_look": seconds,
    }


def mean(rows: list[dict[str, Any]], name: str) -> float:
    return float(np.mean([row[name] for row in rows]))
>>>>>>> 60238c0e481806a6c04b17787689d9b04eed06ba


if __name__ == "__main__":
    main()
