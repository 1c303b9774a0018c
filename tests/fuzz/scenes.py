"""Targets: scenes of every format, and points."""

from __future__ import annotations

import gzip
import json
import math
import struct
from contextlib import suppress
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
import torch

from gsvis.errors import FormatError
from gsvis.io import load_scene, streamed_sog
from gsvis.io.checkpoint import load_checkpoint
from gsvis.io.gltf_splats_writer import encode_glb
from gsvis.io.ply import load_ply, ply_rows
from gsvis.io.points import load_points
from gsvis.scene.gaussians import Gaussians
from tests.fuzz.mutators import KINDS, change_bytes, mutate
from tests.fuzz.places import DROP, edited
from tests.fuzz.targets import Case, Target
from tests.io.scene_files import (
    compressed_ply_bytes,
    glb_bytes,
    glb_parts,
    ksplat_bytes,
    ply_bytes,
    random_scene,
    raw_columns,
    sog_files,
    splat_bytes,
    spz_bytes,
    streamed_files,
    zip_bytes,
)
from tests.io.test_checkpoint import gsplat_file, nerfstudio_file, nerfstudio_state
from tests.io.test_checkpoint import splats as raw_splats

__all__ = ["TARGETS"]

FRAME = struct.pack("<III", 0xADBE0003, 4, 4)
SMALL, DEEP, FLAT = random_scene(12, 1, 1), random_scene(9, 3, 2), random_scene(7, 0, 3)


def read_scene(path: Path, lod: int | None = None) -> None:
    scene = load_scene(path, lod)
    assert isinstance(scene, Gaussians)
    assert len(scene) > 0
    assert np.isfinite(scene.means).all()


def in_one_file(folder: Path, case: Case) -> None:
    (name,) = case
    read_scene(folder / name)


def in_ply(folder: Path, case: Case) -> None:
    """Read a PLY, and where its rows can be counted one row of it; a row that is not there is refused."""
    (name,) = case
    path = folder / name
    with suppress(FormatError), open(path, "rb") as stream:
        counted = ply_rows(path, stream)
        if counted is not None:
            with suppress(FormatError):
                assert len(load_ply(path, rows=(0, 1))) == 1
            with pytest.raises(FormatError):
                load_ply(path, rows=(0, counted[0] + 1))
    read_scene(path)


def by_other_names(folder: Path, case: Case) -> None:
    """Read a file whose name says what it is, one whose name does not, and a level of a file that has none."""
    (name,) = case
    (folder / name).rename(folder / "a.dat")
    with suppress(FormatError):
        read_scene(folder / "a.dat")
    (folder / "a.dat").rename(folder / name)
    with suppress(FormatError, ValueError):
        read_scene(folder / name, 0)
    read_scene(folder / name)


def in_sog_folder(folder: Path, case: Case) -> None:
    if len(case) % 2 and "meta.json" in case:
        read_scene(folder / "meta.json")
    with pytest.raises(FileNotFoundError):
        load_scene(folder / "none")
    read_scene(folder)


def plain_plys() -> list[Case]:
    columns = raw_columns(SMALL)
    faces = "element face 2\nproperty list uchar int vertex_indices\n"
    rows = b"\3" + bytes(12) + b"\1" + bytes(4)
    fixed = "element junk 2\nproperty short a\nproperty double b\n"
    made = [
        ply_bytes(columns),
        ply_bytes(columns, encoding="binary_big_endian"),
        ply_bytes(columns, encoding="ascii"),
        ply_bytes(columns, types={"x": "f8", "opacity": "f8", "rot_0": "f8"}),
        ply_bytes(raw_columns(DEEP)),
        ply_bytes(raw_columns(FLAT), encoding="ascii"),
        ply_bytes(columns, after=faces, after_rows=rows),
        ply_bytes(columns, before=fixed, before_rows=bytes(20)),
        ply_bytes(columns, newline="\r\n"),
    ]
    return [{"a.ply": data} for data in made]


def packed_plys() -> list[Case]:
    made = [compressed_ply_bytes(scene) for scene in (SMALL, DEEP, FLAT, random_scene(300, 0, 4))]
    return [{"a.ply": data} for data in [*made, compressed_ply_bytes(FLAT, color_range=False)]]


