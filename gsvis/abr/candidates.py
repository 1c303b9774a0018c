"""What may be sent to a client in a cell: units of Gaussians that the cell and its neighbors see.

Candidates are computed once for a cell and shared by all clients in it. They do not depend on what a client holds or
looks at. Rings are 0 for the cell itself and 1, 2, 3 for neighbors by face, edge and corner. A Gaussian is in the first
ring that sees it, so the ring orders by distance to the nearest cell from which it is visible (section 6.3). Shells go
on from there to the end of the scene, for links with nothing better to do: shell 0 is the cell and its neighbors, each
further shell the next nearest cells. The last shells are what no cell sees: it is sent last, not never. Outside of all
cells the candidates of the nearest one are widened by the distance, see `gsvis.abr.outside`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis._kernels.bits import count as ones
from gsvis._kernels.blank import PAGE, blank
from gsvis.abr._kernels import plan
from gsvis.abr._kernels import units as kernels
from gsvis.abr._kernels.take import bound
from gsvis.abr._kernels.units import Runs, Seen, Units
from gsvis.abr.cones import TermCones
from gsvis.abr.index import SceneIndex
from gsvis.abr.links import links_of
from gsvis.abr.outside import near_cells, widen
from gsvis.abr.rings import RINGS, Shells, ring_cells
from gsvis.abr.scratch import Scratch
from gsvis.abr.seen import SeenSets
from gsvis.files.cache import Cache
from gsvis.pvs.codec import pack, pack_some, word_count

__all__ = ["CandidateIndex", "Candidates"]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
I32 = NDArray[np.int32]
Words = NDArray[np.uint64]

_DENSE = 1 << 16  # words of a scene up to which all of them are looked at in place of those of a shell
_REST = 1 << 13  # words of a shell of what no cell sees, in a larger scene
_WHOLE = ("words", "places", "owing", "union", "active", "level_bytes")  # arrays of `CandidateIndex.everything`
_Tuple = TypeVar("_Tuple")

_PAGE_BITS = (PAGE // 8).bit_length() - 1  # of a number of words


@dataclass(frozen=True, eq=False)
class Candidates:
    """U units of a cell and its neighbors, in S words.

    Attributes:
        cell: Number of the cell.
        step: How far outside of the cell they are for, see `gsvis.abr.outside`; 0 inside.
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
    step: int
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
        arrays = *self.units, *self.runs, self.words, self.places, self.owing, self.active
        pages = np.count_nonzero(np.diff(self.words >> _PAGE_BITS, prepend=-1)) * PAGE  # the others hold nothing
        return sum(array.nbytes for array in arrays) + min(int(pages), self.union.nbytes)

    @property
    def seen(self) -> Seen:
        """All candidates."""
        return Seen(self.words, self.union[self.words])


class Bounds(NamedTuple):
    """Bounds for B of the E Gaussians that others replace, of which a cell has candidates."""

    ends: I32  # (B,) numbers in [0, E)
    least: I32  # (B,) area of replacements, in units, without which each is not dropped
    sure: I32  # (B,) area that suffices, whatever it consists of


