"""Read and write `.ksplat`, the format of the web viewer GaussianSplats3D, version 0.1.

A header of 4,096 bytes, headers of 1,024 bytes for the sections, then the sections: lengths and centers of buckets,
then one record a Gaussian. Compression 0 keeps floats; 1 and 2 keep half floats, and positions as 16 bits inside the
block of their bucket; 2 keeps a byte for each SH coefficient. Colors and opacities are bytes, SH ends at degree 2.
Without a magic number the suffix alone decides the format.

References:
    https://github.com/mkkellogg/GaussianSplats3D, src/loaders/SplatBuffer.js, which defines the layout.
"""

from __future__ import annotations

import os
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.errors import FormatError
from gsvis.files.atomic import atomic_path
from gsvis.files.limits import read_whole
from gsvis.io._build import LEAST_SCALE, gaussians_from, sh0_from_rgb
from gsvis.io._origin import settle_origin, size_of_gaussians
from gsvis.io.facts import parse_facts, spell_facts
from gsvis.io.losses import report_clipped, report_loss, report_note
from gsvis.scene.facts import SceneFacts
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.sh import SH_C0

__all__ = ["load_ksplat", "save_ksplat"]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
_HEADER = struct.Struct("<BB2xIIIIH2x5f")
_HEADER_BYTES = 4096
_SECTION = struct.Struct("<IIIIfH2xIIIIH")
_SECTION_BYTES = 1024
_CENTER_BYTES = 12
_COMPONENTS = (0, 9, 24)
_RANGE = 32767  # steps from the center of a block to its side
_HALF_RANGE = 1.5  # range of SH in bytes if the header has 0
_BUCKET = 256
# share of the centers that count, and how much wider the grid of blocks may be
_CORE = 0.9
_STRETCHED = 16.0
_BLOCKS = 8  # blocks along the longest side of the middle 98%; few, because viewers search buckets one by one
_COARSE = 0.25  # step that may be visible, as a share of a Gaussian's size
_FACTS_AT = 256
_FACTS = b"gsvis facts "
_LEAST_HALF = 2.0**-24
_MOST_HALF = 65504.0


@dataclass(frozen=True)
class _Section:
    """Fields of a section's header, and the places of its lengths, centers and records in the file."""

    count: int
    degree: int
    bucket_size: int
    full: int
    partial: int
    step: float
    scale_range: int
    base: int
    records: int


def load_ksplat(path: str | os.PathLike[str]) -> Gaussians:
    """Read a `.ksplat` file of any compression.

    Args:
        path: The file.

    Returns:
        The scene in the file's order and frame. Sections of lower SH degree are padded with zeros.

    Raises:
        FormatError: If the file is truncated, of another version, or a value is invalid.
        OSError: If it cannot be opened.
    """
    data = read_whole(path)
    if len(data) < _HEADER_BYTES:
        raise FormatError(path, "header", f"{_HEADER_BYTES:,} bytes", f"{len(data):,}", "is the file truncated?")
    major, minor, sections, _, _, count, level, *_, low, high = _HEADER.unpack_from(data)
    if (major, minor >= 1) != (0, True):
        raise FormatError(path, "header", "version 0.1 of .ksplat", f"{major}.{minor}")
    if level > 2:
        raise FormatError(path, "header", "compression 0, 1 or 2", f"{level}")
    found = _parse_sections(path, data, sections, level)
    total = sum(section.count for section in found)
    if total != count or total == 0:
        raise FormatError(path, "header", f"{total:,} Gaussians, as in the sections", f"{count:,}")
    limits = (low if abs(low) > 0 else -_HALF_RANGE), (high if abs(high) > 0 else _HALF_RANGE)  # NaN counts as 0
    if level == 2 and not limits[0] < limits[1] < np.inf:
        raise FormatError(path, "header", "a least SH coefficient below the largest", f"{limits[0]} and {limits[1]}")
    degree = max(section.degree for section in found if section.count)
    parts = [_decode(path, data, section, level, degree, limits) for section in found if section.count]
    means, quats, scales, opacities, sh0, higher = (_join(arrays) for arrays in zip(*parts, strict=True))
    facts = _facts_in(data)
    scene = gaussians_from(path, means, quats, scales, opacities, sh0, higher, facts)
    return settle_origin(scene, facts.origin) if any(facts.origin) else scene


