"""Tables of a scene that is made of pieces, such as a world, computed piece by piece: memory holds one at a time.

Three passes over the pieces: sizes of Gaussians, which give the steps of rounding; symbols, which give the code; and
records with all that planners need. What is written is what `StreamedScene.from_arrays` reads.
"""

from __future__ import annotations

import base64
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from gsvis.abr import piecewise
from gsvis.abr.index import extents
from gsvis.color.activation import Activation
from gsvis.color.srbf import unit_vectors
from gsvis.files.mapped import ArrayFiles
from gsvis.package.contents import Contents
from gsvis.package.layout import RECORD_BYTES
from gsvis.package.manifest import Manifest
from gsvis.stream.coding import Coding, Limits, Quality, chunks_of, limits_for, mean_light, round_records, sizes_of
from gsvis.stream.header import SceneHeader
from gsvis.stream.scene import chunk_rows_of

__all__ = ["Pieces", "write_tables"]

F32 = NDArray[np.float32]
I64 = NDArray[np.int64]

_BINS = 1024  # of an octave, for medians
_SPAN = 300  # octaves on each side of 1
_SOME = 4096  # records of a piece that are coded to know their mean bytes


@runtime_checkable
class Pieces(Protocol):
    """A package made of pieces. The ids of all stand behind each other; each piece has at least one Gaussian."""

    manifest: Manifest

    @property
    def epsilon(self) -> float | None:
        """Contribution above which a term is active in a cell."""
        ...

    def ranges(self) -> list[tuple[int, int]]:
        """Return the first id of each piece, and its end."""
        ...

    def pieces(self) -> Iterator[Contents]:
        """Yield the records of each piece, in the tables of the whole scene."""
        ...

    def piece_weight(self, piece: int) -> int:
        """Return how often the symbols of a piece count for the code."""
        ...

    def piece_links(self, piece: int, contents: Contents, means: Any) -> I64:
        """Return (P, 2) ascending pairs: a Gaussian of a piece, and an id that replaces it.

        `means(low, high)` returns the centers of ids that come before the piece.
        """
        ...

    def piece_order(self, piece: int) -> NDArray[np.int32]:
        """Return (N,) the Gaussian at each place of the visible sets of a piece; -1 where it is not known."""
        ...

    def piece_sources(self, piece: int) -> Sequence[int]:
        """Return the pieces whose Gaussians those of a piece may replace."""
        ...

    def cell_arrays(self) -> tuple[dict[str, NDArray[Any]], list[Any], F32]:
        """Return the arrays of the cells, their box as in the facts of a scene, and the weight of each class."""
        ...


@dataclass(frozen=True)
class _Survey:
    """What all pieces together decide."""

    coding: Coding
    nbytes: tuple[float, float]
    centers: I64  # ascending places of the centers of terms
    limits: Limits | None  # how records are rounded


def write_tables(
    path: Path, package: Pieces, facts: Mapping[str, Any], work: Path, *, pixel: float, quality: Quality | None
) -> None:
    """Compute the tables of a package of pieces and write them.

    Args:
        path: The file.
        package: The package.
        facts: More facts to write.
        work: An empty folder for arrays that grow, which the caller removes; as large as the tables.
        pixel: Angle of a pixel of the clients, radians.
        quality: How to round records; None means not at all.

    Raises:
        OutputError: If the file cannot be written.
    """
    survey = _survey(package, quality)
    with ArrayFiles(work) as out:
        cells, box, weights = package.cell_arrays()
        m = package.manifest
        ranges = package.ranges()
        about = SceneHeader.from_manifest(m, survey.coding)
        area = 2.0 * np.pi * 0.3 * pixel**2
        weight = float(np.mean(weights))
        numbers = piecewise.PieceNumbers(ranges[-1][1], about.terms, len(m.names), *survey.nbytes, area, weight)
        ends = _write_pieces(out, package, survey, numbers)
        terms = about.terms
        piecewise.write_reversed(out, ranges, ends, [package.piece_sources(k) for k in range(len(ranges))])
        found = piecewise.write_words(out, numbers)
        for name, array in {**cells, "class_weights": weights}.items():
            out.append(name, array)
        stored = float(RECORD_BYTES), about.term_bits / 8
        ratios = [size / each for size, each in zip(found["least_sizes"], stored, strict=True)]
        found |= {"pixel_area": area, "stored": stored, "sent_per_stored": min(ratios) if terms else ratios[0]}
        own = {
            "numbers": found,
            "welcome": base64.b64encode(about.to_message()).decode(),
            "pixel": pixel,
            "box": box,
            "level_counts": list(m.counts),
            "has_cones": package.epsilon is not None and terms > 0,
            "has_active": package.epsilon is not None,
        }
        frozen = (*piecewise.FROZEN, *(f"record_{name}" for name in ("centers", "places", "cosines", "widths")))
        frozen = (*frozen, "class_weights")
        out.write(path, {**own, **facts}, joined=piecewise.JOINED, same=piecewise.SAME, frozen=frozen)


