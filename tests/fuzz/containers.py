"""Mutators of the formats of gsvis: what is under a checksum or a hash is changed and put under a right one again."""

from __future__ import annotations

import hashlib
import io
import json
import struct
import zlib
from collections.abc import Callable
from random import Random
from typing import Any

import numpy as np
import pyarrow as pa
import zstandard

from gsvis.errors import FormatError
from gsvis.files import arrow as _arrow
from gsvis.files.sections import HEAD_BYTES, SectionWriter
from gsvis.package.active_terms import _CRC
from gsvis.pvs._writer import CELL_ROW, FILE_KIND
from tests.fuzz.mutators import KINDS, change_bytes, change_json, change_zstd

__all__ = ["change_manifest", "sealed_manifest"]

_TYPES = (
    pa.uint8(),
    pa.int8(),
    pa.int32(),
    pa.float32(),
    pa.float64(),
    pa.string(),
    pa.int64(),
    pa.binary(),
    pa.list_(pa.int8()),
)
_FAULTS = (pa.ArrowException, ValueError, OSError, OverflowError, TypeError, KeyError, RecursionError)


def _opened(data: bytes) -> tuple[pa.Schema, list[pa.RecordBatch]] | None:
    try:
        reader = pa.ipc.open_file(pa.BufferReader(data))
        return reader.schema, _valid([reader.get_batch(k) for k in range(reader.num_record_batches)])
    except _FAULTS:
        return None


def _valid(batches: list[pa.RecordBatch]) -> list[pa.RecordBatch]:
    """The batches, if they are valid: Arrow ends the process when it writes others."""
    for batch in batches:
        batch.validate(full=True)
    return batches


def _written(rng: Random, schema: pa.Schema, batches: list[pa.RecordBatch], compression: str | None = "any") -> bytes:
    sink = pa.BufferOutputStream()
    chosen = rng.choice(("zstd", "zstd", "zstd", "lz4", None)) if compression == "any" else compression
    options = pa.ipc.IpcWriteOptions(compression=chosen, use_threads=False)
    with pa.ipc.new_file(sink, schema, options=options) as writer:
        for batch in _valid(batches):
            writer.write_batch(batch.replace_schema_metadata(schema.metadata))
    return sink.getvalue().to_pybytes()


def change_column(rng: Random, array: pa.Array) -> pa.Array:
    """A column with other numbers, of another type, or with nulls."""
    way = rng.randrange(6)
    try:
        if way == 0:
            return array.cast(rng.choice(_TYPES), safe=False)
        if way == 1:
            values = array.to_pylist()
            values[rng.randrange(len(values))] = None
            return pa.array(values, array.type)
        if pa.types.is_binary(array.type):
            values = array.to_pylist()
            at = rng.randrange(len(values))
            values[at] = change_bytes(rng, values[at])
            return pa.array(values, array.type)
        return (
            pa.Array.from_buffers(array.type, len(array), _changed_buffers(rng, array))
            if not array.type.num_fields
            else _nested(rng, array)
        )
    except _FAULTS:
        return array


def _nested(rng: Random, array: pa.Array) -> pa.Array:
    if pa.types.is_struct(array.type):
        fields = [array.field(k) for k in range(array.type.num_fields)]
        at = rng.randrange(len(fields))
        fields[at] = change_column(rng, fields[at])
        return pa.StructArray.from_arrays(fields, names=[field.name for field in array.type])
    if pa.types.is_fixed_size_list(array.type):
        return pa.FixedSizeListArray.from_arrays(change_column(rng, array.flatten()), type=array.type)
    if rng.random() < 0.3:
        offsets = np.frombuffer(
            change_bytes(rng, array.offsets.to_numpy().tobytes())[: 4 * len(array) + 4].ljust(
                4 * len(array) + 4, b"\0"
            ),
            "<i4",
        )
        return pa.Array.from_buffers(
            array.type, len(array), [None, pa.py_buffer(offsets.tobytes())], children=[array.values]
        )
    return type(array).from_arrays(array.offsets, change_column(rng, array.values), type=array.type)


def _changed_buffers(rng: Random, array: pa.Array) -> list[Any]:
    buffers = array.buffers()
    data = buffers[-1].to_pybytes()
    changed = change_bytes(rng, data)[: len(data)].ljust(len(data), b"\0")
    return [*buffers[:-1], pa.py_buffer(changed)]


