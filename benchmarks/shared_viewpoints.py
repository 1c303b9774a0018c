"""What do viewpoints on the corners of cells see, and what do inner ones add?

Two rules move the corners of cells into free voxels: "own" takes for each cell the nearest free voxel of that cell, and
corners that fall together share one look; "one" takes one free voxel for each corner, the nearest of all, for all cells
that touch it. With `--merge`, viewpoints within some voxels of each other share one look.

Cells of showroom LOD 3 are drawn at random. Their sets from corners alone are certified, with faces of several sizes.
Then inner viewpoints are added one by one, where the worst ray of a certificate began, with what this certificate found
missing; beside it, with what it found alone, and with viewpoints spread over the cell.

Given: showroom LOD 3, its cells, the hybrid method.
Measured: missed weight over all weight on rays that no step has used; the size of the sets; looks.
Defaults chosen on: showroom LOD 3, the scene that is measured, at 0, 1.8 and 3.5 voxels.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import time
from typing import Any

import numpy as np
from _cells import add_cell_arguments, draw_cells
from _harness import add_arguments, write_result
from numpy.typing import NDArray

from gsvis.pvs.certificate import CertificateConfig, Certifier
from gsvis.pvs.config import PvsConfig
from gsvis.pvs.look import Look
from gsvis.pvs.viewpoints import CellViewpoints, FreeVoxels
from gsvis.raycast import TAU, EllipsoidProxies, Tracer

F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]
GUIDE = CertificateConfig(limit=0.0, rays=2048)
JUDGE = CertificateConfig(limit=0.0, rays=32768, round_rays=8192)
_JUDGED = 1000  # stage of the rays that judge; those of the steps are 1, 2, ...
_CORNERS = tuple(itertools.product((0, 1), repeat=3))
_INSIDE = 0.05  # voxels from the face of a voxel to a viewpoint


def main() -> None:
    parser = add_cell_arguments(add_arguments(argparse.ArgumentParser(description=__doc__)))
    parser.add_argument("--rule", choices=("own", "one"), default="own")
    parser.add_argument("--merge", type=float, default=1.8, help="voxels within which viewpoints share one look")
    parser.add_argument("--sizes", type=int, nargs="+", default=[320, 512], help="pixels of a face")
    parser.add_argument("--inner", type=int, default=1, help="inner viewpoints, at the first size")
    options = parser.parse_args()
    drawn = draw_cells(options)
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


if __name__ == "__main__":
    main()
