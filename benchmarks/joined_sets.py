"""How large are the visible sets of a package, as built and as shipped?

Takes stores that `gsvis pvs` has written (`--stores`), or builds that of two_rooms, and makes what
`gsvis prepare --join-cells` ships: cells joined until the sets are a fifth of it, one direction set for 16 neighbors.
Records are counted with 12 bytes a Gaussian, as the rule does. What a walk through ten of the cells as built needs is
the mean of 64 walks.

Given: stores of about 100 cells each.
Measured: bytes of stores, cells, Gaussians that a walk needs, before and after.
Defaults chosen on: showroom LOD 3; massa, flowers LOD 3, nika LOD 3, relief and two rooms were looked at when the rule
    was chosen.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

from _harness import add_arguments, write_result

from gsvis.pvs.build import build_pvs
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.joined import RECORD_BYTES, join_until_small
from gsvis.pvs.store import VisibilityStore
from gsvis.scene.procedural import builtin_scene

QUESTION = "How large are the visible sets of a package, as built and as shipped?"
CELLS = 100


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--stores", type=Path, nargs="+", help="stores of gsvis pvs; without, that of two_rooms")
    options = parser.parse_args()
    figures = []
    with tempfile.TemporaryDirectory() as folder:
        for path in options.stores or [build_rooms(Path(folder))]:
            figures += figures_of(path)
    write_result(options.out, QUESTION, figures, {})


def build_rooms(folder: Path) -> Path:
    """Write the store of the built-in scene two_rooms with about 100 cells, and return its path."""
    rooms = builtin_scene("two_rooms")
    path = folder / "rooms.pvs"
    grid = CellGrid.over(rooms.navigable, max_cells=CELLS)
    build_pvs(rooms.gaussians, grid, rooms.navigable, path).close()
    return path


def figures_of(path: Path) -> list[dict[str, Any]]:
    """Return the figures of one store."""
    with tempfile.TemporaryDirectory() as folder, VisibilityStore.open(path) as built:
        shipped = Path(folder) / "shipped.pvs"
        tried = join_until_small(built, shipped)
        records = RECORD_BYTES * built.gaussians
        before = path.stat().st_size
        after = shipped.stat().st_size
    first = tried[0]
    last = tried[-1]
    name = path.stem
    return [
        figure(f"share of a package that is sets, as shipped, {name}", 0.2, after / (after + records), "of the bytes"),
        figure(f"the same as built, {name}", None, before / (before + records), "of the bytes"),
        figure(f"bytes as shipped, {name}", None, after, "bytes"),
        figure(f"bytes as built, {name}", None, before, "bytes"),
        figure(f"cells as shipped, {name}", None, last.cells, "cells"),
        figure(f"cells as built, {name}", None, first.cells, "cells"),
        figure(f"Gaussians that a walk needs, as shipped over as built, {name}", None, last.walk / first.walk, "times"),
    ]


def figure(name: str, target: float | None, reached: float, unit: str) -> dict[str, Any]:
    """Return one figure for the result; lower is better."""
    return {"name": name, "target": target, "reached": float(reached), "unit": unit, "better": "lower"}


if __name__ == "__main__":
    main()
