"""Cases with one deliberate fault each, in the heads and rows of files of scenes, cameras, paths and photographs."""

from __future__ import annotations

import gzip
import math
import re
import struct
from typing import Any

import numpy as np

from tests.fuzz import cameras, scenes, training
from tests.fuzz.damage import Damaged
from tests.fuzz.targets import Case
from tests.io.scene_files import compressed_ply_bytes, ksplat_bytes, ply_bytes, raw_columns, spz_bytes

__all__ = ["DAMAGE"]


def put(data: bytes, at: int, form: str, *values: Any) -> bytes:
    """The bytes with other numbers at a place."""
    piece = struct.pack(form, *values)
    return data[:at] + piece + data[at + len(piece) :]


def swapped(data: bytes, old: bytes, new: bytes, count: int = -1) -> bytes:
    """The bytes with another piece; the old one has to be there."""
    assert old in data
    return data.replace(old, new, count)


def plys() -> Damaged:
    columns = raw_columns(scenes.SMALL)
    bare = {name: columns[name] for name in "xyz"}
    whole = ply_bytes(columns)
    face = "element face 1\nproperty list uchar int vertex_indices\n"
    found = {
        "no vertices": swapped(whole, b"element vertex", b"element virtex"),
        "eight coefficients": ply_bytes({name: each for name, each in columns.items() if name != "f_rest_8"}),
        "coefficients from 1 on": swapped(whole, b"f_rest_0\n", b"f_rest_9\n"),
        "a mesh": ply_bytes(bare, after=face, after_rows=b"\0"),
        "a cloud of points": ply_bytes(bare),
        "other columns": ply_bytes({"a": columns["x"]}),
        "no opacity": ply_bytes({name: each for name, each in columns.items() if name != "opacity"}),
        "a vertex of lists": swapped(whole, b"property float x\n", b"property list uchar float x\n"),
        "fewer rows": whole[:-3],
        "an opacity without end": ply_bytes({**columns, "opacity": np.where(columns["x"] > 0, np.nan, 1.0)}),
    }
    return {what: {"a.ply": data} for what, data in found.items()}


def packed_plys() -> Damaged:
    whole, deep = compressed_ply_bytes(scenes.FLAT), compressed_ply_bytes(scenes.DEEP)
    found = {
        "no chunks": swapped(whole, b"element chunk", b"element chank"),
        "chunks of doubles": swapped(whole, b"property float min_x\n", b"property double min_x\n"),
        "no smallest x": swapped(whole, b"property float min_x\n", b""),
        "packed signs": swapped(whole, b"property uint packed_scale\n", b"property int packed_scale\n"),
        "44 coefficients": swapped(deep, b"property uchar f_rest_44\n", b""),
        "coefficients of fewer": swapped(deep, b"element sh 9\n", b"element sh 8\n"),
        "coefficients of another name": swapped(deep, b"f_rest_44\n", b"f_rest_45\n"),
        "one byte less": whole[:-1],
    }
    return {what: {"a.ply": data} for what, data in found.items()}


def ksplats() -> Damaged:
    whole, section = ksplat_bytes([scenes.FLAT], 2), 4096
    found = {
        "another version": put(whole, 0, "<B", 1),
        "compression 3": put(whole, 20, "<H", 3),
        "coefficients of one value": put(whole, 36, "<2f", 0.5, 0.5),
        "coefficients up to infinity": put(whole, 40, "<f", math.inf),
        "a million sections": put(whole, 4, "<I", 1 << 20),
        "one Gaussian more": put(whole, 16, "<I", len(scenes.FLAT) + 1),
        "degree 3": put(whole, section + 40, "<H", 3),
        "more than there is room": put(whole, section + 4, "<I", 1),
        "a section beyond the end": put(whole, section + 4, "<I", 1 << 20),
        "buckets of nothing": put(whole, section + 8, "<I", 0),
        "centers of 8 bytes": put(whole, section + 20, "<H", 8),
        "blocks below 0": put(whole, section + 16, "<f", -1.0),
        "fewer buckets": put(whole, section + 12, "<I", 0),
    }
    return {what: {"a.ksplat": data} for what, data in found.items()}


def old_spz() -> Damaged:
    head = gzip.decompress(spz_bytes(scenes.SMALL, 3))
    found = {
        "another magic": put(head, 0, "<4s", b"NGSQ"),
        "version 4": put(head, 4, "<I", 4),
        "no Gaussian": put(head, 8, "<I", 0),
        "degree 5": put(head, 12, "<B", 5),
        "40 bits of fraction": put(head, 13, "<B", 40),
        "a head that is cut": head[:12],
        "one byte less": head[:-1],
    }
    return {what: {"a.spz": gzip.compress(data, mtime=0)} for what, data in found.items()}


def point_files() -> Damaged:
    columns = {**dict(zip("xyz", np.arange(12.0).reshape(3, 4), strict=True))}
    colors = {**columns, **{name: np.full(4, 0.5) for name in ("red", "green", "blue")}}
    found = {
        "no x": ply_bytes({"a": columns["x"], "y": columns["y"], "z": columns["z"]}),
        "a place that is no number": ply_bytes({**columns, "x": np.array([0, np.nan, 0, 0])}),
        "a place without end, as text": ply_bytes({**columns, "y": np.array([0, 0, np.inf, 0])}, encoding="ascii"),
        "a color above white": ply_bytes({**colors, "red": np.full(4, 1.5)}),
        "one byte less": ply_bytes(columns)[:-1],
    }
    return {what: {"points3D.ply": data} for what, data in found.items()} | {
        "a link that leads out": {"transforms.json": b'{"ply_file_path": "../a.ply", "frames": []}'},
        "a link to nothing": {"transforms.json": b'{"ply_file_path": "b.ply", "frames": []}'},
        "a link that is a number": {"transforms.json": b'{"ply_file_path": 7, "frames": []}'},
    }


