"""Small scenes with levels, colors and, where asked for, visible sets: the contents of packages in tests."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gsvis.color.records import QuantizedColors, quantize
from gsvis.color.srbf import SrbfColors
from gsvis.package import in_package_order
from gsvis.package.codec import ChunkTable
from gsvis.package.layout import RecordLayout
from gsvis.prepare.active_terms import build_active_terms
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.store import CellSet, StoreInfo, VisibilityStore, write_store
from gsvis.scene.content import scene_hash
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels
from gsvis.scene.procedural import random_scene
from gsvis.scene.symlog import from_symlog, symlog
from tests.color.samples import random_colors

NAMES = ("low", "medium", "high")
EPSILON = 0.03


def levels_of(n: int = 400, seed: int = 0, *, lattice: bool = False) -> Levels:
    """Random levels in the order of a package, with centers on the lattice of a SOG file where asked for."""
    rng = np.random.default_rng(seed)
    first = rng.integers(0, 3, n).astype(np.uint8)
    first[:3] = 0, 1, 2
    last = np.maximum(first, rng.integers(0, 3, n)).astype(np.uint8)
    g = random_scene(rng, n)
    return in_package_order(Levels(on_lattice(g, 2047) if lattice else g, first, last, NAMES))


def on_lattice(g: Gaussians, places: int = 65535) -> Gaussians:
    """The same Gaussians, with centers rounded as a SOG file rounds them."""
    logs = symlog(g.means)
    low, high = logs.min(axis=0), logs.max(axis=0)
    rounded = low + (high - low) * (np.rint((logs - low) / (high - low) * places) / places)
    return Gaussians(from_symlog(rounded).astype(np.float32), g.quats, g.scales, g.opacities, g.sh0, g.shN)


def without_wide_places(records: np.ndarray, table: ChunkTable, layout: RecordLayout) -> np.ndarray:
    """The same records (N, 16), without bits of places that their chunks do not have."""
    found, bits = records.copy(), np.repeat(table.bits, table.counts, axis=0)
    for i in range(len(found)):
        word = int.from_bytes(found[i].tobytes(), "little")
        for axis in range(3):
            at = 8 * layout.packed_from + axis * sum(layout.bits)
            word &= ~(((1 << layout.position) - (1 << int(bits[i, axis]))) << at)
        found[i] = np.frombuffer(word.to_bytes(16, "little"), np.uint8)
    return found


def colors_of(n: int, variant: str = "rgb", seed: int = 0) -> tuple[SrbfColors, QuantizedColors]:
    exact = random_colors(np.random.default_rng(seed), n, variant)
    return exact, quantize(exact, "wire")


def sets_of(folder: Path, levels: Levels, cells: int = 9) -> Path:
    """Return the path of visible sets of a scene."""
    rng, g = np.random.default_rng(5), levels.union
    coords = np.stack(np.unravel_index(np.sort(rng.choice(60, cells, replace=False)), (4, 5, 3)), axis=1)
    low, high = g.bounds(1.0)
    grid = CellGrid(low, float((high - low).max()) / 4.0, (4, 5, 3), coords.astype(np.int32), np.array([0.0, 0, 1]))
    info = StoreInfo(len(g), scene_hash(g), 1 / 255, np.array([1 / 255, 0.1]))
    seen = rng.random((cells, len(g))) < 0.4
    sets = [CellSet(ids := np.flatnonzero(row), (ids % 2).astype(np.uint8), 4) for row in seen]
    folder.mkdir(parents=True, exist_ok=True)
    write_store(folder / "w.pvs", grid, info, sets, np.zeros((len(g), 10), np.uint8))
    return folder / "w.pvs"


def lists_of(folder: Path, levels: Levels, colors: SrbfColors, cells: int = 9) -> Path:
    """Return the path of lists of the terms that the cells of `sets_of` need."""
    with VisibilityStore.open(sets_of(folder, levels, cells)) as store:
        build_active_terms(colors, levels.union, store, EPSILON, folder / "w.terms.arrow").close()
    return folder / "w.terms.arrow"
