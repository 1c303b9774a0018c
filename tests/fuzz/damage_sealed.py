"""Cases with one deliberate fault each behind a seal: digests and lengths are right, what they hold is not."""

from __future__ import annotations

import hashlib
import json
import struct
from collections.abc import Callable
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pyarrow as pa

from gsvis.export.static import FORMAT
from gsvis.files import arrow as _arrow
from gsvis.files.archive import load_arrays, save_arrays
from gsvis.io.levels import MAP
from gsvis.package.manifest import MANIFEST
from gsvis.pvs._writer import CELL_ROW
from gsvis.serve.sites import SCENE
from gsvis.train.importance import ROUNDS
from tests.fuzz import packages, stores, training, unfinished, wire
from tests.fuzz.containers import (
    _opened,
    _sections,
    _with_checksum,
    _written,
    change_cells,
    sealed_manifest,
    sealed_sections,
)
from tests.fuzz.damage import LINK, Damaged
from tests.fuzz.damage_stores import Columns, rewritten, with_part
from tests.fuzz.places import DROP, cases_of, edited
from tests.fuzz.targets import Case

__all__ = ["DAMAGE"]


def footer_of(data: bytes) -> tuple[int, int]:
    """Where the footer of an Arrow file begins, and the first of the places of its batches."""
    start = _arrow._footer_start(Path(), memoryview(data))
    footer = data[start:-10]
    place = _arrow._field(footer, _arrow._follow_offset(footer, 0), 3)
    return start, start + _arrow._follow_offset(footer, place) + 4


def arrows() -> Damaged:
    """Files of colors whose footer lists other places, and columns without values."""
    data = stores.color_files()[0]["a.arrow"]
    start, block = footer_of(data)

    def placed(offset: int, length: int, body: int) -> bytes:
        return data[:block] + struct.pack("<qi4xq", offset, length, body) + data[block + 24 :]

    (schema_bytes,) = struct.unpack_from("<I", data, 12)
    footer = start + struct.unpack_from("<I", data, start)[0]
    table = footer - struct.unpack_from("<i", data, footer)[0]
    no_list = data[: table + 10] + b"\0\0" + data[table + 12 :]
    found = {
        "a batch beyond the end": placed(1 << 40, 64, 0),
        "a batch that is the schema": placed(8, 8 + schema_bytes, 0),
        "a footer without a list of batches": no_list,
    }
    sealed = {what: {"a.arrow": _with_checksum(changed)} for what, changed in found.items()}

    def emptied(name: str) -> Case:
        opened = _opened(data)
        assert opened is not None
        schema, (batch,) = opened
        arrays = [_without_value(batch.column(field.name)) if field.name == name else batch.column(field.name)
                  for field in schema]  # fmt: skip
        changed = pa.RecordBatch.from_arrays(arrays, schema=schema)
        return {"a.arrow": _with_checksum(_written(Random(0), schema, [changed], None))}

    opened = _opened(data)
    assert opened is not None
    columns = {f"no value in a row of {name}": emptied(name) for name in opened[0].names}
    headers: dict[str, dict[str, Any]] = {
        "a scene that is a number": {"scene": 7},
        "a variant that is unknown": {"variant": "xyz"},
        "one Gaussian more": {"gaussians": 11},
    }
    return sealed | columns | {what: headed(data, places) for what, places in headers.items()}


def headed(data: bytes, places: dict[str, Any], name: str = "a.arrow") -> Case:
    """An Arrow file of gsvis with other values in its header."""

    def said(header: Any) -> None:
        changed = edited(header, places)
        header.clear()
        header.update(changed)

    return {name: rewritten(data, said=said)}


def _without_value(array: pa.Array) -> pa.Array:
    """The array, or the innermost values of it, without the first value."""
    if pa.types.is_struct(array.type):
        fields = [array.field(k) for k in range(array.type.num_fields)]
        return pa.StructArray.from_arrays([_without_value(fields[0]), *fields[1:]], fields=list(array.type))
    if pa.types.is_fixed_size_list(array.type):
        return pa.FixedSizeListArray.from_arrays(_without_value(array.flatten()), type=array.type)
    if pa.types.is_list(array.type) and len(array.values):
        return pa.ListArray.from_arrays(array.offsets, _without_value(array.values), type=array.type)
    return pa.array([None, *array.to_pylist()[1:]], array.type)


