"""Targets: files of editing. Selections of a scene, and voxels to walk on."""

from __future__ import annotations

import io
import json
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from gsvis.edit import CLASSES
from gsvis.errors import FormatError
from gsvis.io.selection import load_selection, save_selection
from gsvis.io.voxels import Voxels, load_voxels, save_voxels
from tests.fuzz.targets import Case, Target
from tests.io.scene_files import random_scene

__all__ = ["TARGETS"]

SCENE = random_scene(12, 0, 1)


def selections() -> list[Case]:
    """Selections with a note and without, beside files that are no notes, and of all kinds of numbers."""
    classes = (np.arange(12) % 6).astype(np.uint8)
    with TemporaryDirectory() as folder:
        save_selection(Path(folder) / "a.npy", classes, SCENE, CLASSES)
        made = [{path.name: path.read_bytes() for path in sorted(Path(folder).iterdir())}]
    for dtype in (bool, np.int8, ">i4", np.uint64):
        file = io.BytesIO()
        np.save(file, classes.astype(dtype))
        made.append({"a.npy": file.getvalue()})
    others = (b"[]", b'{"format": "another"}', b"no JSON")  # other files of that name
    return [*made, *({"a.npy": saved(classes), "a.json": other} for other in others)]


def in_selection(folder: Path, _: Case) -> None:
    classes = load_selection(folder / "a.npy", SCENE)
    assert classes.shape == (12,)
    assert classes.dtype == np.uint8


def voxel_files() -> list[Case]:
    """Voxels of several shapes: mixed, all solid, all free."""
    rng = np.random.default_rng(0)
    masks = [rng.random((9, 5, 13)) < 0.4, np.ones((4, 4, 4), bool), np.zeros((8, 4, 20), bool)]
    made = []
    for solid in masks:
        with TemporaryDirectory() as folder:
            save_voxels(Voxels(np.array([1.0, -2.0, 0.5]), 0.25, solid), Path(folder) / "a.voxel.json")
            made.append({path.name: path.read_bytes() for path in sorted(Path(folder).iterdir())})
    return made


def in_voxels(folder: Path, _: Case) -> None:
    found = load_voxels(folder / "a.voxel.json")
    assert found.solid.ndim == 3
    assert found.is_solid(found.origin[None] - 1e-3 * found.size).all()


def damaged_selections() -> dict[str, Case]:
    """Headers that promise more than the file holds, and archives."""
    found: dict[str, Case] = {}
    for name, shape in (("a terabyte", (1 << 40,)), ("a bit more", (13,)), ("two axes", (3, 4)), ("no number", ())):
        file = io.BytesIO()
        np.lib.format.write_array_header_1_0(file, {"descr": "|u1", "fortran_order": False, "shape": shape})
        found[name] = {"a.npy": file.getvalue() + bytes(12)}
    archive = io.BytesIO()
    np.savez(archive, a=np.zeros(12, np.uint8))
    found["an archive"] = {"a.npy": archive.getvalue()}
    found["objects"] = {"a.npy": saved(np.array([{}] * 12, object))}
    return found


def damaged_voxels() -> dict[str, Case]:
    """Numbers that no float holds, grids that no memory holds, and children that are their own parents."""
    (first, *_) = voxel_files()
    said = json.loads(first["a.voxel.json"])
    changes = {
        "a side of 10^400": {"voxelResolution": 10**400},
        "a corner of 10^400": {"gridBounds": {"min": [10**400, 0, 0], "max": [1, 1, 1]}},
        "no box": {"gridBounds": []},
        "a huge grid": {"gridBounds": {"min": [0, 0, 0], "max": [4096, 4096, 4096]}, "treeDepth": 12},
        "more nodes": {"nodeCount": 1 << 24},
    }
    found = {what: first | {"a.voxel.json": json.dumps(said | change).encode()} for what, change in changes.items()}
    binary = bytearray(first["a.voxel.bin"])
    binary[:3] = bytes(3)  # the number of its first child
    return found | {"a root of itself": first | {"a.voxel.bin": bytes(binary)}}


def saved(array: np.ndarray) -> bytes:
    """The bytes of an `.npy` file."""
    file = io.BytesIO()
    np.save(file, array, allow_pickle=True)
    return file.getvalue()


IO = "gsvis.io."

TARGETS = [
    Target("selection", selections, in_selection, (FormatError, FileNotFoundError), modules=(IO + "selection",),
           weight=0.5),
    Target("voxels", voxel_files, in_voxels, (FormatError, FileNotFoundError), modules=(IO + "voxels",), weight=0.5),
]  # fmt: skip
