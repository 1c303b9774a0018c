"""Files and folders that appear whole or not at all.

Work is written beside its destination under a hidden name and moved into place at the end, so a crash, a full
disk or Ctrl-C leaves what was there before untouched. A hidden name is `.NAME.gsvis-` and 12 hexadecimal digits, and
its writer holds a lock on it: what SIGKILL leaves has no lock, and the next writer of the same destination removes it.
"""

from __future__ import annotations

import errno
import json
import os
import re
import secrets
import shutil
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from gsvis import _check
from gsvis.errors import FormatError
from gsvis.io._limits import read_whole
from gsvis.io.locks import try_lock
from gsvis.io.output import output_errors

__all__ = ["atomic_folder", "atomic_path", "interrupted_moves", "remove_partials"]

_NOTE = ".gsvis-moves"  # in a hidden folder whose files are on their way: which they are


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary path beside `path` that becomes `path` when the block ends well, and is removed otherwise.

    Write into the file that is there: a block that removes it and makes another loses the lock with it.

    Args:
        path: The file to write; its folder is made if it is missing.

    Yields:
        The path to write to, with the same suffix.

    Raises:
        OutputError: If the file cannot be written.
    """
    target = _check.path("path", path)
    _make(target.parent, path)
    remove_partials(target)
    with output_errors(path, target.parent):
        partial, descriptor = _new_file(target)
    with output_errors(path, partial):
        try:
            yield partial
            os.replace(partial, target)
        finally:
            partial.unlink(missing_ok=True)
            _close(descriptor)


@contextmanager
def atomic_folder(path: str | os.PathLike[str], *, last: str = "") -> Iterator[Path]:
    """A temporary folder whose files move into `path` when the block ends well.

    Files of the same name are replaced one by one; other files already in `path` stay: nothing a user made is lost.

    Args:
        path: The folder to fill; made if it is missing.
        last: Name of the file that moves after all others, for one that says that the folder is whole.

    Yields:
        The folder to write to.

    Raises:
        OutputError: If the folder cannot be written.
    """
    target = _check.path("path", path)
    _make(target.parent, path)
    _remove(target, with_notes=False)  # what a killed run had moved is known until this one has ended well
    with output_errors(path, target.parent):
        partial, descriptor = _new_folder(target)
    with output_errors(path, partial):
        try:
            yield partial
            target.mkdir(exist_ok=True)
            _move(partial, target, last)
        finally:
            if not (partial / _NOTE).exists():
                shutil.rmtree(partial, ignore_errors=True)
            _close(descriptor)
    remove_partials(target)


def remove_partials(path: str | os.PathLike[str]) -> None:
    """Remove what killed writers of a file or folder left beside it.

    What a live process writes stays: it holds a lock. Where the file system has no locks everything stays.

    Args:
        path: The file or folder that was to be written.
    """
    _remove(Path(path), with_notes=True)


def interrupted_moves(path: str | os.PathLike[str]) -> set[str]:
    """Files in a folder that `atomic_folder` had moved there when it was killed, and nobody has changed since.

    Args:
        path: The folder.

    Returns:
        Their names, relative to the folder, with forward slashes.
    """
    target = Path(path)
    found = set()
    for partial in _partials(target):
        try:
            note = json.loads(read_whole(partial / _NOTE))
            found |= {name for name, identity in note.items() if _identity_or_none(target / name) == identity}
        except (FormatError, OSError, ValueError, AttributeError):  # no note, or half of one: nothing was moved
            continue
    return found


def _move(partial: Path, target: Path, last: str) -> None:
    """Move all files of a folder into another, with a note beside them from before the first to after the last."""
    sources = sorted(partial.rglob("*"), key=lambda source: (source.name == last, source))
    files = [source for source in sources if not source.is_dir()]
    note, moved = partial / _NOTE, False
    note.write_text(
        json.dumps({source.relative_to(partial).as_posix(): _identity(source) for source in files}), encoding="utf-8"
    )
    try:
        for source in sources:
            destination = target / source.relative_to(partial)
            if source.is_dir():
                destination.mkdir(exist_ok=True)
            else:
                os.replace(source, destination)
                moved = True
    except BaseException:
        if not moved:  # else the note stays, and the folder with it, as after a kill
            note.unlink()
        raise
    note.unlink()


def _remove(target: Path, *, with_notes: bool) -> None:
    for partial in _partials(target):
        with suppress(OSError), _opened(partial) as descriptor:  # what is another user's stays
            if (with_notes or not (partial / _NOTE).exists()) and try_lock(descriptor) == "held":
                _delete(partial)


def _partials(target: Path) -> list[Path]:
    """Everything beside the target that has a hidden name of ours for it."""
    name = re.compile(re.escape(f".{target.stem}") + r"\.gsvis-[0-9a-f]{12}" + re.escape(target.suffix))
    folder = re.compile(re.escape(f".{target.name}") + r"\.gsvis-[0-9a-f]{12}")
    try:
        names = os.listdir(target.parent)
    except OSError:
        return []
    return [target.parent / each for each in sorted(names) if name.fullmatch(each) or folder.fullmatch(each)]


@contextmanager
def _opened(path: Path) -> Iterator[int]:
    """A file or a folder opened to be locked; nothing else is, and no link is followed."""
    descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0))
    try:
        mode = os.fstat(descriptor).st_mode
        if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
            raise OSError(errno.EINVAL, "neither a file nor a folder", str(path))
        yield descriptor
    finally:
        os.close(descriptor)


def _new_file(target: Path) -> tuple[Path, int | None]:
    """An empty file with a hidden name, and its descriptor if that holds a lock."""
    while True:
        partial = target.with_name(f".{target.stem}.gsvis-{secrets.token_hex(6)}{target.suffix}")
        descriptor = os.open(partial, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666)  # the usual rights, unlike mkstemp's
        if (held := _locked(partial, descriptor)) != "lost":
            return partial, descriptor if held == "held" else None


def _new_folder(target: Path) -> tuple[Path, int | None]:
    """An empty folder with a hidden name, and its descriptor if that holds a lock."""
    while True:
        partial = target.with_name(f".{target.name}.gsvis-{secrets.token_hex(6)}")
        partial.mkdir(0o700)
        descriptor: int | None = None
        with suppress(PermissionError):  # a system that opens no folders
            descriptor = os.open(partial, os.O_RDONLY)
        held = "none" if descriptor is None else _locked(partial, descriptor)
        if held != "lost":
            return partial, descriptor if held == "held" else None


def _locked(partial: Path, descriptor: int) -> str:
    """Lock what was just made: "held", "none" where there are no locks, or "lost" to one who swept it up meanwhile."""
    state = try_lock(descriptor)
    if state == "none":
        os.close(descriptor)
        return "none"
    try:
        if state == "held" and os.path.samestat(os.fstat(descriptor), os.stat(partial)):
            return "held"
    except FileNotFoundError:
        pass
    os.close(descriptor)
    with suppress(OSError):
        _delete(partial)
    return "lost"


def _delete(partial: Path) -> None:
    if partial.is_dir():
        shutil.rmtree(partial)
    else:
        partial.unlink()


def _close(descriptor: int | None) -> None:
    if descriptor is not None:
        os.close(descriptor)


def _identity(path: Path) -> list[int]:
    """What a file keeps when it is renamed and loses when it is written: its inode, size and time of change."""
    found = path.stat()
    return [found.st_ino, found.st_size, found.st_mtime_ns]


def _identity_or_none(path: Path) -> list[int] | None:
    try:
        return _identity(path)
    except OSError:
        return None


def _make(folder: Path, path: str | os.PathLike[str]) -> None:
    """Make a folder and those above it; `path` is what the user asked for."""
    with output_errors(path, folder.absolute().anchor):
        folder.mkdir(parents=True, exist_ok=True)
