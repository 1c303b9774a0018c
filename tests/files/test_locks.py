"""Locks exclude: with those of the system, with those of filelock where there is no fcntl, and with none at all."""

from __future__ import annotations

import errno
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import IO

import pytest

from gsvis.files.locks import lock_file, try_lock
from gsvis.jobs.resume import KeptWork
from gsvis.jobs.work_folder import WorkFolder

ROOT = Path(__file__).parents[2]
KINDS = ("system", "no fcntl", "no locks")
KILLED = """
import os, signal, sys
import filelock

def lock(descriptor, *, blocking):
    raise OSError(38, "no such function")

filelock.lock_descriptor, sys.modules["fcntl"] = lock, None
from gsvis.files.locks import lock_file
file = open(sys.argv[1], "a+")
assert lock_file(file)
os.kill(os.getpid(), signal.SIGKILL)
"""


def refuse(descriptor: int, *, blocking: bool) -> bool:
    raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS))


@pytest.fixture(params=KINDS)
def kind(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """The locks of this system, those that filelock has where there is no fcntl, or none."""
    import filelock  # has its own, as on Windows

    if request.param != "system":
        monkeypatch.setitem(sys.modules, "fcntl", None)
    if request.param == "no locks":
        monkeypatch.setattr(filelock, "lock_descriptor", refuse)
    return str(request.param)


def test_one_holds_a_lock_until_the_file_is_closed(kind: str, tmp_path: Path) -> None:
    first, second = (tmp_path / "a").open("a+"), (tmp_path / "a").open("a+")
    assert lock_file(first)
    assert not lock_file(second)
    first.write("what a lock keeps is written by who holds it")
    first.close()
    del first
    assert lock_file(second)
    second.close()
    del second
    left = {"a"}
    assert {path.name for path in tmp_path.iterdir()} == left
    assert (tmp_path / "a").read_text().endswith("holds it")


def test_locks_of_two_files_do_not_meet(kind: str, tmp_path: Path) -> None:
    with (tmp_path / "a").open("a+") as first, (tmp_path / "b").open("a+") as second:
        assert lock_file(first)
        assert lock_file(second)


def test_a_descriptor_shows_whether_there_are_locks(kind: str, tmp_path: Path) -> None:
    with (tmp_path / "a").open("a+") as first, (tmp_path / "a").open("a+") as second:
        states = [try_lock(first.fileno()), try_lock(second.fileno())]
    assert states == (["none", "none"] if kind == "no locks" else ["held", "busy"])


def test_work_of_two_runs_does_not_meet(kind: str, tmp_path: Path) -> None:
    mine, theirs = (WorkFolder(tmp_path / "a.gsvis") for _ in range(2))
    with mine.opened(), pytest.raises(ValueError, match=r"no other process"), theirs.opened():
        pass
    with theirs.opened():
        pass


def test_a_lock_on_a_folder_that_was_just_removed_is_taken_again(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = []

    def lock(file: IO[str]) -> bool:  # the process before removes its finished work between opening and locking
        calls.append(file.name)
        if len(calls) == 1:
            shutil.rmtree(Path(file.name).parent)
            Path(file.name).parent.mkdir()  # where there are no locks, a mark is written beside the file
        return lock_file(file)

    monkeypatch.setattr("gsvis.jobs.resume.lock_file", lock)
    first, second = KeptWork(tmp_path / "work", {}), KeptWork(tmp_path / "work", {})
    with first.opened():
        assert len(calls) == 2
        with pytest.raises(ValueError, match="no other process"), second.opened():
            pass
        first.keep("a", b"1")
        assert first.read("a") == b"1"


def test_a_lock_is_no_kept_entry_and_stays_until_the_work_ends(kind: str, tmp_path: Path) -> None:
    work = KeptWork(tmp_path / "a", {})
    with work.opened():
        assert work.names() == set()
    assert not work.folder.exists()
    mine, theirs = (WorkFolder(tmp_path / "a.gsvis") for _ in range(2))
    with mine.opened():
        mine.at("kept").touch()
        (mine.folder / "of another run").touch()
        mine.clear()
        assert mine.names() == {"kept"}
        with pytest.raises(ValueError, match=r"no other process"), theirs.opened():
            pass


@pytest.mark.skipif(os.name != "posix", reason="kills itself by a signal")
def test_without_locks_what_a_killed_process_held_is_free(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import filelock

    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    ended = subprocess.run([sys.executable, "-c", KILLED, str(tmp_path / "a")], env=environment, check=False)
    assert ended.returncode < 0
    assert (tmp_path / "a.lock").exists()
    monkeypatch.setitem(sys.modules, "fcntl", None)
    monkeypatch.setattr(filelock, "lock_descriptor", refuse)
    with (tmp_path / "a").open("a+") as file:
        assert lock_file(file)
