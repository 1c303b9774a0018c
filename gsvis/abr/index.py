"""What a planner knows about a scene: positions, sizes, levels and bytes of its records, and what each cell sees.

Plain arrays without shapes or colors. Scene frame and units; bytes as sent. Any order of ids works; 64 consecutive ids
are ranked together, so records should be in the order of a package (`gsvis.package.order`). No files, no clients.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.abr.cones import TermCones
from gsvis.pvs.cells import Cells
from gsvis.pvs.codec import pack_some
from gsvis.pvs.store import VisibilityStore
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels

__all__ = [
    "ActiveSets",
    "CellSets",
    "SceneIndex",
    "SceneTerms",
    "extents",
    "nearest_replacements",
]

F32 = NDArray[np.float32]
I32 = NDArray[np.int32]
I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]
Words = NDArray[np.uint64]

EXTENT = 3.0
"""Radius of a Gaussian in standard deviations, for tests whether it is in view."""


class CellSets(ABC):
    """The visible sets of cells. A subclass has to define `classes`. Several threads call it at once."""

    @abstractmethod
    def classes(self, cell: int, /) -> tuple[I64, U8]:
        """Return (V,) ascending ids of the Gaussians that a cell sees, and (V,) the weight class of each."""

    def visible_masks(self, cell: int, /) -> tuple[I32, Words]:
        """Return the nonempty words of the visible set of a cell: ascending numbers (S,) and masks (S,)."""
        return pack_some(self.classes(cell)[0])

    def ring_masks(self, rings: Sequence[Sequence[int]], /) -> list[list[tuple[I32, Words]]]:
        """Return the visible sets of each ring of cells, in the form of `visible_masks`.

        A ring has one set for each cell, or fewer sets. The union of the sets of a ring and of the rings before it is
        what the cells of these rings see.
        """
        return [[self.visible_masks(cell) for cell in ring] for ring in rings]

    def standing(self, cell: int, /) -> I64:
        """Return ascending ids of the Gaussians that a cell sees at all levels above their last.

        Empty unless a cell sees part of the scene at a lower level, such as the far tiles of a world.
        """
        return np.zeros(0, np.int64)

    def store_of(self, gaussian: int, /) -> tuple[VisibilityStore, int, int] | None:
        """Return the store that lists a Gaussian, its id in the store, and the number of the store's first cell.

        None if no store lists it; such a Gaussian is always sent.
        """
        return None

    @property
    def whole_store(self) -> VisibilityStore | None:
        """The one store that lists all Gaussians; None if there is none or several."""
        return None

    def tiles_near(self, cell: int, /) -> dict[int, tuple[float, float]]:
        """Return the tiles around a cell; for each, where its ids begin and end, as shares of all ids in [0, 1]."""
        return {0: (0.0, 1.0)}

    def is_open(self, tile: int, /) -> bool:
        """Return whether the sets of a tile can be read without opening them first."""
        return True

    def load(self, tile: int, /) -> None:
        """Open the sets of a tile in advance, so that no viewer waits for it. Any thread may call it."""
        assert self.is_open(tile), "a subclass with tiles that can be closed overrides this"


class ActiveSets(Protocol):
    """Interface of the active terms of cells, such as `ActiveTerms`. Several threads call it at once."""

    def active_ids(self, cell: int, /) -> I64:
        """Return (A,) ascending ids of the active terms of a cell, all of Gaussians that it sees."""
        ...


@dataclass(frozen=True, eq=False)
class SceneTerms:
    """The T terms of N Gaussians, for `SceneIndex.from_levels`.

    Args:
        offsets: (N + 1,) terms of Gaussian i are `offsets[i]:offsets[i + 1]`.
        nbytes: (T,) bytes of the record of each term, > 0, or one number for all.
        active: Active terms of the cells; None means no terms are sent.
        cones: When each term is active; None means that all active terms of a cell are sent.
    """

    offsets: ArrayLike
    nbytes: ArrayLike = 4.5
    active: ActiveSets | None = None
    cones: TermCones | None = None


@dataclass(frozen=True, eq=False, repr=False)
class SceneIndex:
    """N Gaussians of all levels and their T terms, as records to send, and C cells.

    Args:
        means: (N, 3) centers.
        radii: (N,) distance from the center at which each Gaussian ends, scene units.
        areas: (N,) mean cross-section, scene units squared.
        importance: (N,) >= 0, blending weight of each visible Gaussian, or a factor on the weight of its class.
        gaussian_bytes: (N,) bytes of each record of geometry and base color, >= 1, or one number for all.
        first: (N,) uint8 lowest level of each Gaussian.
        last: (N,) uint8 highest level of each Gaussian.
        level_names: L names, lowest first.
        term_offsets: (N + 1,) terms of Gaussian i are `term_offsets[i]:term_offsets[i + 1]`.
        term_bytes: (T,) bytes of the record of each term, > 0, or one number for all.
        replacement_offsets: (N + 1,) Gaussian i, if it ends below the highest level, is replaced by
            `replacement_ids[replacement_offsets[i]:replacement_offsets[i + 1]]`, which enter at the level above it.
        replacement_ids: (M,) int32 ids of replacements.
        class_weights: (K,) representative weight of each class of a cell.
        grid: The cells.
        sets: Visible sets of the cells.
        active: Active terms of the cells; None means no terms are sent.
        cones: When each term is active, to choose terms by the pose; None means that all active terms of a cell count.
        sent: (N,) which Gaussians may be sent to a viewer outside of cells or over an idle link; None means all.

    Raises:
        ValueError: If lengths differ or a value is out of range.
    """

    means: F32
    radii: F32
    areas: F32
    importance: F32
    gaussian_bytes: F32
    first: U8
    last: U8
    level_names: tuple[str, ...]
    term_offsets: I64
    term_bytes: F32
    replacement_offsets: I64
    replacement_ids: I32
    class_weights: F32
    grid: Cells
    sets: CellSets
    active: ActiveSets | None = None
    cones: TermCones | None = None
    sent: NDArray[np.bool_] | None = None

    def __post_init__(self) -> None:
        means = _check.floats("means", self.means, ("N", 3))
        n = len(means)
        levels = len(self.level_names)
        if not 1 <= levels <= 16:
            raise ValueError(f"level_names: expected 1 to 16 levels, got {levels}")
        offsets = _check.integers("term_offsets", self.term_offsets, (n + 1,))
        if offsets[0] != 0 or np.any(np.diff(offsets) < 0) or offsets[-1] >= 1 << 31:
            got = _check.not_rising(offsets, first=0) or f"{offsets[-1]:,} at the end"
            raise ValueError(f"term_offsets: expected to start at 0, never to fall, and to end below 2^31, got {got}")
        arrays: dict[str, NDArray[Any]] = {"means": means, "term_offsets": offsets}
        for name in ("radii", "areas", "importance"):
            arrays[name] = _check.floats(name, getattr(self, name), (n,))
            _check.in_range(name, arrays[name], 0.0, np.inf)
        for name, length, least in (("gaussian_bytes", n, 1.0), ("term_bytes", int(offsets[-1]), 0.125)):
            value = np.asarray(getattr(self, name), np.float32)
            value = np.full(length, value, np.float32) if value.ndim == 0 else value
            arrays[name] = _check.floats(name, value, (length,))
            _check.in_range(name, arrays[name], least, 1e6)
        for name in ("first", "last"):
            arrays[name] = _check.integers(name, getattr(self, name), (n,), np.uint8)
            _check.in_range(name, arrays[name], 0, levels - 1)
        if np.any(arrays["first"] > arrays["last"]):
            k = int(np.argmax(arrays["first"] > arrays["last"]))
            got = f"{arrays['last'][k]} after {arrays['first'][k]} at index {k}"
            raise ValueError(f"last: expected at least first, got {got}")
        starts = _check.integers("replacement_offsets", self.replacement_offsets, (n + 1,))
        ids = _check.integers("replacement_ids", self.replacement_ids, ("M",), np.int32)
        if starts[0] != 0 or np.any(np.diff(starts) < 0) or starts[-1] != len(ids):
            got = _check.not_rising(starts, first=0, last=len(ids))
            raise ValueError(f"replacement_offsets: expected to rise from 0 to {len(ids)}, got {got}")
        _check.in_range("replacement_ids", ids, 0, n - 1)
        replaced = np.repeat(np.arange(n), np.diff(starts))
        enters = arrays["first"][ids]
        above = arrays["last"][replaced].astype(np.int64) + 1
        if np.any(enters != above):
            k = int(np.argmax(enters != above))
            got = f"Gaussian {ids[k]}, which enters at level {enters[k]}, for level {above[k]}"
            raise ValueError(f"replacement_ids: expected Gaussians that enter at the level above, got {got}")
        arrays["replacement_offsets"] = starts
        arrays["replacement_ids"] = ids
        arrays["class_weights"] = _check.floats("class_weights", self.class_weights, ("K",))
        _check.in_range("class_weights", arrays["class_weights"], 0.0, np.inf)
        if not 1 <= len(arrays["class_weights"]) <= 255:
            raise ValueError(f"class_weights: expected 1 to 255, got {len(arrays['class_weights'])}")
        for name, array in arrays.items():
            view = array.view()
            view.flags.writeable = False
            object.__setattr__(self, name, view)

    @classmethod
    def from_levels(
        cls,
        levels: Levels,
        grid: Cells,
        sets: CellSets,
        *,
        terms: SceneTerms | None = None,
        gaussian_bytes: ArrayLike = 16.0,
        class_weights: ArrayLike | None = None,
    ) -> SceneIndex:
        """Return the index of levels; derive missing values from their Gaussians.

        Args:
            levels: The scene, its union in the order of ids.
            grid: The cells.
            sets: Visible sets of the cells.
            terms: Terms of the Gaussians; None means no terms.
            gaussian_bytes: (N,) bytes of each record of a Gaussian, or one number for all.
            class_weights: (K,) representative weight of each class of a cell; None means one class, with the opacity of
                a Gaussian as its weight.
        """
        union = levels.union
        n = len(levels.union)
        radii, areas = extents(union)
        starts, ids = nearest_replacements(levels)
        known = SceneTerms(np.zeros(n + 1, np.int64)) if terms is None else terms
        plain = class_weights is None
        return cls(
            means=union.means,
            radii=radii,
            areas=areas,
            importance=union.opacities if plain else np.ones(n, np.float32),
            gaussian_bytes=np.asarray(gaussian_bytes, np.float32),
            first=levels.first,
            last=levels.last,
            level_names=levels.names,
            term_offsets=np.asarray(known.offsets),
            term_bytes=np.asarray(known.nbytes, np.float32),
            replacement_offsets=starts,
            replacement_ids=ids,
            class_weights=np.ones(1, np.float32) if plain else np.asarray(class_weights, np.float32),
            grid=grid,
            sets=sets,
            active=known.active,
            cones=known.cones,
        )

    @classmethod
    def trusted(cls, level_counts: tuple[int, ...], **fields: Any) -> SceneIndex:
        """Return an index without checks: its arrays were checked before they were written to a file.

        Args:
            level_counts: Number of Gaussians of each level.
            **fields: All fields, by name.
        """
        made = object.__new__(cls)
        made.__dict__.update(fields, level_counts=level_counts)
        return made

    def __len__(self) -> int:
        """Return N, the number of Gaussians."""
        return len(self.means)

    def __repr__(self) -> str:
        levels = ", ".join(self.level_names)
        return f"SceneIndex({len(self):,} Gaussians, {self.num_terms:,} terms, {len(self.grid):,} cells; {levels})"

    @property
    def num_terms(self) -> int:
        """T, the number of terms."""
        return int(self.term_offsets[-1])

    @property
    def num_levels(self) -> int:
        """L, the number of levels."""
        return len(self.level_names)

    @cached_property
    def level_counts(self) -> tuple[int, ...]:
        """Number of Gaussians of each level, lowest first."""
        return tuple(int(np.count_nonzero((self.first <= k) & (k <= self.last))) for k in range(self.num_levels))

    def highest_within(self, share: float) -> int:
        """Return the highest level that has at most this share of the highest level's Gaussians; -1 if none has."""
        counts = self.level_counts
        return max((k for k, count in enumerate(counts[:-1]) if count <= share * counts[-1]), default=-1)

    @cached_property
    def replaced(self) -> tuple[I64, I32]:
        """(N + 1,) offsets and (M,) ids of the Gaussians that each Gaussian replaces."""
        n = len(self)
        owners = np.repeat(np.arange(n, dtype=np.int32), np.diff(self.replacement_offsets))
        order = np.argsort(self.replacement_ids, kind="stable")
        return _offsets(self.replacement_ids, n), owners[order]

    def as_dict(self) -> Mapping[str, Any]:
        """Return counts and bytes, ready for JSON."""
        return {
            "gaussians": len(self),
            "terms": self.num_terms,
            "cells": len(self.grid),
            "levels": list(self.level_names),
            "gaussian_bytes": float(self.gaussian_bytes.sum(dtype=np.float64)),
            "term_bytes": float(self.term_bytes.sum(dtype=np.float64)),
        }