def _change_table(
    rng: Random, schema: pa.Schema, batches: list[pa.RecordBatch]
) -> tuple[pa.Schema, list[pa.RecordBatch]]:
    way = rng.randrange(10)
    if way == 0:
        return schema, batches * rng.choice((0, 2))
    if way == 1 and batches:
        cut = [batch.slice(rng.randrange(3), rng.randrange(len(batch) + 1)) for batch in batches]
        return schema, cut
    if not batches:
        return schema, batches
    columns = {name: batches[0].column(name) for name in schema.names}
    name = rng.choice(schema.names)
    if way == 2:
        del columns[name]
    elif way == 3:
        columns[rng.choice(("x", name + "2", ""))] = columns.pop(name)
    elif way == 4:
        columns = dict(reversed(columns.items()))
    else:
        columns[name] = change_column(rng, columns[name])
    kept = schema.metadata
    fields = [pa.field(key, column.type, nullable=rng.random() < 0.05) for key, column in columns.items()]
    if all(schema.get_field_index(field.name) >= 0 and schema.field(field.name).type == field.type for field in fields):
        fields = [schema.field(field.name) if rng.random() < 0.98 else field for field in fields]
    changed = pa.schema(fields, metadata=kept)
    return changed, [
        pa.RecordBatch.from_arrays(list(columns.values()), schema=changed),
        *(batches[1:] if changed == schema else []),
    ]


def change_arrow(rng: Random, data: bytes) -> bytes:
    """One change of an Arrow file of gsvis: header, schema, rows or bytes, under a right checksum."""
    if rng.random() < 0.1:
        return change_bytes(rng, data)
    if rng.random() < 0.2:
        return _with_checksum(change_bytes(rng, data))
    opened = _opened(data)
    if opened is None:
        return change_bytes(rng, data)
    schema, batches = opened
    metadata = dict(schema.metadata or {})
    try:
        if rng.random() < 0.2:  # buffers as they are, so that numbers in them can become impossible
            return _with_checksum(change_bytes(rng, _written(rng, schema, batches, None)))
        if rng.random() < 0.5 and b"gsvis" in metadata:
            header = change_json(rng, json.loads(metadata[b"gsvis"]))
            schema = schema.with_metadata({**metadata, b"gsvis": json.dumps(header).encode()})
        else:
            schema, batches = _change_table(rng, schema, batches)
        return _with_checksum(_written(rng, schema, batches))
    except _FAULTS:
        return change_bytes(rng, data)


def _with_checksum(data: bytes) -> bytes:
    """The file with the checksum that it ought to have, where there is a place for it."""
    changed = bytearray(data)
    try:
        with memoryview(changed) as view:
            places = _arrow._checksum_places(None, view)  # type: ignore[arg-type]
            digits = b"%08x" % _arrow._checksum(view, places)
            for place in places:
                changed[place : place + 8] = digits
    except (FormatError, struct.error, ValueError, TypeError):
        return data
    return bytes(changed)


def change_active(rng: Random, data: bytes) -> bytes:
    """One change of a store of active terms, under right checksums."""
    if rng.random() < 0.2:
        return change_bytes(rng, data)
    opened = _opened(data)
    if opened is None or not opened[1]:
        return change_bytes(rng, data)
    schema, batches = opened
    metadata = dict(schema.metadata or {})
    try:
        way = rng.randrange(3)
        if way == 0:
            text = json.dumps(change_json(rng, json.loads(metadata[b"gsvis"]))).encode()
            schema = schema.with_metadata({**metadata, b"gsvis": text, b"gsvis-crc32": b"%08x" % zlib.crc32(text)})
        elif way == 1:
            schema, batches = _change_table(rng, schema, batches)
        else:
            rows = batches[0].to_pylist()
            row = rng.choice(rows)
            names = schema.names
            name = rng.choice((names[1], names[2], names[4], names[4], names[0]))
            row[name] = (
                change_bytes(rng, row[name]) if name == names[4] else rng.choice((0, 1, row[name] + 1, (1 << 32) - 1))
            )
            head = _CRC.pack(*(row[key] for key in names[:3]))
            row[names[3]] = zlib.crc32(row[names[4]], zlib.crc32(head))
            batches = [pa.RecordBatch.from_pylist(rows, schema=schema), *batches[1:]]
        return _written(rng, schema, batches)
    except (*_FAULTS, struct.error):
        return change_bytes(rng, data)


