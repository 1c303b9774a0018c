"""What may be sent to a client in a cell: units of Gaussians that the cell and its neighbors see.

Made once for a cell and shared by all clients in it; what changes with a client, where it looks and what it holds, is
not known here. Rings are 0 for the cell itself and 1, 2, 3 for neighbors by face, edge and corner; a Gaussian is in
the first ring that sees it, so the ring orders by distance to the nearest cell from which it is visible (section 6.3).
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis._kernels.bits import count as ones
from gsvis.abr._kernels import units as kernels
from gsvis.abr._kernels.plan import SEVERAL
from gsvis.abr.index import CellMembers, SceneIndex
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.codec import word_count

__all__ = ["RINGS", "CandidateStore", "Candidates", "ring_cells"]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Words = NDArray[np.uint64]

RINGS = 4


@dataclass(frozen=True, eq=False)
class Candidates:
    """U units of a cell and its neighbors, in S words.

    Attributes:
        cell: Its number.
        words: (S,) int32 rising, the words that have candidates: Gaussians 64 w to 64 w + 63.
        places: (6, S) float32 of each word: middle (x, y, z) and radius of a sphere around its Gaussians, mean square
            of their distance from its middle, mean bytes of their records.
        own: (S,) uint64, which the cell itself sees.
        owing: (S,) uint64, which of them have active terms.
        slots: (U,) int32, number of the word of each unit, in [0, S).
        masks: (U,) uint64, which Gaussians of it.
        areas: (U,) float32, mean weight times area, for each byte.
        pixels: (U,) float32, mean weight times the area that a pixel adds at distance 1, for each byte.
        codes: (U,) uint16: (ring L + first level) L + last level.
        starts: (R + 1,) int32, where the units of another ring or word begin, and U.
        run_slots: (R,) int32, number of that word.
        union: (W,) uint64, all candidates.
        active: (X,) uint64, active terms of the cell as a packed set; empty where the scene has no terms.
        term_bytes: Mean bytes of the active terms of a Gaussian that has some.
        level_bytes: (L,) bytes of what the cell itself sees of each level, with its active terms.
    """

    cell: int
    words: NDArray[np.int32]
    places: F32
    own: Words
    owing: Words
    slots: NDArray[np.int32]
    masks: Words
    areas: F32
    pixels: F32
    codes: NDArray[np.uint16]
    starts: NDArray[np.int32]
    run_slots: NDArray[np.int32]
    union: Words
    active: Words
    term_bytes: float
    level_bytes: F64

    def __len__(self) -> int:
        return len(self.slots)

    @property
    def units(self) -> tuple[Any, ...]:
        """What the kernels take."""
        return self.slots, self.masks, self.areas, self.pixels, self.codes

    @property
    def runs(self) -> tuple[Any, ...]:
        """Where units of another ring or word begin, and the number of the word."""
        return self.starts, self.run_slots

    @property
    def nbytes(self) -> int:
        """Bytes in memory."""
        return sum(
            array.nbytes
            for array in (*self.units, *self.runs, self.words, self.places, self.own, self.union, self.active)
        )


class CandidateStore:
    """Candidates of the cells of a scene, made when asked for and kept while there is room. Safe to share by threads.

    Args:
        index: The scene.
        pixel: Angle of a pixel of the clients, radians: the rasterizer adds 0.3 square pixels to the size of each
            Gaussian.
        max_bytes: Most bytes of candidates kept; those used last stay in any case.

    Attributes:
        index: As given.
        spheres: (W, 4) float32 middle and radius of a sphere around the Gaussians of each word.
        spreads: (W,) float32 mean square of their distance from its middle.
        word_bytes: (W,) float32 mean bytes of their records.
        bodies: (4, 64 W) float32 middle and radius of each Gaussian, coordinate by coordinate; where there is none, a
            radius of -inf.
        term_size: Mean bytes of a term.
        least_sizes: Bytes of the smallest record of a Gaussian, and of a term.
        sizes: Bytes of the record of each Gaussian; (1,) where they are alike.
        ending: (E,) int32 ids of the Gaussians that are replaced by others.
        links: (N,) int32 number, in [0, E), of the one whose place each Gaussian takes, -1 for none, -2 for several;
            offsets (N + 1,) and numbers of all of them; `ending`; their offsets (E + 1,) and ids of replacements.
    """

    def __init__(self, index: SceneIndex, *, pixel: float = 2e-3, max_bytes: int = 256 << 20) -> None:
        if not 0.0 <= pixel < 1.0:
            raise ValueError(f"pixel: expected radians in [0, 1), got {pixel!r}")
        self.index = index
        self.max_bytes = _check.positive_int("max_bytes", max_bytes, at_least=0)
        count = word_count(len(index))
        self.spheres, self.spreads = np.zeros((count, 4), np.float32), np.zeros(count, np.float32)
        kernels.word_spheres(index.means, index.radii, index.areas, self.spheres, self.spreads)
        starts = np.arange(0, len(index), 64)
        sums = np.add.reduceat(index.gaussian_bytes, starts) if len(index) else np.zeros(0, np.float32)
        self.word_bytes = np.ones(count, np.float32)
        self.word_bytes[: len(starts)] = sums / np.minimum(64, len(index) - starts)
        self.term_size = float(index.term_bytes.mean()) if index.num_terms else 0.0
        self.least_sizes = _least(index.gaussian_bytes), _least(index.term_bytes)
        self.bodies = np.zeros((4, 64 * count), np.float32)
        self.bodies[:3, : len(index)], self.bodies[3, : len(index)] = index.means.T, index.radii
        self.bodies[3, len(index) :] = -np.inf
        self.ending = np.flatnonzero(np.diff(index.replacement_offsets)).astype(np.int32)
        offsets, owners = index.replaced
        numbers = np.searchsorted(self.ending, owners).astype(np.int32)
        starts = np.append(index.replacement_offsets[self.ending], len(index.replacement_ids))
        only = np.full(len(index), SEVERAL, np.int32)
        counts = np.diff(offsets)
        only[counts == 0], only[counts == 1] = -1, numbers[offsets[:-1][counts == 1]]
        self.links = only, offsets, numbers, self.ending, starts, index.replacement_ids
        sizes = index.gaussian_bytes
        self.sizes = sizes[:1] if len(sizes) and sizes.min() == sizes.max() else sizes
        self._strengths = strengths(index, pixel)
        self._pairs = index.first.astype(np.uint16) * index.num_levels + index.last
        self._mixed = np.zeros(count, np.bool_)
        self._mixed[(np.flatnonzero(np.diff(self._pairs)) + 1) >> 6] = True
        self._owners = np.repeat(np.arange(len(index), dtype=np.int32), np.diff(index.term_offsets))
        self._scratch = threading.local()
        every = CellMembers.of(np.arange(len(index)), len(index))
        units = self._units(every, np.full(1, np.mean(index.class_weights), np.float32))
        self._every = tuple(array.copy() for array in units)
        self._kept: OrderedDict[int, Candidates] = OrderedDict()
        self._bytes = 0
        self._lock = threading.Lock()

    @property
    def nbytes(self) -> int:
        """Bytes of the candidates kept."""
        return self._bytes

    def of(self, cell: int) -> Candidates:
        """The candidates of a cell.

        Raises:
            ValueError: If there is no such cell.
        """
        with self._lock:
            found = self._kept.get(cell)
            if found is not None:
                self._kept.move_to_end(cell)
                return found
        made = self.build(cell)
        with self._lock:
            if cell not in self._kept:
                self._kept[cell] = made
                self._bytes += made.nbytes
                while self._bytes > self.max_bytes and len(self._kept) > 1:
                    self._bytes -= self._kept.popitem(last=False)[1].nbytes
        return made

    def build(self, cell: int) -> Candidates:
        """Return the candidates of a cell, made anew.

        Raises:
            ValueError: If the cell names Gaussians or terms that the scene does not have.
        """
        index, levels = self.index, self.index.num_levels
        rings = ring_cells(index.grid, cell)
        own = index.cells.members(cell)
        seen = own.words.copy()
        parts = [self._units(own, index.class_weights)]
        sums = np.zeros(levels * levels)
        kernels.pair_bytes(*parts[0][:2], parts[0][4], self.word_bytes, sums)
        for ring in range(1, RINGS):
            fresh = np.zeros_like(seen)
            for other in rings[ring]:
                kernels.add_words(self._checked_words(index.cells.words(other)), seen, fresh)
            seen |= fresh
            found = _empty(len(self._every[0]))
            count = kernels.ring_units(fresh, self._every, found)
            found[4][:count] += np.uint16(ring * levels * levels)
            parts.append(tuple(array[:count] for array in found))
        held, masks, areas, pixels, codes = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
        words = np.flatnonzero(seen).astype(np.int32)
        slot_of = np.empty(len(seen), np.int32)
        slot_of[words] = np.arange(len(words), dtype=np.int32)
        slots = slot_of[held]
        starts = np.append(np.flatnonzero(np.diff(slots, prepend=-1)), len(slots)).astype(np.int32)
        active, owing, terms = np.zeros(0, np.uint64), np.zeros_like(seen), 0
        if index.num_terms:
            ids = index.cells.terms(cell)
            _check.in_range("terms", ids, 0, index.num_terms - 1)
            active, terms = np.zeros(word_count(index.num_terms), np.uint64), len(ids)
            kernels.active_words(ids, self._owners, active, owing)
        rows = self.spheres[words].T, self.spreads[words][None], self.word_bytes[words][None]
        places = np.ascontiguousarray(np.concatenate(rows))
        return Candidates(
            cell, words, places, own.words[words], owing[words], slots, masks, areas, pixels, codes, starts,
            slots[starts[:-1]], seen, active, terms * self.term_size / max(ones(owing), 1),
            _level_bytes(sums, levels) + terms * self.term_size,
        )  # fmt: skip

    def room(self, slots: int, units: int, keys: int) -> tuple[Any, ...]:
        """Room to rank in, one for each thread, the same when asked for again; see `_kernels_plan.rank`."""
        local = self._scratch
        for name, size, kinds in (
            ("slots", slots, (*3 * (np.uint64,), np.uint8, np.float32)),
            ("units", units, (np.float32, np.int32, np.int32)),
            ("entries", 4 * units, (np.int32, np.int32, np.uint64)), ("keys", keys, (np.int64, np.float64)),
        ):  # fmt: skip
            if not hasattr(local, name) or len(getattr(local, name)[0]) < size:
                setattr(local, name, tuple(np.empty(size, kind) for kind in kinds))
        parts = (local.slots, slots), (local.units, units), (local.entries, 4 * units), (local.keys, keys)
        return tuple(array[:size] for arrays, size in parts for array in arrays)

    def _checked_words(self, words: Words) -> Words:
        """The words, if they are a set of Gaussians of the scene: kernels write by what is in them."""
        n = len(self.index)
        last, spare = n // 64, n % 64
        whole = len(words) == word_count(n)
        if not whole or (last < len(words) and (int(words[last]) >> spare or words[last + 1 :].any())):
            raise ValueError(f"words: expected a set of {n:,} Gaussians, got another")
        return words

    def _units(self, members: CellMembers, weights: F32) -> tuple[Any, ...]:
        """Units of what one cell sees, ring 0."""
        if ones(self._checked_words(members.words)) != len(members.classes):
            raise ValueError(f"classes: expected one for each member, got {len(members.classes)}")
        _check.in_range("classes", members.classes, 0, len(weights) - 1)
        found = _empty(len(members.classes))
        scene = self._strengths, self._pairs, self._mixed
        count = kernels.cell_units((members.words, members.classes), scene, weights, found)
        return tuple(array[:count] for array in found)


def strengths(index: SceneIndex, pixel: float) -> F32:
    """(N, 2) importance times area, and times the area that a pixel adds at distance 1; for each byte."""
    value = (index.importance / index.gaussian_bytes).astype(np.float64)
    both = np.stack([value * index.areas, value * (2.0 * np.pi * 0.3 * pixel**2)], axis=1)
    return np.minimum(both, 1e30).astype(np.float32)


def ring_cells(grid: CellGrid, cell: int) -> list[list[int]]:
    """The cell, and its neighbors by face, by edge and by corner: four lists."""
    rings: list[list[int]] = [[grid.checked(cell)], [], [], []]
    others = grid.neighbors(cell)
    steps = np.abs(grid.coords[others] - grid.coords[cell]).sum(axis=1)
    for other, ring in zip(others.tolist(), steps.tolist(), strict=True):
        rings[ring].append(other)
    return rings


def _level_bytes(sums: F64, levels: int) -> F64:
    """(L,) bytes of each level from those by first and last level."""
    square = sums.reshape(levels, levels)
    return np.array([square[: k + 1, k:].sum() for k in range(levels)])


def _empty(count: int) -> tuple[Any, ...]:
    one = np.empty(count, np.float32)
    return np.empty(count, np.int32), np.empty(count, np.uint64), one, np.empty_like(one), np.empty(count, np.uint16)


def _least(sizes: F32) -> float:
    return float(sizes.min()) if len(sizes) else 1.0
