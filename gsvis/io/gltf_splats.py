"""Read Gaussians from glTF (`.glb`, or `.gltf` with its buffers): KHR_gaussian_splatting, plain or SPZ-compressed.

Scales and opacities in the file are activated and linear, quaternions xyzw, harmonics in the order of 3DGS. The
transforms of nodes are applied, so the scene is in the frame of glTF: +y up, right-handed. Triangles, points without
the extension, materials and animations are skipped.

References:
    https://github.com/KhronosGroup/glTF/tree/main/extensions/2.0/Khronos/KHR_gaussian_splatting (release candidate,
    read in July 2026), KHR_gaussian_splatting_compression_spz_2 (draft), and glTF 2.0, chapter 4 for GLB.
"""

from __future__ import annotations

import os
import struct
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.errors import FormatError
from gsvis.files.fields import Fields, parse_object
from gsvis.files.limits import Budget, read_whole
from gsvis.io._build import LEAST_SCALE, bytes_of_scene, format_error, gaussians_from
from gsvis.io._gltf import LINEAR, SPLATS, SPZ, Accessors, sh_names
from gsvis.io._gltf_nodes import Placed, place_meshes
from gsvis.io._origin import place_scene, settle_origin
from gsvis.io.facts import KEY, facts_from_json
from gsvis.io.losses import report_note
from gsvis.io.spz import decode_spz
from gsvis.scene.facts import SceneFacts
from gsvis.scene.gaussians import Gaussians

__all__ = ["MAGIC", "SPLATS", "SPZ", "decode_gltf_splats", "load_gltf_splats"]

F32 = NDArray[np.float32]
MAGIC = b"glTF"
_HEAD = struct.Struct("<4sII")
_CHUNK = struct.Struct("<I4s")
_KNOWN = {SPLATS, SPZ, "KHR_mesh_quantization"}
_TURN = np.diag([1.0, -1.0, -1.0])  # right-down-front, in which SPZ is decoded, to the frame of the stream


def load_gltf_splats(path: str | os.PathLike[str]) -> Gaussians:
    """Read the Gaussians of a glTF file, in the order of its nodes.

    Args:
        path: A `.glb` whose buffer is its own binary chunk, or a `.gltf` whose buffers are files in its folder or text
            in it.

    Returns:
        The scene in the frame of glTF, +y up. Parts of lower SH degree are padded with zeros. If a node is too far from
        (0, 0, 0) for float32, the scene gets an origin.

    Raises:
        FormatError: If the file is no glTF of version 2, is damaged or truncated, holds no Gaussians, or needs an
            extension, a kernel or a node transform that gsvis does not read.
        OSError: If it cannot be opened.
    """
    return decode_gltf_splats(path, read_whole(path))


def decode_gltf_splats(path: str | os.PathLike[str], data: bytes) -> Gaussians:
    """Return the Gaussians from the bytes of a glTF file.

    Args:
        path: The file that holds them, for error messages; buffers outside are files in its folder.
        data: The bytes.

    Raises:
        FormatError: As `load_gltf_splats`.
    """
    packed = data[: len(MAGIC)] == MAGIC
    document, binary = _chunks(path, data) if packed else (data, None)
    budget = Budget(path, len(data))
    root = parse_object(path, document, budget)
    if not packed and "asset" not in root:
        raise FormatError(path, "", "glTF, JSON with an asset", "JSON without one")
    required = root.items("extensionsRequired") if "extensionsRequired" in root else []
    strange = [str(name)[:60] for name in required if not isinstance(name, str) or name not in _KNOWN]
    if strange:
        raise FormatError(path, "extensionsRequired", f"none but {', '.join(sorted(_KNOWN))}", ", ".join(strange[:3]))
    accessors = Accessors(root, binary, budget)
    parts = []
    for mesh, placed in place_meshes(root):
        for k, primitive in enumerate(mesh.items("primitives")):
            fields = Fields(path, f"{mesh.trail}.primitives[{k}]", primitive)
            if "extensions" in fields and SPLATS in fields.child("extensions"):
                part = _primitive(fields, accessors, budget)
                parts.append(part if placed is None else _transform_part(path, part, placed))
    if not parts:
        remedy = "meshes and point clouds are no scene of Gaussians"
        raise FormatError(path, "", f"a mesh with the extension {SPLATS}", "none", remedy)
    return _with_facts(root, parts[0] if len(parts) == 1 else Gaussians.concatenate(parts))


def _with_facts(root: Fields, scene: Gaussians) -> Gaussians:
    """Return the scene with the facts of the file: +y up, and the facts of gsvis in the extras of the asset."""
    asset = root.raw("asset") if "asset" in root else None
    extras = asset.get("extras") if isinstance(asset, dict) else None
    stated = facts_from_json(extras.get(KEY) if isinstance(extras, dict) else None)
    origin = scene.facts.origin
    own = scene.facts
    up = (stated.up, stated.up_source) if stated.up else ((0.0, 1.0, 0.0), "glTF")
    flagged = own.antialiased or stated.antialiased
    facts = replace(stated, origin=origin, up=up[0], up_source=up[1], antialiased=flagged)
    if stated.box is not None:  # relative to the origin that the file states
        facts = replace(replace(stated, box=stated.box).shift(origin), up=up[0], up_source=up[1], antialiased=flagged)
    return settle_origin(scene.with_facts(facts), stated.origin if any(stated.origin) else None)


