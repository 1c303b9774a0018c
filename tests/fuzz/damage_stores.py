"""Cases with one deliberate fault each, under right checksums and digests: stores, levels, packages, kept files."""

from __future__ import annotations

import hashlib
import json
import os
import struct
import zlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pyarrow as pa
import zstandard

from gsvis.files.archive import load_arrays, save_arrays
from gsvis.io.levels import MAP
from gsvis.package.manifest import MANIFEST
from gsvis.pvs._writer import CELL_ROW
from gsvis.pvs.stored_certificates import CERTIFIED_ROW
from tests.fuzz import packages, stores
from tests.fuzz.cameras import files_in
from tests.fuzz.containers import (
    SIGHTING_HEAD,
    VIEW_HEAD,
    _opened,
    _sections,
    _with_checksum,
    _with_header,
    _written,
    reheaded,
    sealed_journal,
    sealed_manifest,
    sealed_sections,
)
from tests.fuzz.damage import LINK, PIPE, Damaged
from tests.fuzz.targets import Case
from tests.package.worlds import levels_of, sets_of

__all__ = ["DAMAGE"]

Columns = dict[str, Any]


def rewritten(
    data: bytes, change: Callable[[Columns], None] = lambda _: None, said: Callable[[Any], None] = lambda _: None
) -> bytes:
    """An Arrow file of gsvis with other columns, or another header, under a right checksum."""
    opened = _opened(data)
    assert opened is not None
    schema, (batch,) = opened
    columns = {name: batch.column(name) for name in schema.names}
    change(columns)
    header = json.loads(schema.metadata[b"gsvis"])
    said(header)
    schema = schema.with_metadata({**schema.metadata, b"gsvis": json.dumps(header).encode()})
    arrays = [pa.array(columns[field.name], field.type) for field in schema]
    return _with_checksum(_written(Random(0), schema, [pa.RecordBatch.from_arrays(arrays, schema=schema)], "zstd"))


def level_folders() -> Damaged:
    (case,) = stores.level_folders()[:1]

    def mapped(**changes: Any) -> Case:
        return {**case, MAP: rewritten(case[MAP], **changes)}

    def crossed(columns: Columns) -> None:
        columns["first_level"], columns["last_level"] = columns["last_level"], columns["first_level"]

    def none(header: Any) -> None:
        header["levels"] = []

    def many(header: Any) -> None:
        header["levels"] = [{**header["levels"][0], "name": f"n{k}"} for k in range(17)]

    other = {**case, "high.ply": case["low.ply"]}
    return {
        "levels out of order": mapped(change=crossed),
        "no level": mapped(said=none),
        "too many levels": mapped(said=many),
        "a level of another": {**other, MAP: reheaded(case[MAP], other)},
    }


def set_stores() -> Damaged:
    data = stores.both_stores()[0]

    def changed(change: Callable[[Any, dict[str, bytes]], None]) -> Case:
        header, sections = _sections(data)
        change(header, sections)
        return {"a.pvs": sealed_sections(header, sections)}

    def case(**changes: Any) -> Case:
        return changed(lambda header, _: header.update(changes))

    def other_union(_: Any, sections: dict[str, bytes]) -> None:
        inner = zstandard.ZstdDecompressor().decompress(sections["ever"])
        sections["ever"] = zstandard.ZstdCompressor().compress(bytes([inner[0] ^ 1]) + inner[1:])

    def rows(change: Callable[[Any], None]) -> Case:
        def of(_: Any, sections: dict[str, bytes]) -> None:
            found = np.frombuffer(sections["cells"], CELL_ROW).copy()
            change(found)
            sections["cells"] = found.tobytes()

        return changed(of)

    def many(found: Any) -> None:
        found["visible"][0] = (1 << 31) - 1

    def circle(found: Any) -> None:
        found["parent"][:2] = 1, 0

    def short(_: Any, sections: dict[str, bytes]) -> None:
        found = np.frombuffer(sections["cells"], CELL_ROW).copy()
        first = int(found["class_length"][0])
        found["class_length"][0], found["class_crc"][0] = 0, 0
        found["class_offset"][1:] -= first
        sections["cells"], sections["classes"] = found.tobytes(), sections["classes"][first:]

    def labels(_: Any, sections: dict[str, bytes]) -> None:
        sections["labels"] = b"\7" + sections["labels"][1:]

    def shares(_: Any, sections: dict[str, bytes]) -> None:
        found = np.frombuffer(sections["certificates"], CERTIFIED_ROW).copy()
        found["bound"][0] = 1.5
        sections["certificates"] = found.tobytes()

    def fewer(_: Any, sections: dict[str, bytes]) -> None:
        sections["certificates"] = sections["certificates"][: -CERTIFIED_ROW.itemsize]

    def lost(_: Any, sections: dict[str, bytes]) -> None:
        sections["celis"] = sections.pop("cells")

    def headed(change: Callable[[Any], object]) -> Case:
        header, _ = _sections(data)
        change(header)
        return {"a.pvs": _with_header(data, header)}

    place, length, crc = struct.unpack_from("<QII", data, 24)
    fields = struct.pack("<QQII", len(data), place - 1, length, crc)
    return {
        "a newer version": {"a.pvs": data[:8] + struct.pack("<I", 2) + data[12:]},
        "a header elsewhere": {"a.pvs": data[:12] + struct.pack("<I", zlib.crc32(fields)) + fields + data[40:]},
        "sections that end early": headed(lambda header: header["sections"].pop()),
        "no rows of cells": changed(lost),
        "a share above one": changed(shares),
        "certificates of fewer cells": changed(fewer),
        "another format": case(format="gsvis-else"),
        "a scene that is none": case(scene=7),
        "another union": changed(other_union),
        "a cell that sees too many": rows(many),
        "cells that lead to each other": rows(circle),
        "a cell without classes": changed(short),
        "other labels": changed(labels),
    }