def _parse_sections(path: str | os.PathLike[str], data: bytes, sections: int, level: int) -> list[_Section]:
    """Return the checked headers of all sections."""
    base = _HEADER_BYTES + sections * _SECTION_BYTES
    if base > len(data):
        raise FormatError(path, "header", f"{base:,} bytes for {sections:,} sections", f"{len(data):,}")
    found = []
    for k in range(sections):
        fields = _SECTION.unpack_from(data, _HEADER_BYTES + k * _SECTION_BYTES)
        count, room, bucket_size, buckets, block, stored, scale_range, _, full, partial, degree = fields
        where = f"section {k}"
        if degree > 2:
            raise FormatError(path, where, "an SH degree of 0 to 2", f"{degree}")
        if count > room:
            raise FormatError(path, where, f"at most {room:,} Gaussians", f"{count:,}")
        records = base + 4 * partial + stored * buckets
        end = records + room * _record(level, degree).itemsize
        if end > len(data):
            raise FormatError(path, where, f"{end:,} bytes", f"{len(data):,}", "is the file truncated?")
        if level and count and not (stored == _CENTER_BYTES and full + partial <= buckets and 0.0 < block < np.inf):
            raise FormatError(
                path,
                where,
                f"{full + partial:,} buckets of 12 bytes in blocks above 0",
                f"{buckets:,} of {stored} bytes in blocks of {block:g}",
            )
        steps = scale_range or _RANGE
        found.append(_Section(count, degree, bucket_size, full, partial, block / 2.0 / steps, steps, base, records))
        base = end
    return found


def _decode(
    path: str | os.PathLike[str], data: bytes, section: _Section, level: int, degree: int, limits: tuple[float, float]
) -> tuple[F32, F32, F32, F32, F32, F32]:
    """Return means, quats, scales, opacities, sh0 and shN of one section, shN of the degree of the file."""
    n = section.count
    records = np.frombuffer(data, _record(level, section.degree), n, section.records)
    with np.errstate(all="ignore"):  # values that are not finite are rejected later
        if level:
            away = (records["means"].astype(np.float64) - section.scale_range) * section.step
            means = (away + _centers(path, data, section)).astype(np.float32)
        else:
            means = records["means"].astype(np.float32)
        scales = records["scales"].astype(np.float32)
        scales[scales == 0.0] = LEAST_SCALE
        rgba = records["rgba"].astype(np.float32) / np.float32(255.0)
        values = records["sh"].astype(np.float32)
        if level == 2:
            values = values / np.float32(255.0) * np.float32(limits[1] - limits[0]) + np.float32(limits[0])
        higher = np.zeros((n, (degree + 1) ** 2 - 1, 3), np.float32)
        order = _coefficient_places(section.degree)
        higher[:, : len(order)] = values[:, order]
        quats = records["quats"].astype(np.float32)
    return means, quats, scales, rgba[:, 3], sh0_from_rgb(rgba[:, :3]), higher


def _centers(path: str | os.PathLike[str], data: bytes, section: _Section) -> F32:
    """Return the (N, 3) center of the bucket of each Gaussian."""
    rest = np.frombuffer(data, "<u4", section.partial, section.base).astype(np.int64)
    lengths = np.concatenate([np.full(section.full, section.bucket_size, np.int64), rest])
    ends = np.cumsum(lengths)
    if len(ends) == 0 or ends[-1] < section.count:
        held = int(ends[-1]) if len(ends) else 0
        raise FormatError(path, "buckets", f"room for {section.count:,} Gaussians", f"{held:,}")
    centers = np.frombuffer(data, "<f4", 3 * len(ends), section.base + 4 * section.partial).reshape(-1, 3)
    return np.asarray(centers[np.searchsorted(ends, np.arange(section.count), side="right")], np.float32)


def _join(arrays: tuple[F32, ...]) -> F32:
    """Return the arrays of all sections as one."""
    return arrays[0] if len(arrays) == 1 else np.concatenate(arrays)


def _record(level: int, degree: int) -> np.dtype[Any]:
    """Return the layout of one Gaussian."""
    place, value, sh = (("<f4", "<f4", "<f4"), ("<u2", "<f2", "<f2"), ("<u2", "<f2", "u1"))[level]
    fields = [("means", place, (3,)), ("scales", value, (3,)), ("quats", value, (4,)), ("rgba", "u1", (4,))]
    return np.dtype([*fields, ("sh", sh, (_COMPONENTS[degree],))])


def _coefficient_places(degree: int) -> NDArray[np.int64]:
    """Return the (K-1, 3) place of each coefficient of each channel: by band, then channel."""
    bands = [np.arange(3)[None, :] * size + np.arange(size)[:, None] for size in (3, 5)[:degree]]
    rows = [start + band for start, band in zip((0, 9), bands, strict=False)]
    return np.concatenate([*rows, np.zeros((0, 3), np.int64)]).astype(np.int64)


