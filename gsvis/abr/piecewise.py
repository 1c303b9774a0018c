"""The arrays of a `CandidateIndex`, computed piece by piece into files, for scenes that do not fit the memory.

Pieces are ranges of consecutive ids. What replaces what is known piece by piece; what belongs to words of 64 ids is
computed block by block at the end. The arrays equal those of `CandidateIndex.to_arrays`. Scene frame and units.
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
from gsvis.abr.links import only_links
from gsvis.abr.words import room, word_means
from gsvis.files.mapped import ArrayFiles
from gsvis.pvs.codec import pack, word_count

__all__ = [
    "FROZEN",
    "JOINED",
    "SAME",
    "PieceNumbers",
    "write_gaussians",
    "write_links",
    "write_reversed",
    "write_words",
]

I64 = NDArray[np.int64]
F32 = NDArray[np.float32]

JOINED = {"bodies": [f"body_{k}" for k in range(4)], "all_places": [f"place_{k}" for k in range(6)]}
"""Arrays that are written row by row."""

SAME = {"all_active": "active", "every_slots": "unit_slots"} | {
    f"every_{name}": f"unit_{name}" for name in ("masks", "areas", "pixels", "logs")
}
"""Arrays with two names."""

FROZEN = (
    *("record_term_offsets", "record_term_sizes", "link_ids", "replacement_offsets", "first", "last"),
    *("record_sizes", "record_areas", "strengths", "pairs", "mixed"),
)
"""Arrays that nobody may write to, as in a scene in memory: kernels are compiled for one of the two."""

_BLOCK = 1 << 16  # ids; `word_count` rounds up to as many


@dataclass(frozen=True)
class PieceNumbers:
    """Numbers of the whole scene.

    Attributes:
        gaussians: N.
        terms: T.
        levels: L.
        nbytes: Mean bytes of a record of a Gaussian.
        term_bytes: And of a term.
        pixel_area: Steradians that the rasterizer adds to the solid angle of each Gaussian.
        weight: Mean weight of a class.
    """

    gaussians: int
    terms: int
    levels: int
    nbytes: float
    term_bytes: float
    pixel_area: float
    weight: float


def write_gaussians(
    out: ArrayFiles,
    means: F32,
    radii: F32,
    areas: F32,
    levels: tuple[NDArray[np.uint8], NDArray[np.uint8]],
    numbers: PieceNumbers,
) -> None:
    """Append the Gaussians of a piece: bodies, levels, strengths."""
    for k in range(3):
        out.append(f"body_{k}", means[:, k])
    out.append("body_3", radii)
    out.append("record_areas", areas)
    first, last = levels
    out.append("first", first)
    out.append("last", last)
    out.append("pairs", first.astype(np.uint16) * np.uint16(numbers.levels) + last)
    value = (np.ones(len(areas), np.float32) / np.float32(numbers.nbytes)).astype(np.float64)
    both = np.stack([value * areas, value * numbers.pixel_area], axis=1)
    out.append("strengths", np.minimum(both, 1e30).astype(np.float32))


def write_links(out: ArrayFiles, low: int, count: int, pairs: I64) -> int:
    """Append what replaces the Gaussians of a piece, and return how many are replaced by now.

    Args:
        out: The arrays; the areas of all that are named here are there.
        low: First id of the piece.
        count: Its Gaussians.
        pairs: (P, 2) Gaussian of the piece and id of a replacement; each pair once, ascending.
    """
    if low == 0:
        out.append("replacement_offsets", np.zeros(1, np.int64))
    before = 0 if low == 0 else out.count("link_ids")
    counts = np.bincount(pairs[:, 0] - low, minlength=count)
    offsets = before + np.cumsum(counts)
    out.append("replacement_offsets", offsets.astype(np.int64))
    ids = pairs[:, 1].astype(np.int32)
    out.append("link_ids", ids)
    ending = np.flatnonzero(counts)
    out.append("link_ending", (low + ending).astype(np.int32))
    starts = (offsets - counts)[ending]
    out.append("link_starts", starts.astype(np.int64))
    theirs = _areas_of(out, ids)
    out.append("link_areas", theirs.astype(np.float32))
    every = np.add.reduceat(theirs, starts - before) if len(ending) else np.zeros(0)
    out.append("link_every", every)
    return out.count("link_ending")


def write_reversed(
    out: ArrayFiles, ranges: Sequence[tuple[int, int]], ends: Sequence[int], sources: Sequence[Iterable[int]]
) -> None:
    """Append what each Gaussian replaces, piece by piece, when `write_links` was called for all.

    Args:
        out: The arrays.
        ranges: First id and end of each piece.
        ends: What `write_links` returned for each.
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


