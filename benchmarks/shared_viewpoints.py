"""Within which distance should viewpoints near the corners of cells be one?

The fewer viewpoints, the fewer looks, and the more a cell must be mended: its certificate asks for rays and inner
viewpoints. Cells are drawn at random and found as `gsvis pvs` finds them, with viewpoints merged within some distances.
Rays that no build uses judge the sets. Processor time is that of one process; the time of all cells is estimated from a
look and a cell, since neighbors that were not drawn share looks too.

Given: showroom LOD 3, or a folder of levels (`--levels`); its cells.
Measured: viewpoints of all cells; inner ones; missed weight over all weight on fresh rays, of the highest level; the
    size of the sets; processor seconds of a look, of a cell, and of all.
Defaults chosen on: showroom LOD 3 with levels of 25 and 50%, cells of seed 1: the distance of 3.5 voxels.
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
from gsvis.pvs.viewpoints import CellViewpoints, SharedViewpoints
from gsvis.raycast import EllipsoidProxies, Tracer
from gsvis.scene.levels import Levels

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
    parser.add_argument("--levels", help="folder that `gsvis levels` made from the scene")
    parser.add_argument("--merged", type=float, nargs="+", default=[1.8, 3.5, 5.0], help="distances, voxels")
    options = parser.parse_args()
    drawn = draw_cells(options)
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
                seen[k] = finder.look(shared.points[k], fine=bool(shared.fine[k]))
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


if __name__ == "__main__":
    main()
