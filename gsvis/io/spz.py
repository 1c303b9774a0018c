"""Read and write SPZ, Niantic's compressed scenes, versions 1 to 4.

Six byte streams (positions, alphas, colors, scales, rotations, SH) follow a header: all in one gzip stream up to
version 3, each in its own zstd stream from version 4 on. The file's frame is right-up-back; gsvis converts it to the
right-down-front frame that the same scene has in a PLY, and back: half a turn about x.
"""

from __future__ import annotations

import os
import struct
import zlib
from dataclasses import dataclass, replace

import numpy as np
import zstandard
from numpy.typing import NDArray

from gsvis import _check
from gsvis.errors import FormatError
from gsvis.files.atomic import atomic_path
from gsvis.files.limits import Budget, read_whole
from gsvis.io._build import bytes_of_scene, exp_scales, gaussians_from, largest_from_three
from gsvis.io._kernels.spz import look_up, unpack_fixed_points, unpack_higher, unpack_quats
from gsvis.io._origin import settle_origin
from gsvis.io._spz_range import COLOR_SCALE, fit_coordinates, report_spz_losses
from gsvis.io.facts import parse_facts, spell_facts
from gsvis.io.losses import report_loss, report_note
from gsvis.scene.facts import SceneFacts
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.sh import rotation_of_sh

__all__ = ["decode_spz", "encode_old_spz", "load_spz", "report_spz_losses", "save_spz"]

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]
_NOTHING_KNOWN = SceneFacts()
_MAGIC = b"NGSP"
_GZIP = b"\x1f\x8b"
_HEADER = struct.Struct("<4sIIBBBB")
_V4_REST = struct.Struct("<I12x")
_COEFFICIENTS = (0, 3, 8, 15, 24)
_ANTIALIASED = 0x1
_HAS_EXTENSIONS = 0x2
_COORDINATE_SYSTEM = 0xADBE0003
_FACTS = 0x47530001
_FRAMES = (
    "",
    "LDB",
    "RDB",
    "LUB",
    "RUB",
    "LDF",
    "RDF",
    "LUF",
    "RUF",
    "LBD",
    "RBD",
    "LBU",
    "RBU",
    "LFD",
    "RFD",
    "LFU",
    "RFU",
)
_MOST_EXTENSIONS = 1 << 16
_COMPACT_FRACTION_BITS = 12
_COMPACT_SH_BITS = (5, 4)  # bits of degree 1 and of higher degrees: every 8th and 16th of 256 codes, and 255
_TURN = np.diag([1.0, -1.0, -1.0])  # right-up-back to right-down-front, its own inverse
_SQRT_HALF = np.sqrt(0.5)


@dataclass(frozen=True)
class _Header:
    """Version, number of Gaussians, SH degree, fraction bits, flags, streams, and facts from extensions."""

    version: int
    count: int
    sh_degree: int
    fraction_bits: int
    flags: int
    streams: int
    frame: str = ""
    facts: SceneFacts = _NOTHING_KNOWN

    def sizes(self) -> dict[str, int]:
        """Return the bytes of each stream, in file order."""
        n = self.count
        return {
            "positions": n * (6 if self.version == 1 else 9),
            "alphas": n,
            "colors": 3 * n,
            "scales": 3 * n,
            "rotations": n * (4 if self.version >= 3 else 3),
            "sh": 3 * n * _COEFFICIENTS[self.sh_degree],
        }


def load_spz(path: str | os.PathLike[str]) -> Gaussians:
    """Read an SPZ file.

    SH degree 4, which version 4 allows, is dropped with a warning in the log.

    Args:
        path: The file.

    Returns:
        The scene in the file's order, in the frame of a PLY (right-down-front). If the file states its frame, the scene
        gets an up axis; a frame other than right-up-back is rotated or mirrored.

    Raises:
        FormatError: If the file is not SPZ, is truncated, or claims more than its size can hold.
        OSError: If it cannot be opened.

    References:
        The format's README and reference implementation, nianticlabs/spz.
    """
    return decode_spz(path, read_whole(path))


