"""Files and folders that appear whole or not at all."""

from __future__ import annotations

import errno
import json
import os
import re
import signal
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from gsvis.files.atomic import (
    _NOTE,
    _host,
    atomic_folder,
    atomic_path,
    find_interrupted_moves,
    remove_all_partials,
    remove_partials,
)
from gsvis.files.locks import try_lock


def everything(folder: Path) -> list[str]:
    return sorted(str(p.relative_to(folder)) for p in folder.rglob("*"))


def test_a_file_appears_when_the_block_ends(tmp_path: Path) -> None:
    target = tmp_path / "deep" / "scene.ply"
    with atomic_path(target) as partial:
        assert partial.suffix == ".ply"
        assert partial.parent == target.parent
        partial.write_text("whole")
        assert not target.exists()
    assert target.read_text() == "whole"
    assert everything(tmp_path) == ["deep", "deep/scene.ply"]


@pytest.mark.parametrize("crash", [ValueError, KeyboardInterrupt, SystemExit])
def test_a_crash_leaves_the_old_file_and_nothing_else(tmp_path: Path, crash: type[BaseException]) -> None:
    target = tmp_path / "a.json"
    target.write_text("old")
    with pytest.raises(crash), atomic_path(target) as partial:
        partial.write_text("half")
        raise crash
    assert target.read_text() == "old"
    assert everything(tmp_path) == ["a.json"]


def test_a_block_may_make_the_file_anew_or_clean_up_itself(tmp_path: Path) -> None:
    with atomic_path(tmp_path / "a") as partial:
        partial.unlink()
        partial.write_text("new")
    assert (tmp_path / "a").read_text() == "new"
    with pytest.raises(ValueError, match="gave up"), atomic_path(tmp_path / "b") as partial:
        partial.unlink()
        raise ValueError("gave up")
    assert everything(tmp_path) == ["a"]


def test_two_writers_do_not_meet(tmp_path: Path) -> None:
    with atomic_path(tmp_path / "a") as first, atomic_path(tmp_path / "a") as second:
        assert first != second
        first.write_text("first")
        second.write_text("second")
    assert everything(tmp_path) == ["a"]


def test_a_folder_is_filled_when_the_block_ends(tmp_path: Path) -> None:
    target = tmp_path / "out"
    target.mkdir()
    (target / "mine.txt").write_text("kept")
    (target / "report.json").write_text("old")
    with atomic_folder(target) as partial:
        (partial / "plots").mkdir()
        (partial / "plots" / "cdf.png").write_text("png")
        (partial / "report.json").write_text("new")
        assert (target / "report.json").read_text() == "old"
    assert everything(tmp_path) == ["out", "out/mine.txt", "out/plots", "out/plots/cdf.png", "out/report.json"]
    assert (target / "report.json").read_text() == "new"


def test_a_crash_leaves_the_old_folder_and_nothing_else(tmp_path: Path) -> None:
    target = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt), atomic_folder(target) as partial:
        (partial / "half").write_text("")
        raise KeyboardInterrupt
    assert everything(tmp_path) == []
    target.mkdir()
    (target / "old").write_text("old")
    with pytest.raises(KeyboardInterrupt), atomic_folder(target) as partial:
        (partial / "old").write_text("half")
        raise KeyboardInterrupt
    assert everything(tmp_path) == ["out", "out/old"]
    assert (target / "old").read_text() == "old"


KILLED = """
import os, signal, sys
from gsvis.files.atomic import atomic_folder, atomic_path
kind, target = sys.argv[1:]
with {"file": atomic_path, "folder": atomic_folder}[kind](target) as partial:
    (partial if kind == "file" else partial / "half").write_text("half")
    os.kill(os.getpid(), signal.SIGKILL)
"""
posix = pytest.mark.skipif(os.name != "posix", reason="POSIX signals and locks")


def killed(kind: str, target: Path) -> None:
    done = subprocess.run([sys.executable, "-c", KILLED, kind, str(target)], check=False)
    assert done.returncode == -signal.SIGKILL


