"""Write Gaussians as binary glTF (`.glb`) with the extension KHR_gaussian_splatting, plain or SPZ-compressed.

Data keep the frame of the scene, bit by bit; one node rotates them to +y up. Plain attributes are float32. Compressed
data are one SPZ stream, with KHR_gaussian_splatting_compression_spz_2, as CesiumJS reads it.

References:
    See `gsvis.io.gltf_splats`. COLOR_0, the fallback for programs without the extension, is linear as glTF has it; its
    alpha is the opacity.
"""

from __future__ import annotations

import io
import json
import os
import struct
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, BinaryIO, Literal

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.files.atomic import atomic_path
from gsvis.files.folders import GENERATOR
from gsvis.io._gltf import SPLATS, SPZ, SRGB, sh_names
from gsvis.io.facts import KEY, facts_to_json
from gsvis.io.gltf_splats import MAGIC
from gsvis.io.losses import report_loss
from gsvis.io.spz import encode_old_spz
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.sh import SH_C0

__all__ = ["MOST_BYTES", "Compression", "check_size", "encode_glb", "report_antialiased", "save_glb"]

Compression = Literal["none", "spz"]

MOST_BYTES = 2**32 - 1
"""Largest GLB in bytes: its length has 32 bits."""

_FLOAT = 5126
_BYTE = 5121
_VERTICES = 34962
_TURN = np.diag([1.0, -1.0, -1.0])  # SPZ streams are turned by it: half a turn about x
_JSON_ROOM = 16384  # more than the JSON of any scene


def check_size(count: int, sh_degree: int) -> None:
    """Raise unless that many Gaussians fit into a plain GLB.

    Raises:
        ValueError: If they have more than 4 GB.
    """
    size = _JSON_ROOM + count * (48 + 12 * (sh_degree + 1) ** 2)
    if size > MOST_BYTES:
        raise ValueError(
            f"scene: expected at most {MOST_BYTES:,} bytes as GLB, got {size:,} for {count:,} Gaussians; compress it,"
            " or write 3D Tiles"
        )


def save_glb(
    scene: Gaussians,
    path: str | os.PathLike[str],
    *,
    upright: NDArray[np.float64] | None = None,
    compression: Compression = "none",
) -> int:
    """Write a `.glb`, atomically. The same scene gives the same bytes.

    Args:
        scene: The scene; its order is kept.
        path: The file; its folder is created if missing.
        upright: (4, 4) matrix from the frame of the scene to that of glTF, +y up; None for the identity.
        compression: "none" keeps every value; "spz" rounds as `save_spz` does.

    Returns:
        Bytes of the file.

    Raises:
        ValueError: If the scene is empty, too large for the format, or an argument is wrong.
        OSError: If it cannot be written.
    """
    _check_scene(scene, compression)
    if scene.facts.antialiased:
        report_antialiased(path)
    with atomic_path(path) as partial:
        with open(partial, "wb") as out:
            _write(scene, out, upright, compression, path)
        return partial.stat().st_size


def report_antialiased(path: str | os.PathLike[str]) -> None:
    """Log that glTF cannot store the flag of antialiased scenes."""
    report_loss(path, "antialiased", "glTF has no flag for antialiased scenes; only gsvis reads its note")


def encode_glb(
    scene: Gaussians,
    *,
    upright: NDArray[np.float64] | None = None,
    compression: Compression = "none",
    path: str | os.PathLike[str] = "",
) -> bytes:
    """Return the bytes that `save_glb` writes.

    Args:
        scene: As for `save_glb`.
        upright: As for `save_glb`.
        compression: As for `save_glb`.
        path: The file to be written, for the log; empty logs nothing.

    Raises:
        ValueError: As `save_glb`.
    """
    _check_scene(scene, compression)
    out = io.BytesIO()
    _write(scene, out, upright, compression, path)
    return out.getvalue()


