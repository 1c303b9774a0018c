"""WELCOME: what a client must know about a scene before its first batch: counts, levels, color tables, frame, identity.

The content is JSON in the metadata of the Arrow schema of all batches. A WELCOME and the batches after it, each without
its head, form one Arrow stream.
"""

from __future__ import annotations

import hashlib
import json
import re
import struct
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

import pyarrow as pa

from gsvis.color.records import Grids
from gsvis.color.storage import grids_of
from gsvis.color.variants import VARIANTS
from gsvis.errors import FormatError, ProtocolError, SceneError
from gsvis.files.fields import Fields, parse_object
from gsvis.package.layout import RECORD_BYTES, TermLayout
from gsvis.package.manifest import Manifest, PackageInfo
from gsvis.package.rounding import MOST_STEP
from gsvis.stream.coding import Coding, Steps, table_sizes
from gsvis.stream.tables import Tables
from gsvis.stream.wire import FAULTS, PROTOCOL, WELCOME

__all__ = ["MOST", "SCHEMA", "SceneHeader", "identity_of"]

SCHEMA = pa.schema([pa.field("sections", pa.binary(), nullable=False)])
"""Arrow schema of every batch: one row for each section."""

HEAD = struct.Struct("<BBHI")  # type, version, 0, sequence
MOST = 1 << 28
"""Most Gaussians, and most terms, of a streamed scene, because a client reserves memory for each in advance."""

_MOST_BYTES = 1 << 20
_KEY = b"gsvis"
_WHERE = "WELCOME"
_IDENTITY = re.compile("[0-9a-f]{64}")


