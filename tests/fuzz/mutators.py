"""Mutators that know the structure of what they change: bytes, text, JSON, PLY, and what wraps them.

`mutate` changes one file; the kind says how. A wrapped file (gzip, zip, zstd, a container under a checksum) is opened,
its content is changed, and it is packed again with right lengths and checksums, so that the change reaches the code
behind the first check. All randomness comes from the `Random` that is passed in.
"""

from __future__ import annotations

import gzip
import io
import json
import math
import struct
import zipfile
import zlib
from collections.abc import Callable
from random import Random

import numpy as np
import zstandard
from PIL import Image

from tests.fuzz.places import change_json

__all__ = ["KINDS", "Mutator", "change_json", "mutate"]

Mutator = Callable[[Random, bytes], bytes]

INTEGERS = (0, 1, 2, 3, 7, 8, 127, 128, 255, 256, 32767, 65535, 65536, 1 << 20, (1 << 24) - 1, 1 << 30, (1 << 31) - 1,
            1 << 31, (1 << 32) - 1, 1 << 32, 1 << 40, (1 << 63) - 1, 1 << 63, (1 << 64) - 1)  # fmt: skip
FLOATS = (0.0, -0.0, 1.0, -1.0, 1e-45, 1e-8, 0.5, 255.0, 1e10, 3.4e38, -3.4e38, 1e300, 1e308, math.inf, -math.inf,
          math.nan)  # fmt: skip
TOKENS = ("0", "-1", "1", "nan", "inf", "-inf", "1e400", "1e-400", "0x10", "1_000", "٣", "",
          "-0", "999999999999999999999",
          "2147483648", "4294967296", "18446744073709551616", "1e10", "3.5", "abc", "\0", '"', "'", ",", ";", "#", "..",
          "\r", "\ufeff", "element vertex 5", "PINHOLE", "OPENCV", "NaN", "true", "1e300", "-1e300",
          "1" * 400)  # fmt: skip


def change_bytes(rng: Random, data: bytes) -> bytes:
    """One change of bytes: a bit, a number, a piece more, less, twice or elsewhere."""
    if not data:
        return rng.randbytes(9)
    at = rng.randrange(len(data))
    if rng.random() < 0.3:  # heads and tails hold most of the structure
        at = min(rng.randrange(64), len(data) - 1) if rng.random() < 0.7 else len(data) - 1 - min(rng.randrange(32), at)
    way = rng.randrange(10)
    if way == 0:
        return data[:at] + bytes([data[at] ^ 1 << rng.randrange(8)]) + data[at + 1 :]
    if way == 1:
        return data[:at] + bytes([rng.choice((0, 1, 127, 128, 255, rng.randrange(256)))]) + data[at + 1 :]
    if way in (2, 3):
        return _overwrite(data, at, _number(rng))
    if way == 4:
        return data[:at] + rng.randbytes(rng.choice((1, 1, 2, 4, 8, 33))) + data[at:]
    if way == 5:
        return data[:at] + data[at + rng.choice((1, 1, 2, 4, 8, 64)) :]
    if way == 6:
        return data[:at]
    size = rng.choice((1, 4, 16, 64, 256))
    piece = data[at : at + size]
    other = rng.randrange(len(data))
    if way == 7:
        return data[:other] + piece + data[other:]
    if way == 8:
        return _overwrite(data, other, piece)
    return data + (piece if rng.random() < 0.5 else bytes(size))


def _overwrite(data: bytes, at: int, piece: bytes) -> bytes:
    return data[:at] + piece + data[at + len(piece) :]


def _number(rng: Random) -> bytes:
    """A number of one of the widths that files hold, often at the edge of what it can be."""
    order = rng.choice("<<<>")
    if rng.random() < 0.4:
        value = rng.choice(FLOATS)
        if (rng.random() < 0.5 and not math.isfinite(struct.unpack("<d", struct.pack("<d", value))[0])) or abs(
            value
        ) < 3e38:
            return struct.pack(order + "f", value)
        return struct.pack(order + "d", value)
    code, bits = rng.choice((("B", 8), ("H", 16), ("I", 32), ("I", 32), ("Q", 64)))
    value_ = rng.choice(INTEGERS) + rng.choice((0, 0, -1, 1))
    return struct.pack(order + code, value_ & (1 << bits) - 1)


