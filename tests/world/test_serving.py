"""What a server and its viewers hold of a world is as large as what viewers come near, however large the world is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from gsvis._kernels.blank import PAGE, blank, used_bytes
from gsvis.abr.candidates import CandidateIndex
from gsvis.abr.classes import FieldOfView
from gsvis.abr.config import AbrConfig
from gsvis.abr.index import CellSets, SceneIndex
from gsvis.abr.planner import Planner
from gsvis.files.cache import Cache
from gsvis.pvs.cells import CellGrid
from gsvis.world.cells import WorldCells

VIEW = FieldOfView.from_degrees(80, 60, margin=5)
TILE = 1 << 15  # Gaussians of a tile; three of four are of the highest level, the others are replaced by them


@dataclass(frozen=True)
class OwnTile(CellSets):
    """Each cell sees its own tile."""

    tiles: int

    def classes(self, cell: int) -> tuple[np.ndarray, np.ndarray]:
        return np.arange(cell * TILE, (cell + 1) * TILE), np.zeros(TILE, np.uint8)


def row_of_tiles(tiles: int) -> CandidateIndex:
    """Tiles in a row, far apart from each other, one cell each."""
    n = tiles * TILE
    ids, place = np.arange(n), np.random.default_rng(0).uniform(-0.4, 0.4, (TILE, 3))
    means = (np.tile(place, (tiles, 1)) + np.repeat(np.arange(tiles), TILE)[:, None] * (2.0, 0.0, 0.0)).astype(
        np.float32
    )
    low = ids % 4 == 0
    offsets = np.concatenate([[0], np.cumsum(np.where(low, 3, 0))])
    coords = np.stack([2 * np.arange(tiles), np.zeros(tiles), np.zeros(tiles)], axis=1).astype(np.int32)
    grid = CellGrid(np.full(3, -0.5), 1.0, (2 * tiles, 1, 1), coords, np.array([0.0, 0.0, 1.0]))
    index = SceneIndex(
        means=means, radii=np.full(n, 0.01, np.float32), areas=np.full(n, 1e-4, np.float32),
        importance=np.ones(n, np.float32), gaussian_bytes=np.float32(12.0), first=np.where(low, 0, 1).astype(np.uint8),
        last=np.where(low, 0, 1).astype(np.uint8), level_names=("low", "high"), term_offsets=np.zeros(n + 1, np.int64),
        term_bytes=np.float32(1.0), replacement_offsets=offsets, replacement_ids=ids[~low].astype(np.int32),
        class_weights=np.ones(1, np.float32), grid=grid, sets=OwnTile(tiles),
    )  # fmt: skip
    return CandidateIndex(index, cache=Cache(1 << 30))


def held_by(planner: Planner) -> dict[str, int]:
    """Bytes of the pages that arrays of a planner, of its holdings and of its cell use."""
    here, held = planner._cursor.cell, planner.holdings
    arrays = {name: getattr(here, name) for name in here._fields if name not in ("last", "active", "shares")}
    arrays |= {
        "sent": held.sent,
        "gone": held.gone,
        "looks_far": planner._cells.replacements.looks_far,
        "seen": planner._cells.seen,
    }
    return {name: used_bytes(array) for name, array in arrays.items() if isinstance(array, np.ndarray)}


def walk_two_tiles(shared: CandidateIndex, budget: float) -> tuple[Planner, bool]:
    """Return the planner of a viewer who has walked through two tiles, and whether something filled its link."""
    planner, filling = Planner(shared, VIEW, AbrConfig()), False
    for k in range(12):
        planner.on_pose(0.1 * k, [2.0 * (k // 6), 0.0, 0.0], [1.0, 0.1 * k, 0.0, 0.0])
        filling |= planner.next_batch(0.1 * k, budget, 1e6).filling
    return planner, filling


NEEDS, FILLS = 0.5 * TILE, 6.0 * TILE  # bytes of a batch


@pytest.fixture
def as_large(monkeypatch: pytest.MonkeyPatch) -> None:
    """Scenes of this size are treated as those above 4 million Gaussians."""
    monkeypatch.setattr("gsvis.abr.candidates._DENSE", 0)


@pytest.mark.usefixtures("as_large")
@pytest.mark.parametrize("budget", [NEEDS, FILLS])
def test_memory_of_a_viewer_follows_the_tiles_it_visits_not_the_world(budget: float) -> None:
    found = []
    for tiles in (16, 64):
        shared = row_of_tiles(tiles)
        planner, filling = walk_two_tiles(shared, budget)
        assert filling == (budget == FILLS)
        found.append((held_by(planner), shared.cache.nbytes))
    (small, cached), (large, cached_of_large) = found
    assert sum(small.values()) > 0
    assert cached_of_large <= cached + 16 * PAGE
    for name, size in small.items():
        assert large[name] <= size + 2 * PAGE, name


def test_what_is_chosen_does_not_depend_on_tiles_that_nobody_comes_near_nor_on_the_size_of_a_scene(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found = []
    for tiles, dense in ((16, 1 << 16), (16, 0), (64, 0)):
        monkeypatch.setattr("gsvis.abr.candidates._DENSE", dense)
        found.append(walk_two_tiles(row_of_tiles(tiles), FILLS)[0].holdings)
    for mine, *others in zip(*((held.received, held.shown, held.replaced) for held in found), strict=True):
        assert len(mine) > 0
        for theirs in others:
            np.testing.assert_array_equal(mine, theirs)


def test_blank_arrays_are_zeros_that_can_be_written() -> None:
    for size in (0, 10, 1 << 20):
        array = blank(size, np.int32)
        assert array.shape == (size,)
        assert not array.any()
        assert used_bytes(array) == 0
        array[size // 2 :: 1 << 19] = 7
        assert array.sum() == 7 * len(array[size // 2 :: 1 << 19])
        assert used_bytes(array) <= 2 * PAGE


@pytest.mark.parametrize("seed", range(4))
def test_cells_are_found_and_touch_as_if_all_were_looked_at(seed: int) -> None:
    rng = np.random.default_rng(seed)
    counts, sizes = rng.integers(1, 20, 6), rng.choice([0.5, 1.0, 1.25], 6)
    boxes = [np.unique(rng.integers(0, 4, (count, 3)), axis=0) for count in counts]
    counts = np.array([len(each) for each in boxes])
    corners = rng.integers(0, 5, (6, 3)) * 1.0
    cells = WorldCells(
        np.concatenate([c + s * (b + 0.5) for c, s, b in zip(corners, sizes, boxes, strict=True)]),
        np.repeat(sizes, counts), np.repeat(np.arange(6) * 2, counts), np.concatenate([np.arange(n) for n in counts]),
        np.concatenate(boxes).astype(np.int32), np.array([0.0, 0.0, 1.0]),
    )  # fmt: skip
    for position in [*rng.uniform(-3, 12, (60, 3)), *cells.centers[:5], np.full(3, 1e200), np.full(3, -40.0)]:
        apart = np.clip(cells.centers - position, -1e100, 1e100)
        squares = (apart * apart).sum(axis=1)
        inside = np.abs(apart).max(axis=1) <= cells.sizes / 2
        assert cells.nearest(position) == (np.where(inside, squares, np.inf) if inside.any() else squares).argmin()
    for cell in range(len(cells)):
        apart = np.abs(cells.centers - cells.centers[cell]).max(axis=1) - (cells.sizes + cells.sizes[cell]) / 2
        steps = np.abs(cells.boxes - cells.boxes[cell]).max(axis=1)
        near = np.where(cells.tiles == cells.tiles[cell], steps <= 1, apart <= 1e-3 * cells.sizes)
        assert cells.neighbors(cell).tolist() == [k for k in np.flatnonzero(near) if k != cell]