def change_container(rng: Random, data: bytes) -> bytes:
    """One change of a store of visible sets, under right checksums."""
    try:
        header, sections = _sections(data)
    except (ValueError, struct.error, KeyError, TypeError, UnicodeDecodeError):
        return change_bytes(rng, data)
    if rng.random() < 0.15:
        return change_bytes(rng, data)
    way = rng.randrange(8)
    name = rng.choice(sorted(sections))
    if way < 3:
        header = change_json(rng, header)
    elif way == 3 and rng.random() < 0.3:
        sections[rng.choice((name + "x", "cells"))] = sections.pop(name)
    elif name in ("coords", "ever", "common"):
        sections[name] = change_zstd(rng, sections[name])
    elif name in ("directions", "labels") and sections[name]:
        sections[name] = (
            sections[name][:1] + change_zstd(rng, sections[name][1:])
            if name == "labels"
            else change_zstd(rng, sections[name])
        )
    else:
        _change_cell(rng, sections)
    if way < 3 and rng.random() < 0.4 and isinstance(header, dict) and "sections" in header:
        return _with_header(data, header)
    try:
        return sealed_sections(header if isinstance(header, dict) else {}, sections)
    except ValueError:  # NaN has no place there
        return change_bytes(rng, data)


def _sections(data: bytes) -> tuple[Any, dict[str, bytes]]:
    place, length = struct.unpack_from("<QI", data, 24)
    header = json.loads(data[place : place + length])
    found, at = {}, HEAD_BYTES
    for name, _, size, _ in header["sections"]:
        found[name] = data[at : at + size]
        at += size
    return header, found


def sealed_sections(header: dict[str, Any], sections: dict[str, bytes]) -> bytes:
    """A store of visible sets with these sections, under right checksums."""
    out = io.BytesIO()
    writer = SectionWriter(out, FILE_KIND)
    for name, content in sections.items():
        writer.append(content)
        writer.close_section(name)
    writer.finish({key: value for key, value in header.items() if key != "sections"})
    return out.getvalue()


def _with_header(data: bytes, header: dict[str, Any]) -> bytes:
    """The file with another header, its list of sections as it comes."""
    (place,) = struct.unpack_from("<Q", data, 24)
    text = json.dumps(header, separators=(",", ":"), sort_keys=True).encode()
    fields = struct.pack("<QQII", place + len(text), place, len(text), zlib.crc32(text))
    return data[:12] + struct.pack("<I", zlib.crc32(fields)) + fields + data[HEAD_BYTES:place] + text