def change_text(rng: Random, data: bytes) -> bytes:
    """One change of lines, or of the words or cells of a line; sometimes of bytes."""
    if rng.random() < 0.2:
        return change_bytes(rng, data)
    lines = data.split(b"\n")
    at = rng.randrange(len(lines))
    if rng.random() < 0.3:
        at = min(rng.randrange(4), len(lines) - 1)
    way = rng.randrange(8)
    if way == 0 and rng.random() < 0.2:
        del lines[rng.randint(1, 3) :]
    elif way == 0:
        del lines[at]
    elif way == 1:
        lines.insert(at, lines[rng.randrange(len(lines))])
    elif way == 2:
        other = rng.randrange(len(lines))
        lines[at], lines[other] = lines[other], lines[at]
    elif way == 3:
        lines[at : at + rng.randrange(4)] = [
            rng.choice((b"", b"#", b" ", b'"', b"\xff\xfe", b"a" * 70_000, b"1 2", b"x,y"))
        ]
    else:
        lines[at] = _change_line(rng, lines[at], lines[rng.randrange(len(lines))])
    return b"\n".join(lines)


def _change_line(rng: Random, line: bytes, other: bytes) -> bytes:
    separator = b"," if b"," in line else b" "
    words, others = line.split(separator), other.split(separator)
    at = rng.randrange(len(words))
    way = rng.randrange(6)
    if way == 0:
        del words[at]
    elif way == 1:
        words.insert(at, rng.choice(others))
    elif way == 2:
        words[at] = rng.choice(others)
    elif way == 3:
        words[at] = change_bytes(rng, words[at])
    else:
        words[at] = rng.choice(TOKENS).encode("utf-8", "surrogatepass")
    return separator.join(words)


def change_json_file(rng: Random, data: bytes) -> bytes:
    """One change of the document in a JSON file; sometimes of its text."""
    if rng.random() < 0.15:
        return change_text(rng, data)
    if rng.random() < 0.02:
        return rng.choice(
            (b"[" * 5000, b'{"a":' * 5000, b"", b"null", b"[]", b"{}", b"1" * 6000, b'"\\ud800"', b"\xff{}")
        )
    try:
        return json.dumps(change_json(rng, json.loads(data))).encode()
    except (ValueError, RecursionError, OverflowError):
        return change_text(rng, data)


def change_ply(rng: Random, data: bytes) -> bytes:
    """One change of the header or of the rows of a PLY."""
    head, mark, rows = data.partition(b"end_header\n")
    if not mark:
        return change_bytes(rng, data)
    if rng.random() < 0.6:
        return _change_ply_header(rng, head) + mark + rows
    if b"format ascii" in head:
        return head + mark + change_text(rng, rows)
    return head + mark + change_bytes(rng, rows)


def _change_ply_header(rng: Random, head: bytes) -> bytes:
    lines = head.split(b"\n")
    at = rng.randrange(len(lines))
    words = lines[at].split(b" ")
    way = rng.randrange(8)
    if way == 0:
        types = (b"float", b"double", b"uchar", b"char", b"short", b"ushort", b"int", b"uint", b"list uchar int",
                 b"list int float", b"list float int", b"int8", b"float64", b"half")  # fmt: skip
        lines[at] = b" ".join((b"property", rng.choice(types), words[-1] or b"x"))
    elif way == 1:
        lines.insert(at, b"element %s %d" % (rng.choice((b"face", b"chunk", b"sh", b"vertex")), rng.choice(INTEGERS)))
    elif way == 2 and words[0] == b"element":
        lines[at] = b" ".join((*words[:2], str(rng.choice((*INTEGERS, -1))).encode()))
    elif way == 3:
        lines[at] = rng.choice(
            (
                b"format ascii 1.0",
                b"format binary_big_endian 1.0",
                b"format binary_little_endian 1.0",
                b"format x 2.0",
                b"comment",
                b"obj_info a",
                b"\xff",
                b"element",
                b"property",
                b"",
            )
        )
    elif way == 4:
        lines[at] = lines[at] + b"\r"
    else:
        return change_text(rng, head)
    return b"\n".join(lines)


def change_zip(rng: Random, data: bytes) -> bytes:
    """One change of a zip: of a member by its kind, of the list of members, or of its bytes."""
    members = _members(data)
    if members is None or not members or rng.random() < 0.15:
        return change_bytes(rng, data)
    names = list(members)
    name = rng.choice(names)
    way = rng.randrange(12)
    compression = zipfile.ZIP_DEFLATED if rng.random() < 0.3 else zipfile.ZIP_STORED
    if way == 0:
        del members[name]
    elif way == 1:
        other = rng.choice(
            ("../" + name, "/" + name, "a/" + name, name + "\0", "x" * 2000, name.upper(), "C:" + name, ".")
        )
        members[other] = members.pop(name)
    elif way == 2:
        members[name] = members[rng.choice(names)]
    elif way == 3:
        compression = rng.choice((zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA))
    elif way == 4 and name.endswith(".json"):
        members[name] = members[name] + b" " * 300_000
        compression = zipfile.ZIP_DEFLATED
    else:
        members[name] = mutate(rng, kind_of(name), members[name])
    return zip_of(members, compression)