def splats() -> list[Case]:
    return [{"a.splat": splat_bytes(scene)} for scene in (SMALL, FLAT)]


def ksplats() -> list[Case]:
    degree2 = random_scene(9, 2, 5)
    made = [ksplat_bytes([scene], level) for level in (0, 1, 2) for scene in (SMALL, FLAT, degree2)]
    return [{"a.ksplat": data} for data in [*made, ksplat_bytes([FLAT, degree2], 2)]]


def change_ksplat(rng: Random, data: bytes) -> bytes:
    """One change of a .ksplat: mostly of a field of its head or of a section's, else of what follows them."""
    sections = min(3, int.from_bytes(data[4:8], "little"))
    start = 4096 + 1024 * sections
    if len(data) < start or not sections or rng.random() < 0.1:
        return change_bytes(rng, data)
    if rng.random() < 0.4:
        return data[:start] + change_bytes(rng, data[start:])
    if rng.random() < 0.4:
        at, form = rng.choice(((0, "B"), (1, "B"), (4, "I"), (16, "I"), (20, "H"), (36, "f"), (40, "f")))
    else:
        whole = ((at, "I") for at in (0, 4, 8, 12, 24, 32, 36))
        fields = (*whole, (16, "f"), (20, "H"), (40, "H"))
        at, form = rng.choice(fields)
        at += 4096 + 1024 * rng.randrange(sections)
    if form == "f":
        piece = struct.pack("<f", rng.choice((0.0, -1.0, 1e-30, 3e38, math.inf, math.nan, 2.0)))
        return data[:at] + piece + data[at + 4 :]
    size = struct.calcsize(form)
    value = rng.choice((0, 1, 2, 3, 255, 1 << 31, int.from_bytes(data[at : at + size], "little") + rng.choice((-1, 1))))
    return data[:at] + (value & (1 << 8 * size) - 1).to_bytes(size, "little") + data[at + size :]


KINDS["ksplat"] = change_ksplat


def old_spz() -> list[Case]:
    extra = FRAME
    made = [spz_bytes(scene, version) for version in (1, 2, 3) for scene in (SMALL, DEEP, FLAT)]
    head = gzip.decompress(spz_bytes(DEEP, 3))  # degree 4 has 24 coefficients; they are the end of the file
    fourth = gzip.compress(head[:12] + b"\4" + head[13:] + bytes(27 * len(DEEP)), mtime=0)
    return [{"a.spz": data} for data in [*made, spz_bytes(SMALL, 3, extensions=extra), fourth]]


def new_spz() -> list[Case]:
    made = [spz_bytes(SMALL, 4), spz_bytes(DEEP, 4), spz_bytes(FLAT, 4)]
    return [{"a.spz": data} for data in [*made, spz_bytes(SMALL, 4, extensions=FRAME)]]


def gltfs() -> list[Case]:
    """Plain and compressed, turned or not, with two nodes and a scene, and with what may be left out or is integers."""
    turn = np.eye(4)[[0, 2, 1, 3]] * np.array([1.0, 1.0, -1.0, 1.0])
    made = [encode_glb(SMALL), encode_glb(DEEP, upright=turn), encode_glb(FLAT, compression="spz")]
    document, binary = glb_parts(encode_glb(FLAT, upright=turn))
    document["nodes"].append({"children": [0], "rotation": [0, 0, 1, 0], "translation": [1, 2, 3], "scale": [2, 2, 2]})
    document["scenes"] = [{"nodes": [1]}]
    made.append(glb_bytes(document, binary))
    document, binary = glb_parts(encode_glb(FLAT))
    here = "meshes.0.primitives.0.extensions.KHR_gaussian_splatting"
    least = {f"{here}.kernel": DROP, f"{here}.colorSpace": "lin_rec709_display", "scenes": DROP, "scene": DROP,
             "nodes": [{"children": [1]}, {"mesh": 0}], "meshes.1": {"primitives": [{"attributes": {}}]},
             "nodes.2": {"mesh": 1}}  # fmt: skip
    made.append(glb_bytes(edited(document, least), binary))
    for normalized, values in ((True, bytes(range(100, 100 + len(FLAT)))), (False, bytes([0, 1] * 9)[: len(FLAT)])):
        number = document["meshes"][0]["primitives"][0]["attributes"]["KHR_gaussian_splatting:OPACITY"]
        view, accessor = len(document["bufferViews"]), f"accessors.{number}"
        places = {f"bufferViews.{view}": {"buffer": 0, "byteOffset": len(binary), "byteLength": len(values)},
                  f"{accessor}.bufferView": view, f"{accessor}.componentType": 5121,
                  f"{accessor}.normalized": normalized}  # fmt: skip
        made.append(glb_bytes(edited(document, places), binary + values + bytes(-len(values) % 4)))
    return [{"a.glb": data} for data in made]