class Shell(NamedTuple):
    """What some cells around a viewer's cell see."""

    seen: Seen  # in the words of the candidates
    candidates: Candidates  # of it what is of the highest level, without a union; or `CandidateIndex.everything`


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
        everything: All Gaussians and terms as candidates of no cell, in ring 1: those of each shell of a small scene.
        highest: (W,) uint64, the Gaussians of the highest level.
        seen: What each cell sees.
        shells: The cells around each cell.
        scratch: Memory in which threads plan.
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
        self.links = links_of(index)
        pairs = index.first.astype(np.uint16) * index.num_levels + index.last
        mixed = np.zeros(count, np.bool_)
        mixed[(np.flatnonzero(np.diff(pairs)) + 1) >> 6] = True
        self._traits = kernels.Traits(*_check.read_only(strengths(index, self.pixel_area), pairs, mixed))
        self._owners = np.repeat(np.arange(len(index), dtype=np.int32), np.diff(index.term_offsets))
        self.scratch, self._words = Scratch(len(self.links.ending)), (np.zeros(0, np.uint64),) * 2
        self.seen, self.shells = SeenSets(index, self.cache), Shells(index.grid, self.cache)
        all_words = np.arange(-(-len(index) // 64), dtype=np.int32)
        every = Seen(all_words, pack(np.arange(len(index)), len(index))[: len(all_words)])
        weight = np.array([np.mean(index.class_weights)], np.float32)
        units = self._split(every, np.zeros(len(index), np.uint8), weight, np.zeros(0, np.int64))
        self._every = Units(*(array.copy() for array in units))
        sent = index.num_terms if index.cones is not None or index.active is not None else 0
        owners = np.flatnonzero(np.diff(index.term_offsets)) if sent else np.zeros(0, np.int64)
        self._every_term = pack(np.arange(sent), index.num_terms), pack(owners, len(index))
        self._word_terms = _word_means(np.diff(index.term_offsets), count)
        owned, owing = float(sent), self._every_term[1][: len(all_words)]
        units = self._every._replace(codes=self._every.codes + np.uint16(index.num_levels**2))
        self.everything = self._assemble(-1, [units], every, self._every_term[0], owing, owned)
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
        self.scratch, self._words = Scratch(len(self.links.ending)), (np.zeros(0, np.uint64),) * 2
        self.seen, self.shells = SeenSets(index, self.cache), Shells(index.grid, self.cache)
        whole = {name: a[f"all_{name}"] for name in _WHOLE}
        self.everything = Candidates(
            cell=-1, step=0, units=_typed("unit", Units, a), runs=_typed("run", Runs, a),
            term_bytes=numbers["term_bytes"], **whole,
        )  # fmt: skip
        return self

    def in_cell(self, cell: int, step: int = 0) -> Candidates:
        """Return the candidates of a cell, or for an eye that is so far outside of it.

        Raises:
            ValueError: If there is no such cell, or it names Gaussians or terms that the scene does not have.
        """
        found: Candidates = self.cache.find_or_make(("candidates", cell, step), lambda: self.build(cell, step))
        return found

    def has(self, cell: int, step: int = 0) -> bool:
        """Whether the candidates of a cell are in the cache."""
        return self.cache.find(("candidates", cell, step)) is not None

    def build(self, cell: int, step: int = 0) -> Candidates:
        """Compute the candidates of a cell, or for an eye that is so far outside of it, without the cache.

        Raises:
            ValueError: If there is no such cell, or it names Gaussians or terms that the scene does not have.
        """
        index, levels = self.index, self.index.num_levels
        rings, cells = ring_cells(index.grid, cell), [cell]
        seen_by = self.seen.of_rings(rings)
        if step == 0:
            classes, weights = index.sets.classes(cell)[1], index.class_weights
        else:
            cells = near_cells(index, self.shells, cell, step)
            every = self._all_in(self.everything.words) if self.is_small else None
            members, classes, weights = widen(index, self.seen, cells, step, every)
            seen_by[0] = [members]
        fresh, seen = self.seen.join(seen_by)
        parts = [self._split(fresh[0], classes, weights, index.standing(cell))]
        sums = np.zeros(levels * levels)
        kernels.pair_bytes(parts[0].slots, parts[0].masks, parts[0].codes, self._word_bytes, sums)
        parts += [self._units_of(ring, fresh[ring]) for ring in range(1, RINGS)]
        if index.cones is None:
            active, owners = self._active_terms(cells)
            owing, terms = owners[seen.words], float(ones(active))
        else:  # which are active is tested for the eye
            active, owing = self._every_term[0], self._every_term[1][seen.words] & seen.masks
            own = np.zeros(levels * levels)
            kernels.pair_bytes(parts[0].slots, parts[0].masks, parts[0].codes, self._word_terms, own)
            terms = float(own.sum())
        return replace(self._assemble(cell, parts, seen, active, owing, terms, sums), step=step)

    @property
    def is_small(self) -> bool:
        """Whether passes over all words of the scene take less time than lists of some."""
        return len(self.everything.words) <= _DENSE

    def _all_in(self, words: I32) -> Seen:
        """Return all Gaussians of some words (S,) that may be sent."""
        sent, masks = self.index.sent, self.everything.union[words]
        return Seen(words, masks if sent is None else masks & pack(np.flatnonzero(sent), len(sent))[words])

    def count_shells(self, cell: int) -> int:
        """Return the number of shells around a cell; all records are in one of them, in the last what no cell sees."""
        return self.shells.count(cell) + (1 if self.is_small else -(-len(self.everything.words) // _REST))

    def shell(self, here: Candidates, number: int) -> Shell:
        """Return what the cells of a shell around a cell see, or part of the whole scene in the last; cache it.

        Args:
            here: Candidates of the cell.
            number: Number of the shell.
        """
        made, part = self.everything, number - self.shells.count(here.cell)
        if self.is_small and number == 0:
            return Shell(Seen(made.words, here.union[: len(made.words)]), made)
        key = ("rest", part) if part >= 0 else (here.cell, number, 0 if number else here.step)
        found: Shell | None = self.shells.recent.find(key)
        if found is None:
            found, nbytes = self._make_shell(here, number, part)
            self.shells.recent.keep(key, found, nbytes)
        return found

    def _make_shell(self, here: Candidates, number: int, part: int) -> tuple[Shell, int]:
        """Return a shell and its bytes in memory; `part` is that of what no cell sees, below 0 for other shells."""
        made = self.everything
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
        units = self._units_of(1, Seen(seen.words, seen.masks & self.highest[seen.words]))
        owing = self._every_term[1][seen.words]
        own = self._assemble(-1, [units], seen, self._every_term[0], owing, 0.0, has_union=False)
        return Shell(seen, replace(own, term_bytes=made.term_bytes)), own.nbytes + seen.masks.nbytes

    def full_and_empty(self, slots: int) -> tuple[Words, Words]:
        """Return full words and empty words, both (S,), which all clients share: not to be changed."""
        if len(self._words[0]) < slots:
            self._words = np.full(slots, ~np.uint64(0)), np.zeros(slots, np.uint64)
        full, empty = self._words
        return full[:slots], empty[:slots]

    def bounds_of(self, here: Candidates, shares: F64, *, make: bool) -> Bounds | None:
        """Return what has to arrive before Gaussians are dropped, for those that candidates replace.

        Args:
            here: Candidates of a cell.
            shares: (L,) of the area of its replacements, by the level at which a Gaussian ends.
            make: Whether to compute them if they are not in the cache; None is returned otherwise.
        """
        key = "bounds", here.cell, here.step, shares.tobytes()
        found: Bounds | None = self.cache.find(key)
        if found is None and make:
            known, *out = self.scratch.bounds()
            count = bound(here.seen, self.links, self.index.last, shares, known, *out)
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
            owing: (S,) those which own terms that may be active in one of the two cells.
            active: (X,) the terms that may be active in one of them.
        """
        seen, owing = np.zeros_like(here.owing), np.zeros_like(here.owing)
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
        """Return candidates of units in different rings, with words instead of slots.

        `owing` (S,) owns some of the active terms that these units are to send, `terms` of them; `sums` (L * L,) are
        bytes of what the cell itself sees, by first and last level.
        """
        of, *rest = parts[0] if len(parts) == 1 else (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
        words, slots = seen.words, np.empty_like(of)
        kernels.slots_in(words, of, slots)
        starts = np.append(np.flatnonzero(np.diff(slots, prepend=-1)), len(slots)).astype(np.int32)
        rows = self.spheres[words].T, self.spreads[words][None], self._word_bytes[words][None]
        levels, owned = self.index.num_levels, terms * self._term_size
        union: Words = blank(len(self.spheres) if has_union else 0, np.uint64)
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
            level_bytes=(np.zeros(levels) if sums is None else _level_bytes(sums, levels)) + owned,
        )

    def _units_of(self, ring: int, members: Seen) -> Units:
        """Return the units of any Gaussians, in a ring, with words instead of slots."""
        starts, words = self.everything.runs.starts, members.words  # every word has one run
        found = _room(int((starts[words + 1] - starts[words]).sum()))
        count = kernels.ring_units(members, starts, self._every, found)
        found.codes[:count] += np.uint16(ring * self.index.num_levels**2)
        return Units(*(array[:count] for array in found))

    def _active_terms(self, cells: list[int]) -> tuple[Words, Words]:
        """Return the active terms of cells, and the Gaussians that own them."""
        index, owing = self.index, blank(len(self.spheres), np.uint64)
        if index.active is None or not index.num_terms:
            return np.zeros(0, np.uint64), owing
        active = np.zeros(word_count(index.num_terms), np.uint64)
        for cell in cells:
            ids = _check.integers("terms", index.active.active_ids(cell), ("A",))
            _check.in_range("terms", ids, 0, index.num_terms - 1)
            kernels.active_words(ids, self._owners, active, owing)
        return active, owing

    def _split(self, seen: Seen, classes: NDArray[np.uint8], weights: F32, standing: I64) -> Units:
        """Return the units of the visible set of one cell, in ring 0, with words instead of slots."""
        if ones(seen.masks) != len(classes):
            raise ValueError(f"classes: expected one for each member, got {len(classes)}")
        _check.in_range("classes", classes, 0, len(weights) - 1)
        found = _room(len(classes))
        words, masks = pack_some(standing)
        stands = np.zeros(len(seen.words) if len(words) else 0, np.uint64)
        stands[np.searchsorted(seen.words, words)] = masks
        of_cell = *_check.read_only(weights, stands), self.index.num_levels
        count = kernels.cell_units(seen, classes, self._traits, *of_cell, found)
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


def _least(sizes: F32) -> float:
    return float(sizes.min()) if len(sizes) else 1.0
