"""Files and folders that appear whole or not at all.

Work is written beside its destination under a hidden name and moved into place at the end, so a crash, a full
disk or Ctrl-C leaves what was there before untouched. A hidden name is `.NAME.gsvis-` and 12 hexadecimal digits, the
first four of them for the host. Its writer holds a lock on it: what SIGKILL leaves has no lock, and the next writer of
the same destination on the same host removes it.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import platform
import re
import secrets
import shutil
import stat
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import cache
from pathlib import Path

from gsvis import _check
from gsvis.errors import FormatError
from gsvis.files.limits import read_whole
from gsvis.files.locks import try_lock
from gsvis.files.output import output_errors

__all__ = ["atomic_folder", "atomic_path", "find_interrupted_moves", "remove_all_partials", "remove_partials"]

_NOTE = ".gsvis-moves"  # in a hidden folder whose files are on their way: which they are
_NO_HOST = "0000"  # in the place of the host: nobody removes it


@contextmanager
def atomic_path(path: str | os.PathLike[str], *, sweep: bool = True) -> Iterator[Path]:
    """A temporary path beside `path` that becomes `path` when the block ends well, and is removed otherwise.

    Write into the file that is there: a block that removes it and makes another loses the lock with it.

    Args:
        path: The file to write; its folder is made if it is missing.
        sweep: Whether to remove first what killed writers of the file left. This lists the folder, so leave it out for
            each of many files in one folder, and call `remove_all_partials` once.

    Yields:
        The path to write to, with the same suffix.

    Raises:
        OutputError: If the file cannot be written.
    """
    target = _check.path("path", path)
    _make(target.parent, path)
    if sweep:
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
def atomic_folder(path: str | os.PathLike[str], *, last: tuple[str, ...] = ()) -> Iterator[Path]:
    """A temporary folder whose files move into `path` when the block ends well.

    Files of the same name are replaced one by one; other files already in `path` stay: nothing a user made is lost.
    If an error comes between two moves, a small note beside `path` remembers which files have moved.

    Args:
        path: The folder to fill; made if it is missing.
        last: Names of the files that move after all others, in this order, for those that say that the folder is whole.

    Yields:
        The folder to write to.

    Raises:
        OutputError: If the folder cannot be written.
        IsADirectoryError: If `path` has a folder of the name of a file; no file moves.
        NotADirectoryError: If `path` has a file of the name of a folder; no file moves.
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
            with suppress(OSError):
                _settle(partial, target)
            _close(descriptor)
    remove_partials(target)


def remove_partials(path: str | os.PathLike[str]) -> None:
    """Remove what killed writers of a file or folder on this host left beside it.

    What a live process writes stays: it holds a lock. Where the file system has no locks everything stays.

    Args:
        path: The file or folder that was to be written.
    """
    _remove(_check.path("path", path), with_notes=True)


def remove_all_partials(folder: str | os.PathLike[str]) -> None:
    """Remove what killed writers of any file or folder on this host left in a folder, as `remove_partials` does.

    Args:
        folder: The folder; there may be none.
    """
    ours = re.compile(rf"\..+\.gsvis-{_host()}[0-9a-f]{{8}}(\.[^.]*)?", re.DOTALL)
    for name in _names(Path(folder)):
        if name.startswith(".") and ours.fullmatch(name):
            with suppress(OSError), _is_owned(Path(folder, name)) as owned:
                if owned:
                    _delete(Path(folder, name))


def find_interrupted_moves(path: str | os.PathLike[str]) -> set[str]:
    """Files in a folder that `atomic_folder` had moved there when it was cut short, and nobody has changed since.

    Args:
        path: The folder.

    Returns:
        Their names, relative to the folder, with forward slashes.
    """
    target = _check.path("path", path)
    return {name for partial in _partials(target, "[0-9a-f]{4}") for name in _find_moved(partial, target)}


def _move(partial: Path, target: Path, last: tuple[str, ...]) -> None:
    """Move all files of a folder into another, with a note beside them from before the first to after the last."""
    places = {name: place for place, name in enumerate(last, 1)}
    sources = sorted(partial.rglob("*"), key=lambda source: (places.get(source.name, 0), source))
    _check_destinations(partial, target, sources)
    _write_note(partial, target, [source for source in sources if not source.is_dir()])
    for source in sources:
        destination = target / source.relative_to(partial)
        if source.is_dir():
            destination.mkdir(exist_ok=True)
        else:
            os.replace(source, destination)
    (partial / _NOTE).unlink()


def _check_destinations(partial: Path, target: Path, sources: list[Path]) -> None:
    """Raise if a file is to replace a folder or a folder a file, while nothing has moved yet."""
    for source in sources:
        destination = target / source.relative_to(partial)
        if source.is_dir() and os.path.lexists(destination) and not destination.is_dir():
            raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), str(destination))
        if not source.is_dir() and destination.is_dir() and not destination.is_symlink():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(destination))


