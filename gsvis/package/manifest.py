"""The manifest of a package: scene, frame, measured quality, and the name of every part.

The manifest is JSON and contains its own hash. It is written last, so a folder with a manifest is complete. It has no
path of the machine that made it, see `made_from.py`.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from gsvis import _check
from gsvis._kernels.rounding import Limits
from gsvis.color.records import Grids
from gsvis.color.storage import grids_of
from gsvis.color.variants import VARIANTS
from gsvis.errors import FormatError
from gsvis.files.fields import Fields, parse_object
from gsvis.files.limits import DAMAGED, inside, read_whole
from gsvis.io.facts import facts_from_json, facts_to_json
from gsvis.package.fidelity import Fidelity
from gsvis.package.layout import RecordLayout, TermLayout
from gsvis.package.parts import Part
from gsvis.scene.facts import SceneFacts

__all__ = ["MANIFEST", "VERSION", "Blob", "Block", "Cost", "Manifest", "PackageInfo"]

FORMAT = "gsvis-package"
VERSION = 4
_UNROUNDED = 3  # version of a package whose records have all bits
_OLDEST = 2
MANIFEST = "manifest.json"
_MOST_BYTES = 1 << 30
_MOST = (1 << 31) - 1
_MOST_LIMIT = 1 << 15  # largest size of a limit of rounding


@dataclass(frozen=True)
class Cost:
    """Image quality after rounding to records: the highest level with all terms, decoded against exact.

    Attributes:
        psnr: Mean PSNR over views, dB; 100 for equal images.
        worst: Least PSNR of a view, dB.
        views: Number of views.
        width: Width of the views, pixels.
        height: Height of the views, pixels.
    """

    psnr: float
    worst: float
    views: int
    width: int
    height: int


@dataclass(frozen=True)
class PackageInfo:
    """Facts about the scene of a package that are not in its records.

    Attributes:
        up: (3,) unit axis that points upwards.
        meters_per_unit: Meters in a scene unit; 0 if unknown.
        cost: Cost of rounding; None if it was not measured.
        provenance: Any JSON values.
        fidelity: Final quality at a client against the source scene; None if it was not measured.
        epsilon: Contribution above which a term is active in a cell; None if cells do not choose terms.
        facts: More facts, such as the origin of the scene and whether it is antialiased.

    Raises:
        ValueError: If a value is out of its range.
    """

    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    meters_per_unit: float = 0.0
    cost: Cost | None = None
    provenance: dict[str, Any] = field(default_factory=dict)
    fidelity: Fidelity | None = None
    epsilon: float | None = None
    facts: SceneFacts = field(default_factory=SceneFacts)

    def __post_init__(self) -> None:
        up = _check.unit_vectors("up", np.reshape(np.asarray(self.up, np.float64), (1, -1)))[0]
        object.__setattr__(self, "up", tuple(float(v) for v in up))
        if not 0.0 <= self.meters_per_unit < np.inf:
            raise ValueError(f"meters_per_unit: expected a finite number >= 0, got {self.meters_per_unit!r}")
        if self.epsilon is not None and not 0.0 <= self.epsilon < np.inf:
            raise ValueError(f"epsilon: expected a finite number >= 0, got {self.epsilon!r}")
        try:
            kept = json.loads(json.dumps(dict(self.provenance), allow_nan=False))
        except (TypeError, ValueError) as error:
            raise ValueError(f"provenance: expected JSON values, got {error}") from error
        object.__setattr__(self, "provenance", kept)


@dataclass(frozen=True)
class Block:
    """Consecutive Gaussians and their terms, in parts.

    Attributes:
        gaussians: Part with the records of the Gaussians.
        terms: Parts with the records of their terms, in order, and the number of terms in each part.
        count: Number of Gaussians.
        num_terms: Number of terms.
    """

    gaussians: Part
    terms: tuple[tuple[Part, int], ...]
    count: int
    num_terms: int


@dataclass(frozen=True)
class Blob:
    """A file with a format of its own, cut into parts.

    Attributes:
        parts: The parts, in order.
        nbytes: Bytes of the file.
    """

    parts: tuple[Part, ...]
    nbytes: int

    def as_dict(self) -> dict[str, Any]:
        """Return the entry of the manifest."""
        return {"bytes": self.nbytes, "parts": [part.as_dict() for part in self.parts]}


@dataclass(frozen=True, eq=False)
class Manifest:
    """The content of `manifest.json`.

    Attributes:
        info: Frame, cost and provenance.
        scene: `scene_hash` of the union before rounding; visible sets are built for this union.
        names: Names of the levels, lowest first.
        counts: Number of Gaussians of each level.
        grids: The tables of base colors and terms.
        tables: Parts with the rows of chunks, and the number of rows in each part.
        blocks: Blocks of Gaussians and terms.
        visibility: The store of visible sets, or None.
        active_terms: Lists of the active terms of each cell; None where they are computed on request.
        limits: How records are rounded; None for records that have all bits.
        version: Version of the format.
    """

    info: PackageInfo
    scene: str
    names: tuple[str, ...]
    counts: tuple[int, ...]
    grids: Grids
    tables: tuple[tuple[Part, int], ...]
    blocks: tuple[Block, ...]
    visibility: Blob | None = None
    active_terms: Blob | None = None
    limits: Limits | None = None
    version: int = VERSION

    @property
    def gaussians(self) -> int:
        """N, the number of Gaussians."""
        return sum(block.count for block in self.blocks)

    @property
    def terms(self) -> int:
        """T, the number of terms."""
        return sum(block.num_terms for block in self.blocks)

    @property
    def views(self) -> list[dict[str, Any]]:
        """Starting views from the provenance, the best first: `position` (3,), `rotation` (4,) wxyz, maybe `reach`.

        World from camera, OpenCV axes; `reach` is the distance of what is looked at. Invalid entries are skipped.
        """
        listed = self.info.provenance.get("views")
        kinds = (("position", 3), ("rotation", 4))
        return [
            {name: [float(value) for value in each[name]] for name, _ in kinds}
            | ({"reach": float(each["reach"])} if _is_vector([each.get("reach")], 1) and each["reach"] > 0 else {})
            for each in (listed if isinstance(listed, list) else [])
            if isinstance(each, dict) and all(_is_vector(each.get(name), count) for name, count in kinds)
        ]

    def parts(self) -> Iterator[Part]:
        """Yield all parts."""
        yield from (part for part, _ in self.tables)
        for block in self.blocks:
            yield block.gaussians
            yield from (part for part, _ in block.terms)
        for blob in (self.visibility, self.active_terms):
            if blob is not None:
                yield from blob.parts

    def sizes(self) -> dict[str, int]:
        """Return bytes of the parts by content: "records", "chunks", "terms", "visibility", perhaps "active_terms"."""
        sizes = {
            "records": sum(block.gaussians.nbytes for block in self.blocks),
            "chunks": sum(part.nbytes for part, _ in self.tables),
            "terms": sum(part.nbytes for block in self.blocks for part, _ in block.terms),
            "visibility": 0 if self.visibility is None else self.visibility.nbytes,
        }
        return sizes if self.active_terms is None else {**sizes, "active_terms": self.active_terms.nbytes}

    def to_json(self) -> bytes:
        """Return the bytes of the file, in the lowest version that can state it; equal manifests give equal bytes."""
        layout = RecordLayout.from_variant(self.grids.variant)
        sets = self.visibility
        value: dict[str, Any] = {
            "format": FORMAT,
            "version": _UNROUNDED if self.limits is None else VERSION,
            "up": list(self.info.up),
            "meters_per_unit": self.info.meters_per_unit,
            "gaussians": self.gaussians,
            "terms": self.terms,
            "scene": self.scene,
            "levels": [{"name": name, "count": count} for name, count in zip(self.names, self.counts, strict=True)],
            "quantization": {
                "record": asdict(layout),
                "term": asdict(TermLayout.from_grids(self.grids)),
                "colors": asdict(self.grids),
                "cost": None if self.info.cost is None else asdict(self.info.cost),
            },
            "chunks": [{**part.as_dict(), "count": count} for part, count in self.tables],
            "blocks": [
                {
                    **block.gaussians.as_dict(),
                    "count": block.count,
                    "terms": block.num_terms,
                    "term_parts": [{**part.as_dict(), "count": count} for part, count in block.terms],
                }
                for block in self.blocks
            ],
            "visibility": None if sets is None else sets.as_dict(),
            "epsilon": self.info.epsilon,
            "provenance": self.info.provenance,
        }
        if self.limits is not None:
            value["quantization"]["rounding"] = self.limits._asdict()
        if self.info.fidelity is not None:
            value["fidelity"] = self.info.fidelity.as_dict()
        if self.active_terms is not None:
            value["active_terms"] = self.active_terms.as_dict()
        if facts := facts_to_json(self.info.facts):
            value["facts"] = facts
        return json.dumps({**value, "sha256": _digest(value)}, indent=1, sort_keys=True, allow_nan=False).encode()

    @classmethod
    def read(cls, path: Path) -> Manifest:
        """Read and check a manifest.

        Raises:
            FormatError: If the file is not a manifest, is damaged, has an unsupported version, is a link out of its
                folder, or is inconsistent.
            OSError: If the file cannot be opened.
        """
        inside(path, "", path.parent, path.name)
        fields = parse_object(path, read_whole(path, _MOST_BYTES))
        if fields.raw("format") != FORMAT:
            raise FormatError(path, "format", FORMAT, repr(fields.raw("format"))[:60], "is this a package?")
        version = fields.integer("version", 1, 1 << 30)
        if not _OLDEST <= version <= VERSION:
            remedy = "update gsvis" if version > VERSION else "prepare the package again"
            raise FormatError(path, "version", f"{_OLDEST} to {VERSION}", f"{version}", remedy)
        value = dict(fields.value)
        digest = value.pop("sha256", None)
        try:
            if digest != _digest(value):
                raise FormatError(path, "sha256", "the hash of the rest", repr(digest)[:20], DAMAGED)
            return cls._from_fields(fields, version)
        except RecursionError as error:
            raise FormatError(path, "", "JSON", "objects nested too deeply", DAMAGED) from error
        except ValueError as error:
            raise FormatError(path, "", "valid values", str(error), DAMAGED) from error

    @classmethod
    def _from_fields(cls, fields: Fields, version: int) -> Manifest:
        """Return the manifest from parsed JSON of a version; raise FormatError or ValueError if a value is invalid."""
        scene = fields.text("scene")
        quantized = fields.child("quantization")
        colors = quantized.child("colors")
        name = colors.text("variant", VARIANTS)
        grids = grids_of(colors, name)
        for key, layout in (("record", RecordLayout.from_variant(name)), ("term", TermLayout.from_grids(grids))):
            if quantized.raw(key) != asdict(layout):
                raise FormatError(
                    fields.path, f"quantization.{key}", f"{asdict(layout)}", repr(quantized.raw(key))[:200]
                )
        levels = _parse_objects(fields, "levels")
        names = tuple(level.text("name")[:100] for level in levels)
        if not 1 <= len(names) <= 16 or len(set(names)) < len(names):
            raise FormatError(fields.path, "levels", "1 to 16 levels of different names", f"{names}"[:200])
        cost = quantized.child("cost") if "cost" in quantized else None
        measured = None
        if cost is not None:
            sizes = (cost.integer(key, 1, _MOST) for key in ("views", "width", "height"))
            measured = Cost(cost.number("psnr"), cost.number("worst"), *sizes)
        limits = None
        if version >= VERSION:
            rounding = quantized.child("rounding")
            limits = Limits(*(rounding.integer(key, -_MOST_LIMIT, _MOST_LIMIT) for key in Limits._fields))
        up = fields.numbers("up", 3).tolist()
        fidelity = Fidelity.from_fields(fields.child("fidelity")) if "fidelity" in fields else None
        meters = fields.number("meters_per_unit")
        provenance = fields.child("provenance").value
        epsilon = fields.number("epsilon") if "epsilon" in fields else None
        facts = facts_from_json(fields.raw("facts")) if "facts" in fields else SceneFacts()
        info = PackageInfo((up[0], up[1], up[2]), meters, measured, provenance, fidelity, epsilon, facts)
        found = cls(
            info,
            scene,
            names,
            tuple(level.integer("count", 1, _MOST) for level in levels),
            grids,
            tuple((Part.from_fields(row), row.integer("count", 1, _MOST)) for row in _parse_objects(fields, "chunks")),
            tuple(_parse_block(row, "arrow" if version == 2 else "bin") for row in _parse_objects(fields, "blocks")),
            _parse_blob(fields, "visibility"),
            _parse_blob(fields, "active_terms"),
            limits,
            version,
        )
        for key, claimed, counted in (("gaussians", "gaussians", found.gaussians), ("terms", "terms", found.terms)):
            if fields.integer(claimed, 0, _MOST) != counted:
                raise FormatError(fields.path, key, f"{counted:,} as the parts have", f"{fields.raw(key)}", DAMAGED)
        return found


def _parse_objects(fields: Fields, key: str) -> list[Fields]:
    """Return the objects of a list."""
    return [Fields(fields.path, f"{fields.where(key)}[{k}]", row) for k, row in enumerate(fields.items(key))]


def _parse_block(row: Fields, suffix: str) -> Block:
    """Return a block from JSON; `suffix` is that of its parts."""
    rows = _parse_objects(row, "term_parts")
    parts = tuple((Part.from_fields(part, suffix), part.integer("count", 1, _MOST)) for part in rows)
    return Block(Part.from_fields(row, suffix), parts, row.integer("count", 1, _MOST), row.integer("terms", 0, _MOST))


def _parse_blob(fields: Fields, key: str) -> Blob | None:
    """Return a file that is cut into parts, from JSON; None if it is absent."""
    if key not in fields:
        return None
    child = fields.child(key)
    parts = tuple(Part.from_fields(part, "bin") for part in _parse_objects(child, "parts"))
    total = child.integer("bytes", 0, 1 << 50)
    if total != sum(part.nbytes for part in parts):
        raise FormatError(fields.path, f"{key}.bytes", f"{sum(p.nbytes for p in parts):,}", f"{total:,}", DAMAGED)
    return Blob(parts, total)


def _digest(value: dict[str, Any]) -> str:
    """Return the hash of a manifest without its "sha256"."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def _is_vector(value: Any, count: int) -> bool:
    """Return whether a JSON value is a list of `count` numbers below 1e300, which fit a float."""
    if not isinstance(value, list) or len(value) != count:
        return False
    return all(isinstance(each, (int, float)) and not isinstance(each, bool) and abs(each) < 1e300 for each in value)