def _change_cell(rng: Random, sections: dict[str, bytes]) -> None:
    """Change the set, the classes or the row of a cell, and all rows that follow from it."""
    rows = np.frombuffer(
        sections["cells"][: len(sections["cells"]) // CELL_ROW.itemsize * CELL_ROW.itemsize], CELL_ROW
    ).copy()
    if not len(rows):
        return
    at, kind = rng.randrange(len(rows)), rng.choice(("set", "class"))
    if rng.random() < 0.4:
        field = rng.choice(("visible", "parent", "viewpoints", "unused", f"{kind}_length", f"{kind}_offset"))
        rows[field][at] = rng.choice((0, 1, 2, int(max(rows["visible"][at], 0)) + 1, (1 << 31) - 1))
        sections["cells"] = rows.tobytes()
        return

    def change(pieces: list[bytes]) -> None:
        piece = pieces[at]
        pieces[at] = change_zstd(rng, piece) if kind == "set" else piece[:4] + change_zstd(rng, piece[4:])
        if kind == "class" and len(pieces[at]) >= 4 and rng.random() < 0.9 and rows["parent"][at] < 0:
            pieces[at] = struct.pack("<I", len(pieces[at]) - 4) + pieces[at][4:]

    change_cells(sections, kind, change, sealed=rng.random() < 0.9)


def change_cells(
    sections: dict[str, bytes], kind: str, change: Callable[[list[bytes]], None], *, sealed: bool = True
) -> None:
    """Change the pieces of all cells, their "set" or their "class", and the rows that follow from them."""
    rows = np.frombuffer(
        sections["cells"][: len(sections["cells"]) // CELL_ROW.itemsize * CELL_ROW.itemsize], CELL_ROW
    ).copy()
    section, pieces = {"set": "sets", "class": "classes"}[kind], list[bytes]()
    for row in rows:
        start, size = int(row[f"{kind}_offset"]), int(row[f"{kind}_length"])
        pieces.append(sections[section][start : start + size] if start + size < 1 << 40 else b"")
    change(pieces)
    sections[section] = b"".join(pieces)
    sizes = np.array([len(piece) for piece in pieces])
    rows[f"{kind}_length"], rows[f"{kind}_offset"] = sizes, np.cumsum(sizes) - sizes
    if sealed:
        rows[f"{kind}_crc"] = [zlib.crc32(piece) for piece in pieces]
    sections["cells"] = rows.tobytes()


def sealed_manifest(value: dict[str, Any]) -> bytes:
    """A manifest with the hash that it ought to have."""
    value = {key: inner for key, inner in value.items() if key != "sha256"}
    text = json.dumps(value, sort_keys=True, separators=(",", ":"))
    return json.dumps({**value, "sha256": hashlib.sha256(text.encode()).hexdigest()}).encode()


def change_manifest(rng: Random, data: bytes) -> bytes:
    """One change of a manifest, mostly under a right hash."""
    try:
        changed = change_json(rng, json.loads(data))
    except (ValueError, RecursionError, OverflowError):
        return change_bytes(rng, data)
    if not isinstance(changed, dict) or rng.random() < 0.1:
        return json.dumps(changed).encode()
    return sealed_manifest(changed)


VIEW_HEAD, SIGHTING_HEAD = 8 + 44, 8 + 32
"""Bytes before what is packed of a cell and of a viewpoint in a journal, with the head of the seal."""


def change_view(rng: Random, data: bytes) -> bytes:
    """One change of the packed view of a cell."""
    return _change_journal(rng, data, VIEW_HEAD, ((12, "I"), (16, "I"), (28, "d"), (44, "d")))


def change_sighting(rng: Random, data: bytes) -> bytes:
    """One change of the packed sighting of a viewpoint."""
    return _change_journal(rng, data, SIGHTING_HEAD, ((12, "I"), (16, "d"), (32, "d")))


def _change_journal(rng: Random, data: bytes, begin: int, fields: tuple[tuple[int, str], ...]) -> bytes:
    """Change an entry, mostly under a right checksum: its numbers, its ids, or its bytes."""
    if len(data) < begin or rng.random() < 0.2:
        return change_bytes(rng, data)
    head, packed = bytearray(data[:begin]), data[begin:]
    way = rng.randrange(5)
    if way < 2:
        place, code = rng.choice(((8, "I"), (8, "I"), *fields))
        numbers = (0, 1, 19, 40, 41, 255, 1 << 20, (1 << 28) + 1, (1 << 32) - 1)
        struct.pack_into(f"<{code}", head, place, rng.choice(numbers))
    elif way == 2:
        packed = change_zstd(rng, packed)
    else:  # other ids of as many Gaussians
        (count,) = struct.unpack_from("<I", head, 8)
        try:
            body = bytearray(zstandard.ZstdDecompressor().decompress(packed, max_output_size=1 << 22))
        except zstandard.ZstdError:
            return change_bytes(rng, data)
        deltas = np.frombuffer(bytes(body[: 4 * count]), np.uint8).reshape(4, -1).T.copy().view("<i4")
        if not count or len(deltas) != count:
            return change_bytes(rng, data)
        deltas[rng.randrange(count)] = rng.choice((0, -1, -40, 40, (1 << 31) - 1))
        body[: 4 * count] = deltas.view(np.uint8).T.tobytes()
        packed = zstandard.ZstdCompressor(level=1).compress(bytes(body))
    return sealed_journal(bytes(head) + packed)


def sealed_journal(data: bytes) -> bytes:
    """An entry of a journal with the checksum that it ought to have."""
    return data[:4] + struct.pack("<I", zlib.crc32(data[8:])) + data[8:]


def change_coded(rng: Random, data: bytes) -> bytes:
    """One change of a coded part: of anything, of what its head says, or of words without a change of their number."""
    way = rng.randrange(3)
    if way == 0 or len(data) < 32:
        return change_bytes(rng, data)
    if way == 1:
        return change_bytes(rng, data[:16]) + data[16:]
    at = rng.randrange(16, len(data))
    piece = rng.randbytes(min(rng.choice((1, 4, 64)), len(data) - at))
    return data[:at] + piece + data[at + len(piece) :]


KINDS.update(
    {
        "arrow": change_arrow,
        "active": change_active,
        "pvs": change_container,
        "coded": change_coded,
        "manifest": change_manifest,
        "view": change_view,
        "sighting": change_sighting,
    }
)


def reheaded(data: bytes, files: dict[str, bytes]) -> bytes:
    """The map of a folder of levels with the hashes of the files beside it."""
    opened = _opened(data)
    if opened is None:
        return data
    schema, batches = opened
    metadata = dict(schema.metadata or {})
    try:
        header = json.loads(metadata[b"gsvis"])
        for row in header["levels"]:
            row["sha256"] = hashlib.sha256(files[row["file"]]).hexdigest()
        schema = schema.with_metadata({**metadata, b"gsvis": json.dumps(header).encode()})
        return _with_checksum(_written(Random(0), schema, batches))
    except (*_FAULTS, AttributeError):
        return data


def rows_of(data: bytes) -> int:
    """Rows of an Arrow file; 0 where it is none."""
    opened = _opened(data)
    return 0 if opened is None else sum(len(batch) for batch in opened[1])