def term_stores() -> Damaged:
    opened = _opened(stores.both_stores()[1])
    assert opened is not None
    schema, batches = opened
    return {"no header": {"a.arrow": _written(Random(0), schema.remove_metadata(), batches)}}


def journals() -> Damaged:
    (case,) = stores.journals()
    found: Damaged = {
        "no plan": {key: data for key, data in case.items() if key != "plan.json"},
        "nothing kept": {"plan.json": case["plan.json"]},
    }
    for kind, name, begin in (
        ("cell", "cell-000000.bin", VIEW_HEAD),
        ("viewpoint", "viewpoint-000000.bin", SIGHTING_HEAD),
    ):
        whole = case[name]
        entries = {
            "an id twice": _with_ids(whole, begin, 1, lambda _: 0),
            "an id of no Gaussian": _with_ids(whole, begin, -1, lambda delta: delta + stores.SEEN),
            "more than the scene": sealed_journal(whole[:8] + struct.pack("<I", stores.SEEN + 1) + whole[12:]),
            "a file of megabytes": whole + bytes(1 << 20),
            "an end after its head": sealed_journal(whole[:begin]),
            "an end in its head": sealed_journal(whole[: begin - 1]),
        }
        if kind == "cell":
            entries["rays without end"] = sealed_journal(whole[:12] + b"\xff" * 4 + whole[16:])
        found |= {f"{what}, {kind}": {**case, name: data} for what, data in entries.items()}
        found[f"a folder in place of a {kind}"] = {f"{k}/x" if k == name else k: data for k, data in case.items()}
    return found


def _with_ids(whole: bytes, begin: int, row: int, change: Callable[[int], int]) -> bytes:
    """An entry of a journal in which one difference of ids is another."""
    count = struct.unpack_from("<I", whole, 8)[0]
    inner = zstandard.ZstdDecompressor().decompress(whole[begin:])
    deltas = np.frombuffer(inner[: 4 * count], np.uint8).reshape(4, -1).T.copy().view("<i4")[:, 0]
    deltas[row] = change(int(deltas[row]))
    packed = deltas[:, None].view(np.uint8).T.tobytes() + inner[4 * count :]
    return sealed_journal(whole[:begin] + zstandard.ZstdCompressor().compress(packed))


def checkpoints() -> Damaged:
    def changed(change: Callable[[Any, Columns], None]) -> Case:
        with TemporaryDirectory() as folder:
            path = Path(folder) / "a.npz"
            path.write_bytes(stores.checkpoints()[0]["densified.npz"])
            arrays = load_arrays(path)
            header = json.loads(arrays["header"].tobytes())
            change(header, arrays)
            save_arrays(path, {**arrays, "header": np.frombuffer(json.dumps(header).encode(), np.uint8)})
            return {"densified.npz": path.read_bytes()}

    def shape(_: Any, arrays: Columns) -> None:
        arrays["second/quats"] = arrays["second/quats"][:-1]

    return {
        "another format": changed(lambda header, _: header.update(format="gsvis-else")),
        "a newer version": changed(lambda header, _: header.update(version=2)),
        "moments of others": changed(shape),
    }


