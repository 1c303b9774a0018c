"""Folders among temporary files: private, never behind a link, and gone after a kill."""

from __future__ import annotations

import os
import re
import signal
import stat
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

import gsvis
from gsvis.cli import main
from gsvis.files.temporary import private_folder, temporary_folder

PROGRAM = """
import sys
from gsvis.files.temporary import temporary_folder
with temporary_folder() as folder:
    (folder / "large").write_bytes(bytes(1000))
    print(folder, flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)
    return tmp_path


def test_a_folder_is_gone_after_the_block_and_after_an_error(root: Path) -> None:
    with temporary_folder() as folder:
        assert stat.S_IMODE(folder.parent.stat().st_mode) == 0o700
        (folder / "file").touch()
    with pytest.raises(KeyboardInterrupt), temporary_folder():
        raise KeyboardInterrupt
    assert list(root.iterdir()) == []


def test_the_next_process_removes_what_a_killed_one_left_and_nothing_else(root: Path) -> None:
    (root / "gsvis-tmp-other").mkdir()  # without a lock: not ours to judge
    (root / "target").mkdir()
    (root / "gsvis-tmp-link").symlink_to(root / "target", target_is_directory=True)
    (root / "target" / ".gsvis-lock").touch()
    with subprocess.Popen(
        [sys.executable, "-c", PROGRAM], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:  # fmt: skip
        assert process.stdout is not None
        left = Path(process.stdout.readline().strip())
        with temporary_folder():
            assert left.is_dir()  # its owner lives
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert left.is_dir()
    with temporary_folder():
        assert not left.parent.exists()
    assert {path.name for path in root.iterdir()} == {"gsvis-tmp-other", "gsvis-tmp-link", "target"}
    assert (root / "target" / ".gsvis-lock").exists()


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="needs users")
def test_a_private_folder_is_one_of_this_user_or_a_new_one(root: Path) -> None:
    place = root / "gsvis-work-1"
    assert private_folder(place) == place
    assert stat.S_IMODE(place.stat().st_mode) == 0o700
    place.chmod(0o777)
    assert stat.S_IMODE(private_folder(place).stat().st_mode) == 0o700
    elsewhere = root / "elsewhere"
    elsewhere.mkdir(mode=0o755)
    (root / "link").symlink_to(elsewhere, target_is_directory=True)
    (root / "file").touch()
    (root / "broken").symlink_to(root / "nothing")
    for name in ("link", "file", "broken"):
        found = private_folder(root / name)
        assert found != root / name
        assert private_folder(root / name) == found  # one more folder, not one for each process
        assert (found.parent, stat.S_IMODE(found.lstat().st_mode)) == (root, 0o700)
    assert list(elsewhere.iterdir()) == []
    assert not (root / "nothing").exists()


@pytest.mark.skipif(not hasattr(os, "getuid") or os.getuid() != 0, reason="needs to make a folder of another user")
def test_a_folder_of_another_user_is_not_entered(root: Path) -> None:
    place = root / "gsvis-work-0"
    place.mkdir()
    os.chown(place, 12345, 12345)
    assert private_folder(place) != place


def test_every_temporary_folder_is_one_that_is_removed_after_a_kill() -> None:
    """Python's own folders and named files stay behind; only a file without a name does not."""
    package = Path(gsvis.__file__).parent
    made = re.compile(r"\b(TemporaryDirectory|NamedTemporaryFile|SpooledTemporaryFile|mkdtemp|mkstemp|mktemp)\(")
    users = [
        path.relative_to(package) for path in package.rglob("*.py") if made.search(path.read_text(encoding="utf-8"))
    ]
    assert users == [Path("files/temporary.py")]


def test_the_next_command_removes_what_a_killed_one_left(root: Path) -> None:
    left = root / "gsvis-tmp-abc123"
    (left / "files").mkdir(parents=True)
    (left / ".gsvis-lock").touch()
    assert main(["verify", str(root / "nothing.gsvis")]) == 2
    assert list(root.iterdir()) == []
