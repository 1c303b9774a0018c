"""Targets: static scenes, tables of scenes, and what worlds and prune keep: notes, rows, tables beyond, rounds."""

from __future__ import annotations

import hashlib
import json
import shutil
import struct
import zlib
from collections.abc import Callable
from functools import cache
from itertools import pairwise
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest

from gsvis.errors import BackendError
from gsvis.export.static import FORMAT, is_static
from gsvis.files.limits import digest_of
from gsvis.files.mapped import MappedArrays, write_arrays
from gsvis.files.sums import seal
from gsvis.jobs.graph import Result, find_result
from gsvis.jobs.objects import open_store
from gsvis.jobs.resume import KeptWork
from gsvis.package import Package
from gsvis.scene.procedural import random_scene
from gsvis.serve.sites import SCENE, Site
from gsvis.stream import StreamedScene
from gsvis.stream import kept as tables
from gsvis.train.importance import ROUNDS, read_rounds
from gsvis.world import rows
from gsvis.world.beyond import Beyond
from gsvis.world.manifest import BeyondTable, Piece
from tests.fuzz.asked import answer, asked_name
from tests.fuzz.cameras import files_in
from tests.fuzz.mutators import KINDS, change_bytes, change_json, mutate
from tests.fuzz.stores import CELLS, N, both_stores, sparse_store
from tests.fuzz.targets import Case, Target
from tests.package.worlds import levels_of
from tests.stream.worlds import package_of

__all__ = ["TARGETS"]

KEY = "0" * 64
"""Of the note of a task."""
_PAGE = 4096


def sites() -> list[Case]:
    """Static scenes, and what is asked of them."""
    files = {part: {"name": f"{part}-{k:016x}.bin", "bytes": 7} for k, part in enumerate(("records", "cells", "terms"))}
    whole = {"format": FORMAT, "version": 1, "gaussians": 12, "up": [0, 0, 1], "files": files, "levels": [["all", 12]]}
    rest = {row["name"]: f"bytes {k}".encode() for k, row in enumerate(files.values())}
    name = min(rest)
    texts = (f"bytes=2-4\n{name}", f"\n{name}", f"bytes=9-\n{name}", f"bytes=1-\n{SCENE}\nHEAD", "\nnone.bin")
    asked = [{SCENE: json.dumps(whole).encode(), **rest, "request.name": text.encode()} for text in texts]
    folder = {SCENE: asked[1][SCENE], f"{name}/x": b"", "request.name": f"\n{name}".encode()}  # in place of a file
    return [*asked, folder, {SCENE: json.dumps({"format": FORMAT, "files": {}}).encode()}]


def in_site(folder: Path, case: Case) -> None:
    if SCENE not in case:
        return
    is_static(folder)
    site = Site(folder)
    assert site.gaussians is None or site.gaussians >= 0
    assert all(Path(name).name == name and name not in (".", "..") for name in site.names)
    text = case.get("request.name", b"bytes=1-9\n" + SCENE.encode())
    private = len(text) % 2 == 0
    status, headers, body = answer(text, lambda request, name: site.respond(request, name, private=private))
    _, name, others = asked_name(text)
    if status == 200 and "HEAD" not in others:
        assert body == case[name]
        assert (
            answer(
                b"\n" + name.encode() + b"\nif-none-match: " + headers["etag"].encode(),
                lambda request, name: site.respond(request, name, private=private),
            )[0]
            == 304
        )


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
        return change_bytes(rng, data) if rng.random() < 0.2 else resealed(data, lambda said: change_json(rng, said))
    except (ValueError, struct.error):
        return change_bytes(rng, data)


def head_of(data: bytes) -> Any:
    """What the head of a file of arrays says."""
    return json.loads(data[24 : 16 + struct.unpack_from("<Q", data, 8)[0]])