def binary_models() -> Damaged:
    case = cameras.models(False)[0]
    images, points = case["images.bin"], case["points3D.bin"]
    changed: dict[str, Case] = {
        "a turn that is no number": {"images.bin": put(images, 12, "<d", math.nan)},
        "a turn of zeros": {"images.bin": put(images, 12, "<4d", 0, 0, 0, 0)},
        "a name without an end": {"images.bin": images[: images.rindex(b"im2.jpg") + 7]},
        "an image of no camera": {"images.bin": put(images, 8 + 4 + 56, "<i", 99)},
        "a model of a lens that is unknown": {"cameras.bin": put(case["cameras.bin"], 12, "<i", 99)},
        "a lens that bends": {"cameras.bin": put(case["cameras.bin"], 12, "<i", 4)},
        "a point too far away": {"points3D.bin": put(points, 16, "<d", 1e300)},
        "points beyond all": {"points3D.bin": put(points, 0, "<Q", 1 << 60)},
    }
    return {what: {**case, **files} for what, files in changed.items()}


def text_models() -> Damaged:
    case = cameras.models(True)[0]
    lenses, images = case["cameras.txt"], case["images.txt"]
    changed: dict[str, Case] = {
        "a parameter less": {"cameras.txt": re.sub(rb"(?m)^(1 PINHOLE .*) \S+$", rb"\1", lenses)},
        "a parameter that is a word": {"cameras.txt": swapped(lenses, b"50.0", b"wide", 1)},
        "an image of no camera": {"images.txt": swapped(images, b" 1 im0.jpg", b" 9 im0.jpg")},
        "a turn that is no number": {"images.txt": re.sub(rb"(?m)^1 \S+", b"1 nan", images)},
        "a turn that is a word": {"images.txt": re.sub(rb"(?m)^1 \S+", b"1 left", images)},
        "a middle that is no number": {"cameras.txt": swapped(lenses, b"32.0", b"nan", 1)},
        "a lens of no length": {"cameras.txt": swapped(lenses, b"50.0", b"0.0", 1)},
    }
    return {what: {**case, **files} for what, files in changed.items()}


def paths() -> Damaged:
    text = cameras.poses()[0]["a.csv"]
    twice = b"\n".join(line + (b",x" if k == 0 else b",1") for k, line in enumerate(text.splitlines())) + b"\n"
    found = {
        "no pose": text.partition(b"\n")[0] + b"\n",
        "a turn of length 2": swapped(text, b",1,0,0,0\n", b",2,0,0,0\n", 1),
        "a column of a name twice": twice,
        "times that go back": swapped(text, b"0.4,", b"0.1,"),
        "a word": swapped(text, b"1.5", b"high", 1),
        "a cell less": swapped(text, b",1,0,0,0\n", b",1,0,0\n", 1),
    }
    return {what: {"a.csv": data} for what, data in found.items()}


def recordings() -> Damaged:
    recording, settings = (cameras.recordings()[0][name] for name in ("user1_room.csv", "scene_setting.csv"))
    changed = {
        "an eye that is none": swapped(recording, b"\n0,", b"\n2,", 1),
        "a turn of length 3": swapped(recording, b",1.0,", b",3.0,", 1),
        "times that go back": re.sub(rb",[678]\d\n", b",1\n", recording),
        "a place that is a word": swapped(recording, b",1.6,", b",high,", 1),
    }
    tilt = {
        "a tilt that is none": swapped(settings, b'"0,0,0,1"', b'"0,0,0,3"'),
        "a tilt of three numbers": swapped(settings, b'"0,0,0,1"', b'"0,0,0"'),
        "a tilt of words": swapped(settings, b'"0,0,0,1"', b'"a,b,c,d"'),
        "another scene": swapped(settings, b"room,", b"hall,"),
    }
    found = {what: {"user1_room.csv": data, "scene_setting.csv": settings} for what, data in changed.items()}
    return found | {what: {"user1_room.csv": recording, "scene_setting.csv": data} for what, data in tilt.items()}


def photographs() -> Damaged:
    model = training.photos()[0]
    images = sorted(path for path in model if path.endswith(".png"))
    cut = {path: model[path][: len(model[path]) * 2 // 3] for path in images[:2]}
    return {
        "two images that are cut": {**model, **cut},
        "one image that is cut": {**model, images[3]: cut[images[0]]},
        "one image less": {path: data for path, data in model.items() if path != images[2]},
        "images alone": {path: model[path] for path in images},
    }


DAMAGE = {
    "ply": plys,
    "compressed-ply": packed_plys,
    "ksplat": ksplats,
    "spz-gzip": old_spz,
    "points": point_files,
    "colmap-binary": binary_models,
    "colmap-text": text_models,
    "poses": paths,
    "eyenav": recordings,
    "photographs": photographs,
}
"""What makes the damaged cases of a target, by its name."""
