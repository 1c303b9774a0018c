"""What does each part of two rooms see, which Gaussians come next, and why is one of them hidden?

Run it with `python examples/05_visible_sets.py`; the name of a store to write may follow.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

from gsvis.pvs import CellGrid, PvsConfig, build_pvs
from gsvis.raycast import EllipsoidProxies, Tracer
from gsvis.scene.procedural import builtin_scene

scene = builtin_scene("two_rooms")
grid = CellGrid.over(scene.navigable, max_cells=12)

with tempfile.TemporaryDirectory() as folder:
    path = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(folder) / "two_rooms.pvs"
    with build_pvs(scene.gaussians, grid, scene.navigable, path, PvsConfig(size=96)) as store:
        cell = store.cell_at(scene.viewpoints[0])
        visible = store.visible(cell)  # a roaring bitmap of Gaussians
        share = len(visible) / len(scene.gaussians)
        print(f"{len(store)} cells, {path.stat().st_size / 1024:.0f} KiB; the eye's cell {cell} sees {share:.1%}.")

        strong = store.visible(cell, least_class=len(store.info.class_edges) - 1)
        print(f"{len(strong):,} of them have a weight of {store.info.class_edges[-1]:.2f} or more somewhere in it.")

        away = store.distance_to_visibility(cell)  # to the nearest cell that sees each Gaussian
        soon = np.count_nonzero((away > 0) & (away <= 1.5 * grid.cell_size))
        print(f"{soon:,} more can be seen from the cells around it, {np.isinf(away).sum():,} from nowhere.")

        hidden = int(np.flatnonzero(away == away[np.isfinite(away)].max())[0])
        print(store.why(hidden, cell, Tracer(EllipsoidProxies.from_scene(scene.gaussians))))
