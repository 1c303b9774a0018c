"""What every reader holds to: regular files only, nothing outside of the folder, memory by the input's real size."""

from __future__ import annotations

import ast
import gzip
import json
import os
import threading
import tracemalloc
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from gsvis.abr.traces import load_trace
from gsvis.color.storage import load_srbf
from gsvis.errors import FormatError
from gsvis.files.archive import load_arrays
from gsvis.files.fields import estimate_parsed_bytes, parse_json
from gsvis.files.limits import MIN_BUDGET, Budget, inside, open_regular, read_whole
from gsvis.files.sections import HEAD_BYTES, SectionWriter
from gsvis.io.cameras import load_cameras
from gsvis.io.checkpoint import is_checkpoint, load_checkpoint
from gsvis.io.levels import load_levels
from gsvis.io.points import load_points
from gsvis.io.poses import load_path
from gsvis.io.scenes import load_scene
from gsvis.jobs.resume import KeptWork
from gsvis.package import Package
from gsvis.package.active_terms import ActiveTerms
from gsvis.pvs._writer import FILE_KIND, FORMAT
from gsvis.pvs.store import VisibilityStore
from gsvis.serve.parts import read_part
from gsvis.train.photos import load_photos
from tests.io.scene_files import random_scene, sog_files, streamed_files, write_files, zip_bytes

PACKAGE = Path(__file__).parents[2] / "gsvis"
GUARD = 60.0
PART = "0" * 64 + ".arrow"


def finish(call: Callable[[], Any]) -> Any:
    """What a call returns or raises; an error if it hangs."""
    found: list[Any] = []

    def run() -> None:
        try:
            found.append(call())
        except Exception as error:
            found.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    thread.join(GUARD)
    assert found, "it waits for a pipe"
    return found[0]


READERS: dict[str, tuple[str, Callable[[Path], Any]]] = {
    "ply": ("a.ply", load_scene),
    "splat": ("a.splat", load_scene),
    "ksplat": ("a.ksplat", load_scene),
    "spz": ("a.spz", load_scene),
    "sog": ("a.sog", load_scene),
    "glb": ("a.glb", load_scene),
    "meta": ("meta.json", load_scene),
    "streamed": ("lod-meta.json", load_scene),
    "transforms": ("transforms.json", load_cameras),
    "inria": ("cameras.json", load_cameras),
    "colmap bin": ("cameras.bin", load_cameras),
    "colmap txt": ("images.txt", load_cameras),
    "points ply": ("points.ply", load_points),
    "points bin": ("points3D.bin", load_points),
    "points txt": ("points3D.txt", load_points),
    "photos": ("transforms.json", load_photos),
    "poses": ("walk.csv", load_path),
    "trace": ("link.txt", load_trace),
    "5G": ("link.csv", load_trace),
    "store": ("a.pvs", VisibilityStore.open),
    "terms": ("a.terms.arrow", ActiveTerms.open),
    "srbf": ("a.arrow", load_srbf),
    "levels": ("levels.arrow", lambda path: load_levels(path.parent)),
    "package": ("manifest.json", lambda path: Package.open(path.parent)),
    "part": (f"parts/{PART}", lambda path: read_part(path.parent.parent, PART)),
    "archive": ("run.ckpt", load_arrays),
    "checkpoint": ("run.pt", load_checkpoint),
    "checkpoint, looked at": ("run.pth", is_checkpoint),
}


@pytest.mark.parametrize("reader", READERS)
def test_a_pipe_is_refused_in_one_line(tmp_path: Path, reader: str) -> None:
    name, read = READERS[reader]
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    os.mkfifo(path)
    found = finish(lambda: read(path))
    assert isinstance(found, FormatError), repr(found)
    assert "\n" not in str(found)


def test_a_pipe_among_the_files_of_a_scene_is_refused(tmp_path: Path) -> None:
    write_files(tmp_path, sog_files(random_scene(50, 0)))
    (tmp_path / "quats.webp").unlink()
    os.mkfifo(tmp_path / "quats.webp")
    found = finish(lambda: load_scene(tmp_path))
    assert isinstance(found, FormatError), repr(found)


def test_a_pipe_in_place_of_what_was_kept_counts_as_missing(tmp_path: Path) -> None:
    kept = KeptWork(tmp_path, {})
    os.mkfifo(tmp_path / "found.npz")
    assert finish(lambda: kept.read_arrays("found.npz", {})) == {}
    os.mkfifo(tmp_path / "cell-000000.bin")
    assert finish(lambda: kept.read("cell-000000.bin")) is None


