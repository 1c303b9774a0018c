"""Small scenes with levels, cells and terms, at random: what the tests of this room share."""

from __future__ import annotations

import numpy as np

from gsvis.abr.cones import TermCones
from gsvis.abr.index import CellSets, SceneIndex, SceneTerms, nearest_replacements
from gsvis.package.order import in_package_order
from gsvis.pvs.cells import CellGrid
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels


class ArrayCells(CellSets):
    """Cells from lists; if some of what they see stands, as in a far tile of a world, it does at all levels above."""

    def __init__(
        self,
        members: list[tuple[np.ndarray, np.ndarray]],
        terms: list[np.ndarray],
        *,
        stands: bool = False,
    ) -> None:
        self._members = members
        self._terms = terms
        self._stands = stands

    def classes(self, cell: int) -> tuple[np.ndarray, np.ndarray]:
        return self._members[cell]

    def standing(self, cell: int) -> np.ndarray:
        ids = self.classes(cell)[0]
        return ids[np.random.default_rng(cell).random(len(ids)) < (0.3 if self._stands else 0.0)]

    def active_ids(self, cell: int) -> np.ndarray:
        return self._terms[cell]


def random_levels(rng: np.random.Generator, count: int, levels: int, *, ordered: bool = True) -> Levels:
    means = rng.uniform(-5, 5, (count, 3))
    union = Gaussians(
        means,
        rng.normal(size=(count, 4)) + 1e-3,
        rng.lognormal(-2.5, 0.7, (count, 3)),
        rng.uniform(0.05, 1, count),
        np.zeros((count, 1, 3)),
    )
    first = rng.integers(0, levels, count)
    last = np.where(rng.random(count) < 0.7, levels - 1, first)
    last[first == 0] = np.where(rng.random(int((first == 0).sum())) < 0.6, levels - 1, 0)
    first[:levels], last[:levels] = np.arange(levels), levels - 1
    names = tuple(f"level {k}" for k in range(levels))
    made = Levels(union, first, last, names)
    return in_package_order(made) if ordered else made


def random_cones(rng: np.random.Generator, count: int) -> TermCones:
    centers = rng.normal(size=(20, 3))
    centers /= np.linalg.norm(centers, axis=1, keepdims=True)
    return TermCones(
        centers.astype(np.float32),
        rng.integers(0, 20, count),
        rng.uniform(-1.1, 1.1, count),
        rng.uniform(0.05, 0.5, count),
    )


def random_index(
    seed: int,
    count: int = 700,
    levels: int = 3,
    *,
    most_terms: int = 3,
    share: float = 0.4,
    shape: tuple[int, int, int] = (3, 3, 2),
    ordered: bool = True,
    classes: int = 4,
    cones: bool = False,
    standing: bool = False,
) -> SceneIndex:
    rng = np.random.default_rng(seed)
    made = random_levels(rng, count, levels, ordered=ordered)
    boxes = np.argwhere(rng.random(shape) < 0.9)
    boxes = boxes if len(boxes) else np.zeros((1, 3), np.int64)
    grid = CellGrid(np.full(3, -3.0), 2.0, shape, boxes.astype(np.int32), np.array([0.0, 0.0, 1.0]))
    offsets = np.concatenate([[0], np.cumsum(rng.integers(0, most_terms + 1, count))])
    members, terms = [], []
    for _ in range(len(grid)):
        ids = np.flatnonzero(rng.random(count) < share)
        members.append((ids, rng.integers(0, classes, len(ids)).astype(np.uint8)))
        owners = np.repeat(np.arange(count), np.diff(offsets))
        terms.append(np.flatnonzero(np.isin(owners, ids) & (rng.random(len(owners)) < 0.4)))
    cells = ArrayCells(members, terms, stands=standing)
    found = random_cones(rng, int(offsets[-1])) if cones else None
    sizes, nbytes = rng.integers(10, 20, count), rng.uniform(3, 6, int(offsets[-1]))
    return SceneIndex.from_levels(
        made,
        grid,
        cells,
        terms=SceneTerms(offsets, nbytes, cells, found),
        gaussian_bytes=sizes,
        class_weights=np.geomspace(0.01, 0.8, classes),
    )


__all__ = ["ArrayCells", "nearest_replacements", "random_cones", "random_index", "random_levels"]