def with_meta(files: Case, places: dict[str, Any]) -> Case:
    """A SOG with other values in its meta.json."""
    return {**files, "meta.json": json.dumps(edited(json.loads(files["meta.json"]), places)).encode()}


def zipped_sogs() -> list[Case]:
    """Of both versions; and as early writers left them, or with bands that are none."""
    made = [sog_files(scene, version) for version in (1, 2) for scene in (SMALL, DEEP, FLAT)]
    made += [with_meta(made[3], places) for places in ({"scales.codebook.0": None}, {"shN.bands": 0})]
    return [{"a.sog": zip_bytes(files)} for files in made]


def sog_folders() -> list[Case]:
    return [sog_files(scene, version) for version in (1, 2) for scene in (SMALL, FLAT)]


def streams() -> list[Case]:
    zipped = streamed_files({0: SMALL, 1: SMALL[:5]})
    zipped["1.sog"] = zip_bytes(sog_files(SMALL[:5]))
    zipped["lod-meta.json"] = zipped["lod-meta.json"].replace(b'"1_0/meta.json"', b'"1.sog"')
    around = streamed_files({0: SMALL})
    around |= {f"env/{name}": data for name, data in sog_files(FLAT[:3]).items()}
    around["lod-meta.json"] = around["lod-meta.json"].replace(b"null", b'"env/meta.json"')
    whole = streamed_files({0: SMALL, 1: SMALL[:5]})
    some = {"tree": {"children": [{"lods": {"0": {"file": 0, "offset": 2, "count": 5}}}]}}
    part = {**whole, "lod-meta.json": json.dumps({**json.loads(whole["lod-meta.json"]), **some}).encode()}
    alone = {name: data for name, data in whole.items() if not name.startswith("1_")}
    return [whole, zipped, around, part, alone]


def in_streams(folder: Path, case: Case) -> None:
    for name in case:
        if name.count("/") == 0 and name.endswith(".json"):
            with suppress(FormatError):
                read_scene(folder / name)
    read_scene(folder)
    for lod in (0, 1):
        with suppress(FormatError):
            read_scene(folder, lod)
        with suppress(FormatError):
            for file, count, _ in streamed_sog.streamed_files(folder, lod)[1]:
                scene = streamed_sog.load_streamed_file(folder, lod, file)
                assert len(scene) == count or count < 0
        with pytest.raises(FormatError):
            streamed_sog.load_streamed_file(folder, lod, 1 << 20)


def trained() -> list[Case]:
    """Both layouts, of every degree and precision, the values alone, and a file of two ranks."""
    raw, flat = raw_splats(6, 1), raw_splats(6, 0)
    state = {name: value.detach() for name, value in raw.items()}
    small = {name: value.bfloat16() for name, value in state.items()}
    with TemporaryDirectory() as folder:
        path = Path(folder) / "a.pt"

        def saved(content: Any) -> bytes:
            torch.save(content, path)
            return path.read_bytes()

        whole = gsplat_file(path, raw).read_bytes()
        made = [whole, gsplat_file(path, flat).read_bytes(), saved(state), saved({"splats": small})]
        made += [nerfstudio_file(path, nerfstudio_state(values)).read_bytes() for values in (raw, flat)]
    return [*({"a.pt": data} for data in made), {"a_rank0.pt": whole, "a_rank1.pt": whole}]


