"""What may be sent to a client in a cell: units of Gaussians that the cell and its neighbors see.

Candidates are computed once for a cell and shared by all clients in it. They do not depend on what a client holds or
looks at. Rings are 0 for the cell itself and 1, 2, 3 for neighbors by face, edge and corner. A Gaussian is in the first
ring that sees it, so the ring orders by distance to the nearest cell from which it is visible (section 6.3). Shells go
on from there to the end of the scene, for links with nothing better to do: shell 0 is the cell and its neighbors, each
further shell the next nearest cells. All shells share the units of the whole scene.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis._kernels.bits import count as ones
from gsvis.abr._kernels import plan
from gsvis.abr._kernels import units as kernels
from gsvis.abr._kernels.take import bound
from gsvis.abr._kernels.units import Runs, Units
from gsvis.abr.cones import TermCones
from gsvis.abr.index import SceneIndex
from gsvis.files.cache import Cache
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.codec import pack, word_count

__all__ = ["RINGS", "CandidateIndex", "Candidates", "ring_cells"]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I32 = NDArray[np.int32]
Words = NDArray[np.uint64]

RINGS = 4

_WHOLE = ("words", "places", "owing", "union", "active", "level_bytes")  # arrays of `CandidateIndex.everything`
_Tuple = TypeVar("_Tuple")

_WORKS = 64  # ways to divide scratch memory that a thread remembers
_SHELL = 8  # cells of a shell: its sets may all have to be read while a viewer waits


@dataclass(frozen=True, eq=False)
class Candidates:
    """U units of a cell and its neighbors, in S words.

    Attributes:
        cell: Number of the cell.
        words: (S,) int32 ascending, the words that have candidates: word w is Gaussians 64 w to 64 w + 63.
        places: (6, S) float32 for each word: center (x, y, z) and radius of a sphere around its Gaussians, mean square
            of their distance from its center, mean bytes of their records.
        owing: (S,) uint64, which Gaussians have terms in `active`.
        units: The units.
        runs: Where the ring or word of the units changes.
        union: (W,) uint64, all candidates.
        active: (X,) uint64, terms that may be active, as a packed set: the active terms of the cell, or all terms if
            the scene has cones; empty if it has no terms.
        term_bytes: Mean bytes of these terms of a Gaussian that has any.
        level_bytes: (L,) bytes of the Gaussians of each level that the cell itself sees, with their terms in `active`.
    """

    cell: int
    words: NDArray[np.int32]
    places: F32
    owing: Words
    units: Units
    runs: Runs
    union: Words
    active: Words
    term_bytes: float
    level_bytes: F64

    def __len__(self) -> int:
        """Return U."""
        return len(self.units.slots)

    @property
    def nbytes(self) -> int:
        """Bytes in memory."""
        arrays = *self.units, *self.runs, self.words, self.places, self.owing, self.union, self.active
        return sum(array.nbytes for array in arrays)


class CandidateIndex:
    """Candidates of the cells of a scene, computed on demand. Threads may share it.

    Args:
        index: The scene.
        pixel: Angle of a pixel of the clients, radians: the rasterizer adds 0.3 square pixels to the size of each
            Gaussian.
        stored: Bytes that a Gaussian and a term take in the memory of a client.
        cache: Cache of candidates and sets of cells; None means one of 256 MiB.

    Attributes:
        index: The scene.
        cache: The cache.
        pixel_area: Steradians that the rasterizer adds to the solid angle of each Gaussian.
        spheres: (W, 4) float32 center and radius of a sphere around the Gaussians of each word.
        spreads: (W,) float32 mean square of the distance of these Gaussians from the center.
        bodies: (4, 64 W) float32 center and radius of each Gaussian, coordinate by coordinate; the radius is -inf if
            there is no such Gaussian.
        least_sizes: Bytes of the smallest record of a Gaussian, and of a term.
        stored: Bytes that a Gaussian and a term take in the memory of a client.
        sent_per_stored: Least bytes of a record for each byte that it takes in the memory of a client.
        records: Bytes of all records.
        links: Which Gaussians replace which.
        everything: All Gaussians and all terms as candidates of no cell, in ring 1, to fill idle links.
        highest: (W,) uint64, the Gaussians of the highest level.
        all_bits: (W,) uint64, every bit set.
    """

    def __init__(
        self,
        index: SceneIndex,
        *,
        pixel: float = 2e-3,
        stored: tuple[float, float] = (16.0, 4.5),
        cache: Cache[Any] | None = None,
    ) -> None:
        if not 0.0 <= pixel < 1.0:
            raise ValueError(f"pixel: expected radians in [0, 1), got {pixel!r}")
        self.pixel_area = 2.0 * np.pi * 0.3 * pixel**2
        self.index, self.cache = index, Cache(256 << 20) if cache is None else cache
        count = word_count(len(index))
        self.spheres, self.spreads = np.zeros((count, 4), np.float32), np.zeros(count, np.float32)
        kernels.word_spheres(*_check.read_only(index.means, index.radii, index.areas), self.spheres, self.spreads)
        self._word_bytes = _word_means(index.gaussian_bytes, count)
        self._term_size = float(index.term_bytes.mean()) if index.num_terms else 0.0
        self.least_sizes = _least(index.gaussian_bytes), _least(index.term_bytes)
        self.bodies = np.zeros((4, 64 * count), np.float32)
        self.bodies[:3, : len(index)], self.bodies[3, : len(index)] = index.means.T, index.radii
        self.bodies[3, len(index) :] = -np.inf
        sizes = index.gaussian_bytes
        sizes = sizes[:1] if len(sizes) and sizes.min() == sizes.max() else sizes
        cones = TermCones.none() if index.cones is None else index.cones
        self.stored = stored
        ratios = [size / each for size, each in zip(self.least_sizes, stored, strict=True)]
        self.sent_per_stored = min(ratios) if index.num_terms else ratios[0]
        terms = index.term_offsets, index.term_bytes, cones.centers, cones.places, cones.cosines, cones.widths
        self.records = plan.Records(*_check.read_only(sizes, *terms, index.areas))
        self.links = _links(index)
        pairs = index.first.astype(np.uint16) * index.num_levels + index.last
        mixed = np.zeros(count, np.bool_)
        mixed[(np.flatnonzero(np.diff(pairs)) + 1) >> 6] = True
        self._traits = kernels.Traits(*_check.read_only(strengths(index, self.pixel_area), pairs, mixed))
        self._owners = np.repeat(np.arange(len(index), dtype=np.int32), np.diff(index.term_offsets))
        self._scratch, self._shell_counts = threading.local(), dict[int, int]()
        all_of_them = pack(np.arange(len(index)), len(index))
        weight = np.array([np.mean(index.class_weights)], np.float32)
        units = self._split(all_of_them, np.zeros(len(index), np.uint8), weight, all_of_them[:0])
        self._every = Units(*(array.copy() for array in units))
        sent = index.num_terms if index.cones is not None or index.active is not None else 0
        owners = np.flatnonzero(np.diff(index.term_offsets)) if sent else np.zeros(0, np.int64)
        self._every_term = pack(np.arange(sent), index.num_terms), pack(owners, len(index))
        self._word_terms = _word_means(np.diff(index.term_offsets), count)
        owned = float(sent)
        self.all_bits = np.full(count, ~np.uint64(0))
        self.everything = self._assemble(-1, [self._units_of(1, all_of_them)], all_of_them, *self._every_term, owned)
        self.highest = pack(np.flatnonzero(index.last == index.num_levels - 1), len(index))

    def to_arrays(self) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
        """Return all arrays by name, and all numbers, from which `from_arrays` makes the same object."""
        every, traits = self.everything, self._traits
        arrays = {
            "spheres": self.spheres, "spreads": self.spreads, "bodies": self.bodies, "highest": self.highest,
            "word_bytes": self._word_bytes, "word_terms": self._word_terms, "owners": self._owners,
            "strengths": traits.strengths, "pairs": traits.pairs, "mixed": traits.mixed,
            "active": self._every_term[0], "owing": self._every_term[1], **_named("record", self.records),
            **_named("link", self.links), **_named("every", self._every), **_named("unit", every.units),
            **_named("run", every.runs), **{f"all_{name}": getattr(every, name) for name in _WHOLE},
        }  # fmt: skip
        numbers = {
            "pixel_area": self.pixel_area, "term_size": self._term_size, "least_sizes": self.least_sizes,
            "stored": self.stored, "sent_per_stored": self.sent_per_stored, "term_bytes": every.term_bytes,
        }  # fmt: skip
        return arrays, numbers

    @classmethod
    def from_arrays(
        cls, index: SceneIndex, arrays: Mapping[str, NDArray[Any]], numbers: Mapping[str, Any], *, cache: Cache[Any]
    ) -> CandidateIndex:
        """Return the object that `to_arrays` took apart; read no array.

        Args:
            index: The scene.
            arrays: Arrays by name, such as views of a memory-mapped file.
            numbers: Numbers by name.
            cache: Cache of candidates and sets of cells.
        """
        self, a = cls.__new__(cls), arrays
        self.index, self.cache = index, cache
        self.pixel_area, self._term_size = numbers["pixel_area"], numbers["term_size"]
        self.least_sizes, self.stored = tuple(numbers["least_sizes"]), tuple(numbers["stored"])
        self.sent_per_stored = numbers["sent_per_stored"]
        self.spheres, self.spreads, self.bodies, self.highest = a["spheres"], a["spreads"], a["bodies"], a["highest"]
        self._word_bytes, self._word_terms, self._owners = a["word_bytes"], a["word_terms"], a["owners"]
        self._traits = kernels.Traits(*_check.read_only(a["strengths"], a["pairs"], a["mixed"]))
        self._every_term = a["active"], a["owing"]
        self.records, self.links = _typed("record", plan.Records, a), _typed("link", plan.Links, a)
        self._every = _typed("every", Units, a)
        self._scratch, self._shell_counts = threading.local(), dict[int, int]()
        self.all_bits = np.full(len(self.spheres), ~np.uint64(0))
        whole = {name: a[f"all_{name}"] for name in _WHOLE}
        self.everything = Candidates(
            cell=-1, units=_typed("unit", Units, a), runs=_typed("run", Runs, a), term_bytes=numbers["term_bytes"],
            **whole,
        )  # fmt: skip
        return self

    def in_cell(self, cell: int) -> Candidates:
        """Return the candidates of a cell.

        Raises:
            ValueError: If there is no such cell, or it names Gaussians or terms that the scene does not have.
        """
        found: Candidates | None = self.cache.find(("candidates", cell))
        if found is None:
            found = self.build(cell)
            self.cache.keep(("candidates", cell), found)
        return found

    def build(self, cell: int) -> Candidates:
        """Compute the candidates of a cell, without the cache.

        Raises:
            ValueError: If there is no such cell, or it names Gaussians or terms that the scene does not have.
        """
        index, levels = self.index, self.index.num_levels
        rings = ring_cells(index.grid, cell)
        seen = self.words_of(cell).copy()
        parts = [self._split(seen, index.sets.classes(cell)[1], index.class_weights, index.standing(cell))]
        sums = np.zeros(levels * levels)
        kernels.pair_bytes(parts[0].slots, parts[0].masks, parts[0].codes, self._word_bytes, sums)
        for ring in range(1, RINGS):
            parts.append(self._units_of(ring, self._add_cells(rings[ring], seen)))
        if index.cones is None:
            active, owing = self._active_terms([cell])
            terms = float(ones(active))
        else:  # which are active is tested for the eye
            active, owing = self._every_term[0], self._every_term[1] & seen
            own = np.zeros(levels * levels)
            kernels.pair_bytes(parts[0].slots, parts[0].masks, parts[0].codes, self._word_terms, own)
            terms = float(own.sum())
        return self._assemble(cell, parts, seen, active, owing, terms, sums)

    def shells(self, cell: int) -> list[list[int]]:
        """Return the cells of each shell around a cell, nearest first; all cells of the scene are in one of them."""
        grid = self.index.grid
        near = [other for ring in ring_cells(grid, cell) for other in ring]
        order = np.argsort(np.linalg.norm(grid.centers - grid.centers[cell], axis=1), kind="stable")
        far = order[~np.isin(order, near)].tolist()
        return [near, *(far[k : k + _SHELL] for k in range(0, len(far), _SHELL))]

    def num_shells(self, cell: int) -> int:
        """Return the number of shells around a cell."""
        if cell not in self._shell_counts:
            grid = self.index.grid
            self._shell_counts[cell] = 1 - (1 + len(grid.neighbors(cell)) - len(grid)) // _SHELL
        return self._shell_counts[cell]

    def words_of(self, cell: int) -> Words:
        """Return the visible set (W,) of a cell, packed; cache it, since cells share neighbors.

        Raises:
            ValueError: If it names Gaussians that the scene does not have.
        """
        words: Words | None = self.cache.find(("words", cell))
        if words is None:
            words = self.index.sets.visible_words(cell)
            n = len(self.index)
            last, spare = n // 64, n % 64
            whole = len(words) == word_count(n)
            if not whole or (last < len(words) and (int(words[last]) >> spare or words[last + 1 :].any())):
                raise ValueError(f"words: expected a set of {n:,} Gaussians, got another")
            self.cache.keep(("words", cell), words)
        return words

    def bounds_of(self, here: Candidates, shares: F64, *, make: bool) -> tuple[I32, I32] | None:
        """Return (E,) areas without which each of `links.ending` is not dropped, and (E,) which suffice, in units.

        Args:
            here: Candidates of a cell.
            shares: (L,) of the area of its replacements, by the level at which a Gaussian ends.
            make: Whether to compute them if they are not in the cache; None is returned otherwise.
        """
        key = "bounds", here.cell, shares.tobytes()
        found: tuple[I32, I32] | None = self.cache.find(key)
        if found is None and make:
            found = np.zeros(len(self.links.ending), np.int32), np.empty(len(self.links.ending), np.int32)
            bound(here.union, self.links, self.index.last, shares, *found)
            self.cache.keep(key, found, sum(bounds.nbytes for bounds in found))
        return found

    def ahead_of(self, here: Candidates, cell: int) -> tuple[Words, Words, Words]:
        """Return what a cell near `here` adds to it for a viewer who is about to enter the cell.

        Args:
            here: Candidates of the viewer's cell.
            cell: The cell ahead.

        Returns:
            seen: (S,) the Gaussians that the cell ahead sees, in the words of `here`.
            owing: (S,) those which own terms that may be active in one of the two cells.
            active: (X,) the terms that may be active in one of them.
        """
        if self.index.cones is not None:
            return self.words_of(cell)[here.words], here.owing, here.active
        there, owing = self.in_cell(cell), np.zeros(len(self.spheres), np.uint64)
        owing[there.words] = there.owing
        return self.words_of(cell)[here.words], owing[here.words] | here.owing, here.active | there.active

    def _assemble(
        self,
        cell: int,
        parts: list[Units],
        seen: Words,
        active: Words,
        owing: Words,
        terms: float,
        sums: F64 | None = None,
    ) -> Candidates:
        """Return candidates.

        Args:
            cell: Number of the cell.
            parts: Units of different rings, with words instead of slots.
            seen: All candidates.
            active: Active terms.
            owing: Gaussians that own some of the active terms that these units are to send.
            terms: Number of those.
            sums: (L * L,) bytes of what the cell itself sees, by first and last level.
        """
        held, *rest = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
        words = np.flatnonzero(seen).astype(np.int32)
        slot_of = np.empty(len(seen), np.int32)
        slot_of[words] = np.arange(len(words), dtype=np.int32)
        slots = slot_of[held]
        starts = np.append(np.flatnonzero(np.diff(slots, prepend=-1)), len(slots)).astype(np.int32)
        rows = self.spheres[words].T, self.spreads[words][None], self._word_bytes[words][None]
        levels, owned = self.index.num_levels, terms * self._term_size
        return Candidates(
            cell=cell,
            words=words,
            places=np.ascontiguousarray(np.concatenate(rows)),
            owing=owing[words],
            units=Units(slots, *rest),
            runs=Runs(starts, slots[starts[:-1]]),
            union=seen,
            active=active,
            term_bytes=owned / max(ones(owing), 1),
            level_bytes=(np.zeros(levels) if sums is None else _level_bytes(sums, levels)) + owned,
        )

    def work(self, slots: int, units: int, keys: int, terms: int = 1) -> plan.Work:
        """Return scratch memory of the calling thread; the next call overwrites it.

        Args:
            slots: S, number of words.
            units: U, number of units.
            keys: M, number of keys.
            terms: K, number of kinds of terms.
        """
        key = slots, units, keys, terms
        made: dict[tuple[int, ...], plan.Work] = self._scratch.__dict__.setdefault("made", {})
        if key not in made:
            if len(made) >= _WORKS:
                made.clear()
            made[key] = self._work(slots, units, keys, terms)
        return made[key]

    def _work(self, slots: int, units: int, keys: int, terms: int) -> plan.Work:
        local, entries, sizes = self._scratch, 3 * (1 + terms) * units, []
        for name, size, kinds in (
            ("slots", slots, (*3 * (np.uint64,), *2 * (np.uint8,), np.float32)), ("due", terms * slots, (np.uint64,)),
            ("units", units, (np.int32, np.int32)),
            ("entries", entries, (np.int32, np.int32, np.uint64, np.int32)), ("keys", keys, (np.int64, np.float64)),
        ):  # fmt: skip
            if not hasattr(local, name) or len(getattr(local, name)[0]) < size:
                local.made.clear()  # they have the memory before
                setattr(local, name, tuple(np.empty(size, kind) for kind in kinds))
            sizes.append([array[:size] for array in getattr(local, name)])
        (inside, middle, free, *sides, squares), (due,), of_units, listed, sums = sizes
        of_words = [inside, middle, free, due.reshape(terms, slots), *sides, squares]
        return plan.Work(*of_words, *of_units, *listed, *sums)

    def _add_cells(self, cells: list[int], seen: Words) -> Words:
        """Return what cells see that is not in `seen`, and add it."""
        fresh = np.zeros_like(seen)
        for other in cells:
            kernels.add_words(self.words_of(other), seen, fresh)
        seen |= fresh
        return fresh

    def _units_of(self, ring: int, members: Words) -> Units:
        """Return the units of any Gaussians, in a ring, with words instead of slots."""
        found = _room(len(self._every.slots))
        count = kernels.ring_units(members, self._every, found)
        found.codes[:count] += np.uint16(ring * self.index.num_levels**2)
        return Units(*(array[:count] for array in found))

    def _active_terms(self, cells: list[int]) -> tuple[Words, Words]:
        """Return the active terms of cells, and the Gaussians that own them."""
        index, owing = self.index, np.zeros(len(self.spheres), np.uint64)
        if index.active is None or not index.num_terms:
            return np.zeros(0, np.uint64), owing
        active = np.zeros(word_count(index.num_terms), np.uint64)
        for cell in cells:
            ids = _check.integers("terms", index.active.active_ids(cell), ("A",))
            _check.in_range("terms", ids, 0, index.num_terms - 1)
            kernels.active_words(ids, self._owners, active, owing)
        return active, owing

    def _split(self, words: Words, classes: NDArray[np.uint8], weights: F32, standing: Words) -> Units:
        """Return the units of the visible set of one cell, in ring 0, with words instead of slots."""
        if ones(words) != len(classes):
            raise ValueError(f"classes: expected one for each member, got {len(classes)}")
        _check.in_range("classes", classes, 0, len(weights) - 1)
        found = _room(len(classes))
        of_cell = *_check.read_only(weights, standing), self.index.num_levels
        count = kernels.cell_units(words, classes, self._traits, *of_cell, found)
        return Units(*(array[:count] for array in found))


def _named(prefix: str, arrays: Any) -> dict[str, NDArray[Any]]:
    """Return the arrays of a named tuple, as `prefix_field`."""
    return {f"{prefix}_{name}": array for name, array in arrays._asdict().items()}


def _typed(prefix: str, kind: Callable[..., _Tuple], arrays: Mapping[str, NDArray[Any]]) -> _Tuple:
    """Return the named tuple whose arrays `_named` named."""
    return kind(**{name: arrays[f"{prefix}_{name}"] for name in kind._fields})  # type: ignore[attr-defined]


def strengths(index: SceneIndex, pixel_area: float) -> F32:
    """Return (N, 2) per byte: importance times area, and importance times the area that a pixel adds at distance 1."""
    value = (index.importance / index.gaussian_bytes).astype(np.float64)
    both = np.stack([value * index.areas, value * pixel_area], axis=1)
    return np.minimum(both, 1e30).astype(np.float32)


def ring_cells(grid: Any, cell: int) -> list[list[int]]:
    """Return four lists: the cell, and its neighbors by face, by edge and by corner."""
    if not isinstance(grid, CellGrid):  # cells of several grids know their neighbors
        return grid.rings(cell)  # type: ignore[no-any-return]
    rings: list[list[int]] = [[grid.checked(cell)], [], [], []]
    others = grid.neighbors(cell)
    steps = np.abs(grid.coords[others] - grid.coords[cell]).sum(axis=1)
    for other, ring in zip(others.tolist(), steps.tolist(), strict=True):
        rings[ring].append(other)
    return rings


def _level_bytes(sums: F64, levels: int) -> F64:
    """Return the (L,) bytes of each level from (L * L,) bytes by first and last level."""
    square = sums.reshape(levels, levels)
    return np.array([square[: k + 1, k:].sum() for k in range(levels)])


def _room(count: int) -> Units:
    """Return uninitialized units to write to."""
    one = np.empty(count, np.float32)
    codes = np.empty(count, np.uint16)
    numbers = np.empty(count, np.int32), np.empty(count, np.uint64)
    return Units(*numbers, one, np.empty_like(one), codes, np.empty_like(one))


def _word_means(values: NDArray[Any], words: int) -> F32:
    """Return the (W,) mean of values (N,) over the Gaussians of each word."""
    out, starts = np.ones(words, np.float32), np.arange(0, len(values), 64)
    sums = np.add.reduceat(values, starts) if len(values) else np.zeros(0, np.float32)
    out[: len(starts)] = sums / np.minimum(64, len(values) - starts)
    return out


def _links(index: SceneIndex) -> plan.Links:
    """Return which Gaussians replace which."""
    ending = np.flatnonzero(np.diff(index.replacement_offsets)).astype(np.int32)
    starts = np.append(index.replacement_offsets[ending], len(index.replacement_ids))
    offsets, owners = index.replaced
    ranks = np.searchsorted(ending, owners).astype(np.int32)
    areas, counts = np.maximum(index.areas, np.float32(1e-30)).astype(np.float64), np.diff(offsets)
    theirs = areas[index.replacement_ids]
    every = np.add.reduceat(theirs, starts[:-1]) if len(ending) else np.zeros(0)
    units = np.ceil(plan.UNITS * np.repeat(areas, counts) / every[ranks]).astype(np.int32)
    only, only_units = np.full(len(index), plan.SEVERAL, np.int32), np.zeros(len(index), np.int32)
    one = counts == 1
    only[counts == 0], only[one], only_units[one] = -1, ranks[offsets[:-1][one]], units[offsets[:-1][one]]
    return plan.Links(
        only=only, offsets=offsets, ranks=ranks, units=units, only_units=only_units, ending=ending, starts=starts,
        ids=index.replacement_ids, areas=theirs.astype(np.float32), every=every,
    )  # fmt: skip


def _least(sizes: F32) -> float:
    return float(sizes.min()) if len(sizes) else 1.0