def extents(g: Gaussians) -> tuple[F32, F32]:
    """Return the radius (N,) at which each Gaussian ends, and its mean cross-section (N,).

    The cross-section is the integral of the response over a plane, averaged over the planes across the three axes.
    """
    s = g.scales.astype(np.float64)
    pairs = s[:, 0] * s[:, 1] + s[:, 1] * s[:, 2] + s[:, 2] * s[:, 0]
    most = float(np.finfo(np.float32).max)
    radii = EXTENT * s.max(axis=1, initial=0.0)
    areas = 2.0 * np.pi * pairs / 3.0
    return np.minimum(radii, most).astype(np.float32), np.minimum(areas, most).astype(np.float32)


def nearest_replacements(levels: Levels) -> tuple[I64, I32]:
    """Return the replacements of each Gaussian that ends below the highest level.

    A Gaussian that enters at a level replaces the nearest one that ends below it. A Gaussian without such a replacement
    is replaced by the nearest one that enters, so that all are dropped in the end.

    Returns:
        offsets: (N + 1,) offsets into `ids`.
        ids: (M,) int32 ids of replacements, ascending for each Gaussian.
    """
    from scipy.spatial import cKDTree  # slow to import, and seldom needed

    means = levels.union.means
    n = len(levels.union)
    pairs = [np.zeros((0, 2), np.int64)]
    for level in range(1, len(levels)):
        enters = np.flatnonzero(levels.first == level)
        ends = np.flatnonzero(levels.last == level - 1)
        if len(enters) == 0 or len(ends) == 0:
            continue
        nearest = cKDTree(means[ends]).query(means[enters])[1]
        alone = np.setdiff1d(np.arange(len(ends)), nearest)
        pairs.append(np.stack([ends[nearest], enters], axis=1))
        if len(alone):
            pairs.append(np.stack([ends[alone], enters[cKDTree(means[enters]).query(means[ends[alone]])[1]]], axis=1))
    found = np.concatenate(pairs)
    found = found[np.lexsort((found[:, 1], found[:, 0]))]
    return _offsets(found[:, 0], n), found[:, 1].astype(np.int32)


def _offsets(owners: NDArray[Any], count: int) -> I64:
    """Return offsets (count + 1,) of the items of each owner, from the owner of each item."""
    return np.concatenate([[0], np.cumsum(np.bincount(owners, minlength=count))]).astype(np.int64)