def test_devices_and_folders_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="expected a regular file, got a device"):
        open_regular("/dev/zero")
    with pytest.raises(FormatError, match="expected a regular file, got a device"):
        load_scene("/dev/zero")
    with pytest.raises(IsADirectoryError):
        open_regular(tmp_path)
    with pytest.raises(FileNotFoundError):
        open_regular(tmp_path / "none")
    (tmp_path / "a").write_bytes(b"four")
    assert read_whole(tmp_path / "a") == b"four"
    with pytest.raises(FormatError, match="at most 3 bytes, got 4"):
        read_whole(tmp_path / "a", 3)


# Where a file is opened for reading by other means, and why that is no door: file of the package, or call.
OPENED_OTHERWISE = {
    "files/mapped.py": "read_bytes",  # what the system says of this process; such a file has no size
    "files/arrow.py": "memory_map",  # opened as a regular file before
    "report/html.py": "read_text",  # pages that come with gsvis
    "pvs/_tasks.py": "memmap",  # what this run wrote for its workers
    "report/frames.py": "load",  # what this run wrote
    "cli/streams.py": "open",  # the null device
    "io/remote.py": "open",  # a file in a storage of fsspec
}


def opens(tree: ast.AST) -> list[str]:
    """Calls that open a file by its path to read it."""
    found = []
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call):
            continue
        name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        owner = ast.unparse(node.func.value) if isinstance(node.func, ast.Attribute) else ""
        modes = [a.value for a in [*node.args, *(k.value for k in node.keywords)] if isinstance(a, ast.Constant)]
        reads = any(mode in ("r", "rb", "rt") for mode in modes)
        writes = any(str(mode)[:1] in ("w", "a", "x") or mode == "r+b" for mode in modes)
        first = [*node.args, *(k.value for k in node.keywords if k.arg == "fileobj")]
        given = ast.unparse(first[0]) if first else ""
        if (
            (name in BY_PATH and owner != "self._parts")
            or (name in BY_EITHER and not writes and given not in OPENED)
            or (name == "load" and owner in ("np", "numpy", "torch") and given not in OPENED)
            or (name == "open" and reads and owner != "pa")
            or (name == "open" and not node.args and owner.rpartition(".")[2] in ("path", "file", "_path"))
            or (name == "open" and owner in LIBRARIES and not writes and given not in OPENED)
        ):
            found.append(name)
    return found


BY_PATH = {"read_bytes", "read_text", "fromfile", "memory_map", "memmap", "open_memmap", "loadtxt", "genfromtxt"}
"""Calls that take a path alone."""

BY_EITHER = {"ZipFile", "PyZipFile", "TarFile", "GzipFile", "BZ2File", "LZMAFile", "FileIO", "OSFile", "mmap"}
"""Calls that take a path or a number, or what was opened."""

LIBRARIES = {"", "io", "codecs", "Image", "gzip", "bz2", "lzma", "tarfile", "zipfile", "wave", "tokenize"}
"""Whose `open` takes a path or what was opened."""

OPENED = {"file", "stream", "self._file", "file.fileno()", "io.BytesIO(data)", "-1"}
"""What is given in place of a path: files that were opened as regular ones, and bytes."""

DOORS = """zipfile.ZipFile(path)
ZipFile(path, "r")
zipfile.ZipFile(file=path)
zipfile.ZipFile(self.path)
zipfile.ZipFile(os.fspath(folder / name))
np.load(path)
np.load(kept, mmap_mode="r")
torch.load(path)
np.memmap(path, "<f4", mode="r")
np.lib.format.open_memmap(path)
np.fromfile(path)
np.genfromtxt(path)
mmap.mmap(os.open(path, os.O_RDONLY), 0)
pa.OSFile(str(path))
pa.memory_map(str(path))
gzip.open(path)
gzip.GzipFile(path)
lzma.open(folder / name)
tarfile.open(path)
Image.open(path)
Image.open(folder / name)
open(path)
open(folder / name, "rb")
io.open(name)
path.open()
self.path.open()
path.open("rb")
path.read_bytes()""".splitlines()

NO_DOORS = """zipfile.ZipFile(file)
gzip.GzipFile(fileobj=io.BytesIO(data))
zipfile.ZipFile(partial, "w", zipfile.ZIP_STORED)
zipfile.ZipFile(partial, "a")
mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
mmap.mmap(-1, 4096)
pa.OSFile(str(path), "wb")
Image.open(file)
Image.open(io.BytesIO(data), formats=["WEBP"])
open(partial, "r+b")
partial.open("wb")
Package.open(path)
self._door.open()
read_whole(path)""".splitlines()


def test_every_door_is_seen() -> None:
    assert [code for code in DOORS if not opens(ast.parse(code))] == []
    assert [code for code in NO_DOORS if opens(ast.parse(code))] == []