def write_words(out: ArrayFiles, numbers: PieceNumbers) -> dict[str, Any]:
    """Append everything about words of 64 Gaussians, and return the numbers of `CandidateIndex.from_arrays`."""
    n = numbers.gaussians
    owed = 0
    last_pair = None
    for low in range(0, word_count(n) * 64, _BLOCK):
        high = min(low + _BLOCK, n)
        terms = np.diff(out.rows("record_term_offsets", low, high + 1))
        means = np.stack([out.rows(f"body_{k}", low, high) for k in range(3)], axis=1)
        radii = out.rows("body_3", low, high)
        areas = out.rows("record_areas", low, high)
        pairs = out.rows("pairs", low, high)
        lasts = out.rows("last", low, high)
        mixed = np.zeros(_BLOCK // 64, np.bool_)
        before = pairs[0] if last_pair is None else last_pair
        mixed[np.flatnonzero(np.diff(pairs, prepend=before)) >> 6], last_pair = True, pairs[-1]
        owing = pack(np.flatnonzero(terms) if numbers.terms else np.zeros(0, np.int64), _BLOCK)
        owed += int(np.count_nonzero(terms)) if numbers.terms else 0
        traits = kernels.Traits(*_check.read_only(out.rows("strengths", low, high), pairs, mixed))
        own = _Block(low // 64, means, radii, areas, traits)
        sizes = np.full(high - low, numbers.nbytes, np.float32)
        links = out.rows("link_offsets", low, high + 1)
        rows = int(links[0]), int(links[-1])
        only, firsts = only_links(np.diff(links), out.rows("link_ranks", *rows), out.rows("link_units", *rows))
        named: dict[str, NDArray[Any]] = {
            "link_only": only,
            "link_firsts": firsts,
            "mixed": mixed,
            "highest": pack(np.flatnonzero(lasts == numbers.levels - 1), _BLOCK),
            "owing": owing,
            "word_bytes": word_means(sizes, _BLOCK // 64),
            "word_terms": word_means(terms, _BLOCK // 64),
            "all_union": pack(np.arange(high - low), _BLOCK),
        }
        for name, array in named.items():
            out.append(name, array)
        own.write(out, numbers, owing, named["word_bytes"])
    _pad_bodies(out, word_count(n) * 64 - n)
    out.append("run_starts", np.array([out.count("unit_slots")], np.int32))
    for low in range(0, max(numbers.terms, 1), _BLOCK):
        count = min(_BLOCK, numbers.terms - low)
        out.append("active", pack(np.arange(count), _BLOCK) if count > 0 else np.zeros(0, np.uint64))
    size = float(np.float32(numbers.term_bytes)) if numbers.terms else 0.0
    least = float(np.float32(numbers.nbytes)), float(np.float32(numbers.term_bytes)) if numbers.terms else 1.0
    out.append("all_level_bytes", np.zeros(numbers.levels) + numbers.terms * size)
    out.append("record_sizes", np.array([numbers.nbytes], np.float32))
    return {"term_size": size, "least_sizes": least, "term_bytes": numbers.terms * size / max(owed, 1)}


@dataclass(frozen=True)
class _Block:
    """Some words."""

    first: int
    means: F32
    radii: F32
    areas: F32
    traits: kernels.Traits

    def write(self, out: ArrayFiles, numbers: PieceNumbers, owing: NDArray[np.uint64], nbytes: F32) -> None:
        """Append the spheres and the units of the words."""
        words = _BLOCK // 64
        n = len(self.means)
        spheres = np.zeros((words, 4), np.float32)
        spreads = np.zeros(words, np.float32)
        kernels.word_spheres(*_check.read_only(self.means, self.radii, self.areas), spheres, spreads)
        out.append("spheres", spheres)
        out.append("spreads", spreads)
        used = -(-n // 64)
        for k, row in enumerate((*spheres.T, spreads, nbytes)):
            out.append(f"place_{k}", row[:used])
        out.append("all_words", np.arange(self.first, self.first + used, dtype=np.int32))
        out.append("all_owing", owing[:used])
        found, (weights,) = room(n), _check.read_only(np.array([numbers.weight], np.float32))
        members = kernels.Seen(np.arange(used, dtype=np.int32), pack(np.arange(n), _BLOCK)[:used])
        none = _check.read_only(np.zeros(0, np.uint64))[0]
        count = kernels.cell_units(members, np.zeros(n, np.uint8), self.traits, weights, none, numbers.levels, found)
        slots = found.slots[:count] + np.int32(self.first)
        starts = np.flatnonzero(np.diff(slots, prepend=-1)).astype(np.int32)
        before = out.count("unit_slots") if self.first else 0
        out.append("run_starts", starts + np.int32(before))
        out.append("run_slots", slots[starts])
        out.append("unit_slots", slots)
        for name in ("masks", "areas", "pixels", "codes", "logs"):
            array = getattr(found, name)[:count]
            if name == "codes":
                out.append("every_codes", array)
                array = array + np.uint16(numbers.levels**2)
            out.append(f"unit_{name}", array)


def _pad_bodies(out: ArrayFiles, count: int) -> None:
    """Append bodies of no Gaussian."""
    for k in range(3):
        out.append(f"body_{k}", np.zeros(count, np.float32))
    out.append("body_3", np.full(count, -np.inf, np.float32))


def _areas_of(out: ArrayFiles, ids: NDArray[np.int32]) -> NDArray[np.float64]:
    """Return the areas of Gaussians whose ids lie in a few ranges."""
    if not len(ids):
        return np.zeros(0)
    low = int(ids.min())
    high = int(ids.max()) + 1
    if high - low <= 4 * len(ids) + _BLOCK:
        found = out.rows("record_areas", low, high)[ids - low]
    else:  # districts of tiles that lie apart
        order = np.argsort(ids, kind="stable")
        found = np.empty(len(ids), np.float32)
        cuts = np.flatnonzero(np.diff(ids[order]) > _BLOCK) + 1
        for part in np.split(order, cuts):
            some = ids[part]
            found[part] = out.rows("record_areas", int(some[0]), int(some[-1]) + 1)[some - some[0]]
    areas: NDArray[np.float64] = np.maximum(found, np.float32(1e-30)).astype(np.float64)
    return areas