def decode_spz(path: str | os.PathLike[str], data: bytes) -> Gaussians:
    """Return the scene from the bytes of an SPZ file, which may be part of a larger file.

    Args:
        path: The file that holds them, for error messages.
        data: The bytes.

    Raises:
        FormatError: As `load_spz`.
    """
    budget = Budget(path, len(data))
    if data[:4] == _MAGIC:
        header, streams = _read_zstd(path, data, budget)
    elif data[:2] == _GZIP:
        header, streams = _read_gzip(path, data, budget)
    else:
        raise FormatError(path, "byte 0", "the magic 'NGSP' or a gzip stream", repr(data[:4])[1:])
    return _decode(path, header, streams)


def _parse_header(path: str | os.PathLike[str], data: bytes, versions: range, budget: Budget) -> _Header:
    """Return the checked header."""
    if len(data) < _HEADER.size:
        raise FormatError(path, "header", f"{_HEADER.size} bytes", f"{len(data)}", "is the file truncated?")
    magic, version, count, degree, fraction_bits, flags, streams = _HEADER.unpack_from(data)
    if magic != _MAGIC:
        raise FormatError(path, "header", "the magic 'NGSP'", repr(magic)[1:])
    if version not in versions:
        raise FormatError(path, "header", f"version {versions[0]} to {versions[-1]} here", f"{version}")
    if degree >= len(_COEFFICIENTS):
        raise FormatError(path, "header", "an SH degree from 0 to 4", f"{degree}")
    if fraction_bits > 30:
        raise FormatError(path, "header", "at most 30 fraction bits", f"{fraction_bits}")
    if count == 0:
        raise FormatError(path, "header", "at least one Gaussian", "none", "the file holds an empty scene")
    header = _Header(version, count, degree, fraction_bits, flags, streams)
    budget.claim(sum(header.sizes().values()) + bytes_of_scene(count, degree), "header")
    return header


def _read_gzip(path: str | os.PathLike[str], data: bytes, budget: Budget) -> tuple[_Header, dict[str, U8]]:
    """Read versions 1 to 3: header and streams in one gzip stream, then extensions."""
    inflate = zlib.decompressobj(wbits=31)
    try:
        head = inflate.decompress(data, _HEADER.size)
        header = _parse_header(path, head, range(1, 4), budget)
        needed = sum(header.sizes().values())
        body = inflate.decompress(inflate.unconsumed_tail, needed)
        if len(body) == needed and header.flags & _HAS_EXTENSIONS:
            header = _extended(path, header, inflate.decompress(inflate.unconsumed_tail, _MOST_EXTENSIONS))
    except zlib.error as error:
        raise FormatError(path, "", "a gzip stream", str(error), "the file is damaged") from error
    if len(body) < needed:
        raise FormatError(
            path, "", f"{needed:,} bytes for {header.count:,} Gaussians", f"{len(body):,}", "the file is truncated"
        )
    ends = np.cumsum(list(header.sizes().values()))[:-1]
    return header, dict(zip(header.sizes(), np.split(np.frombuffer(body, np.uint8), ends), strict=True))


def _read_zstd(path: str | os.PathLike[str], data: bytes, budget: Budget) -> tuple[_Header, dict[str, U8]]:
    """Read version 4: plain header and extensions, a table of contents, one zstd stream per attribute."""
    header = _parse_header(path, data, range(4, 5), budget)
    start = _HEADER.size + _V4_REST.size
    sizes = {name: size for name, size in header.sizes().items() if size}
    (contents,) = _V4_REST.unpack_from(data, _HEADER.size) if len(data) >= start else (0,)
    at = contents + 16 * len(sizes)
    if header.streams != len(sizes) or contents < start or at > len(data):
        raise FormatError(
            path,
            "table of contents",
            f"{len(sizes)} streams, listed from byte {start} on and before the end of the file",
            f"{header.streams} streams from byte {contents:,}",
        )
    if header.flags & _HAS_EXTENSIONS:
        header = _extended(path, header, data[start : min(contents, start + _MOST_EXTENSIONS)])
    streams = {"sh": np.zeros(0, np.uint8)}
    for i, (name, size) in enumerate(sizes.items()):
        packed, unpacked = struct.unpack_from("<QQ", data, contents + 16 * i)
        if unpacked != size or packed > len(data) - at:
            raise FormatError(
                path,
                f"stream {name}",
                f"{size:,} bytes from at most {len(data) - at:,}",
                f"{unpacked:,} from {packed:,}",
                "is the file truncated?",
            )
        streams[name] = _unzstd(path, name, data[at : at + packed], size)
        at += packed
    return header, streams