def _write_note(partial: Path, target: Path, files: list[Path]) -> None:
    """Note what is about to move and what earlier runs had moved, and remove the notes of those."""
    note = {source.relative_to(partial).as_posix(): [_identity(source)] for source in files}
    with ExitStack() as stack:
        earlier = [other for other in _partials(target, _host()) if stack.enter_context(_is_owned(other))]
        for other in earlier:
            for name, identity in _find_moved(other, target).items():
                note.setdefault(name, []).append(identity)
        (partial / _NOTE).write_text(json.dumps(note), encoding="utf-8")
        for other in earlier:
            with suppress(OSError):
                _delete(other)


def _find_moved(partial: Path, target: Path) -> dict[str, list[int]]:
    """Files of the target that the note in a hidden folder names and nobody changed since; half a note names none."""
    try:
        note = json.loads(read_whole(partial / _NOTE))
        found = {name: _identity_or_none(target / name) for name in note}
        return {name: identity for name, identity in found.items() if identity is not None and identity in note[name]}
    except (FormatError, OSError, ValueError, TypeError):
        return {}


def _settle(partial: Path, target: Path) -> None:
    """Remove a hidden folder; if some of its files have moved, all in it but the note that names them."""
    if not _find_moved(partial, target):
        _delete(partial)
        return
    for each in partial.iterdir():
        if each.name != _NOTE:
            _delete(each)


def _remove(target: Path, *, with_notes: bool) -> None:
    for partial in _partials(target, _host()):
        with suppress(OSError), _is_owned(partial) as owned:
            if owned and with_notes:
                _delete(partial)
            elif owned:
                _settle(partial, target)


def _partials(target: Path, host: str) -> list[Path]:
    """Everything beside the target that has a hidden name of ours for it; `host` is a pattern of four digits."""
    file, folder = f".{target.stem}.gsvis-", f".{target.name}.gsvis-"
    ours = re.compile(
        rf"{re.escape(file)}{host}[0-9a-f]{{8}}{re.escape(target.suffix)}|{re.escape(folder)}{host}[0-9a-f]{{8}}"
    )
    names = [name for name in _names(target.parent) if name.startswith((file, folder)) and ours.fullmatch(name)]
    return [target.parent / name for name in sorted(names)]


def _names(folder: Path) -> list[str]:
    """What is in a folder; nothing where it cannot be listed."""
    try:
        return os.listdir(folder)
    except OSError:
        return []


@cache
def _host() -> str:
    """Four hexadecimal digits for this host: on some file systems a lock holds for one host alone."""
    digest = hashlib.sha256(os.fsencode(platform.node())).digest()
    return f"{1 + int.from_bytes(digest[:4], 'big') % 0xFFFF:04x}"  # never `_NO_HOST`


def _hidden(name: str, suffix: str = "", host: str = "") -> str:
    return f".{name}.gsvis-{host or _host()}{secrets.token_hex(4)}{suffix}"


@contextmanager
def _is_owned(partial: Path) -> Iterator[bool]:
    """Whether a hidden file or folder has no live writer; if so it is locked during the block."""
    with ExitStack() as stack:
        try:
            owned = try_lock(stack.enter_context(_open(partial))) == "held"
        except OSError:  # another user's, or gone meanwhile
            owned = False
        yield owned


@contextmanager
def _open(path: Path) -> Iterator[int]:
    """A file or a folder opened to be locked; nothing else is, and no link is followed."""
    access = os.O_RDONLY if path.is_dir() else os.O_RDWR  # NFS locks no file that is open for reading alone
    descriptor = os.open(path, access | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0))
    try:
        mode = os.fstat(descriptor).st_mode
        if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
            raise OSError(errno.EINVAL, "neither a file nor a folder", str(path))
        yield descriptor
    finally:
        os.close(descriptor)


def _new_file(target: Path) -> tuple[Path, int | None]:
    """An empty file with a hidden name, and its descriptor if that holds a lock; without a lock nobody removes it."""
    while True:
        partial = target.with_name(_hidden(target.stem, target.suffix))
        descriptor = os.open(partial, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666)  # the usual rights, unlike mkstemp's
        held = _lock(partial, descriptor)
        if held == "held" and _lets_others_write(partial):
            return partial, descriptor
        if held == "held":
            os.close(descriptor)
        if held != "lost":
            unlocked = target.with_name(_hidden(target.stem, target.suffix, _NO_HOST))
            with suppress(FileNotFoundError):  # swept up meanwhile
                partial.rename(unlocked)
                return unlocked, None


def _new_folder(target: Path) -> tuple[Path, int | None]:
    """An empty folder with a hidden name, and its descriptor if that holds a lock."""
    while True:
        partial = target.with_name(_hidden(target.name))
        partial.mkdir(0o700)
        descriptor: int | None = None
        with suppress(PermissionError):  # a system that opens no folders
            descriptor = os.open(partial, os.O_RDONLY)
        held = "none" if descriptor is None else _lock(partial, descriptor)
        if held != "lost":
            return partial, descriptor if held == "held" else None


def _lock(partial: Path, descriptor: int) -> str:
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


def _lets_others_write(partial: Path) -> bool:
    """Whether a locked empty file takes what another descriptor writes; on SMB (CIFS) a lock keeps others out."""
    try:
        with open(partial, "r+b", buffering=0) as file:
            file.write(b"0")
            file.truncate(0)
    except PermissionError:
        return False
    except OSError:  # such as a full disk: the writer will meet it, too
        return True
    return True


def _delete(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


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
