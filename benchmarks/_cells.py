"""A scene, its navigable space, its grid of cells, and some cells drawn from the grid."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from _harness import realdata

from gsvis.io import load_scene
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.viewpoints import CellViewpoints
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace

__all__ = ["DrawnCells", "add_cell_arguments", "draw_cells"]


@dataclass(frozen=True, eq=False)
class DrawnCells:
    """A scene, the viewpoints of all its cells, and the numbers of the cells that were drawn, ascending."""

    scene: Gaussians
    viewpoints: CellViewpoints
    cells: tuple[int, ...]

    @property
    def grid(self) -> CellGrid:
        return self.viewpoints.grid


def add_cell_arguments(parser: argparse.ArgumentParser) -> argparse.ArgumentParser:
    """The options that say which cells of which scene."""
    parser.add_argument("--scene", default="showroom", help="folder of scenes/, or a path")
    parser.add_argument("--lod", type=int, default=3)
    parser.add_argument("--max-cells", type=int, default=256, help="of the grid")
    parser.add_argument("--cells", type=int, default=10, help="cells measured, drawn at random")
    parser.add_argument("--seed", type=int, default=0)
    return parser


def draw_cells(options: argparse.Namespace) -> DrawnCells:
    """Read the scene and draw the cells, in the navigable space and grid that `gsvis pvs` makes."""
    path = Path(options.scene)
    path = path if path.exists() else realdata() / "scenes" / options.scene / "lod-meta.json"
    scene = load_scene(path, lod=options.lod)
    space = NavigableSpace.from_scene(scene)
    grid = CellGrid.over(space, max_cells=options.max_cells)
    count = min(options.cells, len(grid))
    cells = np.sort(np.random.default_rng(options.seed).choice(len(grid), count, replace=False))
    return DrawnCells(scene, CellViewpoints(grid, space), tuple(cells.tolist()))