def _unzstd(path: str | os.PathLike[str], name: str, packed: bytes, size: int) -> U8:
    """Decompress one stream, never more than `size` bytes of it."""
    try:
        frame = zstandard.get_frame_parameters(packed)
        unpacker = zstandard.ZstdDecompressor(max_window_size=1 << 27)
        with unpacker.stream_reader(packed) as reader:
            data = reader.read(size + 1)
    except (zstandard.ZstdError, MemoryError) as error:
        raise FormatError(path, f"stream {name}", "zstd data", str(error), "the file is damaged") from error
    if len(data) != size or frame.dict_id:
        raise FormatError(path, f"stream {name}", f"{size:,} bytes", f"{len(data):,}", "the file is damaged")
    return np.frombuffer(data, np.uint8)


def _extended(path: str | os.PathLike[str], header: _Header, block: bytes) -> _Header:
    """Return the header with data of extensions: the frame, and the facts of gsvis; other extensions are skipped."""
    frame = ""
    facts = SceneFacts()
    at = 0
    while at + 8 <= len(block):
        kind, length = struct.unpack_from("<II", block, at)
        body = block[at + 8 : at + 8 + length]
        if kind == _COORDINATE_SYSTEM and len(body) == length == 4:
            (system,) = struct.unpack("<I", body)
            if system >= len(_FRAMES):
                expected = f"a coordinate system from 0 to {len(_FRAMES) - 1}"
                raise FormatError(path, "extension", expected, f"coordinate system {system}")
            frame = _FRAMES[system]
        elif kind == _FACTS:
            facts = parse_facts(body)
        at += 8 + length
    return replace(header, frame=frame, facts=facts)


def _stated(header: _Header) -> SceneFacts:
    """Return the facts of the file; if it states a frame, the scene in the frame of a PLY has -y up."""
    facts = replace(header.facts, antialiased=bool(header.flags & _ANTIALIASED))
    if facts.up is None and header.frame:
        facts = replace(facts, up=(0.0, -1.0, 0.0), up_source=f"coordinate system {header.frame} of the SPZ")
    return facts


def _framed(scene: Gaussians, frame: str) -> Gaussians:
    """Return a scene, read as right-up-back although its frame is another, in the frame of a PLY.

    `frame` names the directions of x, y and z. Half of the frames are mirror images of right-up-back.
    """
    axes = {"R": (1, 0, 0), "L": (-1, 0, 0), "D": (0, 1, 0), "U": (0, -1, 0), "F": (0, 0, 1), "B": (0, 0, -1)}
    turn = np.array([axes[letter] for letter in frame], np.float64).T @ _TURN
    if np.array_equal(turn, np.eye(3)):
        return scene
    facts = scene.facts
    plain = scene.with_facts(SceneFacts())
    if np.linalg.det(turn) > 0.0:
        return plain.transform(turn).with_facts(facts)
    flipped = plain.transform(-turn)  # then mirror through (0, 0, 0): harmonics of odd degree change their sign
    degrees = np.repeat(np.arange(1, scene.sh_degree + 1), [2 * d + 1 for d in range(1, scene.sh_degree + 1)])
    odd = np.where(degrees % 2 == 1, -1.0, 1.0).astype(np.float32)[None, :, None]
    return Gaussians(
        -flipped.means, flipped.quats, flipped.scales, flipped.opacities, flipped.sh0, flipped.shN * odd, facts=facts
    )


def _decode(path: str | os.PathLike[str], header: _Header, streams: dict[str, U8]) -> Gaussians:
    """Return the scene from the streams."""
    n = header.count
    degree = header.sh_degree
    means = _positions(header, streams["positions"])
    quats = _smallest_three(streams["rotations"]) if header.version >= 3 else _first_three(streams["rotations"])
    codes = np.arange(256, dtype=np.float32)
    scales = _look_up_bytes(streams["scales"], exp_scales(codes / 16.0 - 10.0), (n, 3))
    sh0 = _look_up_bytes(streams["colors"], (codes / 255.0 - 0.5) / np.float32(COLOR_SCALE), (n, 1, 3))
    opacities = _look_up_bytes(streams["alphas"], codes / np.float32(255.0), (n,))
    shN = None
    if degree:
        if degree == 4:
            report_loss(path, "SH", "SH degree 4 is dropped; gsvis keeps degrees 0 to 3")
        signs = np.diag(rotation_of_sh(_TURN, min(degree, 3)))[1:].round().astype(np.float32)
        shN = np.empty((n, len(signs), 3), np.float32)
        unpack_higher(
            *_check.read_only(streams["sh"].reshape(n, -1)), np.repeat(signs / np.float32(128.0), 3), shN.reshape(n, -1)
        )
    facts = _stated(header)
    scene = gaussians_from(path, means, quats, scales, opacities, sh0, shN, facts)
    scene = _framed(scene, header.frame) if header.frame else scene
    return settle_origin(scene, facts.origin) if any(facts.origin) else scene