def _members(data: bytes) -> dict[str, bytes] | None:
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            return {info.filename: archive.read(info) for info in archive.infolist()}
    except Exception:  # zipfile and its decompressors have many words for damage
        return None


def zip_of(members: dict[str, bytes], compression: int = zipfile.ZIP_STORED) -> bytes:
    """A zip of these members; the same bytes whenever it is made."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", compression) as archive:
        for name, data in members.items():
            archive.writestr(zipfile.ZipInfo(name), data, compress_type=compression)
    return out.getvalue()


def change_archive(rng: Random, data: bytes) -> bytes:
    """One change of an archive of arrays; mostly its checksum, the comment of the zip, fits again."""
    if rng.random() < 0.1:
        return change_bytes(rng, data)
    changed = change_zip(rng, data)
    if changed[-22:-18] == b"PK\5\6" and changed[-2:] == b"\0\0":
        changed = changed[:-2] + struct.pack("<H", 20) + b"gsvis-crc32:"
    elif changed[-20:-8] == b"gsvis-crc32:":
        changed = changed[:-8]
    else:
        return changed
    return changed + b"%08x" % zlib.crc32(changed)


def change_npy(rng: Random, data: bytes) -> bytes:
    """One change of the header or the numbers of a NumPy array."""
    if len(data) < 10 or rng.random() < 0.2:
        return change_bytes(rng, data)
    (length,) = struct.unpack_from("<H", data, 8)
    head, rows = data[10 : 10 + length], data[10 + length :]
    way = rng.randrange(6)
    if way == 0:
        types = (
            b"'<f4'",
            b"'<f8'",
            b"'>f4'",
            b"'|u1'",
            b"'|O'",
            b"'<U9'",
            b"'|V8'",
            b"'<i8'",
            b"[('a', '<f4')]",
            b"'<c8'",
            b"'<M8[s]'",
            b"'|S0'",
            b"'|b1'",
            b"()",
            b"('|u1',)",
            b"('|u1', (2, 2))",
            b"[('a',)]",
            b"'f8,('",
            b"-" * 3000 + b"1",
        )
        head = (
            b"{'descr': "
            + rng.choice(types)
            + b", "
            + head.partition(b", 'fortran")[1][2:]
            + head.partition(b"'fortran")[2][7:]
        )
        head = head if b"fortran" in head else data[10 : 10 + length]
    elif way == 1:
        sizes = (
            "()",
            "(0,)",
            "(-1,)",
            "(1000000000000,)",
            "(3, 3)",
            "(1, 2, 3, 4)",
            "(2147483648, 2147483648)",
            "5",
            "(1.5,)",
            "(True,)",
            "('a',)",
            "(" + "1, " * 70 + ")",
        )
        before, _, _ = head.partition(b"'shape': ")
        head = before + b"'shape': " + rng.choice(sizes).encode() + b", }\n"
    elif way == 2:
        head = change_bytes(rng, head)
    else:
        return data[: 10 + length] + change_bytes(rng, rows)
    return data[:8] + struct.pack("<H", len(head) & 0xFFFF) + head + rows


def change_gzip(kind: str) -> Mutator:
    """A mutator of what is in a gzip file; sometimes of the gzip file."""

    def change(rng: Random, data: bytes) -> bytes:
        if rng.random() < 0.2:
            return change_bytes(rng, data)
        try:
            inner = gzip.decompress(data)
        except (OSError, EOFError, zlib.error):
            return change_bytes(rng, data)
        packed = gzip.compress(mutate(rng, kind, inner), 1, mtime=0)
        return packed + packed if rng.random() < 0.02 else packed

    return change


def change_spz4(rng: Random, data: bytes) -> bytes:
    """One change of an SPZ of version 4: its head, its table of contents, or one of its zstd streams."""
    if len(data) < 32 or rng.random() < 0.25:
        return change_bytes(rng, data)
    if rng.random() < 0.1:
        return change_spz_head(rng, data)
    streams, (contents,) = data[15], struct.unpack_from("<I", data, 16)
    at = contents + 16 * streams
    if at > len(data) or rng.random() < 0.3:
        return change_bytes(rng, data[:at]) + data[at:]
    pieces = []
    for k in range(streams):
        packed, size = struct.unpack_from("<QQ", data, contents + 16 * k)
        pieces.append([data[at : at + packed], size])
        at += packed
    if not pieces:
        return change_bytes(rng, data)
    chosen = rng.choice(pieces)
    chosen[0] = change_zstd(rng, chosen[0])
    if rng.random() < 0.2:
        chosen[1] = rng.choice((*INTEGERS, chosen[1] + 1))
    table = b"".join(struct.pack("<QQ", len(packed), size & (1 << 64) - 1) for packed, size in pieces)
    return data[:contents] + table + b"".join(packed for packed, _ in pieces)


def change_spz_head(rng: Random, data: bytes) -> bytes:
    """One change of what is in an SPZ of version 1 to 3: mostly of a field of its head, or of what follows it."""
    if len(data) < 16 or rng.random() < 0.4:
        return change_bytes(rng, data)
    fields = list(struct.unpack_from("<4sIIBBBB", data))
    at = rng.choice((1, 2, 2, 3, 3, 4, 5, 6))
    fields[at] = rng.choice((0, 1, 2, 3, 4, 5, 31, 255) if at > 2 else (0, 1, 2, 3, 4, fields[2] + 1, 1 << 31))
    if rng.random() < 0.2:
        fields[5], data = 2, data + struct.pack("<III", 0xADBE0003, 4, rng.choice((0, 4, 5, 1 << 31)))
    return struct.pack("<4sIIBBBB", *fields) + data[16:]


def change_zstd(rng: Random, data: bytes, change: Mutator = change_bytes) -> bytes:
    """One change of what is in a zstd frame; sometimes of the frame."""
    if rng.random() < 0.2:
        return change(rng, data)
    try:
        inner = zstandard.ZstdDecompressor().decompress(data, max_output_size=1 << 22)
    except zstandard.ZstdError:
        return change(rng, data)
    if rng.random() < 0.05:
        inner = bytes(len(inner) + rng.choice((0, 1, 1 << 20)))
    states_size = rng.random() < 0.9
    return zstandard.ZstdCompressor(level=1, write_content_size=states_size).compress(change(rng, inner))


def change_webp(rng: Random, data: bytes) -> bytes:
    """One change of a picture: its pixels, its size, its format, or its bytes."""
    if rng.random() < 0.25:
        return change_bytes(rng, data)
    try:
        with Image.open(io.BytesIO(data)) as image:
            pixels = np.array(image.convert("RGBA"))
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        return change_bytes(rng, data)
    way = rng.randrange(5)
    if way == 0:
        pixels = pixels[: rng.randint(1, len(pixels)), : rng.randint(1, pixels.shape[1])]
    elif way == 1:
        pixels = np.concatenate([pixels] * rng.randint(2, 3), axis=rng.randrange(2))
    elif way == 2:
        pixels[..., rng.randrange(4)] = rng.choice((0, 127, 251, 252, 255))
    else:
        raw = bytearray(pixels.tobytes())
        for _ in range(rng.randint(1, 8)):
            raw[rng.randrange(len(raw))] = rng.choice((0, 255, rng.randrange(256)))
        pixels = np.frombuffer(bytes(raw), np.uint8).reshape(pixels.shape)
    out, odd = io.BytesIO(), rng.random()
    picture = Image.fromarray(np.ascontiguousarray(pixels))
    if odd < 0.03:
        picture.save(out, rng.choice(("PNG", "GIF", "TIFF")))
    elif odd < 0.08:
        picture.convert(rng.choice(("RGB", "L"))).convert("RGB").save(out, "WEBP", lossless=odd < 0.06)
    elif odd < 0.13:  # an extended file, with its size twice
        picture.save(out, "WEBP", lossless=True, exact=True, xmp=b"<x/>")
    elif odd < 0.16:
        picture.save(out, "WEBP", save_all=True, append_images=[picture, picture], lossless=True)
    else:
        picture.save(out, "WEBP", lossless=True, exact=True, quality=0, method=0)
    return out.getvalue()


KINDS: dict[str, Mutator] = {
    "bytes": change_bytes,
    "text": change_text,
    "json": change_json_file,
    "ply": change_ply,
    "zip": change_zip,
    "archive": change_archive,
    "npy": change_npy,
    "gzip": change_gzip("bytes"),
    "gzip-spz": change_gzip("spz-head"),
    "gzip-text": change_gzip("text"),
    "spz-head": change_spz_head,
    "spz4": change_spz4,
    "zstd": change_zstd,
    "webp": change_webp,
}
"""Mutators of one file by the kind of what it holds; a family adds those of its own formats."""

_SUFFIXES = {
    ".json": "json", ".ply": "ply", ".webp": "webp", ".npy": "npy", ".npz": "archive", ".sog": "zip", ".txt": "text",
    ".csv": "text", ".ksplat": "ksplat", ".gz": "gzip-text", ".log": "text",
}  # fmt: skip


def kind_of(name: str) -> str:
    """The kind of a file, by its name."""
    return next((kind for suffix, kind in _SUFFIXES.items() if name.endswith(suffix)), "bytes")


def mutate(rng: Random, kind: str, data: bytes) -> bytes:
    """One change of a file of this kind."""
    return KINDS[kind](rng, data)
