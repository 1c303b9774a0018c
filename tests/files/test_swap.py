"""A folder that replaces another does so in one step: what a kill or an error leaves is the old one or the new one."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from gsvis.files import swap
from gsvis.files.atomic import atomic_folder

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="no exchange of folders")

OLD = {"a": "old", "b": "old", "sub/c": "old", "others/d": "somebody's", "e": "somebody's"}
NEW = {"a": "new", "b": "new", "sub/c": "new", "sub/f": "new"}


def write(folder: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)


def read(folder: Path) -> dict[str, str]:
    return {p.relative_to(folder).as_posix(): p.read_text() for p in folder.rglob("*") if p.is_file()}


@pytest.fixture
def out(tmp_path: Path) -> Path:
    write(tmp_path / "out", OLD)
    return tmp_path / "out"


def test_a_new_result_takes_the_place_of_an_old_one_and_others_stay(out: Path) -> None:
    (out / "link").symlink_to("e")
    out.chmod(0o751)
    (out / "others").chmod(0o750)
    (out / "sub").chmod(0o705)
    os.utime(out, (1e9, 1e9))
    before = (out / "e").stat().st_ino
    with atomic_folder(out) as partial:
        write(partial, NEW)
    assert read(out) == {**OLD, **NEW, "link": "somebody's"}
    assert (out / "link").is_symlink()
    assert (out / "e").stat().st_ino == before
    assert [folder.stat().st_mode & 0o777 for folder in (out, out / "others", out / "sub")] == [0o751, 0o750, 0o705]
    assert out.stat().st_mtime > 1e9  # it has changed
    assert [path.name for path in out.parent.iterdir()] == ["out"]


def test_a_kill_at_any_call_of_the_system_leaves_the_old_or_the_new(tmp_path: Path) -> None:
    """The process is killed before the k-th call that changes files, for every k."""
    code = """
import os, signal, sys
from pathlib import Path
from gsvis.files import swap
from gsvis.files.atomic import atomic_folder
left = [int(sys.argv[2])]
def counted(call):
    def wrapped(*args, **more):
        left[0] -= 1
        if left[0] < 0:
            os.kill(os.getpid(), signal.SIGKILL)
        return call(*args, **more)
    return wrapped
with atomic_folder(sys.argv[1]) as partial:
    (partial / "sub").mkdir()
    for name in ("a", "b", "sub/c", "sub/f"):
        (partial / name).write_text("new")
    swap._exchange = counted(swap._exchange)
    for name in ("replace", "rename", "link", "mkdir", "unlink", "rmdir"):
        setattr(os, name, counted(getattr(os, name)))
"""
    seen = set()
    for k in range(30):
        out = tmp_path / f"{k}" / "out"
        write(out, OLD)
        status = subprocess.run([sys.executable, "-c", code, out, str(k)], check=False).returncode
        now = read(out)
        assert now in (OLD, {**OLD, **NEW}), k
        seen.add(now == OLD)
        with atomic_folder(out) as partial:  # the next writer removes what the kill left
            write(partial, {"a": "newer"})
        assert [path.name for path in out.parent.iterdir()] == ["out"]
        assert status == -signal.SIGKILL
        if len(seen) == 2:
            break
    else:
        pytest.fail("the writer does not end")
    assert seen == {True, False}


@pytest.mark.parametrize("why", ["current", "below", "many", "no call", "no links"])
def test_files_move_one_by_one_where_folders_cannot_be_exchanged(
    out: Path, why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    inode = out.stat().st_ino
    if why in ("current", "below"):
        monkeypatch.chdir(out if why == "current" else out / "others")
    monkeypatch.setattr(swap, "_MOST", 1 if why == "many" else swap._MOST)
    if why == "no call":
        monkeypatch.setattr(swap, "_call", lambda: None)

    def fails(*_: object, **__: object) -> None:
        raise PermissionError

    if why == "no links":
        monkeypatch.setattr(os, "link", fails)
    with atomic_folder(out, last=("a",)) as partial:
        write(partial, NEW)
    assert read(out) == {**OLD, **NEW}
    assert out.stat().st_ino == inode
    assert [path.name for path in out.parent.iterdir()] == ["out"]


def test_a_folder_behind_a_link_is_replaced_and_the_link_stays(out: Path, tmp_path: Path) -> None:
    (tmp_path / "deep").mkdir()
    out.rename(tmp_path / "deep" / "real")
    out.symlink_to("deep/real")
    with atomic_folder(out) as partial:
        write(partial, NEW)
    assert out.is_symlink()
    assert read(out) == {**OLD, **NEW}


def test_a_link_to_a_folder_in_an_old_result_stays_and_its_folder_is_filled(out: Path, tmp_path: Path) -> None:
    (out / "sub").rename(tmp_path / "large")
    (out / "sub").symlink_to(tmp_path / "large")
    (tmp_path / "large" / "g").write_text("somebody's")
    with atomic_folder(out) as partial:
        write(partial, NEW)
    assert (out / "sub").is_symlink()
    assert read(tmp_path / "large") == {"c": "new", "f": "new", "g": "somebody's"}
    assert (out / "a").read_text() == "new"