def with_part(case: Case, name: str, data: bytes) -> Case:
    """A package with another content of a part, under a right name and a right manifest."""
    manifest, (old, _, suffix) = json.loads(case[MANIFEST]), name.rpartition("/")[2].partition(".")
    new = hashlib.sha256(data).hexdigest()
    found = {key: value for key, value in case.items() if key != name} | {f"parts/{new}.{suffix}": data}
    for _, row in packages._rows(manifest):
        if row["sha256"] == old:
            row["sha256"], row["bytes"] = new, len(data)
    for key in ("visibility", "active_terms"):
        if manifest.get(key):
            manifest[key]["bytes"] = sum(row["bytes"] for row in manifest[key]["parts"])
    return {**found, MANIFEST: sealed_manifest(manifest)}


@cache
def other_sets() -> bytes:
    """Visible sets of another scene."""
    with TemporaryDirectory() as folder:
        return sets_of(Path(folder), levels_of(packages.N, 1)).read_bytes()


def manifests() -> Damaged:
    manifest = json.loads(packages.packages()[0][MANIFEST])

    def case(change: Callable[[Any], object]) -> Case:
        value = json.loads(json.dumps(manifest))
        change(value)
        return {MANIFEST: sealed_manifest(value)}

    return {
        "a newer version": case(lambda m: m.update(version=9)),
        "meters below 0": case(lambda m: m.update(meters_per_unit=-1.0)),
        "levels of one name": case(lambda m: m["levels"][0].update(name=m["levels"][1]["name"])),
        "a store of another size": case(lambda m: m["visibility"].update(bytes=m["visibility"]["bytes"] + 1)),
        "bits of another layout": case(lambda m: m["quantization"].update(record={})),
        "one Gaussian more": case(lambda m: m.update(gaussians=m["gaussians"] + 1)),
    }


def whole_packages() -> Damaged:
    case = packages.packages()[0]
    manifest = json.loads(case[MANIFEST])

    def part_of(row: Any, suffix: str = "arrow") -> str:
        return f"parts/{row['sha256']}.{suffix}"

    def blob(key: str, data: bytes) -> Case:
        (row,) = manifest[key]["parts"]
        return with_part(case, part_of(row, "bin"), data)

    def columns(name: str, change: Callable[[Columns], None]) -> Case:
        return with_part(case, name, rewritten(case[name], change))

    def more(key: str) -> Callable[[Columns], None]:
        def change(found: Columns) -> None:
            values = found[key].to_numpy().copy()
            values[0] += 1
            found[key] = values

        return change

    def crossed(found: Columns) -> None:
        found["first_level"], found["last_level"] = found["last_level"], found["first_level"]

    (first, *_) = (row for row in manifest["blocks"] if row["term_parts"])
    table, block, terms = part_of(manifest["chunks"][0]), part_of(first, "bin"), part_of(first["term_parts"][0], "bin")
    changed = json.loads(case[MANIFEST])
    changed["terms"] += 1
    changed["blocks"][manifest["blocks"].index(first)]["terms"] += 1
    one_more = {**case, MANIFEST: sealed_manifest(changed)}
    rest = {name: data for name, data in case.items() if name != block}
    found = {
        "a part that is a folder": {**rest, f"{block}/x": b""},
        "a chunk of one more": columns(table, more("count")),
        "levels out of order": columns(table, crossed),
        "one more term": one_more,
        "a part of another kind": with_part(case, block, case[terms]),
        "a part with the bytes of another": with_part(case, block, case[block][:16] + bytes(len(case[block]) - 16)),
        "sets of another scene": blob("visibility", other_sets()),
        "no manifest": {name: data for name, data in case.items() if name != MANIFEST},
        "a longer part": {**case, block: case[block] + b"\0"},
    }
    if os.name == "posix":
        found["a part that is a pipe"] = {**rest, block + PIPE: b""}
        found["a part that is a link"] = {**rest, "beside.bin": case[block], block + LINK: b"../beside.bin"}
    return found


def requests() -> Damaged:
    if os.name != "posix":
        return {}
    part = b"the bytes of a part"
    name = hashlib.sha256(part).hexdigest() + ".bin"
    link = {"request.name": f"bytes=0-5\n{name}".encode(), f"parts/{name}{LINK}": b"../beside", "beside": part}
    return {"a part that is a link": link}


def kept() -> Damaged:
    with TemporaryDirectory() as folder:
        save_arrays(Path(folder) / "a.npz", {"sets": np.zeros((3, 10), np.uint8), "other": np.zeros(5)})
        return {"arrays of others": {"kept.npz": files_in(Path(folder))["a.npz"]}}


DAMAGE = {
    "levels": level_folders,
    "visibility": set_stores,
    "active-terms": term_stores,
    "journal": journals,
    "kept": kept,
    "checkpoint": checkpoints,
    "manifest": manifests,
    "package": whole_packages,
    "requests": requests,
}
"""What makes the damaged cases of a target, by its name."""