def save_ksplat(scene: Gaussians, path: str | os.PathLike[str], *, compression: int = 1) -> None:
    """Write a `.ksplat` file, atomically.

    Lossy: colors are clipped to [0, 1], colors and opacities take a byte per value, and SH above degree 2 is dropped
        with
    a warning in the log. Compression 0 keeps everything else, and the order. 1 and 2 sort Gaussians by block, round
    positions to 1/65534 of a block (an eighth of the longest side of the middle 98% of the centers), and hold scales of
    6e-8 to 65504.

    Args:
        scene: The scene; its frame is kept.
        path: The file; its folder is created if missing.
        compression: 0, 1 or 2, with 44 to 140, 24 to 72 or 24 to 48 bytes per Gaussian, depending on the SH degree.

    Raises:
        ValueError: If the scene is empty, or `compression` is not 0, 1 or 2.
        OSError: If it cannot be written.
    """
    if isinstance(compression, bool) or compression not in (0, 1, 2):
        raise ValueError(f"compression: expected 0, 1 or 2, got {compression!r}")
    if len(scene) == 0:
        raise ValueError("scene: expected at least one Gaussian, got none")
    target = _check.path("path", path)
    if scene.sh_degree > 2:
        report_loss(target, "SH", "SH degree 3 is reduced to 2, the highest of .ksplat")
        lower = scene.shN[:, :8]
        scene = Gaussians(scene.means, scene.quats, scene.scales, scene.opacities, scene.sh0, lower, facts=scene.facts)
    _report(scene, target, compression)
    buckets = _sort_into_buckets(scene) if compression else None
    step = 0.0 if buckets is None else buckets.block / 2.0 / _RANGE
    size = size_of_gaussians(scene.scales)
    if step > _COARSE * size:
        report_loss(target, "centers", f"centers are rounded to steps of {step:.3g}; Gaussians have {size:.3g}")
    low, high = _sh_limits(scene.shN)
    records = _encode(scene if buckets is None else scene[buckets.order], compression, buckets, (low, high))
    n = len(scene)
    head = b""
    fields: tuple[float, ...] = (n, n, 0, 0, 0.0, 0, 0, records.nbytes, 0, 0, scene.sh_degree)
    if buckets is not None:
        head = buckets.lengths[buckets.full :].astype("<u4").tobytes() + buckets.centers.astype("<f4").tobytes()
        made = len(buckets.lengths)
        stored = len(head) + records.nbytes
        fields = (
            n,
            n,
            _BUCKET,
            made,
            buckets.block,
            _CENTER_BYTES,
            _RANGE,
            stored & 0xFFFFFFFF,
            buckets.full,
            made - buckets.full,
            scene.sh_degree,
        )
    with atomic_path(target) as partial, open(partial, "wb") as out:
        fixed = _HEADER.pack(0, 1, 1, 1, n, n, compression, 0.0, 0.0, 0.0, low, high)
        out.write(_with_facts(fixed, scene.facts).ljust(_HEADER_BYTES, b"\0"))
        out.write(_SECTION.pack(*fields).ljust(_SECTION_BYTES, b"\0"))
        out.write(head)
        out.write(records.data)


def _with_facts(header: bytes, facts: SceneFacts) -> bytes:
    """Return the header with the facts in the part that the format leaves unused; unchanged if there are none."""
    found = spell_facts(facts).encode()
    return header.ljust(_FACTS_AT, b"\0") + _FACTS + found + b"\0" if found else header


def _facts_in(data: bytes) -> SceneFacts:
    """Return the facts in the unused part of the header."""
    room = data[_FACTS_AT:_HEADER_BYTES]
    return parse_facts(room[len(_FACTS) :].split(b"\0", 1)[0]) if room.startswith(_FACTS) else SceneFacts()


def _report(scene: Gaussians, path: Path, compression: int) -> None:
    """Log what the format clips, and which facts other programs do not read."""
    rgb = 0.5 + SH_C0 * scene.sh0[:, 0].astype(np.float64)
    over = np.maximum(np.maximum(-rgb, rgb - 1.0), 0.0)
    report_clipped(path, "colors", np.where(over > 0.5 / 255.0, over, 0.0), "0 to 1 of white", "of white")
    if compression:
        over = np.maximum(scene.scales.astype(np.float64) - _MOST_HALF, 0.0)
        report_clipped(path, "scales", over, f"{_LEAST_HALF:.2g} to {_MOST_HALF:g}")
        thin = int((scene.scales < 0.5 * _LEAST_HALF).any(axis=1).sum())
        if thin:
            text = f"scales of {thin:,} Gaussians below {_LEAST_HALF:.2g} become {_LEAST_HALF:.2g}"
            report_loss(path, "scales", text, thin)
    if compression == 1:
        over = np.maximum(np.abs(scene.shN.astype(np.float64)) - _MOST_HALF, 0.0)
        report_clipped(path, "SH", over.reshape(len(scene), -1), f"{-_MOST_HALF:g} to {_MOST_HALF:g}")
    if scene.facts.antialiased:
        report_loss(path, "antialiased", "the format has no flag for antialiased scenes; only gsvis reads its note")
    if any(scene.facts.origin):
        report_note(path, "the origin is a note that only gsvis reads; other programs see the scene at (0, 0, 0)")


