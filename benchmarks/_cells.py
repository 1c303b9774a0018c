"""A scene, its navigable space, its grid of cells, and the visible sets of some cells drawn from the grid."""

from __future__ import annotations

import argparse
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from _harness import realdata
from numpy.typing import NDArray

from gsvis.io.sources import load_source
from gsvis.pvs.cell_view import CellView, Finder, Sighting
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.config import PvsConfig
from gsvis.pvs.store import CellSet, StoreInfo, StoreWriter, VisibilityStore
from gsvis.pvs.viewpoints import CellViewpoints, SharedViewpoints
from gsvis.raycast.directions import NUM_FACES
from gsvis.scene.content import scene_hash, space_hash
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels
from gsvis.scene.navigable import NavigableSpace

__all__ = ["DrawnCells", "add_cell_arguments", "draw_cells", "find_sets", "store_of"]


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
    parser.add_argument("--scene", default="showroom", help="folder of scenes/, a path, or builtin:NAME")
    parser.add_argument("--lod", type=int, default=3)
    parser.add_argument("--max-cells", type=int, default=256, help="of the grid")
    parser.add_argument("--cells", type=int, default=10, help="cells measured, drawn at random")
    parser.add_argument("--seed", type=int, default=0)
    return parser


def draw_cells(options: argparse.Namespace) -> DrawnCells:
    """Read the scene and draw the cells, in the navigable space and grid that `gsvis pvs` makes."""
    if options.scene.startswith("builtin:") or Path(options.scene).exists():
        scene = load_source(options.scene, None).gaussians
    else:
        scene = load_source(str(realdata() / "scenes" / options.scene / "lod-meta.json"), options.lod).gaussians
    space = NavigableSpace.from_scene(scene)
    grid = CellGrid.over(space, max_cells=options.max_cells)
    count = min(options.cells, len(grid))
    cells = np.sort(np.random.default_rng(options.seed).choice(len(grid), count, replace=False))
    return DrawnCells(scene, CellViewpoints(grid, space), tuple(cells.tolist()))


def find_sets(drawn: DrawnCells, config: PvsConfig) -> dict[int, CellView]:
    """Return the view of each drawn cell, by number: what a build of the whole grid keeps of it."""
    shared = SharedViewpoints(drawn.viewpoints)
    finder = Finder(Levels.single(drawn.scene), config)
    seen: dict[int, Sighting] = {}
    views = {}
    for cell in drawn.cells:
        around = shared.of_cell(cell).tolist()
        for k in around:
            if k not in seen:
                seen[k] = finder.look(shared.points[k], fine=bool(shared.fine[k]))
        views[cell] = finder.find_cell(drawn.viewpoints.voxels(cell), [seen[k] for k in around])
        print(f"cell {cell}: {len(views[cell].ids):,} Gaussians", file=sys.stderr, flush=True)
    return views


def store_of(drawn: DrawnCells, views: dict[int, CellView], config: PvsConfig, path: Path) -> VisibilityStore:
    """Write a store that has the drawn cells alone, numbered from 0 in their order, and open it."""
    whole = drawn.grid
    grid = CellGrid(whole.origin, whole.cell_size, whole.shape, whole.coords[list(drawn.cells)], whole.up)
    how = {**config.as_dict(), "space": space_hash(drawn.viewpoints.space)}
    info = StoreInfo(len(drawn.scene), scene_hash(drawn.scene), config.tau, config.class_edges, how)
    directions: NDArray[np.uint8] = np.zeros((len(drawn.scene), NUM_FACES // 8), np.uint8)
    with StoreWriter(path, grid, info) as writer:
        for cell in drawn.cells:
            view = views[cell]
            directions[view.ids] |= view.directions
            writer.add_cell(CellSet(view.ids, view.classes, **asdict(view.figures)))
        writer.finish(directions)
    return VisibilityStore.open(path, scene=drawn.scene)