def _check_scene(scene: Gaussians, compression: Compression) -> None:
    """Raise unless the scene is not empty and the compression is known."""
    _check.one_of("compression", compression, ("none", "spz"))
    if len(scene) == 0:
        raise ValueError("scene: expected at least one Gaussian, got none")
    if compression == "none":
        check_size(len(scene), scene.sh_degree)


def _write(
    scene: Gaussians,
    out: BinaryIO,
    upright: NDArray[np.float64] | None,
    compression: Compression,
    path: str | os.PathLike[str],
) -> None:
    """Write the file to a stream."""
    matrix = np.eye(4) if upright is None else np.asarray(upright, np.float64)
    document: dict[str, Any] = {"asset": {"version": "2.0", "generator": GENERATOR} | _extras(scene, matrix)}
    if compression == "spz":
        packed, scene = encode_old_spz(scene, path)
        matrix = _with_origin(matrix, scene)
        chunks: Iterator[bytes] = iter((packed,))
        turned = matrix.copy()
        turned[:3, :3] = matrix[:3, :3] @ _TURN
        size = _describe_packed(document, scene, len(packed))
        _place(document, turned)
    else:
        matrix = _with_origin(matrix, scene)
        chunks = (column.tobytes() for _, _, _, column in _columns(scene))
        size = _describe_plain(document, scene)
        _place(document, matrix)
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    padding = -size % 4
    out.write(struct.pack("<4sII", MAGIC, 2, 28 + len(text) + size + padding))
    out.write(struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", size + padding, b"BIN\0"))
    for chunk in chunks:
        out.write(chunk)
    out.write(bytes(padding))


def _with_origin(matrix: NDArray[np.float64], scene: Gaussians) -> NDArray[np.float64]:
    """Return the matrix of a node that moves centers to their place in the source: the node holds the origin."""
    moved: NDArray[np.float64] = matrix.copy()
    moved[:3, 3] += matrix[:3, :3] @ np.asarray(scene.facts.origin)
    return moved


def _extras(scene: Gaussians, matrix: NDArray[np.float64]) -> dict[str, Any]:
    """Return the facts of the scene in the frame of glTF, for the asset; empty if +y up is the only one."""
    linear = matrix[:3, :3]
    scale = float(np.cbrt(abs(np.linalg.det(linear))))
    facts = scene.facts.transform(linear / scale, scale)
    facts = facts.transform(np.eye(3), 1.0, matrix[:3, 3])
    if facts.up is not None and np.allclose(facts.up, (0.0, 1.0, 0.0), atol=1e-6):
        facts = replace(facts, up=None, up_source="")
    found = facts_to_json(facts)
    return {"extras": {KEY: found}} if found else {}


def _columns(scene: Gaussians) -> Iterator[tuple[str, str, int, NDArray[np.generic]]]:
    """Yield name, accessor type, component type and values of each attribute."""
    yield "POSITION", "VEC3", _FLOAT, _floats(scene.means)
    yield f"{SPLATS}:ROTATION", "VEC4", _FLOAT, _floats(scene.quats[:, [1, 2, 3, 0]])
    yield f"{SPLATS}:SCALE", "VEC3", _FLOAT, _floats(scene.scales)
    yield f"{SPLATS}:OPACITY", "SCALAR", _FLOAT, _floats(scene.opacities)
    yield sh_names(0)[0], "VEC3", _FLOAT, _floats(scene.sh0[:, 0])
    first = 0
    for degree in range(1, scene.sh_degree + 1):
        for n, name in enumerate(sh_names(degree)):
            yield name, "VEC3", _FLOAT, _floats(scene.shN[:, first + n])
        first += 2 * degree + 1
    yield "COLOR_0", "VEC4", _BYTE, _fallback(scene)


def _floats(values: NDArray[np.floating[Any]]) -> NDArray[np.generic]:
    """Return values as contiguous float32."""
    return np.ascontiguousarray(values, "<f4")


def _fallback(scene: Gaussians) -> NDArray[np.uint8]:
    """Return (N, 4) linear RGB of the base color and the opacity, a byte each."""
    srgb = np.clip(0.5 + SH_C0 * scene.sh0[:, 0].astype(np.float64), 0.0, 1.0)
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    rgba = np.column_stack([linear, scene.opacities])
    return np.asarray(np.rint(255.0 * rgba), np.uint8)


def _describe_plain(document: dict[str, Any], scene: Gaussians) -> int:
    """Fill in accessors, views and the mesh of plain data; return their bytes."""
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    attributes: dict[str, int] = {}
    at = 0
    for name, kind, component, column in _columns(scene):
        accessor: dict[str, Any] = {
            "bufferView": len(views),
            "componentType": component,
            "count": len(scene),
            "type": kind,
        }
        if component == _BYTE:
            accessor["normalized"] = True
        if name == "POSITION":
            accessor |= _ends(scene)
        attributes[name] = len(accessors)
        accessors.append(accessor)
        views.append({"buffer": 0, "byteOffset": at, "byteLength": column.nbytes, "target": _VERTICES})
        at += column.nbytes
    document |= {"buffers": [{"byteLength": at}], "bufferViews": views, "accessors": accessors}
    _mesh(document, attributes, {}, [SPLATS], [])
    return at


def _describe_packed(document: dict[str, Any], scene: Gaussians, size: int) -> int:
    """Fill in the accessors of an SPZ stream; return its bytes.

    The draft of the compression has neither OPACITY nor SH_DEGREE_0: COLOR_0 stands for both. CesiumJS counts the
    attributes whose names contain SH_DEGREE to find the degree, so no others may be listed.
    """
    kinds = {"POSITION": "VEC3", "COLOR_0": "VEC4", f"{SPLATS}:SCALE": "VEC3", f"{SPLATS}:ROTATION": "VEC4"}
    kinds |= {name: "VEC3" for degree in range(1, scene.sh_degree + 1) for name in sh_names(degree)}
    accessors: list[dict[str, Any]] = []
    for name, kind in kinds.items():
        accessor: dict[str, Any] = {"componentType": _FLOAT, "count": len(scene), "type": kind}
        if name == "COLOR_0":
            accessor |= {"componentType": _BYTE, "normalized": True}
        if name == "POSITION":
            accessor |= _ends(scene, np.diag(_TURN))
        accessors.append(accessor)
    views = [{"buffer": 0, "byteOffset": 0, "byteLength": size}]
    document |= {"buffers": [{"byteLength": size}], "bufferViews": views, "accessors": accessors}
    inner = {"extensions": {SPZ: {"bufferView": 0}}}
    _mesh(document, {name: k for k, name in enumerate(kinds)}, inner, [SPLATS, SPZ], [SPLATS, SPZ])
    return size


def _ends(scene: Gaussians, signs: NDArray[np.float64] | None = None) -> dict[str, Any]:
    """Return the lowest and highest center, for an accessor."""
    means = scene.means if signs is None else scene.means * signs.astype(np.float32)
    return {"min": means.min(axis=0).tolist(), "max": means.max(axis=0).tolist()}


def _mesh(
    document: dict[str, Any], attributes: dict[str, int], inner: dict[str, Any], used: list[str], required: list[str]
) -> None:
    """Add the mesh with its extension to the document."""
    said = {"kernel": "ellipse", "colorSpace": SRGB, "sortingMethod": "cameraDistance", "projection": "perspective"}
    primitive = {"attributes": attributes, "mode": 0, "extensions": {SPLATS: {**said, **inner}}}
    document |= {"meshes": [{"primitives": [primitive]}], "extensionsUsed": used}
    if required:
        document["extensionsRequired"] = required


def _place(document: dict[str, Any], matrix: NDArray[np.float64]) -> None:
    """Add the node to the document, with its matrix."""
    node: dict[str, Any] = {"mesh": 0}
    if not np.array_equal(matrix, np.eye(4)):
        node["matrix"] = [float(v) + 0.0 for v in matrix.T.ravel()]
    document |= {"nodes": [node], "scenes": [{"nodes": [0]}], "scene": 0}