class _Buckets(NamedTuple):
    """Gaussians in order of their buckets, full ones first; each bucket lies in one block of a grid.

    order (N,) indices; lengths (B,); full: number of full ones; centers (B, 3) float32; block: side of a block.
    """

    order: NDArray[np.int64]
    lengths: NDArray[np.int64]
    full: int
    centers: F32
    block: float


def _sort_into_buckets(scene: Gaussians) -> _Buckets:
    """Return the Gaussians sorted into blocks of a grid and buckets inside them."""
    low, high = scene.bounds()
    core_low, core_high = scene.bounds(_CORE)
    if (high - low).max() > _STRETCHED * (core_high - core_low).max() > 0.0:  # flyaways would make the grid coarse
        low = core_low
        high = core_high
    side = float((high - low).max()) or _BLOCKS
    block = float(max(np.float32(side / _BLOCKS), np.finfo(np.float32).tiny))
    cells = np.floor((scene.means.astype(np.float64) - low) / block)
    order = np.lexsort(cells.T[::-1])
    cells = cells[order]
    starts = np.flatnonzero(np.r_[True, (cells[1:] != cells[:-1]).any(axis=1)])
    place = np.arange(len(cells)) - np.repeat(starts, np.diff(np.r_[starts, len(cells)]))
    starts = np.flatnonzero(place % _BUCKET == 0)
    lengths = np.diff(np.r_[starts, len(cells)])
    ranked = np.argsort(lengths < _BUCKET, kind="stable")
    rank = np.empty(len(ranked), np.int64)
    rank[ranked] = np.arange(len(ranked))
    centers = (low + (cells[starts] + 0.5) * block)[ranked].astype(np.float32)
    order = order[np.argsort(np.repeat(rank, lengths), kind="stable")]
    return _Buckets(order, lengths[ranked], int((lengths == _BUCKET).sum()), centers, block)


def _sh_limits(higher: F32) -> tuple[float, float]:
    """Return the values of SH codes 0 and 255, such that all values lie between them and code 128 is exactly 0."""
    step = max(float(higher.max()) / 127.0, -float(higher.min()) / 128.0) if higher.size else 0.0
    step = min(step, 1e36) or _HALF_RANGE / 128.0
    return float(np.float32(-128.0 * step)), float(np.float32(127.0 * step))


def _encode(scene: Gaussians, level: int, buckets: _Buckets | None, limits: tuple[float, float]) -> NDArray[Any]:
    """Return the records (N,) of a scene, in the order of its buckets."""
    records = np.zeros(len(scene), _record(level, scene.sh_degree))
    order = _coefficient_places(scene.sh_degree).reshape(-1)
    values = np.empty((len(scene), len(order)), np.float32)
    values[:, order] = scene.shN.reshape(len(scene), -1)
    if buckets is None:
        records["means"], records["scales"] = scene.means, scene.scales
    else:
        centers = np.repeat(buckets.centers, buckets.lengths, axis=0).astype(np.float64)
        steps = np.rint((scene.means - centers) / (buckets.block / 2.0 / _RANGE))
        records["means"] = np.clip(steps + _RANGE, 0, 2 * _RANGE + 1)
        records["scales"] = np.clip(scene.scales, _LEAST_HALF, _MOST_HALF)
        values = np.clip(values, -_MOST_HALF, _MOST_HALF) if level == 1 else _to_bytes(values, *limits)
    records["quats"] = scene.quats
    records["sh"] = values
    records["rgba"][:, :3] = np.rint(np.clip(0.5 + SH_C0 * scene.sh0[:, 0], 0.0, 1.0) * 255.0)
    records["rgba"][:, 3] = np.rint(scene.opacities * 255.0)
    return records


def _to_bytes(values: F32, low: float, high: float) -> F32:
    """Return values in [low, high] as 0 to 255."""
    return np.asarray(
        np.clip(np.rint((values - np.float32(low)) * np.float32(255.0 / (high - low))), 0, 255), np.float32
    )
