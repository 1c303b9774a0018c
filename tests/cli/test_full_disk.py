"""Every command that writes, where it cannot: one line with path and remedy, nothing lost, nothing half-written."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from gsvis.cli import main
from gsvis.errors import GsvisError, OutputError
from tests import warm_start
from tests.cli.every_command import COMMANDS, at_their_smallest, make_world

pytestmark = pytest.mark.usefixtures("blank_plots")
Capture = pytest.CaptureFixture[str]
# What is kept of unfinished work, and parts that lie there already.
RESUMED = (".partial-", ".checkpoint", ".gsvis", ".gsworld.work")


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """What the commands read."""
    return make_world(tmp_path_factory.mktemp("world"), tmp_path_factory.mktemp("photos"))


@pytest.fixture(scope="module", autouse=True)
def _smallest(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with at_their_smallest(tmp_path_factory.mktemp("viewer")):
        yield


@contextmanager
def small_files(most: int) -> Iterator[None]:
    """No file can grow past so many bytes: the system refuses the write itself, whoever makes it."""
    resource = pytest.importorskip("resource")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (most, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def contents(folder: Path) -> dict[str, bytes]:
    """What a folder holds, without what is kept of unfinished work."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    names = {path.relative_to(folder).as_posix(): path for path in files}
    return {name: path.read_bytes() for name, path in names.items() if not any(part in name for part in RESUMED)}


def read_error(capsys: Capture) -> str:
    """The one line of the error; nothing on stdout."""
    out, err = capsys.readouterr()
    lines = [line for line in err.splitlines() if line.startswith("gsvis: error: ")]
    assert out == ""
    assert len(lines) == 1, err
    assert "Traceback" not in err
    return lines[0]


@pytest.mark.parametrize("name", COMMANDS)
def test_a_disk_that_takes_no_more_costs_nothing(
    name: str, world: dict[str, Path], tmp_path: Path, capsys: Capture
) -> None:
    out = tmp_path / "out"
    words = [word.format(out=out, **world) for word in COMMANDS[name].split()]
    out.mkdir()
    with small_files(0):  # kernels are not compiled yet: nothing long begins where nothing can be written
        code = main(words)
    assert code == 1
    line = read_error(capsys)
    assert str(out) in line
    assert "cannot be written: file too large" in line
    assert "ulimit -f" in line
    assert contents(out) == {}
    assert main(words) == 0
    before = contents(out)
    capsys.readouterr()
    if name == "prepare":
        (out / "a.gsvis" / "manifest.json").unlink()
        words += ["--face-size", "18"]
    if name == "pvs":
        words += ["--tau", "0.01"]
    with small_files(300):  # the first bytes go in
        assert main(words) == 1
    assert str(tmp_path) in read_error(capsys)  # it may be the folder beside OUT that keeps unfinished work
    assert contents(out) == before
    assert main(words) == 0


@pytest.mark.parametrize(
    ("code", "remedy"),
    [
        (errno.ENOSPC, "make room"),
        (errno.EDQUOT, "make room"),
        (errno.EROFS, "another folder"),
        (errno.EACCES, "rights"),
        (errno.EIO, "check the disk"),
    ],
)
def test_each_fault_has_its_remedy(
    code: int, remedy: str, world: dict[str, Path], tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "a.ply"
    out.write_bytes(b"mine")

    def full(source: object, target: object) -> None:
        raise OSError(code, os.strerror(code), str(source))

    with monkeypatch.context() as patched:
        patched.setattr("gsvis.files.atomic.os.replace", full)
        assert main(["convert", str(world["ply"]), str(out), "--overwrite"]) == 1
    line = read_error(capsys)
    assert line.startswith(f"gsvis: error: {out}: cannot be written: {os.strerror(code).lower()}; ")
    assert remedy in line
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {"a.ply": b"mine"}


@pytest.mark.parametrize(
    "command",
    [
        "render {ply} -o {out}/a.gif --orbit 2 --depth --width 64 --height 48",
        "export {package} -o {out}/a.html --format html --overwrite",
    ],
    ids=["render", "export"],
)
def test_temporary_files_that_do_not_fit_are_named(
    command: str, world: dict[str, Path], tmp_path: Path, capsys: Capture
) -> None:
    words = [word.format(out=tmp_path, **world) for word in command.split()]
    assert main(words) == 0
    before = contents(tmp_path)
    capsys.readouterr()
    with small_files(300):
        assert main(words) == 1
    assert "TMPDIR" in read_error(capsys)
    assert contents(tmp_path) == before


def test_a_full_standard_output_is_reported(world: dict[str, Path]) -> None:
    full = Path("/dev/full")
    if not full.exists():
        pytest.skip("no /dev/full here")
    for words in (["inspect", str(world["ply"])], ["inspect", str(world["ply"]), "--json"], ["--help"], ["--version"]):
        with full.open("w") as stdout:
            command = [sys.executable, "-m", "gsvis", *words]
            done = warm_start.run(command, stdout=stdout, stderr=subprocess.PIPE, text=True)
        assert done.returncode == 1
        *progress, error = done.stderr.splitlines()
        assert error.startswith("gsvis: error: standard output: cannot be written: no space left on device")
        assert all(
            line.startswith("gsvis: finding navigable space") for line in progress
        )  # said where it takes seconds


def test_an_output_error_is_an_oserror_with_its_parts() -> None:
    error = OutputError("a/b.ply", errno.ENOSPC, "3 of 12 cells are kept")
    assert isinstance(error, OSError)
    assert isinstance(error, GsvisError)
    assert (error.errno, error.filename, error.path, error.kept) == (
        errno.ENOSPC,
        "a/b.ply",
        "a/b.ply",
        "3 of 12 cells are kept",
    )
    assert "; 3 of 12 cells are kept; make room" in str(error)
    assert error.keeping("other").kept == error.kept