def _transform_part(path: str | os.PathLike[str], part: Gaussians, placed: Placed) -> Gaussians:
    """Return the Gaussians of a node, transformed."""
    try:
        with np.errstate(all="ignore"):  # infinite values are rejected below
            return place_scene(part, *placed)
    except ValueError as error:
        raise format_error(path, error) from error


def _chunks(path: str | os.PathLike[str], data: bytes) -> tuple[bytes, memoryview]:
    """Return the JSON and the binary chunk of a GLB; the latter may be empty."""
    if len(data) < _HEAD.size + _CHUNK.size:
        raise FormatError(path, "header", f"{_HEAD.size + _CHUNK.size} bytes", f"{len(data)}", "is the file truncated?")
    magic, version, length = _HEAD.unpack_from(data)
    if magic != MAGIC or version != 2:
        raise FormatError(path, "header", "binary glTF of version 2", f"{magic!r} of version {version}")
    if length != len(data):
        raise FormatError(path, "header", f"a length of {len(data):,} bytes", f"{length:,}", "is the file truncated?")
    found: dict[bytes, memoryview] = {}
    at = _HEAD.size
    while at + _CHUNK.size <= len(data):
        size, kind = _CHUNK.unpack_from(data, at)
        at += _CHUNK.size
        if size > len(data) - at:
            raise FormatError(path, f"byte {at - 8}", f"a chunk of at most {len(data) - at:,} bytes", f"{size:,}")
        if not found and kind != b"JSON":
            raise FormatError(path, f"byte {at - 4}", "a JSON chunk first", repr(kind)[1:])
        found.setdefault(kind, memoryview(data)[at : at + size])
        at += size
    return bytes(found[b"JSON"]), found.get(b"BIN\0", memoryview(b""))


def _primitive(fields: Fields, accessors: Accessors, budget: Budget) -> Gaussians:
    """Return the Gaussians of one primitive in the frame of its mesh."""
    path = fields.path
    splats = fields.child("extensions").child(SPLATS)
    if "mode" not in fields or fields.integer("mode", 0, 6) != 0:
        raise FormatError(path, fields.where("mode"), "0, points", str(fields.raw("mode")))
    if "kernel" in splats:
        splats.text("kernel", ("ellipse",))
    if splats.raw("colorSpace") == LINEAR:
        report_note(path, "colors are linear and are not converted; they look darker")
    if "extensions" in splats and SPZ in splats.child("extensions"):
        where = splats.child("extensions").child(SPZ)
        decoded = decode_spz(path, bytes(accessors.view(where)))
        flagged = SceneFacts(antialiased=decoded.facts.antialiased)  # the node states the frame, not the stream
        return decoded.with_facts(flagged).transform(_TURN)
    attributes = fields.child("attributes")
    means = accessors.read(attributes, "POSITION", "VEC3")
    budget.claim(bytes_of_scene(len(means), 0), attributes.where("POSITION"))
    quats = accessors.read(attributes, f"{SPLATS}:ROTATION", "VEC4")
    scales = accessors.read(attributes, f"{SPLATS}:SCALE", "VEC3")
    if scales.size and scales.min() < 0.0:
        remedy = "drafts of the extension stored logarithms; export it again with a newer program"
        raise FormatError(path, f"{SPLATS}:SCALE", "scales of at least 0", f"{scales.min():g}", remedy)
    opacities = accessors.read(attributes, f"{SPLATS}:OPACITY", "SCALAR")
    bands = _band_names(attributes)
    budget.claim(12 * len(means) * sum(map(len, bands)), attributes.trail)
    read = [[accessors.read(attributes, name, "VEC3") for name in names] for names in bands]
    columns: list[tuple[str, F32]] = [("ROTATION", quats), ("SCALE", scales), ("OPACITY", opacities)]
    columns += [
        (name, column)
        for names, band in zip(bands, read, strict=True)
        for name, column in zip(names, band, strict=True)
    ]
    for name, column in columns:
        if len(column) != len(means):
            raise FormatError(path, attributes.where(name), f"{len(means):,} values", f"{len(column):,}")
    higher = [column for band in read[1:] for column in band]
    return gaussians_from(
        path,
        means,
        np.ascontiguousarray(quats[:, [3, 0, 1, 2]]),
        np.maximum(scales, np.float32(LEAST_SCALE)),
        opacities[:, 0],
        read[0][0][:, None, :],
        np.stack(higher, axis=1) if higher else None,
    )


def _band_names(attributes: Fields) -> list[tuple[str, ...]]:
    """Return the names of the coefficients of each degree that the file has; raise if a degree is incomplete."""
    bands: list[Any] = [sh_names(degree) for degree in range(4)]
    there = [sum(name in attributes for name in names) for names in bands]
    highest = max((degree for degree in range(4) if there[degree]), default=0)
    for degree in range(highest + 1):
        if there[degree] != len(bands[degree]):
            expected = f"all {len(bands[degree])} coefficients of degree {degree}"
            raise FormatError(attributes.path, attributes.trail, expected, str(there[degree]))
    return bands[: highest + 1]
