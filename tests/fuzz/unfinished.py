"""Targets: static scenes, tables of scenes, and what worlds and prune keep: notes, rows, tables beyond, rounds."""

from __future__ import annotations

import hashlib
import json
import shutil
import struct
import zlib
from functools import cache
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory

import numpy as np

from gsvis.export.static import FORMAT, is_static
from gsvis.files.limits import digest_of
from gsvis.files.mapped import MappedArrays, write_arrays
from gsvis.files.objects import open_store
from gsvis.files.resume import KeptWork, seal
from gsvis.package import Package
from gsvis.scene.procedural import random_scene
from gsvis.serve.sites import SCENE, Site
from gsvis.stream import StreamedScene
from gsvis.stream import kept as tables
from gsvis.train.importance import ROUNDS, read_rounds
from gsvis.world import rows
from gsvis.world.beyond import Beyond
from gsvis.world.graph import Result, find_result
from gsvis.world.manifest import BeyondTable, Piece
from tests.fuzz.cameras import files_in
from tests.fuzz.mutators import KINDS, change_bytes, change_json, mutate
from tests.fuzz.stores import CELLS, N, both_stores
from tests.fuzz.targets import Case, Target
from tests.package.worlds import levels_of
from tests.stream.worlds import package_of

__all__ = ["TARGETS"]

KEY = "0" * 64
"""Of the note of a task."""
_PAGE = 4096


def sites() -> list[Case]:
    files = {part: {"name": f"{part}-{k:016x}.bin", "bytes": 7} for k, part in enumerate(("records", "cells", "terms"))}
    whole = {"format": FORMAT, "version": 1, "gaussians": 12, "up": [0, 0, 1], "files": files, "levels": [["all", 12]]}
    return [{SCENE: json.dumps(about).encode()} for about in (whole, {"format": FORMAT, "files": {}})]


def in_site(folder: Path, case: Case) -> None:
    if SCENE not in case:
        return
    is_static(folder)
    site = Site(folder)
    assert site.gaussians is None or site.gaussians >= 0
    assert all(Path(name).name == name and name not in (".", "..") for name in site.names)


def arrays() -> list[Case]:
    rng = np.random.default_rng(0)
    made = {"a": rng.normal(size=(7, 3)), "b": np.arange(9, dtype=np.uint8), "none": np.zeros((0, 3), np.float32)}
    with TemporaryDirectory() as folder:
        path = Path(folder) / "a.tables"
        write_arrays(path, made, {"numbers": [1, 2], "identity": "x"})
        return [{path.name: path.read_bytes()}]


def in_arrays(folder: Path, case: Case) -> None:
    (name,) = case
    found = MappedArrays(folder / name)
    assert sum(array.nbytes for array in found.arrays.values()) < 1 << 30
    for array in found.arrays.values():
        assert array.tobytes() is not None
    found.release()