def _positions(header: _Header, stream: U8) -> F32:
    """Return (N, 3) coordinates: half floats in version 1, then 24-bit fixed point."""
    turn = np.diag(_TURN).astype(np.float32)
    if header.version == 1:
        with np.errstate(all="ignore"):
            return stream.view("<f2").astype(np.float32).reshape(-1, 3) * turn
    means = np.empty((header.count, 3), np.float32)
    unpack_fixed_points(*_check.read_only(stream), turn / np.float32(1 << header.fraction_bits), means)
    return means


def _look_up_bytes(stream: U8, table: F32, shape: tuple[int, ...]) -> F32:
    """Return the table value of each byte."""
    values = np.empty(stream.size, np.float32)
    look_up(stream, table, values)
    return values.reshape(shape)


def _first_three(stream: U8) -> F32:
    """Return (N, 4) wxyz from three bytes x, y, z with w >= 0 (versions 1 and 2)."""
    three = stream.reshape(-1, 3).astype(np.float32) / np.float32(127.5) - 1.0
    xyzw = largest_from_three(three, np.full(len(three), 3))
    return xyzw[:, [3, 0, 1, 2]] * np.array([1, 1, -1, -1], np.float32)


def _smallest_three(stream: U8) -> F32:
    """Return (N, 4) wxyz from 32 bits: the index of the largest of xyzw, then sign and 9 bits for each other."""
    codes = np.arange(1024)
    size = (codes & 0x1FF).astype(np.float32) * np.float32(_SQRT_HALF / 0x1FF)
    bits = stream.view("<u4").astype(np.uint32, copy=False)
    quats = np.empty((len(bits), 4), np.float32)
    table = np.where(codes & 0x200, -size, size)
    unpack_quats(*_check.read_only(bits), table, np.array([1, 2, 3, 0]), np.array([1, -1, -1, 1], np.float32), quats)
    return quats


def save_spz(scene: Gaussians, path: str | os.PathLike[str], *, compact: bool = False) -> None:
    """Write an SPZ file, version 4, atomically.

    Lossy: a byte per value, log-scales within [-10, 5.94] in steps of 1/16, SH within [-1, 1), constant color
        within +-3.3. Coordinates have 24 bits, up to 16 of them fraction bits, more in a tiny scene, as many as the
        extent allows. A few flyaways are moved closer, to keep the precision of the other Gaussians. A scene far from
        (0, 0, 0) is written relative to an origin, which gsvis reads back. Each such change, and each clipped property,
        is one line in the log (`gsvis.io.losses`).

    Args:
        scene: The scene, in the frame of a PLY (right-down-front); its order is kept.
        path: The file; its folder is created if missing.
        compact: Round as other encoders do: coordinates to at most 12 fraction bits, SH of degree 1 to 5 bits, higher
            degrees to 4 bits. Files become 25 to 40 percent smaller, and quality drops by several dB.

    Raises:
        ValueError: If the scene is empty or extends beyond 2^23 units, which 24 bits cannot hold.
        OSError: If it cannot be written.
    """
    fitted, fraction_bits = fit_coordinates(scene, _COMPACT_FRACTION_BITS if compact else 16, path)
    report_spz_losses(fitted, path)
    if any(scene.facts.origin):
        report_note(path, "the origin is a note that only gsvis reads; other programs see the scene at (0, 0, 0)")
    streams = [_stream_bytes(stream) for stream in _pack_streams(fitted, fraction_bits, compact)]
    packed = [zstandard.ZstdCompressor(level=12).compress(stream) for stream in streams]
    extensions = _extensions(fitted.facts)
    contents = _HEADER.size + _V4_REST.size + len(extensions)
    flags = _header_flags(fitted.facts) | (_HAS_EXTENSIONS if extensions else 0)
    with atomic_path(path) as partial, open(partial, "wb") as out:
        out.write(_HEADER.pack(_MAGIC, 4, len(scene), scene.sh_degree, fraction_bits, flags, len(streams)))
        out.write(_V4_REST.pack(contents))
        out.write(extensions)
        for stream, data in zip(streams, packed, strict=True):
            out.write(struct.pack("<QQ", len(data), len(stream)))
        out.writelines(packed)


