"""Small valid scene files of every format, written plainly and apart from the library's own writers."""

from __future__ import annotations

import gzip
import io
import json
import struct
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import zstandard
from numpy.typing import NDArray
from PIL import Image

from gsvis.scene.gaussians import Gaussians

SH_C0 = 0.28209479177387814
PLY_TYPES = {"f4": "float", "f8": "double", "u1": "uchar", "i1": "char", "u2": "ushort", "i2": "short", "i4": "int"}


def random_scene(n: int = 70, sh_degree: int = 1, seed: int = 0) -> Gaussians:
    rng = np.random.default_rng(seed)
    higher = 0.2 * rng.standard_normal((n, (sh_degree + 1) ** 2 - 1, 3))
    return Gaussians(
        rng.uniform(-3, 3, (n, 3)),
        rng.standard_normal((n, 4)),
        np.exp(rng.uniform(-5, 0, (n, 3))),
        rng.uniform(0.02, 0.98, n),
        rng.uniform(-1.5, 1.5, (n, 1, 3)),
        higher.clip(-0.9, 0.9),
    )


def raw_columns(scene: Gaussians) -> dict[str, NDArray[np.float64]]:
    """The columns of an INRIA PLY by name."""
    columns = dict(zip("xyz", scene.means.astype(np.float64).T, strict=True))
    for channel in range(3):
        columns[f"f_dc_{channel}"] = scene.sh0[:, 0, channel].astype(np.float64)
        for k in range(scene.shN.shape[1]):
            columns[f"f_rest_{channel * scene.shN.shape[1] + k}"] = scene.shN[:, k, channel].astype(np.float64)
    opacity = scene.opacities.astype(np.float64)
    columns["opacity"] = np.log(opacity / (1 - opacity))
    for i in range(3):
        columns[f"scale_{i}"] = np.log(scene.scales[:, i].astype(np.float64))
    for i in range(4):
        columns[f"rot_{i}"] = scene.quats[:, i].astype(np.float64)
    return columns


def ply_bytes(
    columns: dict[str, Any],
    *,
    encoding: str = "binary_little_endian",
    types: dict[str, str] | None = None,
    before: str = "",
    before_rows: bytes = b"",
    after: str = "",
    after_rows: bytes = b"",
    newline: str = "\n",
) -> bytes:
    """A PLY of one vertex element, with other elements before and after it."""
    kinds = {name: (types or {}).get(name, "f4") for name in columns}
    n = len(next(iter(columns.values())))
    lines = ["ply", f"format {encoding} 1.0", "comment made by a test", *before.splitlines(), f"element vertex {n}"]
    lines += [f"property {PLY_TYPES[kind]} {name}" for name, kind in kinds.items()]
    lines += [*after.splitlines(), "end_header", ""]
    if encoding == "ascii":
        rows = "".join(" ".join(repr(float(columns[c][i])) for c in columns) + "\n" for i in range(n)).encode()
    else:
        order = "<" if encoding == "binary_little_endian" else ">"
        table = np.zeros(n, [(name, order + kind) for name, kind in kinds.items()])
        for name in columns:
            table[name] = columns[name]
        rows = table.tobytes()
    return newline.join(lines).encode() + before_rows + rows + after_rows


def splat_bytes(scene: Gaussians) -> bytes:
    records = []
    for i in range(len(scene)):
        rgb = np.clip((0.5 + SH_C0 * scene.sh0[i, 0]) * 255, 0, 255).round()
        quat = np.clip(scene.quats[i] * 128 + 128, 0, 255).round()
        small = [*rgb, scene.opacities[i] * 255, *quat]
        records.append(struct.pack("<6f8B", *scene.means[i], *scene.scales[i], *(round(float(v)) for v in small)))
    return b"".join(records)


