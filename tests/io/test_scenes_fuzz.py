"""Damaged scene files of every format: a valid scene or a `FormatError`, never anything else, in bounded memory."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
import tracemalloc
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsvis.errors import FormatError
from gsvis.io import load_scene
from gsvis.scene.gaussians import Gaussians
from tests.io.scene_files import (
    compressed_ply_bytes,
    ply_bytes,
    random_scene,
    raw_columns,
    sog_files,
    splat_bytes,
    spz_bytes,
    streamed_files,
    write_files,
    zip_bytes,
)

EFFORT = int(os.environ.get("GSVIS_FUZZ", "1"))
"""Set GSVIS_FUZZ=20 for a long run."""

SCENE = random_scene(12, 1)
FILES = {
    "plain.ply": ply_bytes(raw_columns(SCENE)),
    "big_endian.ply": ply_bytes(raw_columns(SCENE), encoding="binary_big_endian"),
    "text.ply": ply_bytes(raw_columns(SCENE), encoding="ascii"),
    "mixed.ply": ply_bytes(raw_columns(SCENE), types={"x": "f8", "opacity": "f8"}),
    "packed.ply": compressed_ply_bytes(SCENE),
    "a.splat": splat_bytes(SCENE),
    **{f"v{version}.spz": spz_bytes(SCENE, version) for version in (1, 2, 3, 4)},
    **{f"v{version}.sog": zip_bytes(sog_files(SCENE, version)) for version in (1, 2)},
}
FOLDERS = {
    "sog1": sog_files(SCENE, 1),
    "sog2": sog_files(SCENE, 2),
    "streamed": streamed_files({0: SCENE, 1: SCENE[:5]}),
}

Edit = tuple[str, float, bytes]
EDITS = st.lists(
    st.tuples(st.sampled_from(["set", "insert", "delete", "cut"]), st.floats(0, 1), st.binary(min_size=1, max_size=6)),
    min_size=1,
    max_size=4,
)
JSON_VALUES = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-(10**30), 10**30),
    st.floats(),
    st.text(max_size=5),
    st.sampled_from(["..", "/", "../x", "meta.json", "means_l.webp", "\\", "."]),
    st.just([]),
    st.just({}),
    st.lists(st.integers(-3, 300), max_size=4),
)


def damaged(data: bytes, edits: list[Edit]) -> bytes:
    for kind, place, piece in edits:
        at = int(place * len(data))
        if kind == "set":
            data = data[:at] + piece + data[at + len(piece) :]
        elif kind == "insert":
            data = data[:at] + piece + data[at:]
        elif kind == "delete":
            data = data[:at] + data[at + len(piece) :]
        else:
            data = data[:at]
    return data


def load_or_refuse(path: Path, lod: int | None = None) -> None:
    try:
        scene = load_scene(path, lod)
    except FormatError as error:
        assert "\n" not in str(error)
    else:
        assert isinstance(scene, Gaussians)
        assert len(scene) > 0


@pytest.fixture(scope="module")
def folder() -> Any:
    """A folder with all the intact scenes that are folders."""
    path = Path(tempfile.mkdtemp())
    for name, files in FOLDERS.items():
        write_files(path / name, files)
    yield path
    shutil.rmtree(path)


def load_damaged_or_refuse(folder: Path, name: str, file: str, data: bytes, lod: int | None) -> None:
    """Load a scene that is a folder with one file replaced, and put the file back."""
    try:
        (folder / name / file).write_bytes(data)
        load_or_refuse(folder / name, lod)
    finally:
        (folder / name / file).write_bytes(FOLDERS[name][file])


@pytest.mark.parametrize("name", FILES)
@settings(max_examples=40 * EFFORT)
@given(edits=EDITS)
def test_files(folder: Path, name: str, edits: list[Edit]) -> None:
    (folder / name).write_bytes(damaged(FILES[name], edits))
    load_or_refuse(folder / name)


@pytest.mark.parametrize("name", FOLDERS)
@settings(max_examples=50 * EFFORT)
@given(data=st.data())
def test_folders(folder: Path, name: str, data: st.DataObject) -> None:
    victim = data.draw(st.sampled_from(sorted(FOLDERS[name])))
    lod = data.draw(st.sampled_from([None, 0, 1])) if name == "streamed" else None
    load_damaged_or_refuse(folder, name, victim, damaged(FOLDERS[name][victim], data.draw(EDITS)), lod)


def places(value: Any, trail: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Trails to all values in a JSON document, of long lists only the first entries."""
    found = [trail] if trail else []
    pairs = value.items() if isinstance(value, dict) else enumerate(value[:3]) if isinstance(value, list) else ()
    for key, inner in pairs:
        found += places(inner, (*trail, key))
    return found


@pytest.mark.parametrize("name", FOLDERS)
@settings(max_examples=100 * EFFORT)
@given(data=st.data())
def test_json_of_other_values(folder: Path, name: str, data: st.DataObject) -> None:
    meta_name = "lod-meta.json" if name == "streamed" else "meta.json"
    meta = json.loads(FOLDERS[name][meta_name])
    trail = data.draw(st.sampled_from(places(meta)))
    inner = meta
    for key in trail[:-1]:
        inner = inner[key]
    inner[trail[-1]] = data.draw(JSON_VALUES)
    lod = 0 if name == "streamed" else None
    load_damaged_or_refuse(folder, name, meta_name, json.dumps(meta).encode(), lod)


@pytest.mark.parametrize("name", ["plain.ply", "text.ply", "packed.ply"])
@pytest.mark.parametrize("count", [10**9, 2**31, 2**63, 10**12])
def test_a_thousand_bytes_that_declare_a_thousand_million_rows(tmp_path: Path, name: str, count: int) -> None:
    data = FILES[name].replace(b"element vertex 12\n", b"element vertex %d\n" % count)
    data = data.replace(b"element chunk 1\n", b"element chunk %d\n" % -(-count // 256))
    (tmp_path / name).write_bytes(data)
    tracemalloc.start()
    with pytest.raises(FormatError):
        load_scene(tmp_path / name)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 4 << 20


@pytest.mark.parametrize("name", FILES)
def test_every_prefix_of_every_file(tmp_path: Path, name: str) -> None:
    data = FILES[name]
    for size in range(0, len(data), max(1, len(data) // 60)):
        (tmp_path / name).write_bytes(data[:size])
        load_or_refuse(tmp_path / name)