def level_folders() -> Damaged:
    case = stores.level_folders()[0]
    faults: dict[str, dict[str, Any]] = {
        "a name twice": {"levels.1.name": json.loads(_header(case[MAP]))["levels"][0]["name"]},
        "a name that is a number": {"levels.0.name": 7},
        "a digest of 63 digits": {"levels.0.sha256": "0" * 63},
        "a file that leads out": {"levels.0.file": "../a.ply"},
        "one Gaussian more in a level": {"levels.0.count": json.loads(_header(case[MAP]))["levels"][0]["count"] + 1},
    }
    return {what: {**case, **headed(case[MAP], places, MAP)} for what, places in faults.items()}


def _header(data: bytes) -> bytes:
    opened = _opened(data)
    assert opened is not None
    return bytes(opened[0].metadata[b"gsvis"])


def term_stores() -> Damaged:
    data = stores.both_stores()[1]
    opened = _opened(data)
    assert opened is not None
    schema, batches = opened
    other = edited(json.loads(schema.metadata[b"gsvis"]), {"version": 1})
    changed = {**schema.metadata, b"gsvis": json.dumps({**other, "x": 1}).encode()}
    return {
        "another header under the old checksum": {
            "a.arrow": _written(Random(0), schema.with_metadata(changed), batches)
        },
        "each cell twice": {"a.arrow": _written(Random(0), schema, batches * 2)},
        "no cell": {"a.arrow": _written(Random(0), schema, [])},
    }


def set_stores() -> Damaged:
    data = stores.both_stores()[0]

    def with_piece(kind: str, change: Callable[[bytes], bytes]) -> Case:
        header, sections = _sections(data)
        change_cells(sections, kind, lambda pieces: pieces.__setitem__(0, change(pieces[0])))
        return {"a.pvs": sealed_sections(header, sections)}

    def with_rows(change: Callable[[Any], None]) -> Case:
        header, sections = _sections(data)
        rows = np.frombuffer(sections["cells"], CELL_ROW).copy()
        change(rows)
        return {"a.pvs": sealed_sections(header, {**sections, "cells": rows.tobytes()})}

    def parent(value: int) -> Case:
        return with_rows(lambda rows: rows["parent"].__setitem__(0, value))

    def longer(piece: bytes) -> bytes:
        return struct.pack("<I", struct.unpack_from("<I", piece)[0] + 1) + piece[4:]

    return {
        "a parent that is no cell": parent(99),
        "a parent below none": parent(-2),
        "a set that is cut": with_piece("set", lambda piece: piece[:-1]),
        "a set of nothing": with_piece("set", lambda _: b""),
        "classes of another length": with_piece("class", longer),
        "classes that are cut": with_piece("class", lambda piece: piece[:2]),
        "cells that leave a gap": with_rows(lambda rows: rows["set_offset"].__setitem__(1, 0)),
    }


def archives(case: Case, name: str, changes: dict[str, Callable[[dict[str, Any]], None]]) -> Damaged:
    """An archive of arrays with other arrays in it, under a right checksum, beside the rest of a case."""
    found = {}
    for what, change in changes.items():
        with TemporaryDirectory() as folder:
            path = Path(folder) / "a.npz"
            path.write_bytes(case[name])
            arrays = dict(load_arrays(path))
            change(arrays)
            save_arrays(path, arrays)
            found[what] = {**case, name: path.read_bytes()}
    return found


def put(**values: Any) -> Callable[[dict[str, Any]], None]:
    return lambda arrays: arrays.update({name: np.asarray(value) for name, value in values.items()})


def rounds() -> Damaged:
    case = unfinished.rounds()[1]
    count = unfinished.COUNT
    return archives(
        case,
        ROUNDS,
        {
            "rounds that are fractions": put(rounds=[2.0]),
            "no round": put(rounds=np.zeros(1, np.int64)),
            "more rounds than there are": put(rounds=[9]),
            "Gaussians of another scene": put(left=np.full(count + 1, -1)),
            "a round that is to come": put(left=np.full(count, 2)),
            "values of others": put(values=np.zeros(3)),
            "a value that is no number": put(values=np.full(unfinished.SCHEDULE[1], np.nan)),
            "no values": lambda arrays: arrays.pop("values"),
        },
    )


