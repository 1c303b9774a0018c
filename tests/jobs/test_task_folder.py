"""The folder of a running task: nobody loses it to a worker that ends, and nothing is left of it."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import pytest

from gsvis.jobs import task_folder as work
from gsvis.jobs.objects import open_store
from gsvis.jobs.task_folder import work_folder

KEY = "0" * 64


def test_a_killed_attempt_leaves_its_folder_and_a_finished_one_none(tmp_path: Path) -> None:
    store = open_store(tmp_path)
    with pytest.raises(KeyboardInterrupt), work_folder(store, KEY) as folder:
        (folder / "half").write_bytes(b"half")
        raise KeyboardInterrupt
    with work_folder(store, KEY) as again, work_folder(store, KEY) as other:
        assert again == folder
        assert (again / "half").read_bytes() == b"half"
        assert other != folder  # a slow worker still holds it
        (again / "kept").mkdir()
        (again / "kept" / "more").write_bytes(b"")
    assert not list((tmp_path / "work").iterdir())


def test_a_worker_that_ends_takes_no_folder_from_the_one_that_follows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first ends after the second has opened its lock: the second needs a lock that is still there."""
    store, try_lock = open_store(tmp_path), work.try_lock
    first = work_folder(store, KEY)
    folder = first.__enter__()

    def end_first(descriptor: int) -> str:
        monkeypatch.setattr(work, "try_lock", try_lock)
        first.__exit__(None, None, None)
        return try_lock(descriptor)

    monkeypatch.setattr(work, "try_lock", end_first)
    with work_folder(store, KEY) as second:
        assert second == folder
        assert (folder / "lock").exists()
        with work_folder(store, KEY) as third:
            assert third != folder
    assert not list((tmp_path / "work").iterdir())


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="users of POSIX")
def test_users_of_a_machine_have_folders_of_their_own_where_the_store_is_elsewhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    folders = []
    for user in (7, 8):
        monkeypatch.setattr(os, "getuid", lambda user=user: user)
        with work_folder(open_store("memory://city"), KEY) as folder:
            folders.append(folder)
    assert folders[0].parent != folders[1].parent
    assert {each.parent.parent for each in folders} == {tmp_path}


def test_work_among_temporary_files_waits_a_day(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    store = open_store("memory://city")
    kept = {}
    for name in ("old", "new", "held"):
        with pytest.raises(KeyboardInterrupt), work_folder(store, name) as folder:
            raise KeyboardInterrupt
        kept[name] = folder
    with work_folder(store, "held"):
        for name in ("old", "held"):
            os.utime(kept[name] / "lock", (1.0, 1.0))
        with work_folder(store, "another"):
            pass
        assert [name for name, folder in kept.items() if folder.exists()] == ["new", "held"]
