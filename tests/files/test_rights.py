"""What replaces a file or a folder takes its rights; what is new has those of any new file."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest

from gsvis.files.atomic import atomic_folder, atomic_path

pytestmark = pytest.mark.skipif(os.name != "posix", reason="rights of POSIX")


@pytest.mark.parametrize("umask", [0o022, 0o077])
def test_files_have_the_rights_of_any_new_file(tmp_path: Path, umask: int) -> None:
    before = os.umask(umask)
    try:
        with atomic_path(tmp_path / "a") as partial:
            partial.write_text("")
        with atomic_folder(tmp_path / "f") as folder:
            (folder / "a").write_text("")
    finally:
        os.umask(before)
    for path, full in ((tmp_path / "a", 0o666), (tmp_path / "f", 0o777), (tmp_path / "f" / "a", 0o666)):
        assert stat.S_IMODE(path.stat().st_mode) == full & ~umask


@pytest.mark.parametrize("mode", [0o600, 0o640, 0o664, 0o444])
@pytest.mark.parametrize("can_swap", [True, False])
def test_what_replaces_a_file_takes_its_rights(
    tmp_path: Path, mode: int, can_swap: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not can_swap:
        monkeypatch.setattr("gsvis.files.atomic.swap_folder", lambda *_: False)
    (tmp_path / "out").mkdir(0o700)
    for file in (tmp_path / "a", tmp_path / "out" / "b"):
        file.write_text("old")
        file.chmod(mode)
    with atomic_path(tmp_path / "a") as partial:
        partial.write_text("new")
    with atomic_folder(tmp_path / "out") as folder:
        (folder / "b").write_text("new")
        (folder / "c").write_text("new")
    for file in (tmp_path / "a", tmp_path / "out" / "b"):
        assert (file.read_text(), stat.S_IMODE(file.stat().st_mode)) == ("new", mode)
    assert stat.S_IMODE((tmp_path / "out").stat().st_mode) == 0o700


@pytest.mark.parametrize("can_swap", [True, False])
def test_private_files_stay_private_where_owners_cannot_be_kept(
    tmp_path: Path, can_swap: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not can_swap:
        monkeypatch.setattr("gsvis.files.atomic.swap_folder", lambda *_: False)
    others = 1 + os.getuid()

    def refuse(path: Path, user: int, group: int) -> None:
        raise PermissionError

    (tmp_path / "out" / "sub").mkdir(0o700, parents=True)
    file = tmp_path / "out" / "sub" / "a"
    file.write_text("old")
    file.chmod(0o600)
    stated = Path.stat

    def of_another(path: Path, **more: bool) -> os.stat_result:
        state = stated(path, **more)
        return os.stat_result((*state[:4], others, *state[5:])) if path == file else state

    monkeypatch.setattr(Path, "stat", of_another)
    monkeypatch.setattr(os, "chown", refuse)
    with atomic_path(file) as partial:
        partial.write_text("new")
    assert stat.S_IMODE(stated(file).st_mode) == 0o600
    with atomic_folder(tmp_path / "out") as folder:
        (folder / "sub").mkdir()
        (folder / "sub" / "a").write_text("newer")
    assert (file.read_text(), stat.S_IMODE(stated(file).st_mode)) == ("newer", 0o600)
    assert stat.S_IMODE(stated(file.parent).st_mode) == 0o700