@dataclass(frozen=True)
class SceneHeader:
    """The content of WELCOME.

    Attributes:
        gaussians: N, the number of Gaussians.
        terms: T, the number of terms.
        chunks: C, the number of chunks.
        names: Names of the levels, lowest first.
        counts: Number of Gaussians of each level.
        grids: Tables that base colors and terms index.
        up: (3,) unit axis that points up.
        meters_per_unit: Size of a scene unit; 0 if unknown.
        identity: 64 hexadecimal digits that identify the ids and records. Holdings are valid only for a scene with the
            same identity.
        code: Tables of the coder of records, as `Tables.to_text` writes them.
        steps: Bits of records that are not sent; None if the records are those of the package.
        antialiased: Whether the renderer lowers opacities to compensate for the blur of a pixel.
    """

    gaussians: int
    terms: int
    chunks: int
    names: tuple[str, ...]
    counts: tuple[int, ...]
    grids: Grids
    up: tuple[float, float, float]
    meters_per_unit: float
    identity: str
    code: str
    steps: Steps | None = None
    antialiased: bool = False

    @classmethod
    def from_manifest(cls, manifest: Manifest, coding: Coding) -> SceneHeader:
        """Return the header of a package.

        Args:
            manifest: The manifest of the package.
            coding: The code of its records.

        Raises:
            SceneError: If the scene is too large for one stream.
        """
        if max(manifest.gaussians, manifest.terms) > MOST:
            got = f"{manifest.gaussians:,} and {manifest.terms:,}"
            raise SceneError(f"expected at most {MOST:,} Gaussians and terms in a stream, got {got}; cut the scene")
        return cls(
            manifest.gaussians,
            manifest.terms,
            sum(rows for _, rows in manifest.tables),
            manifest.names,
            manifest.counts,
            manifest.grids,
            manifest.info.up,
            manifest.info.meters_per_unit,
            identity_of(manifest, coding.steps),
            coding.tables.to_text(),
            coding.steps,
            manifest.info.facts.antialiased,
        )

    @cached_property
    def coding(self) -> Coding:
        """The code of the records.

        Raises:
            ProtocolError: If `code` does not hold valid tables.
        """
        return Coding(self.grids, self.steps, Tables.from_text(self.code, table_sizes(self.grids)))

    @cached_property
    def term_bytes(self) -> int:
        """Bytes of the record of a term, padded."""
        return TermLayout.from_grids(self.grids).nbytes

    @cached_property
    def term_bits(self) -> int:
        """Bits of the record of a term, as sent: without padding."""
        return int(TermLayout.from_grids(self.grids).widths.sum())

    def to_message(self) -> bytes:
        """Return the WELCOME message."""
        fields = {
            "protocol": PROTOCOL,
            "gaussians": self.gaussians,
            "terms": self.terms,
            "chunks": self.chunks,
            "levels": [{"name": name, "count": count} for name, count in zip(self.names, self.counts, strict=True)],
            "record_bytes": RECORD_BYTES,
            "term_bits": self.term_bits,
            "colors": asdict(self.grids),
            "up": list(self.up),
            "meters_per_unit": self.meters_per_unit,
            "identity": self.identity,
            "code": self.code,
            "steps": None if self.steps is None else asdict(self.steps),
        }
        if self.antialiased:
            fields["antialiased"] = True
        text = json.dumps(fields, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()
        schema = SCHEMA.with_metadata({_KEY: text})
        return HEAD.pack(WELCOME, PROTOCOL, 0, 0) + bytes(schema.serialize())

    @classmethod
    def parse(cls, data: bytes) -> SceneHeader:
        """Return the content of a WELCOME.

        Raises:
            ProtocolError: If the message is not a WELCOME, has an unsupported version, or contradicts itself.
        """
        if len(data) < HEAD.size or len(data) > _MOST_BYTES or data[0] != WELCOME:
            kind = f" of kind {data[0]}" if data else ""
            raise ProtocolError(f"message: expected WELCOME, got {len(data):,} bytes{kind}")
        if data[1] != PROTOCOL:
            raise ProtocolError(f"WELCOME: expected version {PROTOCOL}, got {data[1]}; update", FAULTS["version"])
        try:
            schema = pa.ipc.read_schema(pa.py_buffer(data[HEAD.size :]))
            if not schema.remove_metadata().equals(SCHEMA):
                raise ProtocolError(f"WELCOME: expected the schema of batches, got {str(schema)[:80]!r}")
            return cls._from_fields(parse_object(_WHERE, (schema.metadata or {}).get(_KEY, b"")))
        except FormatError as error:  # its message names WELCOME already
            raise ProtocolError(str(error)[:200]) from error
        except (pa.ArrowException, OSError, ValueError) as error:
            raise ProtocolError(f"WELCOME: {' '.join(str(error).split())[:200]}") from error

    @classmethod
    def _from_fields(cls, fields: Fields) -> SceneHeader:
        """Return the header from parsed JSON; raise ProtocolError or FormatError if a value is invalid."""
        colors = fields.child("colors")
        identity = fields.text("identity")
        name = colors.text("variant", VARIANTS)
        if not _IDENTITY.fullmatch(identity):
            raise ProtocolError(f"WELCOME: expected an identity of 64 hexadecimal digits, got {identity[:64]!r}")
        levels = [Fields(_WHERE, "levels", row) for row in fields.items("levels")]
        if not 1 <= len(levels) <= 16:
            raise ProtocolError(f"WELCOME: expected 1 to 16 levels, got {len(levels)}")
        up = fields.numbers("up", 3).tolist()
        info = PackageInfo((up[0], up[1], up[2]), fields.number("meters_per_unit"))  # checks both values
        n = fields.integer("gaussians", 0, MOST)
        found = cls(
            n,
            fields.integer("terms", 0, min(255 * n, MOST)),
            fields.integer("chunks", 0, n),
            tuple(level.text("name")[:100] for level in levels),
            tuple(level.integer("count", 0, n) for level in levels),
            grids_of(colors, name),
            (up[0], up[1], up[2]),
            info.meters_per_unit,
            identity,
            fields.text("code"),
            _parse_steps(fields),
            "antialiased" in fields and fields.raw("antialiased") is True,
        )
        sizes = RECORD_BYTES, found.term_bits
        got = tuple(fields.integer(key, 0, 64) for key in ("record_bytes", "term_bits"))
        if got != sizes:
            raise ProtocolError(
                f"WELCOME: expected records of {sizes[0]} bytes and terms of {sizes[1]} bits, got {got}"
            )
        _ = found.coding  # raises if the tables are invalid
        return found


def identity_of(manifest: Manifest, steps: Steps | None) -> str:
    """Return 64 hexadecimal digits that identify the ids and records of a package as they are sent."""
    named = [part.name for part, _ in manifest.tables]
    for block in manifest.blocks:
        named += [block.gaussians.name, *(part.name for part, _ in block.terms)]
    content: list[Any] = [named, asdict(manifest.grids), manifest.names]
    if steps is not None:
        content.append(asdict(steps))
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _parse_steps(fields: Fields) -> Steps | None:
    """Return the field "steps"; None if it is null."""
    if fields.raw("steps") is None:
        return None
    steps = fields.child("steps")
    return Steps(steps.integer("place", -MOST_STEP, MOST_STEP), steps.integer("turn", -MOST_STEP, MOST_STEP))