def arrays() -> Damaged:
    data = unfinished.arrays()[0]["a.tables"]
    faults: dict[str, dict[str, Any]] = {
        "a type that is parsed": {"arrays.0.1": "f8,("},
        "a type of earlier versions": {"arrays.0.1": "a8"},
        "objects": {"arrays.0.1": "|O8"},
        "a type that is a number": {"arrays.0.1": 7},
        "half a row": {"arrays.0.2": [6.5, 3]},
        "more than there is": {"arrays.0.2": [1 << 40, 3]},
        "rows below none": {"arrays.0.2": [-1, 3]},
        "seventy axes": {"arrays.0.2": [1] * 70},
        "a place between pages": {"arrays.0.3": 8},
        "a place beyond the end": {"arrays.0.3": 1 << 40},
        "a name that is a number": {"arrays.0.0": 7},
        "a row of four": {"arrays.0": ["a", "<f8", [7, 3], 0]},
        "one byte more": {"bytes": 1},
        "no facts": {"facts": DROP},
    }

    def seal(document: Any) -> Case:
        return {"a.tables": unfinished.resealed(data, lambda _: document)}

    return cases_of(unfinished.head_of(data), faults, seal)


def subsets() -> Damaged:
    case = training.subsets()[0]

    def inverted(arrays: dict[str, Any]) -> None:
        arrays["masks"] = ~arrays["masks"]

    return archives(
        case,
        training.SUBSETS,
        {
            "masks of other sizes": inverted,
            "masks of fractions": put(masks=np.zeros((2, 8))),
            "no masks": lambda arrays: arrays.pop("masks"),
        },
    )


def tile_rows() -> Damaged:
    scene, levels = unfinished.row_files()[:2]

    def crossed(arrays: dict[str, Any]) -> None:
        arrays["first"], arrays["last"] = arrays["last"] + 1, arrays["first"]

    found = archives(
        scene,
        "rows.npz",
        {
            "fewer turns": put(quats=np.zeros((3, 4), np.float32)),
            "a place that is no number": put(means=np.full((12, 3), np.nan, np.float32)),
            "no scales": lambda arrays: arrays.pop("scales"),
        },
    )
    return found | archives(
        levels,
        "levels.npz",
        {
            "levels out of order": crossed,
            "names that are no text": put(names=np.full(3, 255, np.uint8)),
            "no names": lambda arrays: arrays.pop("names"),
        },
    )


def checkpoints() -> Damaged:
    case = stores.checkpoints()[0]

    def other(arrays: dict[str, Any]) -> None:
        header = {**json.loads(arrays["header"].tobytes()), "run": "0" * 64}
        arrays["header"] = np.frombuffer(json.dumps(header).encode(), np.uint8)

    return archives(case, "densified.npz", {"a checkpoint of another run": other})


def whole_packages() -> Damaged:
    case, old = packages.packages()[0], packages.packages()[-1]
    manifest, before = json.loads(case[MANIFEST]), json.loads(old[MANIFEST])

    def arrow(of: Case, row: Any, change: Callable[[Columns], None], kind: str | None = None) -> Case:
        name = f"parts/{row['sha256']}.arrow"
        other = {} if kind is None else {"kind": kind}
        return with_part(of, name, rewritten(of[name], change, lambda header: header.update(other)))

    def shorter(columns: Columns) -> None:
        for name, column in columns.items():
            columns[name] = column.slice(0, len(column) - 1)

    def two_kinds(columns: Columns) -> None:
        steps = -np.abs(columns["step_x"].to_numpy()) - 1e-3
        columns["step_x"] = steps.astype(np.float32)

    def wide(columns: Columns) -> None:
        columns["bits_x"] = np.full(len(columns["bits_x"]), 200, np.uint8)

    def turned(columns: Columns) -> None:
        columns["step_x"] = -columns["step_x"].to_numpy() - np.float32(1.0)

    def kept(columns: Columns) -> None:
        pass

    table = manifest["chunks"][0]
    block = next(iter(manifest["blocks"]))
    part = f"parts/{block['sha256']}.bin"
    colors = {**manifest["quantization"]["colors"]["precision"], "base": 2}
    found = cases_of(
        manifest,
        {
            "one Gaussian more in a level": {"levels.0.count": manifest["levels"][0]["count"] + 1},
            "a Gaussian in another block": _moved(manifest),
        },
        lambda document: {**case, MANIFEST: sealed_manifest(document)},
    )
    return found | {
        "other bytes under the name of a part": {**case, part: case[part][:-1] + bytes([case[part][-1] ^ 1])},
        "a part shorter than its head": with_part(case, part, case[part][:10]),
        "chunks of another kind": arrow(case, table, kept, "gaussians"),
        "chunks of fewer rows": arrow(case, table, shorter),
        "chunks of two kinds of steps": arrow(case, table, two_kinds),
        "places of 200 bits": arrow(case, table, wide),
        "steps below 0 in an old package": arrow(old, before["chunks"][0], turned),
        "an old block of another kind": arrow(old, before["blocks"][0], kept, "terms"),
        "an old block of fewer rows": arrow(old, before["blocks"][0], shorter),
        "fewer colors than records name": {
            **case,
            MANIFEST: sealed_manifest(edited(manifest, {"quantization.colors.precision": colors})),
        },
    }