@posix
@pytest.mark.parametrize("kind", ["file", "folder"])
def test_what_a_kill_left_goes_with_the_next_writer(tmp_path: Path, kind: str) -> None:
    target = tmp_path / "a.sog"
    killed(kind, target)
    (left,) = tmp_path.iterdir()
    assert re.fullmatch(r"\.a(\.sog)?\.gsvis-[0-9a-f]{12}(\.sog)?", left.name)
    with atomic_path(tmp_path / "b.sog") as partial:  # of another file: it is not its business
        partial.write_text("b")
    assert left.exists()
    if kind == "file":
        with atomic_path(target) as partial:
            assert not left.exists()
            partial.write_text("a")
    else:
        with atomic_folder(target) as partial:
            assert not left.exists()
            (partial / "whole").write_text("a")
    assert {path.name for path in tmp_path.iterdir()} == {"a.sog", "b.sog"}


@posix
def test_partials_are_removed_on_request(tmp_path: Path) -> None:
    killed("file", tmp_path / "a.checkpoint")
    remove_partials(tmp_path / "a.checkpoint")
    remove_partials(tmp_path / "nowhere" / "a")
    assert everything(tmp_path) == []


@posix
def test_what_a_live_process_writes_stays(tmp_path: Path) -> None:
    code = "import sys; from gsvis.files.atomic import atomic_folder, atomic_path\n"
    code += "with atomic_path(sys.argv[1]) as p, atomic_folder(sys.argv[2]) as f:\n"
    code += "    print(p, f, flush=True); sys.stdin.read(); p.write_text('theirs'); (f / 'x').write_text('theirs')"
    file, folder = tmp_path / "a.ply", tmp_path / "out"
    with subprocess.Popen(
        [sys.executable, "-c", code, file, folder], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout is not None
        theirs = [Path(name) for name in other.stdout.readline().split()]
        with atomic_path(file) as partial, atomic_folder(folder) as mine:
            assert all(path.exists() for path in theirs)
            partial.write_text("mine")
            (mine / "x").write_text("mine")
        remove_partials(file)
        remove_partials(folder)
        assert all(path.exists() for path in theirs)
        other.communicate()  # its standard input ends: it goes on
    assert other.returncode == 0
    assert everything(tmp_path) == ["a.ply", "out", "out/x"]
    assert file.read_text() == (folder / "x").read_text() == "theirs"


@posix
def test_only_names_that_are_ours_are_removed(tmp_path: Path) -> None:
    names = [
        ".a-0123456789ab.sog", ".a.gsvis-0123456789ab.ply", ".a.gsvis-0123456789ag.sog", "a.gsvis-0123456789ab.sog",
        ".a.gsvis-0123456789abc.sog", ".b.gsvis-0123456789ab.sog", ".aa.gsvis-0123456789ab.sog", "a.sog.bak",
    ]  # fmt: skip
    for name in names:
        (tmp_path / name).write_text("mine")
    names = [re.sub("(?<=gsvis-)0123", _host(), name) for name in names]
    for name in names[1:]:
        (tmp_path / name).write_text("mine")
    names = everything(tmp_path)
    (tmp_path / f".a.gsvis-{_host()}456789aa.sog").symlink_to(tmp_path / "a.sog.bak")
    os.mkfifo(tmp_path / f".a.gsvis-{_host()}456789ac.sog")
    remove_partials(tmp_path / "a.sog")
    assert len(everything(tmp_path)) == len(names) + 2
    (tmp_path / f".a.gsvis-{_host()}456789ab.sog").write_text("a killed writer's")
    remove_partials(tmp_path / "a.sog")
    assert len(everything(tmp_path)) == len(names) + 2


@posix
def test_a_file_system_without_locks_keeps_everything(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    killed("file", tmp_path / "a")
    killed("folder", tmp_path / "a")
    left = everything(tmp_path)
    monkeypatch.setattr("gsvis.files.atomic.try_lock", lambda descriptor: "none")
    with atomic_path(tmp_path / "a") as partial:
        partial.write_text("a")
    with atomic_folder(tmp_path / "f") as folder:
        (folder / "x").write_text("x")
    assert everything(tmp_path) == sorted([*left, "a", "f", "f/x"])


@posix
def test_a_file_that_another_sweeps_up_before_it_is_locked_is_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    swept: list[Path] = []

    def lock(descriptor: int) -> str:
        if not swept:
            swept.append(next(path for path in tmp_path.iterdir()))
            swept[0].rmdir() if swept[0].is_dir() else swept[0].unlink()
        return try_lock(descriptor)

    monkeypatch.setattr("gsvis.files.atomic.try_lock", lock)
    with atomic_path(tmp_path / "a") as partial:
        partial.write_text("a")
    assert partial not in swept
    swept.clear()
    (tmp_path / "a").unlink()
    with atomic_folder(tmp_path / "a") as folder:
        (folder / "x").write_text("x")
    assert folder not in swept
    assert everything(tmp_path) == ["a", "a/x"]


@posix
def test_files_that_a_kill_left_moved_are_known_until_the_next_run_is_done(tmp_path: Path) -> None:
    code = "import os, signal, sys; from gsvis.files import atomic\nmoved = []\nmove = os.replace\n"
    code += "def replace(a, b):\n    moved.append(a)\n    len(moved) > 2 and os.kill(os.getpid(), signal.SIGKILL)\n"
    code += "    move(a, b)\natomic.os.replace = replace\natomic.swap_folder = lambda *_: False\n"
    code += "with atomic.atomic_folder(sys.argv[1], last=('map',)) as f:\n"
    code += "    for name in ('map', 'p', 'q', 'r'):\n        (f / name).write_text(name)\n"
    target = tmp_path / "out"
    assert subprocess.run([sys.executable, "-c", code, target], check=False).returncode == -signal.SIGKILL
    assert everything(target) == ["p", "q"]
    assert find_interrupted_moves(target) == {"p", "q"}
    (target / "q").write_text("somebody's")
    (target / "r").write_text("somebody's")
    assert find_interrupted_moves(target) == {"p"}
    with pytest.raises(KeyboardInterrupt), atomic_folder(target):
        raise KeyboardInterrupt
    assert find_interrupted_moves(target) == {"p"}
    with atomic_folder(target) as folder:
        (folder / "p").write_text("new")
    assert find_interrupted_moves(target) == set()
    assert everything(tmp_path) == ["out", "out/p", "out/q", "out/r"]


@pytest.mark.parametrize("fault", [KeyboardInterrupt, OSError(errno.EIO, os.strerror(errno.EIO))])
def test_where_files_move_one_by_one_an_error_puts_them_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fault: type[BaseException] | BaseException
) -> None:
    target, replace, moved, limits = tmp_path / "out", os.replace, list[Path](), list[int]()
    (target / "sub").mkdir(parents=True)
    old = {"p": "old p", "q": "old q", "sub/r": "old r", "map": "old map", "other": "somebody's"}
    for name, text in old.items():
        (target / name).write_text(text)

    def interrupted(source: Path, destination: Path) -> None:
        if len(moved) == limits[-1]:
            moved.append(source)
            raise fault
        moved.append(source)
        replace(source, destination)

    monkeypatch.setattr("gsvis.files.atomic.swap_folder", lambda *_: False)
    monkeypatch.setattr("gsvis.files.atomic.os.replace", interrupted)
    for limit in range(5):
        limits.append(limit)
        moved.clear()
        with pytest.raises((KeyboardInterrupt, OSError)), atomic_folder(target, last=("map",)) as folder:
            (folder / "sub").mkdir()
            for name in ("p", "q", "sub/r", "sub/new", "map"):
                (folder / name).write_text("new")
        assert {name: (target / name).read_text() for name in old} == old
        assert everything(tmp_path) == ["out", *sorted(f"out/{name}" for name in (*old, "sub"))]
    assert len(moved) > 5
    assert find_interrupted_moves(target) == set()


def test_where_files_move_one_by_one_the_last_ones_may_lie_in_folders(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    order, replace = list[str](), os.replace
    (tmp_path / "out" / "sub").mkdir(parents=True)
    for name in ("map", "sub/map"):
        (tmp_path / "out" / name).write_text("somebody's")

    def noted(source: Path, destination: Path) -> None:
        order.append(destination.relative_to(tmp_path / "out").as_posix())
        assert (tmp_path / "out" / "sub" / "map").exists() == ("sub/map" in order[:-1])
        replace(source, destination)

    monkeypatch.setattr("gsvis.files.atomic.swap_folder", lambda *_: False)
    monkeypatch.setattr("gsvis.files.atomic.os.replace", noted)
    with atomic_folder(tmp_path / "out", last=("sub/map", "page")) as folder:
        (folder / "sub").mkdir()
        for name in ("page", "sub/map", "sub/zero"):
            (folder / name).write_text("new")
    assert order == ["sub/zero", "sub/map", "page"]
    assert (tmp_path / "out" / "map").read_text() == "somebody's"


def hidden(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.name.startswith("."))


@posix
@pytest.mark.parametrize("note", ['{"p": [[1, 2', "[1]", "7", '{"p": 1}', '{"p": [[1, 2, 3]]}', '{"gone": [null]}'])
def test_a_note_that_is_cut_or_of_which_nothing_moved_is_no_note(tmp_path: Path, note: str) -> None:
    target = tmp_path / "out"
    target.mkdir()
    (target / "p").write_text("somebody's")
    left = tmp_path / f".out.gsvis-{_host()}01234567"
    left.mkdir()
    (left / "half").write_text("half")
    (left / _NOTE).write_text(note)
    assert find_interrupted_moves(target) == set()
    with pytest.raises(KeyboardInterrupt), atomic_folder(target):
        raise KeyboardInterrupt
    assert everything(tmp_path) == ["out", "out/p"]


def test_a_disk_that_is_full_for_the_note_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write = Path.write_text

    def full(path: Path, text: str, encoding: str = "utf-8") -> int:
        if path.name != _NOTE:
            return write(path, text, encoding)
        write(path, text[: len(text) // 2], encoding)
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("gsvis.files.atomic.swap_folder", lambda *_: False)
    monkeypatch.setattr(Path, "write_text", full)
    for _ in range(3):
        with pytest.raises(OSError, match="no space left"), atomic_folder(tmp_path / "out") as folder:
            (folder / "p").write_text("p")
        assert everything(tmp_path) == ["out"]


def test_a_folder_in_the_way_of_a_file_is_found_before_anything_moves(tmp_path: Path) -> None:
    target = tmp_path / "out"
    (target / "report.json").mkdir(parents=True)
    for _ in range(3):
        with pytest.raises(IsADirectoryError) as caught, atomic_folder(target) as folder:
            (folder / "a").write_text("a")
            (folder / "report.json").write_text("{}")
        assert caught.value.filename == str(target / "report.json")
        assert everything(tmp_path) == ["out", "out/report.json"]
    (target / "plots").write_text("somebody's")
    with pytest.raises(NotADirectoryError), atomic_folder(target) as folder:
        (folder / "a").write_text("a")
        (folder / "plots").mkdir()
        (folder / "plots" / "b").write_text("b")
    assert everything(tmp_path) == ["out", "out/plots", "out/report.json"]


@posix
def test_what_a_kill_between_moves_left_shrinks_to_its_note(tmp_path: Path) -> None:
    target = tmp_path / "out"
    target.mkdir()
    left = tmp_path / f".out.gsvis-{_host()}01234567"
    left.mkdir()
    (left / "half").write_text("half")
    (target / "p").write_text("p")
    found = (target / "p").stat()
    note = {"p": [[found.st_ino, found.st_size, found.st_mtime_ns]], "half": [[1, 2, 3]]}
    (left / _NOTE).write_text(json.dumps(note))
    with pytest.raises(KeyboardInterrupt), atomic_folder(target):
        raise KeyboardInterrupt
    assert everything(left) == [_NOTE]
    assert find_interrupted_moves(target) == {"p"}


@posix
def test_another_host_s_files_stay_and_its_moves_are_known(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target = tmp_path / "out"
    killed("file", target)
    killed("folder", target)
    (left,) = (path for path in hidden(tmp_path) if path.is_dir())
    target.mkdir()
    (target / "p").write_text("p")
    found = (target / "p").stat()
    (left / _NOTE).write_text(json.dumps({"p": [[found.st_ino, found.st_size, found.st_mtime_ns]]}))
    theirs, host = hidden(tmp_path), _host()
    assert all(f".gsvis-{host}" in path.name for path in theirs)
    with monkeypatch.context() as patched:  # its locks do not reach us
        patched.setattr("gsvis.files.atomic._host", lambda: "ffff" if host != "ffff" else "fffe")
        with atomic_folder(target) as folder:
            (folder / "q").write_text("q")
        remove_partials(target)
        remove_all_partials(tmp_path)
        assert hidden(tmp_path) == theirs
        assert find_interrupted_moves(target) == {"p"}
    remove_all_partials(tmp_path)
    assert everything(tmp_path) == ["out", "out/p", "out/q"]


@posix
def test_where_a_lock_keeps_other_descriptors_out_none_is_held(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As on SMB: while a descriptor holds a lock, a write through another fails."""
    opened, refused = open, []

    def smb(path: Path, mode: str, **more: int) -> object:
        with opened(path) as file:
            state = try_lock(file.fileno())
        if state == "busy":
            refused.append(path)
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
        return opened(path, mode, **more)  # type: ignore[call-overload]

    monkeypatch.setattr("gsvis.files.atomic.open", smb, raising=False)
    with atomic_path(tmp_path / "a.ply") as partial:
        assert refused == [path for path in refused if not path.exists()] != []
        with partial.open() as file:
            assert try_lock(file.fileno()) == "held"  # nobody else had it
        remove_partials(tmp_path / "a.ply")
        remove_all_partials(tmp_path)
        assert partial.exists()
        partial.write_text("whole")
    assert (tmp_path / "a.ply").read_text() == "whole"
    assert everything(tmp_path) == ["a.ply"]


@posix
def test_the_trial_of_a_lock_leaves_an_empty_file(tmp_path: Path) -> None:
    with atomic_path(tmp_path / "a") as partial:
        assert partial.read_bytes() == b""


@posix
def test_files_are_opened_for_writing_to_be_locked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As on NFS: an exclusive lock needs a descriptor that is open for writing."""
    import fcntl

    def nfs(descriptor: int) -> str:
        readable = fcntl.fcntl(descriptor, fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY
        return "none" if readable and stat.S_ISREG(os.fstat(descriptor).st_mode) else try_lock(descriptor)

    killed("file", tmp_path / "a")
    killed("folder", tmp_path / "b")
    monkeypatch.setattr("gsvis.files.atomic.try_lock", nfs)
    remove_partials(tmp_path / "a")
    remove_partials(tmp_path / "b")
    assert everything(tmp_path) == []


@posix
def test_partials_of_all_targets_of_a_folder(tmp_path: Path) -> None:
    killed("file", tmp_path / "c.tar.gz")
    killed("folder", tmp_path / ".d.json")
    digits = f"{_host()}01234567"
    for name in (f".a.gsvis-{digits}.sog", f".b.gsvis-{digits}", f"..d.gsvis-{digits}.json"):
        (tmp_path / name).write_text("half")
    names = sorted(
        [".profile", f".gsvis-{digits}", f"a.gsvis-{digits}", f".a.gsvis-{digits}8", f".a.gsvis-{digits}.b.c"]
    )
    for name in names:
        (tmp_path / name).write_text("mine")
    with atomic_path(tmp_path / "e") as partial:
        remove_all_partials(tmp_path)
        assert everything(tmp_path) == sorted([*names, partial.name])
        partial.write_text("e")
    remove_all_partials(tmp_path / "nowhere")


@posix
def test_a_writer_that_does_not_sweep_lists_no_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    killed("file", tmp_path / "a")
    (left,) = tmp_path.iterdir()
    with monkeypatch.context() as patched:
        patched.delattr("gsvis.files.atomic.os.listdir")
        with atomic_path(tmp_path / "a", sweep=False) as partial:
            partial.write_text("a")
    assert left.exists()
    with atomic_path(tmp_path / "a") as partial:
        assert not left.exists()
        partial.write_text("a")