def _header_flags(facts: SceneFacts) -> int:
    """Return the flags of the header."""
    return _ANTIALIASED if facts.antialiased else 0


def _extensions(facts: SceneFacts) -> bytes:
    """Return the extension with facts that the header cannot store; empty if there are none."""
    body = spell_facts(replace(facts, antialiased=False)).encode()
    return struct.pack("<II", _FACTS, len(body)) + body if body else b""


def encode_old_spz(scene: Gaussians, path: str | os.PathLike[str] = "") -> tuple[bytes, Gaussians]:
    """Return an SPZ file of version 3, one gzip stream, for readers without version 4. Rounds like `save_spz`.

    Args:
        scene: The scene, in the frame of a PLY (right-down-front); its order is kept.
        path: The file to be written, for the log.

    Returns:
        The bytes, whose only fact is the flag of antialiased scenes; and the scene as fitted into the range of
        coordinates, whose origin may have changed.

    Raises:
        ValueError: If the scene is empty or extends beyond 2^23 units.
    """
    fitted, fraction_bits = fit_coordinates(scene, 16, path)
    report_spz_losses(fitted, path)
    packer = zlib.compressobj(9, wbits=31)
    head = _HEADER.pack(_MAGIC, 3, len(scene), scene.sh_degree, fraction_bits, _header_flags(scene.facts), 0)
    parts = [packer.compress(head)]
    parts += [packer.compress(_stream_bytes(stream)) for stream in _pack_streams(fitted, fraction_bits, compact=False)]
    return b"".join([*parts, packer.flush()]), fitted


def _pack_streams(scene: Gaussians, fraction_bits: int, compact: bool) -> list[NDArray[np.generic]]:
    """Return the values of each stream."""
    turned = scene.means.astype(np.float64) * np.diag(_TURN)
    fixed = np.rint(turned * 2.0**fraction_bits).astype("<i4")
    xyzw = scene.quats[:, [1, 2, 3, 0]] * np.array([1, -1, -1, 1], np.float32)
    streams: list[NDArray[np.generic]] = [
        fixed.reshape(-1, 1).view(np.uint8)[:, :3],
        _to_byte(scene.opacities * 255.0),
        _to_byte(scene.sh0 * (COLOR_SCALE * 255.0) + 127.5),
        _to_byte((np.log(scene.scales.astype(np.float64)) + 10.0) * 16.0),
        _pack_smallest_three(xyzw),
    ]
    if scene.sh_degree:
        signs = np.diag(rotation_of_sh(_TURN, scene.sh_degree))[1:, None].round()
        codes = np.rint(scene.shN * signs * 128.0 + 128.0)
        if compact:
            steps = np.where(np.arange(len(signs)) < 3, *(2.0 ** (8 - bits) for bits in _COMPACT_SH_BITS))[:, None]
            codes = np.floor(codes / steps + 0.5) * steps
        streams.append(_to_byte(codes))
    return streams


def _to_byte(values: NDArray[np.floating]) -> U8:
    """Return values rounded and clipped to 0 to 255."""
    return np.asarray(np.clip(np.rint(values), 0, 255), np.uint8)


def _stream_bytes(values: NDArray[np.generic]) -> bytes:
    """Return the values of a stream as bytes, in the order of the array."""
    return np.ascontiguousarray(values).tobytes()


def _pack_smallest_three(xyzw: F32) -> NDArray[np.uint32]:
    """Return 32 bits per quaternion; see `_smallest_three`."""
    largest = np.abs(xyzw).argmax(axis=1)
    negative = np.take_along_axis(xyzw, largest[:, None], axis=1) < 0
    q = np.where(negative, -xyzw, xyzw)
    packed = largest.astype(np.uint32)
    for place in range(4):
        size = np.clip(np.rint(np.abs(q[:, place]) * (0x1FF / _SQRT_HALF)), 0, 0x1FF).astype(np.uint32)
        field = size | (q[:, place] < 0).astype(np.uint32) << np.uint32(9)
        packed = np.where(largest == place, packed, packed << np.uint32(10) | field)
    return np.asarray(packed, "<u4")
