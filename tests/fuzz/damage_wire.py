"""Cases with one deliberate fault each: what a hostile server says to a client, and a hostile client to a server."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pyarrow as pa

from gsvis.stream import Ack, PoseAt
from gsvis.stream.batch import _IDS, Sections
from gsvis.stream.header import HEAD, SCHEMA
from gsvis.stream.wire import ServerFault
from tests.fuzz import wire
from tests.fuzz.damage import Damaged
from tests.fuzz.targets import Case

__all__ = ["DAMAGE"]

NO_IDS = np.zeros(0, np.int64)


def case(*messages: bytes) -> Case:
    return {f"{k:02d}.down": data for k, data in enumerate(messages)}


def welcome(change: Callable[[Any], object], schema: pa.Schema = SCHEMA) -> bytes:
    """WELCOME of the first scene with another header."""
    data = wire.batches("rgb")[0]
    header = json.loads(pa.ipc.read_schema(pa.py_buffer(data[HEAD.size :])).metadata[b"gsvis"])
    change(header)
    text = json.dumps(header).encode()
    return data[: HEAD.size] + bytes(schema.with_metadata({b"gsvis": text}).serialize())


def welcomes() -> Damaged:
    good = wire.batches("rgb")[0]
    other = pa.schema([pa.field("sections", pa.int8())])
    found = {
        "a newer WELCOME": good[:1] + bytes([good[1] + 1]) + good[2:],
        "columns of something else": welcome(lambda _: None, other),
        "a short identity": welcome(lambda header: header.update(identity="0" * 63)),
        "no level": welcome(lambda header: header.update(levels=[])),
        "too many levels": welcome(lambda header: header.update(levels=header["levels"] * 6)),
        "records of another size": welcome(lambda header: header.update(record_bytes=17)),
        "tables that are cut": welcome(lambda header: header.update(code=header["code"][:-8])),
        "steps beyond all": welcome(lambda header: header.update(steps={"place": 1 << 20, "turn": 0})),
        "a scene of billions": welcome(lambda header: header.update(gaussians=1 << 28)),
        "a scene for more memory than there is": welcome(lambda header: header.update(gaussians=(1 << 31) - 1)),
    }
    for bits in (0, 1, 7, 0x49, 0x92, 0xAA, 0xFF):  # each table begins with an order, its first symbol, its length
        text = base64.b64encode(bytes([bits]) * 300).decode()
        found[f"tables of bytes {bits:#x}"] = welcome(lambda header, text=text: header.update(code=text))
    return {name: case(data) for name, data in found.items()}


def batches() -> Damaged:
    """Batches that fit the scene one by one, but not what came before."""
    about = wire.scenes()["rgb"].about
    first, *rest = wire.batches("rgb")
    parsed = [Sections.parse(data, about) for data in rest]
    nothing = replace(
        parsed[0], chunks=NO_IDS, rows=parsed[0].rows[:0], gaussians=NO_IDS, records=parsed[0].records[:0],
        terms=NO_IDS, owners=NO_IDS, term_records=parsed[0].term_records[:0], gone=NO_IDS,
    )  # fmt: skip
    at = next(k for k, s in enumerate(parsed) if len(s.terms))
    s, before = parsed[at], rest[:at]
    crossed = s.rows.copy()
    crossed["first_level"], crossed["last_level"] = 2, 0
    ids, gone = parsed[0].gaussians[:2], replace(nothing, sequence=3)
    once, again = replace(nothing, sequence=2, gone=ids), replace(gone, gone=ids)
    rows = wire.rows_of(rest[0])
    orders = _IDS.pack(*_IDS.unpack_from(rows[0])[:4], 255, 0, 0, 0, 0, 0)
    wide = parsed[0].rows.copy()
    wide["count"] = 200
    again_first = replace(parsed[0], sequence=2).to_message(about)
    many = _IDS.pack(0, 0, about.gaussians + 1, 0, 0, 0, 0, 0, 0, 0) + bytes(about.gaussians)
    return {
        "levels out of order": case(first, *before, replace(s, rows=crossed).to_message(about)),
        "no chunk": case(first, replace(parsed[0], chunks=NO_IDS, rows=s.rows[:0]).to_message(about)),
        "terms of nobody": case(
            first, replace(s, sequence=1, gaussians=NO_IDS, records=s.records[:0]).to_message(about)
        ),
        "gone again": case(first, rest[0], once.to_message(about), again.to_message(about)),
        "a message of another kind": case(first, b"\x7f" * 400),
        "records that end too soon": case(first, wire.framed(rest[0], [*rows[:2], rows[2][:-2], rows[3]])),
        "terms with more behind": case(first, wire.framed(rest[0], [*rows[:3], rows[3] + b"\0\0"])),
        "an order that is none": case(first, wire.framed(rest[0], [orders + rows[0][_IDS.size :], *rows[1:]])),
        "evicted and not held": case(first, replace(nothing, sequence=1, evicted=ids).to_message(about)),
        "a Gaussian twice": case(first, rest[0], replace(parsed[0], sequence=2).to_message(about)),
        "more chunks than there are": case(welcome(lambda header: header.update(chunks=1)), *rest),
        "a Gaussian that was replaced": case(first, replace(nothing, gone=ids).to_message(about), again_first),
        "chunks that overlap": case(first, replace(parsed[0], rows=wide).to_message(about)),
        "half a row of chunks": case(first, wire.framed(rest[0], [rows[0], rows[1] + b"\0", *rows[2:]])),
        "ids that end too soon": case(first, wire.framed(rest[0], [rows[0][:-3], *rows[1:]])),
        "ids with more behind": case(first, wire.framed(rest[0], [rows[0] + b"\0", *rows[1:]])),
        "more gone than there are": case(first, wire.framed(rest[0], [many, b"", b"", b""])),
    }


def faults() -> Damaged:
    """What a server says last, cut short or longer than it says."""
    first, fault = wire.batches("rgb")[0], ServerFault(3, "too large").to_bytes()
    return {"a fault cut short": case(first, fault[:1]), "a longer fault": case(first, fault + b"x")}


def downstream() -> Damaged:
    return welcomes() | batches() | faults()


def clients() -> Damaged:
    """Clients that never acknowledge, fall silent, say too much, or find no seat."""
    hello, eye = wire.hellos()[0], wire.eyes()[0]
    pose, ack = PoseAt(100, eye, (1.0, 0.0, 0.0, 0.0)).to_bytes(), Ack(0).to_bytes()
    scripts = {
        "no acknowledgement": [hello, pose, *([pose] * 30)],
        "silence": [hello, pose, ack, wire.SILENCE, pose],
        "no seat": [hello],
        "a flood": [hello, *([ack] * 60)],
        "poses that pile up": [hello, *([pose] * 600), b"\x63"],
        "acknowledgements that pile up": [hello, pose, *([ack] * 600)],
    }
    return {name: {f"{k:03d}.hello": data for k, data in enumerate(script)} for name, script in scripts.items()}


DAMAGE = {"client-session": downstream, "server-session": clients}
"""What makes the damaged cases of a target, by its name."""
