"""Targets: scenes of every format, and points."""

from __future__ import annotations

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
from gsvis.io import load_scene
from gsvis.io.checkpoint import load_checkpoint
from gsvis.io.points import load_points
from gsvis.scene.gaussians import Gaussians
from tests.fuzz.mutators import KINDS, change_bytes
from tests.fuzz.targets import Case, Target
from tests.io.scene_files import (
    compressed_ply_bytes,
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
    return [{"a.spz": data} for data in [*made, spz_bytes(SMALL, 3, extensions=extra)]]


def new_spz() -> list[Case]:
    made = [spz_bytes(SMALL, 4), spz_bytes(DEEP, 4), spz_bytes(FLAT, 4)]
    return [{"a.spz": data} for data in [*made, spz_bytes(SMALL, 4, extensions=FRAME)]]


def zipped_sogs() -> list[Case]:
    return [{"a.sog": zip_bytes(sog_files(scene, version))} for version in (1, 2) for scene in (SMALL, DEEP, FLAT)]


def sog_folders() -> list[Case]:
    return [sog_files(scene, version) for version in (1, 2) for scene in (SMALL, FLAT)]


def streams() -> list[Case]:
    zipped = streamed_files({0: SMALL, 1: SMALL[:5]})
    zipped["1.sog"] = zip_bytes(sog_files(SMALL[:5]))
    zipped["lod-meta.json"] = zipped["lod-meta.json"].replace(b'"1_0/meta.json"', b'"1.sog"')
    around = streamed_files({0: SMALL})
    around |= {f"env/{name}": data for name, data in sog_files(FLAT[:3]).items()}
    around["lod-meta.json"] = around["lod-meta.json"].replace(b"null", b'"env/meta.json"')
    return [streamed_files({0: SMALL, 1: SMALL[:5]}), zipped, around]


def in_streams(folder: Path, case: Case) -> None:
    for name in case:
        if name.count("/") == 0 and name.endswith(".json"):
            with suppress(FormatError):
                read_scene(folder / name)
    read_scene(folder)
    for lod in (0, 1):
        with suppress(FormatError):
            read_scene(folder, lod)


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


FILES, IO = "gsvis.files.", "gsvis.io."
_PLY = (IO + "ply", IO + "_ply_header", IO + "_ply_rows", IO + "_build", FILES + "limits", IO + "scenes")
_SOG = (IO + "sog", IO + "_sog_files", IO + "_webp", FILES + "fields", FILES + "limits")

TARGETS = [
    Target("ply", plain_plys, in_one_file, modules=_PLY),
    Target("compressed-ply", packed_plys, in_one_file, modules=(IO + "compressed_ply", *_PLY)),
    Target("splat", splats, by_other_names, modules=(IO + "splat",), weight=0.5),
    Target("ksplat", ksplats, in_one_file, modules=(IO + "ksplat",)),
    Target("spz-gzip", old_spz, in_one_file, kinds={"a.spz": "gzip-spz"}, modules=(IO + "spz",)),
    Target("spz-zstd", new_spz, in_one_file, kinds={"a.spz": "spz4"}, modules=(IO + "spz",)),
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