def _survey(package: Pieces, quality: Quality | None) -> _Survey:
    """Read all pieces twice: their sizes and centers, then their symbols."""
    limits = None if quality is None else _limits(package, quality)
    keys = np.zeros(0, np.int64)
    coding = None
    counts = np.zeros(0, np.int64)
    sums = np.zeros(4)
    for k, contents in enumerate(package.pieces()):
        rounded = contents if limits is None else round_records(contents, limits)
        if coding is None:
            coding = Coding.blank(contents.grids, None if limits is None else limits.steps)
            counts = np.zeros(len(coding.tables.levels), np.int64)
        counts += package.piece_weight(k) * coding.count(rounded)
        if package.epsilon is not None and len(contents.term_records):
            keys = np.union1d(keys, _center_keys(contents))
    assert coding is not None, "a scene has pieces"
    coding = coding.filled(counts)
    for contents in package.pieces():
        rounded = contents if limits is None else round_records(contents, limits)
        ids = np.arange(0, len(contents), 2)[:_SOME]
        owners = np.repeat(np.arange(len(contents), dtype=np.int32), contents.term_counts)[:_SOME]
        found = coding.encode_records(rounded.records[ids], ids, rounded.chunks[ids], chunks_of(rounded.table))
        of_terms = coding.encode_terms(rounded.term_records[: len(owners)].copy(), owners)
        shares = len(contents) / max(len(ids), 1), len(contents.term_records) / max(len(owners), 1)
        sums += (len(found) * shares[0], len(contents), len(of_terms) * shares[1], len(contents.term_records))
    return _Survey(coding, (sums[0] / max(sums[1], 1), sums[2] / sums[3] if sums[3] else 4.0), keys, limits)


def _limits(package: Pieces, quality: Quality) -> Limits:
    """Return how records are rounded, from sizes that are right to 1/2048 octave."""
    counts = np.zeros((3, 2 * _SPAN * _BINS), np.int64)
    for contents in package.pieces():
        for row, values in zip(counts, sizes_of(contents), strict=True):
            places = np.floor((np.clip(values, -_SPAN, _SPAN) + _SPAN) * _BINS).astype(np.int64)
            row += np.bincount(places.clip(0, len(row) - 1), minlength=len(row))
    middles = (np.arange(counts.shape[1]) + 0.5) / _BINS - _SPAN
    mean, area = (middles[np.searchsorted(np.cumsum(row), (row.sum() + 1) // 2)] for row in counts[:2])
    found = counts[2] > 0
    return limits_for(quality, mean, area, mean_light(middles[found], counts[2][found]))


def _write_pieces(out: ArrayFiles, package: Pieces, survey: _Survey, numbers: piecewise.PieceNumbers) -> list[int]:
    """Append the records of all pieces and what replaces them; return what `write_links` returns for each."""
    ends = []
    coding = survey.coding
    chunks = 0
    terms = 0

    def means(low: int, high: int) -> F32:
        return np.stack([out.rows(f"body_{k}", low, high) for k in range(3)], axis=1)

    grids = coding.grids
    keys = survey.centers
    if len(keys):
        angles = np.stack([grids.theta_table()[keys >> 16], grids.phi_table()[keys & 0xFFFF]], axis=1)
        out.append("record_centers", unit_vectors(angles).astype(np.float32))
    else:
        out.append("record_centers", np.zeros((0, 3), np.float32))
    out.append("record_term_offsets", np.zeros(1, np.int64))
    for piece, (low, contents) in enumerate(zip((low for low, _ in package.ranges()), package.pieces(), strict=True)):
        rounded = contents if survey.limits is None else round_records(contents, survey.limits)
        g = contents.gaussians()
        piecewise.write_gaussians(out, g.means, *extents(g), (contents.first, contents.last), numbers)
        counts = contents.term_counts
        out.append("importance", np.ones(len(contents), np.float32))
        out.append("parts", coding.split_records(rounded))
        out.append("set_order", package.piece_order(piece))
        out.append("chunks", contents.chunks + np.int32(chunks))
        out.append("starts", rounded.table.starts[:-1] + low)
        out.append("chunk_rows", chunk_rows_of(rounded).view(np.uint8))
        for name, array in chunks_of(rounded.table)._asdict().items():
            out.append(f"chunk_{name}", array)
        out.append("term_records", contents.term_records)
        out.append("owners", np.repeat(np.arange(low, low + len(contents), dtype=np.int32), counts))
        out.append("record_term_offsets", terms + np.cumsum(counts, dtype=np.int64))
        out.append("record_term_sizes", np.full(len(contents.term_records), numbers.term_bytes, np.float32))
        _write_cones(out, contents, package.epsilon, survey.centers)
        ends.append(piecewise.write_links(out, low, len(contents), package.piece_links(piece, contents, means)))
        chunks = chunks + len(contents.table)
        terms = terms + len(contents.term_records)
    out.append("starts", np.array([numbers.gaussians], np.int64))
    return ends


def _write_cones(out: ArrayFiles, contents: Contents, epsilon: float | None, centers: I64) -> None:
    """Append the directions in which the terms of a piece are active."""
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
    """Return the places of the centers of terms, each once, or of all terms in their order."""
    centers = contents.colors().centers.astype(np.int64)
    keys: I64 = centers[:, 0] << 16 | centers[:, 1]
    return keys if every else np.unique(keys)