def test_files_are_opened_by_the_one_door() -> None:
    wrong = {}
    for path in PACKAGE.rglob("*.py"):
        name = path.relative_to(PACKAGE).as_posix()
        found = set(opens(ast.parse(path.read_text(encoding="utf-8")))) - {OPENED_OTHERWISE.get(name)}
        if found:
            wrong[name] = found
    assert wrong == {}, "use open_regular or read_whole"


SECRET = b"hunter2 hunter2 hunter2 hunter2"


@pytest.mark.parametrize("name", ["quats.webp", "meta.json"])
def test_a_link_out_of_a_scene_is_refused_and_shows_nothing(tmp_path: Path, name: str) -> None:
    (tmp_path / "secret").write_bytes(b'{"version": "%s"}' % SECRET)
    folder = write_files(tmp_path / "scene", sog_files(random_scene(50, 0)))
    for target in ("../secret", str(tmp_path / "secret"), *(["../nothing"] if name != "meta.json" else [])):
        (folder / name).unlink()
        (folder / name).symlink_to(target)
        with pytest.raises(FormatError, match="a link that leads out of it") as caught:
            load_scene(folder)
        assert b"hunter2" not in str(caught.value).encode()


def test_links_inside_of_a_scene_are_followed(tmp_path: Path) -> None:
    scene = random_scene(50, 0)
    folder = write_files(tmp_path / "scene", sog_files(scene))
    (folder / "quats.webp").rename(folder / "q.webp")
    (folder / "quats.webp").symlink_to("q.webp")
    (tmp_path / "by another name").symlink_to(folder)
    assert len(load_scene(folder)) == len(load_scene(tmp_path / "by another name")) == len(scene)


def test_links_out_of_a_streamed_scene_are_refused(tmp_path: Path) -> None:
    files = streamed_files({0: random_scene(50, 0), 1: random_scene(20, 0)})
    folder = write_files(tmp_path / "scene", files)
    plane = next(name for name in files if name.endswith("quats.webp"))
    inner = folder / plane
    inner.rename(folder / "shared.webp")
    inner.symlink_to(folder / "shared.webp")
    load_scene(folder, lod=0)
    load_scene(folder, lod=1)
    inner.unlink()
    (tmp_path / "secret").write_bytes(SECRET)
    inner.symlink_to(tmp_path / "secret")
    with pytest.raises(FormatError, match="a link that leads out of it"):
        [load_scene(folder, lod=lod) for lod in (0, 1)]


def test_links_out_of_other_folders_are_refused(tmp_path: Path) -> None:
    (tmp_path / "secret").write_bytes(SECRET)
    folder = tmp_path / "model"
    folder.mkdir()
    (folder / "transforms.json").write_text('{"ply_file_path": "p.ply"}')
    (folder / "p.ply").symlink_to("../secret")
    with pytest.raises(FormatError, match="a link that leads out of it"):
        load_points(folder)
    (folder / "manifest.json").symlink_to("../secret")
    with pytest.raises(FormatError, match="a link that leads out of it"):
        Package.open(folder)
    assert inside(folder, "", folder, "transforms.json") == folder / "transforms.json"


@pytest.mark.parametrize("wrong", [SECRET, b"RIFF" + SECRET])
def test_a_plane_of_another_kind_is_not_quoted(tmp_path: Path, wrong: bytes) -> None:
    folder = write_files(tmp_path, sog_files(random_scene(50, 0)) | {"quats.webp": wrong})
    with pytest.raises(FormatError, match="lossless WebP") as caught:
        load_scene(folder)
    assert "hunter" not in str(caught.value)


COUNT = 5000
TEXTS = {
    "lists": "[" + "[]," * COUNT + "0]",
    "objects": "[" + "{}," * COUNT + "0]",
    "lists of one": "[" + "[0]," * COUNT + "0]",
    "objects of one": "[" + '{"":0},' * COUNT + "0]",
    "objects of their own keys": "[" + ",".join(f'{{"k{i}":0}}' for i in range(COUNT)) + "]",
    "keys": "{" + ",".join(f'"k{i}":0' for i in range(COUNT)) + "}",
    "floats": "[" + "1.5," * COUNT + "0]",
    "integers": "[" + "123456789012," * COUNT + "0]",
    "strings": "[" + '"ab",' * COUNT + "0]",
    "wide strings": "[" + '"\\ud83d\\ude00a",' * COUNT + "0]",
    "one wide string": '["' + "a" * COUNT + '\U0001f600"]',
    "six keys": "[" + '{"a":0,"b":0,"c":0,"d":0,"e":0,"f":0},' * COUNT + "0]",
    "deep": "[" * 300 + "]" * 300,
    "nested": "[" + "[[]]," * COUNT + "0]",
}