def resealed(data: bytes, change: Callable[[Any], Any]) -> bytes:
    """A file of arrays with another head, what `change` returns or has changed in place, under a right checksum."""
    (length,), said = struct.unpack_from("<Q", data, 8), head_of(data)
    start = -(-(16 + length) // _PAGE) * _PAGE
    if len(data) < start:
        raise ValueError("the file is cut")
    changed = change(said)
    head = seal(json.dumps(said if changed is None else changed).encode())
    whole = data[:8] + struct.pack("<Q", len(head)) + head
    return whole + bytes(-len(whole) % _PAGE) + data[start:]


@cache
def streamed(variant: str) -> tuple[Case, bytes, bytes, bytes]:
    """A package, its tables, and what of them a scene has at the end: its header and its records."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        with package_of(folder / "p", 40, variant, stores=variant == "rgb") as package:
            scene, _ = tables.open_kept(package, folder / "t")
            found = scene.header, scene.records.parts.tobytes()
        (kept,) = (folder / "t").glob("*.tables")
        return files_in(folder / "p"), kept.read_bytes(), *found


def kept_tables() -> list[Case]:
    return [{"a.tables": streamed("rgb")[1]}, {"hsl.tables": streamed("hsl")[1]}]


def change_tables(rng: Random, case: Case, target: Target) -> Case:
    """Change the head, the arrays, their checksums or the length."""
    ((name, data),) = case.items()
    (length,) = struct.unpack_from("<Q", data, 8) if len(data) > 16 else (0,)
    end = min(16 + length, len(data))
    way = rng.randrange(6)
    if way == 0:
        return {name: data[: rng.randrange(len(data) + 1)]}
    if way == 1:
        return {name: data + rng.randbytes(rng.choice((1, 8, _PAGE)))}
    if way < 4:
        return {name: data[:end] + change_bytes(rng, data[end:])}
    return {name: change_bytes(rng, data[:end]) + data[end:]}


def in_kept_tables(folder: Path, case: Case) -> None:
    ((named, data),) = case.items()
    files, whole, header, records = streamed("hsl" if named.startswith("hsl") else "rgb")
    for name, content in files.items():
        path = folder / "p" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    with Package.open(folder / "p") as package:
        place = folder / "t" / (tables._key(package, 2e-3, None) + ".tables")
        place.parent.mkdir()
        if data == whole:  # under a right seal, tables of another package are made again
            place.write_bytes(resealed(whole, lambda said: said["facts"].update(identity=KEY)))
            tables.open_kept(package, folder / "t")
            assert place.stat().st_size == len(whole)
        shutil.copyfile(folder / named, place)
        scene, kept = tables.open_kept(package, folder / "t")
        assert isinstance(scene, StreamedScene)
        assert kept is not None
        assert (scene.header, scene.records.parts.tobytes()) == (header, records)
        assert place.stat().st_size == len(whole)


def notes() -> list[Case]:
    """The note of a task with its file; and notes that count as missing: what they name is no object, or not there."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        store = open_store(folder / "s")
        (folder / "rows.npz").write_bytes(b"rows of a tile")
        found = Result({"rows": store.put(folder / "rows.npz")}, {"spacings": [0.5], "sampled": True}, 1.0, 2.0, 3)
        made = []
        odd = ({"files": {"rows": row}} for row in (["x", 14], ["0" * 64, -1], ["0" * 64, 14]))
        for changes in ({}, *odd, {"seconds": -1.0}, {"peak": -1}, {"facts": {"a": np.nan}}):
            store.keep_note(f"{KEY}.json", json.dumps({**json.loads(found.to_json()), **changes}).encode())
            made.append(files_in(folder))
        return made


def change_note(rng: Random, data: bytes) -> bytes:
    """One change of a sealed JSON, mostly under a right checksum."""
    if rng.random() < 0.2 or len(data) < 8:
        return change_bytes(rng, data)
    changed = mutate(rng, "json", data[8:])
    return data[:4] + struct.pack("<I", zlib.crc32(changed)) + changed


def in_notes(folder: Path, case: Case) -> None:
    with pytest.raises(BackendError):
        open_store("nowhere://store")
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
        levels = path.read_bytes()
        rows.save_gaussians(path, g[:1])
        return [{"rows.npz": plain}, {"levels.npz": levels}, {"rows.npz": path.read_bytes()}]


def in_rows(folder: Path, case: Case) -> None:
    (name,) = case
    path = folder / name
    if name == "levels.npz":
        levels = rows.load_tile_levels(path)
        assert len(levels.first) == len(levels.last) == len(levels.union)
        assert len(levels.level(0)) <= len(levels.union)
        return
    alone = rows.load_gaussians(path)
    assert sorted(rows.content_order(alone).tolist()) == list(range(len(alone)))
    assert rows.median_spacing(alone) >= 0.0
    g = rows.load_rows([path, path])
    assert np.isfinite(g.means).all()
    assert sorted(rows.content_order(g).tolist()) == list(range(len(g)))
    assert rows.median_spacing(rows.flatten(g)) >= 0.0


TABLE = {"runs": [[0, 30], [40, N - 40]], "digest": None}
"""What a world says of a table of what lies beyond: runs of its first piece, and its digest; None if it is right."""


def beyonds() -> list[Case]:
    said = json.dumps(TABLE).encode()
    return [{"a.pvs": data, "table.json": said} for data in (both_stores()[0], sparse_store())]


def in_beyond(folder: Path, case: Case) -> None:
    path = folder / "a.pvs"
    try:
        said = json.loads(case["table.json"])
        runs = tuple((int(first), int(count)) for first, count in said["runs"])
        good = all(0 <= first < 1000 and 0 < count < 1000 for first, count in runs)
        good = good and all(first + count <= after for (first, count), (after, _) in pairwise(runs))
        digest = said["digest"] if isinstance(said["digest"], str) else None
    except (KeyError, ValueError, TypeError, OverflowError, RecursionError):
        good = False
    if not good:  # the manifest of a world has checked these
        runs, digest = ((0, 30), (40, N - 40)), None
    digest = digest_of(path) if digest is None and path.is_file() else digest or KEY
    table = BeyondTable(digest, len(case.get("a.pvs", b"")), (Piece(3, 0, runs), Piece(4, 1, ((5, 10),))))
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
FILES, JOBS, WORLD = "gsvis.files.", "gsvis.jobs.", "gsvis.world."

TARGETS = [
    Target("static-scene", sites, in_site, kinds={"request.name": "text"}, modules=("gsvis.serve.sites",), weight=0.5),
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
        modules=(JOBS + "objects", JOBS + "graph"),
        weight=0.5,
    ),
    Target("world-rows", row_files, in_rows, modules=(WORLD + "rows", FILES + "archive"), weight=0.5),
    Target(
        "beyond",
        beyonds,
        in_beyond,
        kinds={"a.pvs": "pvs"},
        modules=(WORLD + "beyond",),
        weight=0.5,
    ),
    Target(
        "rounds",
        rounds,
        in_rounds,
        modules=("gsvis.train.importance", JOBS + "resume"),
        weight=0.5,
        beginnings=("path: expected ",),  # another run's
    ),
]
