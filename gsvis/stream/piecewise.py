"""Compute the serving tables of a scene piece by piece: memory holds one piece at a time.

There are three passes over the pieces: sizes of Gaussians, to choose how to round; symbols, to choose the code; and
records with everything that planners need. `StreamedScene` uses these tables, in memory or in a mapped file.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.abr import piecewise
from gsvis.abr.index import extents
from gsvis.color.activation import Activation
from gsvis.color.srbf import unit_vectors
from gsvis.files.mapped import ArrayFiles, ArrayLists, GrowingArrays
from gsvis.package.codec import packed_bits
from gsvis.package.contents import Contents
from gsvis.package.layout import RECORD_BYTES
from gsvis.package.rounding import Limits, Quality, chunks_of, limits_for, mean_light, round_records, sizes_of
from gsvis.stream.batch import CHUNK_ROW
from gsvis.stream.coding import Coding, Steps
from gsvis.stream.header import SceneHeader
from gsvis.stream.source import SceneSource

__all__ = ["SceneTables", "make_tables", "write_tables"]

F32 = NDArray[np.float32]
I64 = NDArray[np.int64]

_BINS = 1024  # histogram bins for each octave, for medians
_SPAN = 300  # octaves of the histogram below and above 1
_SOME = 4096  # records of a piece that are coded to measure their mean bytes
_MOST = 1 << 16  # the same if the scene is one piece
_FROZEN = (*piecewise.FROZEN, "class_weights")


@dataclass(frozen=True, eq=False)
class SceneTables:
    """Everything that a server needs of a scene, except its visible sets.

    Attributes:
        arrays: Arrays by name.
        facts: Numbers and texts that JSON can hold.
    """

    arrays: Mapping[str, NDArray[Any]]
    facts: Mapping[str, Any]


def make_tables(source: SceneSource, *, pixel: float, quality: Quality | None) -> SceneTables:
    """Compute the tables of a scene in memory.

    Args:
        source: The scene.
        pixel: Angle of a pixel of the clients, radians.
        quality: How to round records; None means not at all.
    """
    out = ArrayLists()
    facts = _append_all(out, source, pixel, quality)
    return SceneTables(out.arrays(joined=piecewise.JOINED, same=piecewise.SAME, frozen=_FROZEN), facts)


def write_tables(
    path: Path, source: SceneSource, facts: Mapping[str, Any], work: Path, *, pixel: float, quality: Quality | None
) -> None:
    """Compute the tables of a scene and write them for `MappedArrays`.

    Args:
        path: The file.
        source: The scene.
        facts: More facts to write.
        work: An empty folder for growing arrays, as large as the tables; the caller removes it.
        pixel: Angle of a pixel of the clients, radians.
        quality: How to round records; None means not at all.

    Raises:
        OutputError: If the file cannot be written.
    """
    with ArrayFiles(work) as out:
        own = _append_all(out, source, pixel, quality)
        out.write(path, {**own, **facts}, joined=piecewise.JOINED, same=piecewise.SAME, frozen=_FROZEN)


def chunk_rows_of(contents: Contents) -> NDArray[np.void]:
    """Return the rows (C,) of chunks, as sent."""
    table = contents.table
    rows = np.zeros(len(contents.table), CHUNK_ROW)
    for name, values in (
        ("origin", table.origins),
        ("step", table.steps),
        ("low", table.lows),
        ("count", table.counts),
        ("stride", table.strides),
        ("first_level", contents.chunk_levels[:, 0]),
        ("last_level", contents.chunk_levels[:, 1]),
        ("bits", packed_bits(table.bits)),
    ):
        rows[name] = values
    return rows


@dataclass(frozen=True)
class _Survey:
    """What is known after the passes over sizes and symbols.

    Attributes:
        coding: The code of the records.
        nbytes: Mean bytes of a Gaussian and of a term, as sent.
        centers: Ascending keys of all centers of terms, see `_center_keys`.
        limits: How records are rounded; None for not at all.
    """

    coding: Coding
    nbytes: tuple[float, float]
    centers: I64
    limits: Limits | None


def _append_all(out: GrowingArrays, source: SceneSource, pixel: float, quality: Quality | None) -> dict[str, Any]:
    """Append all tables of a scene, and return its facts."""
    if not 0.0 <= pixel < 1.0:
        raise ValueError(f"pixel: expected radians in [0, 1), got {pixel!r}")
    survey = _survey(source, quality)
    m = source.manifest
    cells, weights = source.read_cells()
    ranges = source.ranges()
    about = SceneHeader.from_manifest(m, survey.coding)
    numbers = piecewise.PieceNumbers(
        gaussians=ranges[-1][1],
        terms=about.terms,
        levels=len(m.names),
        sizes=piecewise.RecordSizes.of_means(*survey.nbytes, about.terms),
        pixel_area=piecewise.pixel_area(pixel),
        stored=(float(RECORD_BYTES), about.term_bits / 8),
        weight=float(np.mean(weights)),
        sends_terms=source.active() is not None,
    )
    ends = _write_pieces(out, source, survey, numbers)
    piecewise.write_replaced(out, ranges, ends, [source.piece_sources(k) for k in range(len(ranges))])
    found = piecewise.write_words(out, numbers)
    for name, array in {**cells.to_arrays(), "class_weights": weights}.items():
        out.append(name, array)
    return {
        "numbers": asdict(found),
        "welcome": base64.b64encode(about.to_message()).decode(),
        "pixel": pixel,
        "level_counts": list(m.counts),
        "has_cones": source.epsilon is not None and about.terms > 0,
    }


def _survey(source: SceneSource, quality: Quality | None) -> _Survey:
    """Read all pieces to choose rounding and code, and to measure mean bytes."""
    limits = None if quality is None else _rounding_limits(source, quality)
    known = limits or source.manifest.limits
    steps = None if known is None else Steps.from_limits(known)
    keys = np.zeros(0, np.int64)
    coding = None
    counts = np.zeros(0, np.int64)
    for k, contents in enumerate(source.pieces()):
        rounded = contents if limits is None else round_records(contents, limits, stated=False)
        if coding is None:
            coding = Coding.blank(contents.grids, steps)
            counts = np.zeros(len(coding.tables.levels), np.int64)
        counts += source.piece_weight(k) * coding.count(rounded)
        if source.epsilon is not None and len(contents.term_records):
            keys = np.union1d(keys, _center_keys(contents))
    assert coding is not None, "a scene has pieces"
    coding = coding.filled(counts)
    of_gaussians = _Mean(16.0)
    of_terms = _Mean(4.0)
    some = _MOST if len(source.ranges()) == 1 else _SOME
    for contents in source.pieces():
        rounded = contents if limits is None else round_records(contents, limits, stated=False)
        found = coding.mean_bytes(rounded, most=some)
        of_gaussians.add(found[0], len(contents))
        of_terms.add(found[1], len(contents.term_records))
    return _Survey(coding, (of_gaussians.value, of_terms.value), keys, limits)


class _Mean:
    """A running weighted mean; with one number it is exactly that number.

    Args:
        default: Value before the first number.
    """

    def __init__(self, default: float) -> None:
        self.value = default
        self._weight = 0

    def add(self, value: float, weight: int) -> None:
        """Add a number; a weight of 0 changes nothing."""
        if weight == 0:
            return
        self._weight += weight
        if self._weight == weight:
            self.value = value
        else:
            self.value += (value - self.value) * weight / self._weight


def _rounding_limits(source: SceneSource, quality: Quality) -> Limits:
    """Return how records are rounded: by exact medians for one piece, else by medians within 1/2048 octave."""
    if len(source.ranges()) == 1:
        sizes = sizes_of(next(source.pieces()))
        mean, area = np.median(sizes[:2], axis=1).tolist()
        return limits_for(quality, mean, area, mean_light(sizes[2]))
    counts = np.zeros((3, 2 * _SPAN * _BINS), np.int64)
    for contents in source.pieces():
        for row, values in zip(counts, sizes_of(contents), strict=True):
            places = np.floor((np.clip(values, -_SPAN, _SPAN) + _SPAN) * _BINS).astype(np.int64)
            row += np.bincount(places.clip(0, len(row) - 1), minlength=len(row))
    middles = (np.arange(counts.shape[1]) + 0.5) / _BINS - _SPAN
    mean, area = (middles[np.searchsorted(np.cumsum(row), (row.sum() + 1) // 2)] for row in counts[:2])
    found = counts[2] > 0
    return limits_for(quality, mean, area, mean_light(middles[found], counts[2][found]))


def _write_pieces(
    out: GrowingArrays, source: SceneSource, survey: _Survey, numbers: piecewise.PieceNumbers
) -> list[int]:
    """Append the records and replacements of all pieces; return the results of `write_replacements`, one a piece."""
    ends = []
    coding = survey.coding
    chunks = 0
    terms = 0

    def means(low: int, high: int) -> F32:
        """Return the centers of the ids in [low, high), which have been appended."""
        return np.stack([out.rows(f"body_{k}", low, high) for k in range(3)], axis=1)

    grids = coding.grids
    keys = survey.centers
    if len(keys):
        angles = np.stack([grids.theta_table()[keys >> 16], grids.phi_table()[keys & 0xFFFF]], axis=1)
        out.append("record_centers", unit_vectors(angles).astype(np.float32))
    else:
        out.append("record_centers", np.zeros((0, 3), np.float32))
    out.append("record_term_offsets", np.zeros(1, np.int64))
    for piece, (low, contents) in enumerate(zip((low for low, _ in source.ranges()), source.pieces(), strict=True)):
        rounded = contents if survey.limits is None else round_records(contents, survey.limits, stated=False)
        g = contents.gaussians()
        importance = np.ones(len(contents), np.float32) if source.has_cells else g.opacities
        levels = contents.first, contents.last
        piecewise.write_gaussians(out, g.means, *extents(g), levels, numbers, importance=importance)
        counts = contents.term_counts
        out.append("importance", importance)
        out.append("parts", coding.split_records(rounded))
        out.append("set_order", source.piece_order(piece))
        out.append("chunks", contents.chunks + np.int32(chunks))
        out.append("starts", rounded.table.starts[:-1] + low)
        out.append("chunk_rows", chunk_rows_of(rounded).view(np.uint8))
        for name, array in chunks_of(rounded.table)._asdict().items():
            out.append(f"chunk_{name}", array)
        out.append("term_records", contents.term_records)
        out.append("owners", np.repeat(np.arange(low, low + len(contents), dtype=np.int32), counts))
        out.append("record_term_offsets", terms + np.cumsum(counts, dtype=np.int64))
        out.append("record_term_sizes", np.full(len(contents.term_records), survey.nbytes[1], np.float32))
        _write_cones(out, contents, source.epsilon, survey.centers)
        ends.append(piecewise.write_replacements(out, low, len(contents), source.piece_links(piece, contents, means)))
        chunks = chunks + len(contents.table)
        terms = terms + len(contents.term_records)
    out.append("starts", np.array([numbers.gaussians], np.int64))
    return ends


def _write_cones(out: GrowingArrays, contents: Contents, epsilon: float | None, centers: I64) -> None:
    """Append the cones of the terms of a piece, see `TermCones`; `centers` are keys from `_center_keys`."""
    places = np.zeros(0, np.int32)
    cosines = np.zeros(0, np.float32)
    widths = np.zeros(0, np.float32)
    if epsilon is not None and len(contents.term_records):
        exact = contents.colors().dequantize()
        found = Activation(exact, np.zeros((len(contents), 3), np.float32), epsilon).least_cosines()
        cosines = np.clip(np.asarray(found, np.float32), -1e30, 1e30)
        places = np.searchsorted(centers, _center_keys(contents, every=True)).astype(np.int32)
        widths = np.asarray(1.0 / exact.decays, np.float32)
    for name, array in (("places", places), ("cosines", cosines), ("widths", widths)):
        out.append(f"record_{name}", array)


def _center_keys(contents: Contents, every: bool = False) -> I64:
    """Return integer keys of the centers of terms: each key once, ascending, or with `every` the key of each term."""
    centers = contents.colors().centers.astype(np.int64)
    keys: I64 = centers[:, 0] << 16 | centers[:, 1]
    return keys if every else np.unique(keys)