def in_trained(folder: Path, case: Case) -> None:
    """Read a checkpoint as a scene, and by its own reader, which says more of what is no checkpoint."""
    name = min(case)
    with suppress(FormatError):
        load_checkpoint(folder / name)
    read_scene(folder / name)


def point_files() -> list[Case]:
    rng = np.random.default_rng(0)
    columns = {
        **dict(zip("xyz", rng.normal(size=(3, 8)), strict=True)),
        **{c: np.arange(8.0) for c in ("red", "green", "blue")},
    }
    bare = {name: columns[name] for name in "xyz"}
    floats = {**bare, **{c: np.linspace(0, 1, 8) for c in ("red", "green", "blue")}}
    colors = ("red", "green", "blue")
    link = b'{"ply_file_path": "a.ply", "frames": []}'
    return [
        {"points3D.ply": ply_bytes(columns, types=dict.fromkeys(colors, "u1"))},
        {"points3D.ply": ply_bytes(columns, types=dict.fromkeys(colors, "u2"), encoding="binary_big_endian")},
        {"points3D.ply": ply_bytes(floats, types=dict.fromkeys("xyz", "f8"))},
        {"points3D.ply": ply_bytes(bare, encoding="ascii")},
        {"transforms.json": link, "a.ply": ply_bytes(floats)},
    ]


def in_points(folder: Path, case: Case) -> None:
    cloud = load_points(folder if "points3D.ply" not in case else folder / "points3D.ply")
    assert np.isfinite(cloud.means).all()
    assert ((cloud.colors >= 0) & (cloud.colors <= 1)).all()


def change_glb(rng: Random, data: bytes) -> bytes:
    """One change of a binary glTF: of its JSON or its binary chunk, with right lengths; sometimes of its bytes."""
    if len(data) < 28 or rng.random() < 0.2:
        return change_bytes(rng, data)
    (length,) = struct.unpack_from("<I", data, 12)
    text, binary = data[20 : 20 + length], data[28 + length :]
    if rng.random() < 0.7:
        text = mutate(rng, "json", text.rstrip(b" "))
    else:
        binary = change_bytes(rng, binary)
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


KINDS["glb"] = change_glb

FILES, IO = "gsvis.files.", "gsvis.io."
_PLY = (IO + "ply", IO + "_ply_header", IO + "_ply_rows", IO + "_build", FILES + "limits", IO + "scenes")
_SOG = (IO + "sog", IO + "_sog_files", IO + "_webp", FILES + "fields", FILES + "limits")

TARGETS = [
    Target("ply", plain_plys, in_ply, modules=_PLY),
    Target("compressed-ply", packed_plys, in_ply, modules=(IO + "compressed_ply", *_PLY)),
    Target("splat", splats, by_other_names, modules=(IO + "splat",), weight=0.5),
    Target("ksplat", ksplats, in_one_file, modules=(IO + "ksplat",)),
    Target("spz-gzip", old_spz, in_one_file, kinds={"a.spz": "gzip-spz"}, modules=(IO + "spz",)),
    Target("spz-zstd", new_spz, in_one_file, kinds={"a.spz": "spz4"}, modules=(IO + "spz",)),
    Target(
        "glb",
        gltfs,
        in_one_file,
        kinds={"a.glb": "glb"},
        modules=(IO + "gltf_splats", IO + "_gltf", IO + "_gltf_nodes"),
    ),
    Target("sog-zip", zipped_sogs, in_one_file, modules=_SOG),
    Target("sog-folder", sog_folders, in_sog_folder, modules=_SOG),
    Target("streamed-sog", streams, in_streams, (FormatError, FileNotFoundError), modules=(IO + "streamed_sog", *_SOG)),
    Target(
        "trained",
        trained,
        in_trained,
        kinds=dict.fromkeys(("a.pt", "a_rank0.pt", "a_rank1.pt"), "zip"),
        modules=(IO + "checkpoint",),
    ),
    Target("points", point_files, in_points, (FormatError, FileNotFoundError), modules=(IO + "points",)),
]
