"""What may be sent to a client in a cell: units of Gaussians that the cell and its neighbors see.

Candidates are computed once for a cell and shared by all clients in it. They do not depend on what a client holds or
looks at. Ring 0 is the cell itself; rings 1, 2 and 3 are its neighbors by face, edge and corner. A Gaussian is in the
first ring that sees it, so the ring orders by distance to the nearest cell from which it is visible (section 6.3).
Shells fill an idle link with the rest of the scene: shell 0 is the cell and its neighbors, each further shell the next
nearest cells. The last shells hold what no cell sees. For an eye outside of all cells, the candidates of the nearest
cell are widened by the distance, see `gsvis.abr.outside`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis._kernels.bits import count as ones
from gsvis._kernels.blank import blank
from gsvis.abr._kernels import units as kernels
from gsvis.abr._kernels.take import bound
from gsvis.abr._kernels.units import Runs, Seen, Units
from gsvis.abr.candidate_sets import Bounds, Candidates, Shell
from gsvis.abr.index import SceneIndex
from gsvis.abr.outside import near_cells, widen
from gsvis.abr.piecewise import tables_of
from gsvis.abr.rings import RINGS, Shells
from gsvis.abr.scratch import Scratch
from gsvis.abr.seen import SeenSets
from gsvis.abr.tables import CandidateTables
from gsvis.abr.words import empty_units, level_bytes
from gsvis.files.cache import Cache
from gsvis.pvs.codec import pack, pack_some, word_count

__all__ = ["CandidateIndex"]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
I32 = NDArray[np.int32]
Words = NDArray[np.uint64]

_DENSE = 1 << 16  # most words of a small scene: there, passes over all words replace lists of words
_REST = 1 << 13  # words in a shell of what no cell sees, in a larger scene


class CandidateIndex:
    """Candidates of the cells of a scene, computed on demand. Threads may share it.

    Args:
        index: The scene.
        pixel: Angle of a pixel of the clients, radians: the rasterizer adds 0.3 square pixels to the size of each
            Gaussian.
        stored: Bytes that a Gaussian and a term take in the memory of a client.
        cache: Cache of candidates and sets of cells; None means one of 256 MiB.
        tables: Tables of the scene, computed before with the same pixel; None computes them.

    Attributes:
        index: The scene.
        tables: Tables of the scene that do not depend on a cell.
        cache: The cache.
        seen: Visible sets of the cells.
        shells: The cells around each cell.
        scratch: Scratch arrays of the threads that plan.

    Raises:
        ValueError: If the angle is out of range.
    """

    def __init__(
        self,
        index: SceneIndex,
        *,
        pixel: float = 2e-3,
        stored: tuple[float, float] = (16.0, 4.5),
        cache: Cache[Any] | None = None,
        tables: CandidateTables | None = None,
    ) -> None:
        self.index = index
        self.tables = tables_of(index, pixel=pixel, stored=stored) if tables is None else tables
        self.cache = Cache(256 << 20) if cache is None else cache
        self.seen = SeenSets(index, self.cache)
        self.shells = Shells(index.grid, self.cache)
        self.scratch = Scratch(len(self.tables.links.ending))
        self._words = (np.zeros(0, np.uint64),) * 2

    def in_cell(self, cell: int, step: int = 0) -> Candidates:
        """Return the candidates of a cell; `step` is the distance of an eye outside of it.

        Raises:
            ValueError: If there is no such cell, or its sets contain ids that the scene does not have.
        """
        found: Candidates = self.cache.find_or_make(("candidates", cell, step), lambda: self.build(cell, step))
        return found

    def has(self, cell: int, step: int = 0) -> bool:
        """Whether the candidates of a cell are in the cache."""
        return self.cache.find(("candidates", cell, step)) is not None

    def build(self, cell: int, step: int = 0) -> Candidates:
        """Compute the candidates of a cell without the cache; `step` is the distance of an eye outside of it.

        Raises:
            ValueError: If there is no such cell, or its sets contain ids that the scene does not have.
        """
        index = self.index
        levels = index.num_levels
        cells = [cell]
        seen_by = self.seen.of_rings(index.grid.rings(cell))
        if step == 0:
            classes = index.sets.classes(cell)[1]
            weights = index.class_weights
        else:
            cells = near_cells(index, self.shells, cell, step)
            every = self._all_in(self.tables.everything.words) if self.is_small else None
            members, classes, weights = widen(index, self.seen, cells, step, every)
            seen_by[0] = [members]
        fresh, seen = self.seen.join(seen_by)
        parts = [self._split_cell(fresh[0], classes, weights, index.sets.standing(cell))]
        sums = np.zeros(levels * levels)
        kernels.pair_bytes(parts[0].slots, parts[0].masks, parts[0].codes, self.tables.word_bytes, sums)
        parts += [self._units_of(ring, fresh[ring]) for ring in range(1, RINGS)]
        if index.cones is None:
            active, owners = self._active_terms(cells)
            owing = owners[seen.words]
            terms = float(ones(active))
        else:  # the planner tests for the eye which terms are active
            active = self.tables.active
            owing = self.tables.owing[seen.words] & seen.masks
            own = np.zeros(levels * levels)
            kernels.pair_bytes(parts[0].slots, parts[0].masks, parts[0].codes, self.tables.word_terms, own)
            terms = float(own.sum())
        return replace(self._assemble(cell, parts, seen, active, owing, terms, sums), step=step)

    @property
    def is_small(self) -> bool:
        """Whether the scene is so small that passes over all words are faster than lists of words."""
        return len(self.tables.everything.words) <= _DENSE

    def _all_in(self, words: I32) -> Seen:
        """Return the Gaussians of words (S,) that may be sent."""
        sent = self.index.sent
        masks = self.tables.everything.union[words]
        return Seen(words, masks if sent is None else masks & pack(np.flatnonzero(sent), len(sent))[words])

    def count_shells(self, cell: int) -> int:
        """Return the number of shells around a cell, with those of what no cell sees."""
        return self.shells.count(cell) + (1 if self.is_small else -(-len(self.tables.everything.words) // _REST))

    def shell(self, here: Candidates, number: int) -> Shell:
        """Return a shell around a cell; cache it. The last shells have all Gaussians of the scene.

        Args:
            here: Candidates of the cell.
            number: Number of the shell.
        """
        made = self.tables.everything
        part = number - self.shells.count(here.cell)
        if self.is_small and number == 0:
            return Shell(Seen(made.words, here.union[: len(made.words)]), made)
        key = ("rest", part) if part >= 0 else (here.cell, number, 0 if number else here.step)
        found: Shell | None = self.shells.recent.find(key)
        if found is None:
            found, nbytes = self._make_shell(here, number, part)
            self.shells.recent.keep(key, found, nbytes)
        return found

    def _make_shell(self, here: Candidates, number: int, part: int) -> tuple[Shell, int]:
        """Return a shell and its bytes; `part` numbers the shells of what no cell sees, < 0 for other shells."""
        made = self.tables.everything
        if part >= 0:
            seen = self._all_in(made.words if self.is_small else made.words[_REST * part : _REST * (part + 1)])
        elif self.is_small:
            seen = Seen(made.words, self.seen.pack(self.shells.cells(here.cell, number))[: len(made.words)])
        elif number:
            seen = self.seen.join([[self.seen.of_cell(other) for other in self.shells.cells(here.cell, number)]])[1]
        else:
            seen = here.seen
        if self.is_small:
            return Shell(seen, made), seen.masks.nbytes  # shells differ in their masks alone
        units = self._units_of(1, Seen(seen.words, seen.masks & self.tables.highest[seen.words]))
        owing = self.tables.owing[seen.words]
        own = self._assemble(-1, [units], seen, self.tables.active, owing, 0.0, has_union=False)
        return Shell(seen, replace(own, term_bytes=made.term_bytes)), own.nbytes + seen.masks.nbytes

    def full_and_empty(self, slots: int) -> tuple[Words, Words]:
        """Return words with all bits set and words with none, both (S,). All clients share them: do not change them."""
        if len(self._words[0]) < slots:
            self._words = np.full(slots, ~np.uint64(0)), np.zeros(slots, np.uint64)
        full, empty = self._words
        return full[:slots], empty[:slots]

    def bounds_of(self, here: Candidates, shares: F64, *, make: bool) -> Bounds | None:
        """Return the bounds for the Gaussians that candidates replace; None if they are not cached and `make` is False.

        Args:
            here: Candidates of a cell.
            shares: (L,) see `Replacements.shares`.
            make: Whether to compute the bounds if they are not cached.
        """
        key = "bounds", here.cell, here.step, shares.tobytes()
        found: Bounds | None = self.cache.find(key)
        if found is None and make:
            known, *out = self.scratch.bounds()
            count = bound(here.seen, self.tables.links, self.index.last, shares, known, *out)
            found = Bounds(*(array[:count].copy() for array in out))
            self.cache.keep(key, found, sum(array.nbytes for array in found))
        return found

    def ahead_of(self, here: Candidates, cell: int) -> tuple[Words, Words, Words]:
        """Return what a cell near `here` adds to it for a viewer who is about to enter the cell.

        Args:
            here: Candidates of the viewer's cell.
            cell: The cell ahead.

        Returns:
            seen: (S,) the Gaussians that the cell ahead sees, in the words of `here`.
            owing: (S,) the Gaussians that own terms in `active`.
            active: (X,) the terms that may be active in one of the two cells.
        """
        seen = np.zeros_like(here.owing)
        owing = np.zeros_like(here.owing)
        kernels.find_masks(here.words, self.seen.of_cell(cell), seen)
        if self.index.cones is not None:
            return seen, here.owing, here.active
        there = self.in_cell(cell)
        kernels.find_masks(here.words, Seen(there.words, there.owing), owing)
        return seen, owing | here.owing, here.active | there.active

    def _assemble(
        self,
        cell: int,
        parts: list[Units],
        seen: Seen,
        active: Words,
        owing: Words,
        terms: float,
        sums: F64 | None = None,
        *,
        has_union: bool = True,
    ) -> Candidates:
        """Return the candidates that consist of units.

        Args:
            cell: Number of the cell; -1 for a shell.
            parts: Units of each ring, with words instead of slots.
            seen: All Gaussians of the units.
            active: (X,) terms that may be active.
            owing: (S,) the Gaussians that own some of them.
            terms: Number of active terms of these Gaussians.
            sums: (L * L,) bytes of what the cell itself sees, by first and last level; None for 0.
            has_union: Whether to make the packed set of all Gaussians.
        """
        of, *rest = parts[0] if len(parts) == 1 else (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
        words = seen.words
        slots = np.empty_like(of)
        kernels.slots_in(words, of, slots)
        starts = np.append(np.flatnonzero(np.diff(slots, prepend=-1)), len(slots)).astype(np.int32)
        rows = self.tables.spheres[words].T, self.tables.spreads[words][None], self.tables.word_bytes[words][None]
        levels = self.index.num_levels
        owned = terms * self.tables.numbers.term_size
        union: Words = blank(len(self.tables.spheres) if has_union else 0, np.uint64)
        if has_union:
            kernels.put_in(words, seen.masks, union)
        return Candidates(
            cell=cell,
            step=0,
            words=words,
            places=np.ascontiguousarray(np.concatenate(rows)),
            owing=owing,
            units=Units(slots, *rest),
            runs=Runs(starts, slots[starts[:-1]]),
            union=union,
            active=active,
            term_bytes=owned / max(ones(owing), 1),
            level_bytes=(np.zeros(levels) if sums is None else level_bytes(sums, levels)) + owned,
        )

    def _units_of(self, ring: int, members: Seen) -> Units:
        """Return the units of Gaussians as those of a ring, with words instead of slots."""
        starts = self.tables.everything.runs.starts  # every word has one run
        found = empty_units(int((starts[members.words + 1] - starts[members.words]).sum()))
        count = kernels.ring_units(members, starts, self.tables.every, found)
        found.codes[:count] += np.uint16(ring * self.index.num_levels**2)
        return Units(*(array[:count] for array in found))

    def _active_terms(self, cells: list[int]) -> tuple[Words, Words]:
        """Return the active terms (X,) of cells and the Gaussians (W,) that own them, as packed sets."""
        index = self.index
        owing = blank(len(self.tables.spheres), np.uint64)
        if index.active is None or not index.num_terms:
            return np.zeros(0, np.uint64), owing
        active = np.zeros(word_count(index.num_terms), np.uint64)
        for cell in cells:
            ids = _check.integers("terms", index.active.active_ids(cell), ("A",))
            _check.in_range("terms", ids, 0, index.num_terms - 1)
            kernels.active_words(ids, self.tables.owners, active, owing)
        return active, owing

    def _split_cell(self, seen: Seen, classes: NDArray[np.uint8], weights: F32, standing: I64) -> Units:
        """Return the units of the visible set of one cell, in ring 0, with words instead of slots.

        Args:
            seen: The V Gaussians of the set.
            classes: (V,) weight class of each.
            weights: (K,) weight of each class.
            standing: Ids of those that the cell sees at all levels above their last.
        """
        if ones(seen.masks) != len(classes):
            raise ValueError(f"classes: expected one for each member, got {len(classes)}")
        _check.in_range("classes", classes, 0, len(weights) - 1)
        found = empty_units(len(classes))
        words, masks = pack_some(standing)
        stands = np.zeros(len(seen.words) if len(words) else 0, np.uint64)
        stands[np.searchsorted(seen.words, words)] = masks
        of_cell = *_check.read_only(weights, stands), self.index.num_levels
        count = kernels.cell_units(seen, classes, self.tables.traits, *of_cell, found)
        return Units(*(array[:count] for array in found))