@pytest.mark.parametrize("text", TEXTS)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16", "utf-32"])
def test_the_bound_of_parsed_json_holds(text: str, encoding: str) -> None:
    data = TEXTS[text].encode(encoding)
    tracemalloc.start()
    try:
        value = json.loads(data)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert value
    assert peak - 4096 <= estimate_parsed_bytes(data)  # the parser itself takes a little


def test_json_is_refused_before_it_is_parsed(monkeypatch: pytest.MonkeyPatch) -> None:
    data = b"[" + b"[]," * 2_000_000 + b"0]"
    parse_json("a", b"[0]", Budget("a", 0))

    def never(*_: Any, **__: Any) -> Any:
        raise AssertionError("parsed")

    monkeypatch.setattr(json, "loads", never)
    with pytest.raises(FormatError, match="made to exhaust memory"):
        parse_json("a", data, Budget("a", 6000))


def test_a_small_zip_of_much_json_is_refused(tmp_path: Path) -> None:
    bomb = b'{"version": 2, "asset": [' + b"[]," * 2_000_000 + b"0]}"
    path = tmp_path / "a.sog"
    path.write_bytes(zip_bytes(sog_files(random_scene(50, 0)) | {"meta.json": bomb}, zipfile.ZIP_DEFLATED))
    assert path.stat().st_size < 100_000
    with pytest.raises(FormatError, match=r"JSON: .* exhaust memory"):
        load_scene(path)


def test_a_small_gzip_of_many_cells_is_refused(tmp_path: Path) -> None:
    row = b",".join([b"1"] * 8000) + b"\n"
    path = tmp_path / "a.csv.gz"
    path.write_bytes(gzip.compress(row * 300))
    with pytest.raises(FormatError, match=r"the cells of the table: .* exhaust memory"):
        load_path(path)


def store_of(path: Path, gaussians: int, cells: int) -> Path:
    """A store of next to nothing whose header promises much, every checksum right."""
    grid = {"cells": cells, "origin": [0, 0, 0], "cell_size": 1.0, "shape": [1, 1, 1], "up": [0, 0, 1]}
    header = {"format": FORMAT, "scene": "0", "gaussians": gaussians, "tau": 0.5, "class_edges": [0.5]}
    with path.open("wb") as file:
        writer = SectionWriter(file, FILE_KIND)
        writer.append(b"x")
        writer.close_section("coords")
        writer.finish(header | {"config": {}, "grid": grid})
    assert path.stat().st_size < 1000 + HEAD_BYTES
    return path


def test_counts_of_a_store_are_bounded_by_its_size(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"grid.cells: expected an integer from 1 to 100000"):
        VisibilityStore.open(store_of(tmp_path / "cells.pvs", 10, 1 << 30))
    with pytest.raises(FormatError, match=r"header: .* exhaust memory"):
        VisibilityStore.open(store_of(tmp_path / "gaussians.pvs", (1 << 31) - 1, 1))


def test_a_group_of_terms_is_bounded_by_the_size_of_the_file(tmp_path: Path) -> None:
    from gsvis.package import active_terms as module

    said = {"format": module.FORMAT, "version": module.VERSION, "cells": 1, "terms": 1, "gaussians": 1}
    said |= {
        "variant": "rgb",
        "epsilon": 0.1,
        "provenance": "",
        "weighted": False,
        "scene": "",
        "colors": "",
        "sets": "",
    }
    text = json.dumps(said).encode()
    schema = module._SCHEMA.with_metadata({b"gsvis": text, b"gsvis-crc32": b"%08x" % zlib.crc32(text)})
    path = tmp_path / "a.terms.arrow"
    columns = [[0], [0], [0], [0], [bytes(MIN_BUDGET + (16 << 20))]]
    arrays = [pa.array(column, field.type) for column, field in zip(columns, schema, strict=True)]
    with pa.OSFile(str(path), "wb") as sink:
        options = pa.ipc.IpcWriteOptions(compression="zstd")
        with pa.ipc.new_file(sink, schema, options=options) as writer:
            writer.write_batch(pa.record_batch(arrays, schema=schema))
    assert path.stat().st_size < 30_000
    with ActiveTerms.open(path) as terms, pytest.raises(FormatError, match=r"cell 0: .* exhaust memory"):
        terms.active(0)


def test_an_image_that_unpacks_to_far_more_than_its_size_is_refused(tmp_path: Path) -> None:
    from PIL import Image

    from gsvis.train._photo_files import read_sizes

    path = tmp_path / "black.png"
    Image.fromarray(np.zeros((6000, 6000), np.uint8)).save(path)
    assert path.stat().st_size < 200_000
    with pytest.raises(FormatError, match="exhaust memory"):
        read_sizes([path])