def ksplat_bytes(scenes: list[Gaussians], level: int, *, bucket: int = 4, block: float = 16.0) -> bytes:
    """A .ksplat with a section for each scene; buckets of Gaussians in turn, their first center as center."""
    low, high = -1.0, 0.9
    total = sum(map(len, scenes))
    data = struct.pack("<4B4IHH5f", 0, 1, 0, 0, len(scenes), len(scenes), total, total, level, 0, 0, 0, 0, low, high)
    data += bytes(4096 - len(data))
    bodies = []
    for scene in scenes:
        n = len(scene)
        starts = range(0, n, bucket) if level else []
        full, rest = (n // bucket, [n % bucket] if n % bucket else []) if level else (0, [])
        centers = [scene.means[k].tolist() for k in starts]
        body = struct.pack(f"<{len(rest)}I", *rest) + b"".join(struct.pack("<3f", *center) for center in centers)
        for i in range(n):
            sh = [scene.shN[i, k, c] for ks in ((0, 1, 2), (3, 4, 5, 6, 7)) for c in range(3) for k in ks
                  if k < scene.shN.shape[1]]  # fmt: skip
            rest_of = [*scene.scales[i], *scene.quats[i]]
            if level == 0:
                body += struct.pack("<10f", *scene.means[i], *rest_of)
            else:
                away = (scene.means[i].astype(np.float64) - centers[i // bucket]) / (block / 2 / 32767) + 32767
                body += struct.pack("<3H7e", *(round(v) for v in away), *rest_of)
            rgb = np.clip((0.5 + SH_C0 * scene.sh0[i, 0]) * 255, 0, 255)
            body += bytes(round(float(v)) for v in (*rgb, scene.opacities[i] * 255))
            if level == 2:
                body += bytes(round(float(np.clip((v - low) / (high - low) * 255, 0, 255))) for v in sh)
            else:
                body += struct.pack(f"<{len(sh)}{'fe'[level]}", *sh)
        head = struct.pack("<4IfHHIIII", n, n, bucket if level else 0, len(starts), block if level else 0.0,
                           12 if level else 0, 0, 32767 if level else 0, len(body), full, len(rest))  # fmt: skip
        head += struct.pack("<H", scene.sh_degree)
        data += head + bytes(1024 - len(head))
        bodies.append(body)
    return data + b"".join(bodies)


def compressed_ply_bytes(scene: Gaussians, *, color_range: bool = True) -> bytes:
    n = len(scene)
    rgb = 0.5 + SH_C0 * scene.sh0[:, 0].astype(np.float64)
    logs = np.log(scene.scales.astype(np.float64))
    chunks, packed = [], []
    for start in range(0, n, 256):
        some = slice(start, start + 256)
        parts = [scene.means[some].astype(np.float64), logs[some], rgb[some]]
        if not color_range:
            parts[2] = parts[2].clip(0, 1)
        bounds = [(part.min(axis=0), part.max(axis=0)) for part in parts]
        if not color_range:
            bounds[2] = (np.zeros(3), np.ones(3))
        chunks += [v for low, high in bounds[: 3 if color_range else 2] for v in (*low, *high)]
        units = [(p - lo) / np.maximum(hi - lo, 1e-9) for p, (lo, hi) in zip(parts, bounds, strict=True)]
        for i in range(len(parts[0])):
            position, scale = (
                round(u[i, 0] * 2047) << 21 | round(u[i, 1] * 1023) << 11 | round(u[i, 2] * 2047) for u in units[:2]
            )
            r, g, b = (round(c * 255) for c in units[2][i])
            color = r << 24 | g << 16 | b << 8 | round(float(scene.opacities[start + i]) * 255)
            packed.append((position, _rotation_2_10_10_10(scene.quats[start + i]), scale, color))
    names = ["min_x", "min_y", "min_z", "max_x", "max_y", "max_z"]
    names += [name.replace("_", "_scale_") for name in names]
    if color_range:
        names += ["min_r", "min_g", "min_b", "max_r", "max_g", "max_b"]
    lines = ["ply", "format binary_little_endian 1.0", f"element chunk {-(-n // 256)}"]
    lines += [f"property float {name}" for name in names] + [f"element vertex {n}"]
    lines += [f"property uint packed_{name}" for name in ("position", "rotation", "scale", "color")]
    body = np.array(chunks, "<f4").tobytes() + np.array(packed, "<u4").tobytes()
    if scene.sh_degree:
        lines += [f"element sh {n}"] + [f"property uchar f_rest_{i}" for i in range(3 * scene.shN.shape[1])]
        flat = scene.shN.transpose(0, 2, 1).reshape(n, -1)
        body += np.clip(np.floor((flat / 8 + 0.5) * 256), 0, 255).astype(np.uint8).tobytes()
    return ("\n".join([*lines, "end_header"]) + "\n").encode() + body


def _rotation_2_10_10_10(quat: NDArray[np.float32]) -> int:
    largest = int(np.abs(quat).argmax())
    sign = -1.0 if quat[largest] < 0 else 1.0
    bits = largest
    for place in range(4):
        if place != largest:
            bits = bits << 10 | int(np.clip(round((sign * float(quat[place]) * 0.5**0.5 + 0.5) * 1023), 0, 1023))
    return bits


def spz_bytes(scene: Gaussians, version: int, fraction_bits: int = 12, extensions: bytes = b"") -> bytes:
    """SPZ of any version: the scene is taken to be in the PLY frame and turned to right-up-back."""
    n, k = scene.shN.shape[:2]
    half_turn = np.array([1.0, -1.0, -1.0])
    means = scene.means * half_turn
    if version == 1:
        positions = means.astype("<f2").tobytes()
    else:
        fixed = np.round(means * 2.0**fraction_bits).astype(int) & 0xFFFFFF
        positions = b"".join(int(v).to_bytes(3, "little") for v in fixed.ravel())
    rotations = b""
    for w, x, y, z in scene.quats:
        q = [float(x), -float(y), -float(z), float(w)]
        if version < 3:
            sign = -1.0 if q[3] < 0 else 1.0
            rotations += bytes(round(sign * v * 127.5 + 127.5) for v in q[:3])
            continue
        largest = max(range(4), key=lambda i: abs(q[i]))
        bits = largest
        for place in (p for p in range(4) if p != largest):
            negative = (q[place] < 0) != (q[largest] < 0)
            bits = bits << 10 | int(negative) << 9 | int(511 * abs(q[place]) * 2**0.5 + 0.5)
        rotations += struct.pack("<I", bits)
    # parity of the real harmonics under y, z -> -y, -z: the sign of each basis function at a mirrored direction
    parity = np.array([-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1])[:k, None]
    streams = [
        positions,
        np.round(scene.opacities * 255).astype(np.uint8).tobytes(),
        np.clip(np.round(scene.sh0 * 0.15 * 255 + 127.5), 0, 255).astype(np.uint8).tobytes(),
        np.clip(np.round((np.log(scene.scales) + 10) * 16), 0, 255).astype(np.uint8).tobytes(),
        rotations,
        np.clip(np.round(scene.shN * parity * 128 + 128), 0, 255).astype(np.uint8).tobytes(),
    ]
    streams = [stream for stream in streams if stream]
    flags = 2 if extensions else 0
    if version < 4:
        header = struct.pack("<4sIIBBBB", b"NGSP", version, n, scene.sh_degree, fraction_bits, flags, 0)
        return gzip.compress(header + b"".join(streams) + extensions, mtime=0)
    packed = [zstandard.ZstdCompressor().compress(stream) for stream in streams]
    contents = 32 + len(extensions)
    header = struct.pack("<4sIIBBBB", b"NGSP", 4, n, scene.sh_degree, fraction_bits, flags, len(streams))
    header += struct.pack("<I12x", contents) + extensions
    header += b"".join(struct.pack("<QQ", len(p), len(s)) for p, s in zip(packed, streams, strict=True))
    return header + b"".join(packed)


def webp(pixels: NDArray[np.uint8], **options: Any) -> bytes:
    out = io.BytesIO()
    Image.fromarray(pixels).save(out, "WEBP", **({"lossless": True, "exact": True} | options))
    return out.getvalue()


def plane(values: NDArray[Any], width: int | None = None) -> bytes:
    """A lossless plane with one pixel for each row of values, spare pixels at the end."""
    width = width or int(np.ceil(np.sqrt(len(values))))
    height = -(-len(values) // width)
    pixels = np.zeros((width * height, 4), np.uint8)
    pixels[:, 3] = 255
    pixels[: len(values), : values.shape[1]] = values
    return webp(pixels.reshape(height, width, 4))


def sog_files(scene: Gaussians, version: int = 2) -> dict[str, bytes]:
    """The files of a SOG scene by name. Every Gaussian has its own palette entry for the higher SH."""
    n, k = scene.shN.shape[:2]
    means = np.sign(scene.means) * np.log1p(np.abs(scene.means.astype(np.float64)))
    low, high = means.min(axis=0), means.max(axis=0)
    steps = np.round((means - low) / (high - low) * 65535).astype(int)
    quats = []
    for q in scene.quats.astype(np.float64):
        largest = int(np.abs(q).argmax())
        q = -q if q[largest] < 0 else q
        quats.append([*(np.round((np.delete(q, largest) * 2**0.5 * 0.5 + 0.5) * 255)), 252 + largest])
    logs, sh0, opacity = np.log(scene.scales), scene.sh0[:, 0], scene.opacities.astype(np.float64)
    meta: dict[str, Any] = {
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "quats": {"files": ["quats.webp"]},
    }
    files = {
        "means_l.webp": plane(steps & 255),
        "means_u.webp": plane(steps >> 8),
        "quats.webp": plane(np.array(quats)),
    }
    flat = scene.shN.reshape(n * k, 3)
    if version == 2:
        meta |= {"version": 2, "count": n}
        books = {name: np.linspace(v.min(), v.max(), 256) for name, v in (("scales", logs), ("sh0", sh0))}
        index = {name: np.abs(v[..., None] - books[name]).argmin(-1) for name, v in (("scales", logs), ("sh0", sh0))}
        meta |= {name: {"codebook": books[name].tolist(), "files": [f"{name}.webp"]} for name in books}
        files["scales.webp"] = plane(index["scales"])
        files["sh0.webp"] = plane(np.column_stack([index["sh0"], np.round(opacity * 255)]))
        if k:
            book = np.linspace(-1, 1, 256)
            centroids = np.abs(flat[..., None] - book).argmin(-1)
            names = ["shN_centroids.webp", "shN_labels.webp"]
            meta["shN"] = {"count": n, "bands": scene.sh_degree, "codebook": book.tolist(), "files": names}
    else:
        meta["means"]["shape"] = [n, 3]
        colors = np.column_stack([sh0, np.log(opacity / (1 - opacity))])
        for name, v in (("scales", logs), ("sh0", colors)):
            mins, maxs = v.min(axis=0), v.max(axis=0)
            files[f"{name}.webp"] = plane(np.round((v - mins) / (maxs - mins) * 255))
            meta[name] = {"mins": mins.tolist(), "maxs": maxs.tolist(), "files": [f"{name}.webp"]}
        if k:
            centroids = np.round((flat + 1) / 2 * 255)
            meta["shN"] = {"mins": -1.0, "maxs": 1.0, "files": ["shN_centroids.webp", "shN_labels.webp"]}
    if k:
        files["shN_centroids.webp"] = plane(np.asarray(centroids), width=64 * k)
        labels = np.arange(n)
        files["shN_labels.webp"] = plane(np.column_stack([labels & 255, labels >> 8]))
    return files | {"meta.json": json.dumps(meta).encode()}


def write_files(folder: Path, files: dict[str, bytes]) -> Path:
    for name, data in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)
    return folder


def zip_bytes(files: dict[str, bytes], compression: int = zipfile.ZIP_STORED) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", compression) as archive:
        for name, data in files.items():
            archive.writestr(zipfile.ZipInfo(name), data, compress_type=compression)
    return out.getvalue()


def streamed_files(levels: dict[int, Gaussians], *, present: set[int] | None = None) -> dict[str, bytes]:
    """A streamed scene of one SOG folder a level and a tree of two leaves, which share each level in halves."""
    numbers = sorted(levels)
    leaves: list[dict[str, Any]] = [{"bound": {}, "lods": {}}, {"bound": {}, "lods": {}}]
    files = {}
    for place, level in enumerate(numbers):
        half = len(levels[level]) // 2
        leaves[0]["lods"][str(level)] = {"file": place, "offset": 0, "count": half}
        leaves[1]["lods"][str(level)] = {"file": place, "offset": half, "count": len(levels[level]) - half}
        if present is None or level in present:
            files |= {f"{level}_0/{name}": data for name, data in sog_files(levels[level]).items()}
    names = [f"{level}_0/meta.json" for level in numbers]
    meta = {"lodLevels": len(numbers), "environment": None, "filenames": names, "tree": {"children": leaves}}
    return files | {"lod-meta.json": json.dumps(meta).encode()}
