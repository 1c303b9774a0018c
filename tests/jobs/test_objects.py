"""Stores of objects: a folder, fsspec, and stores that answer slowly, wrongly or not at all."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import Any

import pytest

fsspec = pytest.importorskip("fsspec")
from fsspec.implementations.memory import MemoryFileSystem  # noqa: E402

from gsvis.errors import BackendError, FormatError  # noqa: E402
from gsvis.jobs.objects import open_store  # noqa: E402


class FlexibleChecksumError(Exception):
    """Named as that of botocore."""


class Faulty(MemoryFileSystem):  # type: ignore[misc]
    """Does as a test says before each call."""

    protocol = "faulty"
    store: dict[str, Any] = {}
    pseudo_dirs = [""]
    fault = ""
    calls = 0

    def get_file(self, rpath: str, lpath: str, **options: Any) -> None:
        type(self).calls += 1
        if self.fault == "wrong" or (self.fault == "cut once" and self.calls == 1):
            Path(lpath).write_bytes(b"wrong")
            return
        self._fail()
        super().get_file(rpath, lpath, **options)

    def cat_file(self, path: str, start: Any = None, end: Any = None, **options: Any) -> Any:
        type(self).calls += 1
        self._fail()
        return super().cat_file(path, start, end, **options)

    def _fail(self) -> None:
        if self.fault == "slow":
            time.sleep(1.0)
        if self.fault == "checksum":
            raise FlexibleChecksumError("Expected checksum zDOvIQ== did not match")
        if self.fault == "down" or (self.fault == "down once" and self.calls == 1):
            raise ConnectionError("connection refused")


@pytest.fixture
def faulty() -> type[Faulty]:
    fsspec.register_implementation("faulty", Faulty, clobber=True)
    Faulty.fault, Faulty.calls = "", 0
    return Faulty


@pytest.fixture(params=["folder", "file", "memory"])
def address(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    paths = {"folder": str(tmp_path / "store"), "file": f"file://{tmp_path / 'store'}"}
    return paths.get(request.param, f"memory://{tmp_path.name}")


def test_objects_and_notes_come_back(address: str, tmp_path: Path) -> None:
    store = open_store(address)
    (tmp_path / "x").write_bytes(b"some bytes")
    found = store.put(tmp_path / "x")
    assert store.put(tmp_path / "x") == found
    assert store.has(found)
    assert not store.has((found[0], 3))
    again = open_store(store.address)
    assert again.path_of(found, tmp_path).read_bytes() == b"some bytes"
    assert again.note("key.json") is None
    store.keep_note("key.json", b"facts")
    assert again.note("key.json") == b"facts"
    with pytest.raises(FormatError, match="an object of the store"):
        store.path_of(("0" * 64, 3), tmp_path)
    with pytest.raises(ValueError, match="lower-case"):
        store.keep_note("../escape", b"")


def test_a_sweep_keeps_what_is_named(tmp_path: Path) -> None:
    store = open_store(tmp_path / "store")
    objects = []
    for k in range(3):
        (tmp_path / "x").write_bytes(b"%d" % k)
        objects.append(store.put(tmp_path / "x"))
        store.keep_note(f"n{k}", b"")
    store.sweep({"n1"}, {objects[1][0]})
    assert [store.has(each) for each in objects] == [False, True, False]
    assert [store.note(f"n{k}") for k in range(3)] == [None, b"", None]


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("down", "reading an object failed 3 times: ConnectionError: connection refused"),
        ("slow", "reading an object: no answer within 0.2 s"),
        ("wrong", "content that fits its name"),
        ("checksum", "content that fits its checksum, got bytes that do not fit it, when reading an object"),
    ],
)
def test_a_store_that_fails_gives_one_line(faulty: type[Faulty], tmp_path: Path, fault: str, message: str) -> None:
    (tmp_path / "x").write_bytes(b"some bytes")
    found = open_store("faulty://city").put(tmp_path / "x")
    # Only a store that answers slowly may meet the end of the patience, however busy the machine is.
    store = open_store("faulty://city", patience=0.2 if fault == "slow" else 120.0)
    faulty.fault = fault
    with pytest.raises((BackendError, FormatError), match=message):
        store.path_of(found, tmp_path / "cache")
    assert not list((tmp_path / "cache").iterdir())
    stuck = [thread for thread in threading.enumerate() if thread.name.startswith("gsvis-store")]
    assert stuck or fault != "slow"
    assert all(thread.daemon for thread in stuck)  # else the program could not end


@pytest.mark.parametrize("fault", ["down once", "cut once"])
def test_a_store_that_fails_once_is_asked_again(faulty: type[Faulty], tmp_path: Path, fault: str) -> None:
    store = open_store("faulty://city")
    (tmp_path / "x").write_bytes(b"some bytes")
    found = store.put(tmp_path / "x")
    faulty.fault = fault
    assert store.path_of(found, tmp_path / "cache").read_bytes() == b"some bytes"
    assert faulty.calls == 2


@pytest.mark.parametrize("fault", ["wrong", "checksum"])
def test_what_is_damaged_in_a_store_goes_so_that_the_next_run_makes_it_again(
    faulty: type[Faulty], tmp_path: Path, fault: str
) -> None:
    store = open_store("faulty://city")
    (tmp_path / "x").write_bytes(b"other bytes")
    found = store.put(tmp_path / "x")
    store.keep_note("key.json", b"facts")
    faulty.fault = fault
    with pytest.raises(FormatError, match="run the same again"):
        store.path_of(found, tmp_path / "cache")
    assert not store.has(found)
    assert store.note("key.json") == (None if fault == "checksum" else b"facts")


def test_a_note_that_is_cut_in_a_store_counts_as_missing(faulty: type[Faulty]) -> None:
    store = open_store("faulty://city")
    store.keep_note("key.json", b"facts")
    for path in [path for path in faulty.store if path.endswith("key.json")]:
        fsspec.filesystem("faulty").pipe_file(path, b"gvc")
    assert store.note("key.json") is None


def test_an_unknown_kind_of_store_is_refused() -> None:
    with pytest.raises(BackendError, match="no store can be opened there"):
        open_store("nosuchkind://city")