def change_mapped(rng: Random, data: bytes) -> bytes:
    """One change of a file of arrays: mostly of its head, under a right checksum and with as many bytes behind it."""
    try:
        _, length = struct.unpack_from("<8sQ", data)
        said = json.loads(data[24 : 16 + length])
        start = -(-(16 + length) // _PAGE) * _PAGE
    except (ValueError, struct.error):
        return change_bytes(rng, data)
    if rng.random() < 0.2 or len(data) < start:
        return change_bytes(rng, data)
    head = seal(json.dumps(change_json(rng, said)).encode())
    whole = data[:8] + struct.pack("<Q", len(head)) + head
    return whole + bytes(-len(whole) % _PAGE) + data[start:]


@cache
def streamed() -> tuple[Case, bytes, bytes, bytes]:
    """A package, its tables, and what of them a scene has at the end: its header and its records."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        with package_of(folder / "p", 40, "rgb") as package:
            scene, _ = tables.open_kept(package, folder / "t")
            found = scene.header, scene.parts.tobytes()
        (kept,) = (folder / "t").glob("*.tables")
        return files_in(folder / "p"), kept.read_bytes(), *found


def kept_tables() -> list[Case]:
    return [{"a.tables": streamed()[1]}]


def change_tables(rng: Random, case: Case, target: Target) -> Case:
    """Change the head as bytes, or the length; the arrays are under no checksum, to check them is to read them."""
    data = case["a.tables"]
    (length,) = struct.unpack_from("<Q", data, 8) if len(data) > 16 else (0,)
    end = min(16 + length, len(data))
    way = rng.randrange(4)
    if way == 0:
        return {"a.tables": data[: rng.randrange(len(data) + 1)]}
    if way == 1:
        return {"a.tables": data + rng.randbytes(rng.choice((1, 8, _PAGE)))}
    changed = change_bytes(rng, data[:end])
    return {"a.tables": changed + data[end:]}


def in_kept_tables(folder: Path, case: Case) -> None:
    files, whole, header, records = streamed()
    for name, data in files.items():
        path = folder / "p" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
    with Package.open(folder / "p") as package:
        place = folder / "t" / (tables._key(package, 2e-3, None) + ".tables")
        place.parent.mkdir()
        shutil.copyfile(folder / "a.tables", place)
        scene, kept = tables.open_kept(package, folder / "t")
        assert isinstance(scene, StreamedScene)
        assert kept is not None
        assert (scene.header, scene.parts.tobytes()) == (header, records)
        assert place.stat().st_size == len(whole)


def notes() -> list[Case]:
    with TemporaryDirectory() as name:
        folder = Path(name)
        store = open_store(folder / "s")
        (folder / "rows.npz").write_bytes(b"rows of a tile")
        found = Result({"rows": store.put(folder / "rows.npz")}, {"spacings": [0.5], "sampled": True}, 1.0, 2.0, 3)
        store.keep_note(f"{KEY}.json", found.to_json())
        return [files_in(folder)]


def change_note(rng: Random, data: bytes) -> bytes:
    """One change of a sealed JSON, mostly under a right checksum."""
    if rng.random() < 0.2 or len(data) < 8:
        return change_bytes(rng, data)
    changed = mutate(rng, "json", data[8:])
    return data[:4] + struct.pack("<I", zlib.crc32(changed)) + changed


def in_notes(folder: Path, case: Case) -> None:
    store = open_store(folder / "s")
    found = find_result(store, KEY)
    if found is None:
        return
    assert isinstance(found.facts, dict)
    assert len(found.digest) == 64
    assert found.seconds >= 0.0
    for stored in found.files.values():
        path = store.path_of(stored, folder / "cache")
        assert hashlib.sha256(path.read_bytes()).hexdigest() == stored[0]


def row_files() -> list[Case]:
    g = random_scene(np.random.default_rng(0), 12)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "rows.npz"
        rows.save_gaussians(path, g)
        plain = path.read_bytes()
        rows.save_tile_levels(path, levels_of(12))
        return [{"rows.npz": plain}, {"levels.npz": path.read_bytes()}]


def in_rows(folder: Path, case: Case) -> None:
    (name,) = case
    path = folder / name
    if name == "levels.npz":
        levels = rows.load_tile_levels(path)
        assert len(levels.first) == len(levels.last) == len(levels.union)
        assert len(levels.level(0)) <= len(levels.union)
        return
    g = rows.load_rows([path, path])
    assert np.isfinite(g.means).all()
    assert sorted(rows.content_order(g).tolist()) == list(range(len(g)))
    assert rows.median_spacing(rows.flatten(g)) >= 0.0


def in_beyond(folder: Path, case: Case) -> None:
    (name,) = case
    path = folder / name
    runs = ((0, 30), (40, N - 40))
    table = BeyondTable(digest_of(path), len(case[name]), (Piece(3, 0, runs), Piece(4, 1, ((5, 10),))))
    found = Beyond(path, table)
    try:
        for cell in range(min(len(found), CELLS)):
            for seen in found.of_cell(cell):
                assert seen.node in (3, 4)
                assert len(seen.ids) == len(seen.classes) > 0
                assert (np.diff(seen.ids) > 0).all()
        found.verify()
    finally:
        found.close()


SCHEDULE, COUNT = [30, 20, 12], 40
PLAN = {"counts": [20, 12]}


def rounds() -> list[Case]:
    found, left = [], np.full(COUNT, -1)
    with TemporaryDirectory() as folder:
        for number, size in enumerate(SCHEDULE):
            left[size : len(left) if number == 0 else SCHEDULE[number - 1]] = number
            values = np.linspace(1.0, 0.0, size)
            KeptWork(folder, PLAN).keep_own(ROUNDS, {"rounds": np.array([number + 1]), "left": left, "values": values})
            found.append(files_in(Path(folder)))
    return found


def in_rounds(folder: Path, case: Case) -> None:
    done, left, values = read_rounds(KeptWork(folder, PLAN), SCHEDULE, COUNT)
    assert 0 <= done <= len(SCHEDULE)
    assert left.shape == (COUNT,)
    assert -1 <= left.min() <= left.max() < max(done, 1)
    assert len(values) == (left < 0).sum() == (SCHEDULE[done - 1] if done else COUNT)
    assert np.isfinite(values).all()


KINDS.update({"mapped": change_mapped, "note": change_note})
FILES, WORLD = "gsvis.files.", "gsvis.world."

TARGETS = [
    Target("static-scene", sites, in_site, modules=("gsvis.serve.sites",), weight=0.5),
    Target("arrays", arrays, in_arrays, kinds={"a.tables": "mapped"}, modules=(FILES + "mapped",), weight=0.5),
    Target(
        "kept-tables",
        kept_tables,
        in_kept_tables,
        (),
        change=change_tables,
        modules=(FILES + "mapped", "gsvis.stream.kept"),
        weight=0.3,
        refuses=False,
    ),
    Target(
        "notes",
        notes,
        in_notes,
        kinds={f"s/notes/{KEY}.json": "note"},
        modules=(FILES + "objects", WORLD + "graph"),
        weight=0.5,
    ),
    Target("world-rows", row_files, in_rows, modules=(WORLD + "rows", FILES + "archive"), weight=0.5),
    Target(
        "beyond",
        lambda: [{"a.pvs": both_stores()[0]}],
        in_beyond,
        kinds={"a.pvs": "pvs"},
        modules=(WORLD + "beyond",),
        weight=0.5,
    ),
    Target(
        "rounds",
        rounds,
        in_rounds,
        modules=("gsvis.train.importance", FILES + "resume"),
        weight=0.5,
        beginnings=("path: expected ",),  # another run's
    ),
]
