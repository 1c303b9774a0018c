"""Compute the arrays of `CandidateTables` piece by piece, so that the scene need not fit into memory.

Pieces are ranges of consecutive ids. Gaussians and their replacements are written piece by piece, arrays of words of 64
ids block by block at the end. A `SceneIndex` in memory is one piece. Scene frame and units.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.abr._kernels import plan
from gsvis.abr._kernels import units as kernels
from gsvis.abr.cones import TermCones
from gsvis.abr.index import SceneIndex
from gsvis.abr.links import pack_single_links
from gsvis.abr.tables import CandidateTables, TableNumbers
from gsvis.abr.words import empty_units, strengths, word_means
from gsvis.files.mapped import ArrayLists, GrowingArrays
from gsvis.pvs.codec import pack, word_count

__all__ = [
    "FROZEN",
    "JOINED",
    "SAME",
    "PieceNumbers",
    "RecordSizes",
    "tables_of",
    "write_gaussians",
    "write_replaced",
    "write_replacements",
    "write_words",
]

I64 = NDArray[np.int64]
F32 = NDArray[np.float32]

JOINED = {"bodies": [f"body_{k}" for k in range(4)], "all_places": [f"place_{k}" for k in range(6)]}
"""Arrays whose rows are written as arrays of their own."""

SAME = {"all_active": "active", "every_slots": "unit_slots"} | {
    f"every_{name}": f"unit_{name}" for name in ("masks", "areas", "pixels", "logs")
}
"""Arrays with two names."""

FROZEN = (
    *("record_term_offsets", "record_term_sizes", "link_ids", "replacement_offsets", "first", "last"),
    *("record_sizes", "record_areas", "strengths", "pairs", "mixed"),
    *("record_centers", "record_places", "record_cosines", "record_widths"),
)
"""Arrays that are read-only, also in memory: numba compiles a kernel anew for writable arrays."""

_BLOCK = 1 << 16  # ids in a block; `word_count` rounds up to a multiple of it


@dataclass(frozen=True, eq=False)
class RecordSizes:
    """Bytes of the records of a scene.

    Attributes:
        gaussians: (N,) float32 of Gaussians, (1,) if all are equal.
        terms: (T,) float32 of terms, (1,) if all are equal; empty without terms.
    """

    gaussians: F32
    terms: F32

    @classmethod
    def of_means(cls, gaussian: float, term: float, terms: int) -> RecordSizes:
        """Return sizes with the same bytes for all Gaussians, and the same for all `terms` terms."""
        return cls(np.array([gaussian], np.float32), np.full(min(terms, 1), term, np.float32))

    def of_gaussians(self, low: int, high: int) -> F32:
        """Return the bytes of the Gaussians with ids in [low, high)."""
        if len(self.gaussians) == 1:
            return np.full(high - low, self.gaussians[0], np.float32)
        return self.gaussians[low:high]

    @property
    def least(self) -> tuple[float, float]:
        """Bytes of the smallest record of a Gaussian, and of a term; 1 where there is none."""
        return _least_size(self.gaussians), _least_size(self.terms)

    @property
    def mean_term(self) -> float:
        """Mean bytes of a term; 0 without terms."""
        return float(self.terms.mean()) if len(self.terms) else 0.0


@dataclass(frozen=True, eq=False)
class PieceNumbers:
    """Numbers of the whole scene that every piece needs.

    Attributes:
        gaussians: N, number of Gaussians.
        terms: T, number of terms.
        levels: L, number of levels.
        sizes: Bytes of records.
        pixel_area: Steradians that the rasterizer adds to the solid angle of each Gaussian.
        stored: Bytes that a Gaussian and a term take in the memory of a client.
        weight: Mean weight of a class.
        sends_terms: Whether terms are sent.
    """

    gaussians: int
    terms: int
    levels: int
    sizes: RecordSizes
    pixel_area: float
    stored: tuple[float, float]
    weight: float
    sends_terms: bool


def tables_of(index: SceneIndex, *, pixel: float = 2e-3, stored: tuple[float, float] = (16.0, 4.5)) -> CandidateTables:
    """Return the tables of a scene in memory.

    Args:
        index: The scene.
        pixel: Angle of a pixel of the clients, radians: the rasterizer adds 0.3 square pixels to the size of each
            Gaussian.
        stored: Bytes that a Gaussian and a term take in the memory of a client.

    Raises:
        ValueError: If the angle is out of range.
    """
    if not 0.0 <= pixel < 1.0:
        raise ValueError(f"pixel: expected radians in [0, 1), got {pixel!r}")
    n = len(index)
    sizes = index.gaussian_bytes
    sizes = sizes[:1] if n and sizes.min() == sizes.max() else sizes
    numbers = PieceNumbers(
        gaussians=n,
        terms=index.num_terms,
        levels=index.num_levels,
        sizes=RecordSizes(sizes, index.term_bytes),
        pixel_area=pixel_area(pixel),
        stored=stored,
        weight=float(np.mean(index.class_weights)),
        sends_terms=index.cones is not None or index.active is not None,
    )
    out = ArrayLists()
    bodies = index.means, index.radii, index.areas
    write_gaussians(out, *bodies, (index.first, index.last), numbers, importance=index.importance)
    out.append("owners", np.repeat(np.arange(n, dtype=np.int32), np.diff(index.term_offsets)))
    cones = TermCones.none() if index.cones is None else index.cones
    of_terms: dict[str, NDArray[Any]] = {
        "term_offsets": index.term_offsets,
        "term_sizes": index.term_bytes,
        "centers": cones.centers,
        "places": cones.places,
        "cosines": cones.cosines,
        "widths": cones.widths,
    }
    for name, array in of_terms.items():
        out.append(f"record_{name}", array)
    owners = np.repeat(np.arange(n), np.diff(index.replacement_offsets))
    ends = write_replacements(out, 0, n, np.stack([owners, index.replacement_ids.astype(np.int64)], axis=1))
    write_replaced(out, [(0, n)], [ends], [[0]])
    found = write_words(out, numbers)
    return CandidateTables.from_arrays(out.arrays(joined=JOINED, same=SAME, frozen=FROZEN), found)


def pixel_area(pixel: float) -> float:
    """Return the steradians that the rasterizer adds to each Gaussian, for pixels of `pixel` radians."""
    return float(2.0 * np.pi * 0.3 * pixel**2)


def write_gaussians(
    out: GrowingArrays,
    means: F32,
    radii: F32,
    areas: F32,
    levels: tuple[NDArray[np.uint8], NDArray[np.uint8]],
    numbers: PieceNumbers,
    *,
    importance: F32,
) -> None:
    """Append the G Gaussians of the next piece.

    Args:
        out: The arrays.
        means: (G, 3) centers.
        radii: (G,) distance at which each Gaussian ends.
        areas: (G,) mean cross-section.
        levels: (G,) first and (G,) last level.
        numbers: Numbers of the scene.
        importance: (G,) see `SceneIndex`.
    """
    low = out.count("body_3")
    for k in range(3):
        out.append(f"body_{k}", means[:, k])
    out.append("body_3", radii)
    out.append("record_areas", areas)
    first, last = levels
    out.append("first", first)
    out.append("last", last)
    out.append("pairs", first.astype(np.uint16) * np.uint16(numbers.levels) + last)
    sizes = numbers.sizes.of_gaussians(low, low + len(areas))
    out.append("strengths", strengths(importance, sizes, areas, numbers.pixel_area))


def write_replacements(out: GrowingArrays, low: int, count: int, pairs: I64) -> int:
    """Append the replacements of the Gaussians of a piece.

    Args:
        out: The arrays; areas of all replacements have been appended.
        low: First id of the piece.
        count: Number of its Gaussians.
        pairs: (P, 2) id of a Gaussian of the piece and id of a replacement; each pair once, ascending.

    Returns:
        Number of replaced Gaussians in this piece and those before it.
    """
    if low == 0:
        out.append("replacement_offsets", np.zeros(1, np.int64))
    before = out.count("link_ids")
    counts = np.bincount(pairs[:, 0] - low, minlength=count)
    offsets = before + np.cumsum(counts)
    out.append("replacement_offsets", offsets.astype(np.int64))
    ids = pairs[:, 1].astype(np.int32)
    out.append("link_ids", ids)
    ending = np.flatnonzero(counts)
    out.append("link_ending", (low + ending).astype(np.int32))
    starts = (offsets - counts)[ending]
    out.append("link_starts", starts.astype(np.int64))
    areas = _areas_of(out, ids)
    out.append("link_areas", areas.astype(np.float32))
    every = np.add.reduceat(areas, starts - before) if len(ending) else np.zeros(0)
    out.append("link_every", every)
    return out.count("link_ending")


def write_replaced(
    out: GrowingArrays, ranges: Sequence[tuple[int, int]], ends: Sequence[int], sources: Sequence[Iterable[int]]
) -> None:
    """Append which Gaussians each Gaussian replaces, for all pieces, after `write_replacements` for all of them.

    Args:
        out: The arrays.
        ranges: First id and end of each piece.
        ends: What `write_replacements` returned for each.
        sources: For each piece, the pieces whose Gaussians it may replace.
    """
    out.append("link_starts", np.array([out.count("link_ids")], np.int64))
    out.append("link_offsets", np.zeros(1, np.int64))
    for (low, high), some in zip(ranges, sources, strict=True):
        every = []
        ranks = []
        ids = []
        for k in sorted(some):
            (first, end), known = ranges[k], (ends[k - 1] if k else 0, ends[k])
            offsets = out.rows("replacement_offsets", first, end + 1)
            found = out.rows("link_ids", int(offsets[0]), int(offsets[-1]))
            mine = (found >= low) & (found < high)
            ids.append(found[mine] - low)
            owners = np.repeat(np.arange(first, end), np.diff(offsets))[mine]
            places = np.searchsorted(out.rows("link_ending", *known), owners)
            ranks.append(known[0] + places)
            every.append(out.rows("link_every", *known)[places])
        order = np.argsort(np.concatenate(ids), kind="stable")  # pieces ascend, so equal ids stay in order of owners
        counts = np.bincount(np.concatenate(ids), minlength=high - low)
        ranked = np.concatenate(ranks)[order].astype(np.int32)
        sums = np.concatenate(every)[order]
        areas = np.maximum(out.rows("record_areas", low, high), np.float32(1e-30)).astype(np.float64)
        units = np.ceil(plan.UNITS * np.repeat(areas, counts) / sums).astype(np.int32)
        out.append("link_offsets", out.count("link_ranks") + np.cumsum(counts) if low else np.cumsum(counts))
        for name, array in (("ranks", ranked), ("units", units)):
            out.append(f"link_{name}", array)


def write_words(out: GrowingArrays, numbers: PieceNumbers) -> TableNumbers:
    """Append the arrays of words of 64 Gaussians, and return the numbers of the tables."""
    owed = 0
    last_pair = np.zeros(0, np.uint16)
    for low in range(0, max(word_count(numbers.gaussians) * 64, 1), _BLOCK):
        found, last_pair = _write_block(out, numbers, low, last_pair)
        owed += found
    _pad_bodies(out, word_count(numbers.gaussians) * 64 - numbers.gaussians)
    out.append("run_starts", np.array([out.count("unit_slots")], np.int32))
    sent = numbers.terms if numbers.sends_terms else 0
    for low in range(0, max(numbers.terms, 1), _BLOCK):
        some = np.arange(min(_BLOCK, max(sent - low, 0)))
        out.append("active", pack(some, _BLOCK if numbers.terms else 0))
    size = numbers.sizes.mean_term
    out.append("all_level_bytes", np.zeros(numbers.levels) + sent * size)
    out.append("record_sizes", numbers.sizes.gaussians)
    least = numbers.sizes.least
    ratios = [bytes_sent / held for bytes_sent, held in zip(least, numbers.stored, strict=True)]
    return TableNumbers(
        pixel_area=numbers.pixel_area,
        term_size=size,
        term_bytes=sent * size / max(owed, 1),
        least_sizes=least,
        stored=numbers.stored,
        sent_per_stored=min(ratios) if numbers.terms else ratios[0],
    )


def _write_block(
    out: GrowingArrays, numbers: PieceNumbers, low: int, last_pair: NDArray[np.uint16]
) -> tuple[int, NDArray[np.uint16]]:
    """Append the arrays of the words of a block.

    Args:
        out: The arrays.
        numbers: Numbers of the scene.
        low: First id of the block.
        last_pair: (1,) levels of the Gaussian before the block, as in `Traits.pairs`; empty at the start.

    Returns:
        Number of its Gaussians that own terms that are sent, and the levels (1,) of its last Gaussian.
    """
    high = min(low + _BLOCK, numbers.gaussians)
    ids = min(_BLOCK, 64 * word_count(numbers.gaussians))
    words = ids // 64
    terms = np.diff(out.rows("record_term_offsets", low, high + 1))
    pairs = out.rows("pairs", low, high)
    mixed = np.zeros(words, np.bool_)
    before = last_pair if len(last_pair) else pairs[:1]
    mixed[np.flatnonzero(np.diff(pairs, prepend=before)) >> 6] = True
    owing = pack(np.flatnonzero(terms) if numbers.sends_terms else np.zeros(0, np.int64), ids)
    links = out.rows("link_offsets", low, high + 1)
    rows = int(links[0]), int(links[-1])
    only, firsts = pack_single_links(np.diff(links), out.rows("link_ranks", *rows), out.rows("link_units", *rows))
    nbytes = word_means(numbers.sizes.of_gaussians(low, high), words)
    named: dict[str, NDArray[Any]] = {
        "link_only": only,
        "link_firsts": firsts,
        "mixed": mixed,
        "highest": pack(np.flatnonzero(out.rows("last", low, high) == numbers.levels - 1), ids),
        "owing": owing,
        "word_bytes": nbytes,
        "word_terms": word_means(terms, words),
        "all_union": pack(np.arange(high - low), ids),
    }
    for name, array in named.items():
        out.append(name, array)
    own = _Block(
        first=low // 64,
        words=words,
        means=np.stack([out.rows(f"body_{k}", low, high) for k in range(3)], axis=1),
        radii=out.rows("body_3", low, high),
        areas=out.rows("record_areas", low, high),
        traits=kernels.Traits(*_check.read_only(out.rows("strengths", low, high), pairs, mixed)),
    )
    own.write(out, numbers, owing, nbytes)
    return int(np.count_nonzero(terms)) if numbers.sends_terms else 0, pairs[-1:]


@dataclass(frozen=True)
class _Block:
    """The Gaussians of a block of words.

    Attributes:
        first: Number of the first word.
        words: Number of words.
        means: (B, 3) centers.
        radii: (B,) distance at which each Gaussian ends.
        areas: (B,) mean cross-section.
        traits: Strengths and levels.
    """

    first: int
    words: int
    means: F32
    radii: F32
    areas: F32
    traits: kernels.Traits

    def write(self, out: GrowingArrays, numbers: PieceNumbers, owing: NDArray[np.uint64], nbytes: F32) -> None:
        """Append the spheres and the units of the words."""
        n = len(self.means)
        spheres = np.zeros((self.words, 4), np.float32)
        spreads = np.zeros(self.words, np.float32)
        kernels.word_spheres(*_check.read_only(self.means, self.radii, self.areas), spheres, spreads)
        out.append("spheres", spheres)
        out.append("spreads", spreads)
        used = -(-n // 64)
        for k, row in enumerate((*spheres.T, spreads, nbytes)):
            out.append(f"place_{k}", row[:used])
        out.append("all_words", np.arange(self.first, self.first + used, dtype=np.int32))
        out.append("all_owing", owing[:used])
        found = empty_units(n)
        weights = _check.read_only(np.array([numbers.weight], np.float32))[0]
        members = kernels.Seen(np.arange(used, dtype=np.int32), pack(np.arange(n), 64 * self.words)[:used])
        none = _check.read_only(np.zeros(0, np.uint64))[0]
        count = kernels.cell_units(members, np.zeros(n, np.uint8), self.traits, weights, none, numbers.levels, found)
        slots = found.slots[:count] + np.int32(self.first)
        starts = np.flatnonzero(np.diff(slots, prepend=-1)).astype(np.int32)
        before = out.count("unit_slots")
        out.append("run_starts", starts + np.int32(before))
        out.append("run_slots", slots[starts])
        out.append("unit_slots", slots)
        for name in ("masks", "areas", "pixels", "codes", "logs"):
            array = getattr(found, name)[:count]
            if name == "codes":
                out.append("every_codes", array)
                array = array + np.uint16(numbers.levels**2)
            out.append(f"unit_{name}", array)


def _pad_bodies(out: GrowingArrays, count: int) -> None:
    """Append `count` bodies with radius -inf, for ids without a Gaussian."""
    for k in range(3):
        out.append(f"body_{k}", np.zeros(count, np.float32))
    out.append("body_3", np.full(count, -np.inf, np.float32))


def _areas_of(out: GrowingArrays, ids: NDArray[np.int32]) -> NDArray[np.float64]:
    """Return the areas (M,) of Gaussians `ids` (M,), read in as few ranges as useful."""
    if not len(ids):
        return np.zeros(0)
    low = int(ids.min())
    high = int(ids.max()) + 1
    if high - low <= 4 * len(ids) + _BLOCK:
        found = out.rows("record_areas", low, high)[ids - low]
    else:  # ids of tiles that lie far apart
        order = np.argsort(ids, kind="stable")
        found = np.empty(len(ids), np.float32)
        cuts = np.flatnonzero(np.diff(ids[order]) > _BLOCK) + 1
        for part in np.split(order, cuts):
            some = ids[part]
            found[part] = out.rows("record_areas", int(some[0]), int(some[-1]) + 1)[some - some[0]]
    areas: NDArray[np.float64] = np.maximum(found, np.float32(1e-30)).astype(np.float64)
    return areas


def _least_size(sizes: F32) -> float:
    """Return the smallest size; 1 if there is none."""
    return float(sizes.min()) if len(sizes) else 1.0