def _moved(manifest: Any) -> dict[str, Any]:
    """Places of a manifest whose second block begins a Gaussian later; of one block alone, a second of one."""
    counts = [block["count"] for block in manifest["blocks"]]
    if len(counts) < 2:
        return {"blocks.0.count": counts[0] - 1, "blocks.1": {**manifest["blocks"][0], "count": 1}}
    return {"blocks.0.count": counts[0] + 1, "blocks.1.count": counts[1] - 1}


def requests() -> Damaged:
    table = b"what lies beyond a tile"
    name = hashlib.sha256(table).hexdigest() + ".pvs"
    return {
        "a table of another content": {"request.name": f"\n{name}".encode(), f"beyond/{name}": b"another"},
        "a part of another content": {
            "request.name": f"\n{'0' * 64}.arrow".encode(), f"parts/{'0' * 64}.arrow": b"another",
        },
    }  # fmt: skip


def sites() -> Damaged:
    case = unfinished.sites()[0]
    about = json.loads(case[SCENE])
    names = sorted(name for name in case if name not in (SCENE, "request.name"))
    rest = {name: data for name, data in case.items() if name != names[0]}
    asked = f"\n{names[0]}".encode()
    faults = {"another format": {"format": f"{FORMAT}-else"}, "no format": {"format": DROP}}
    found = cases_of(about, faults, lambda document: {**case, SCENE: json.dumps(document).encode()})
    return found | {
        "a file that is a link": {**rest, names[0] + LINK: b"scene.json", "request.name": asked},
        "a list": {SCENE: b"[]"},
    }


def beyond() -> Damaged:
    data = stores.both_stores()[0]
    said = unfinished.TABLE
    faults = {
        "ids of other pieces": {"runs": [[0, 3]]},
        "the digest of another file": {"digest": "0" * 64},
    }
    found = cases_of(said, faults, lambda document: {"a.pvs": data, "table.json": json.dumps(document).encode()})
    return found | {"no store": {"table.json": json.dumps(said).encode()}}


def said() -> Damaged:
    hello, _, pose, ack, bye, token = (case["message.hello"] for case in wire.said())
    found = {
        "nothing": b"",
        "a message that is unknown": b"\x63\0\0\0",
        "HELLO of another version": hello[:1] + b"\x63" + hello[2:],
        "HELLO that is cut": hello[:20],
        "HELLO of one byte": hello[:1],
        "HELLO that is too long": hello + bytes(1 << 20),
        "HELLO with more behind": hello + b"\0",
        "a view of ten million": struct.pack("<f", 1e7).join((hello[:8], hello[12:])),
        "a view that is no number": struct.pack("<f", np.nan).join((hello[:8], hello[12:])),
        "a view of nothing": hello[:8] + bytes(24) + hello[32:],
        "POSE that is cut": pose[:-1],
        "POSE with other bytes": pose[:1] + b"\1" + pose[2:],
        "a place without end": struct.pack("<f", np.inf).join((pose[:8], pose[12:])),
        "a turn of zeros": pose[:20] + bytes(16),
        "a turn that is enormous": pose[:20] + struct.pack("<4f", 1e30, 0, 0, 0),
        "ACK that is cut": ack[:-1],
        "BYE with more behind": bye + b"\0",
        "TOKEN of nothing": token[:4],
        "TOKEN that is too long": token[:4] + b"a" * 2000,
        "TOKEN of another length": token + b"a",
        "TOKEN of other characters": token[:-1] + b"\n",
    }
    return {what: {"message.hello": data} for what, data in found.items()}


def notes() -> Damaged:
    """An object of another content under a note that is right."""
    case = unfinished.notes()[0]
    name = next(name for name in case if "/objects/" in name)
    return {"an object of another content": {**case, name: bytes([case[name][0] ^ 1]) + case[name][1:]}}


DAMAGE = {
    "color": arrows,
    "levels": level_folders,
    "active-terms": term_stores,
    "visibility": set_stores,
    "arrays": arrays,
    "rounds": rounds,
    "subsets": subsets,
    "world-rows": tile_rows,
    "checkpoint": checkpoints,
    "package": whole_packages,
    "requests": requests,
    "static-scene": sites,
    "beyond": beyond,
    "client-message": said,
    "notes": notes,
}
"""What makes the damaged cases of a target, by its name."""
