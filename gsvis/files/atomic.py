"""Write files and folders atomically.

Data is written beside the destination under a hidden name, and moved into place at the end. So a crash, a full disk or
Ctrl-C leaves the old content untouched. A hidden name is `.NAME.gsvis-` and 12 hexadecimal digits; the first four
stand for the host. The writer holds a lock on it. Leftovers of a killed writer have no lock; the next writer of the
same destination on the same host removes them.
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
from gsvis.files.swap import swap_folder, take_owner

__all__ = ["atomic_folder", "atomic_path", "find_interrupted_moves", "remove_all_partials", "remove_partials"]

_NOTE = ".gsvis-moves"  # in a hidden folder: lists the files that are being moved
_OLD = ".gsvis-replaced"  # in a hidden folder: the files that are being replaced
_NO_HOST = "0000"  # in place of the host: never removed


@contextmanager
def atomic_path(path: str | os.PathLike[str], *, sweep: bool = True) -> Iterator[Path]:
    """Yield a temporary file that replaces `path` when the block succeeds; an error removes it.

    It takes the rights of the file that it replaces. Write into the existing temporary file. A block that removes and
    recreates it loses the lock.

    Args:
        path: The file to write; its folder is created if it is missing.
        sweep: First remove the leftovers of killed writers of the file. This lists the folder. For many files in one
            folder, pass False and call `remove_all_partials` once.

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
            _take_mode(target, partial)
            os.replace(partial, target)
        finally:
            partial.unlink(missing_ok=True)
            _close(descriptor)


@contextmanager
def atomic_folder(path: str | os.PathLike[str], *, last: tuple[str, ...] = ()) -> Iterator[Path]:
    """Yield a temporary folder whose files move into `path` when the block succeeds.

    Other files in `path` stay, so no file of a user is lost. Where the system can exchange two folders, all files
    appear in one step: a reader, and whoever finds the folder after a kill, sees the old result or the new one.
    Elsewhere, and where `path` is the current folder, which a shell would lose, files are replaced one by one and put
    back after an error. After a kill between two moves, a small note beside `path` lists the files that have moved.

    Args:
        path: The folder to fill; created if it is missing.
        last: Files that move after all others, in this order, where files move one by one; older ones are removed
            first. Use it for files that mark the folder complete. Names relative to the folder, with forward slashes.

    Yields:
        The folder to write to.

    Raises:
        OutputError: If the folder cannot be written.
        IsADirectoryError: If `path` has a folder where a file must go; no file moves.
        NotADirectoryError: If `path` has a file where a folder must go; no file moves.
    """
    target = _check.path("path", path)
    _make(target.parent, path)
    _remove(target, with_notes=False)  # keeps the notes of killed runs until this one succeeds
    with output_errors(path, target.parent):
        partial, descriptor = _new_folder(target)
    with output_errors(path, partial):
        try:
            yield partial
            _replace(partial, target, last)
        finally:
            with suppress(OSError):
                _settle(partial, target)
            _close(descriptor)
    remove_partials(target)


def remove_partials(path: str | os.PathLike[str]) -> None:
    """Remove the leftovers of killed writers of a file or folder on this host.

    Files of live processes stay, because they hold a lock. On a file system without locks, everything stays.

    Args:
        path: The destination of the writers.
    """
    _remove(_check.path("path", path), with_notes=True)


def remove_all_partials(folder: str | os.PathLike[str]) -> None:
    """Remove the leftovers of killed writers on this host of all files and folders in a folder; see `remove_partials`.

    Args:
        folder: The folder; it may be missing.
    """
    ours = re.compile(rf"\..+\.gsvis-{_host()}[0-9a-f]{{8}}(\.[^.]*)?", re.DOTALL)
    for name in _names(Path(folder)):
        if name.startswith(".") and ours.fullmatch(name):
            with suppress(OSError), _is_owned(Path(folder, name)) as owned:
                if owned:
                    _delete(Path(folder, name))


def find_interrupted_moves(path: str | os.PathLike[str]) -> set[str]:
    """Return the files that interrupted runs of `atomic_folder` moved into a folder, if they are unchanged since.

    Args:
        path: The folder.

    Returns:
        Names relative to the folder, with forward slashes.
    """
    target = _check.path("path", path)
    return {name for partial in _partials(target, "[0-9a-f]{4}") for name in _find_moved(partial, target)}


def _replace(partial: Path, target: Path, last: tuple[str, ...]) -> None:
    """Put all files of a folder into another, in one step if possible."""
    target.mkdir(exist_ok=True)
    places = {name: place for place, name in enumerate(last, 1)}
    sources = sorted(
        partial.rglob("*"), key=lambda source: (places.get(source.relative_to(partial).as_posix(), 0), source)
    )
    _check_destinations(partial, target, sources)
    for source in sources:
        if not source.is_dir():
            _take_mode(target / source.relative_to(partial), source)
    if swap_folder(partial, target):
        return
    _write_note(partial, target, [source for source in sources if not source.is_dir()])
    with _restored(partial, target, [source for source in sources if not source.is_dir()]):
        for name in last:  # a folder with an interrupted move has none of them
            (target / name).unlink(missing_ok=True)
        for source in sources:
            destination = target / source.relative_to(partial)
            if source.is_dir():
                destination.mkdir(exist_ok=True)
            else:
                os.replace(source, destination)
    (partial / _NOTE).unlink()


@contextmanager
def _restored(partial: Path, target: Path, sources: list[Path]) -> Iterator[None]:
    """Keep the files that a block replaces, and put them back and remove the note if it fails."""
    names = [source.relative_to(partial) for source in sources]
    before = {name for name in names if os.path.lexists(target / name)}
    for name in before:
        (partial / _OLD / name).parent.mkdir(parents=True, exist_ok=True)
        _link_or_copy(target / name, partial / _OLD / name)
    try:
        yield
    except BaseException:
        for name in names:
            if name in before:
                os.replace(partial / _OLD / name, target / name)
            elif not (partial / name).exists():  # it has moved
                (target / name).unlink(missing_ok=True)
        raise


def _take_mode(old: Path, new: Path) -> None:
    """Give a file the rights of the one that it replaces: a private result stays private."""
    with suppress(OSError):  # nothing is replaced, or the file system has no rights
        state = old.stat()
        if stat.S_ISREG(state.st_mode):
            take_owner(state, new)
            new.chmod(state.st_mode & 0o777)


def _link_or_copy(source: Path, destination: Path) -> None:
    """Link a file to a second place, or copy it if links are not possible."""
    try:
        os.link(source, destination, follow_symlinks=False)
    except (OSError, NotImplementedError):  # no links there, or none to links
        shutil.copy2(source, destination, follow_symlinks=False)


def _check_destinations(partial: Path, target: Path, sources: list[Path]) -> None:
    """Raise, before any move, if a file would replace a folder or a folder a file."""
    for source in sources:
        destination = target / source.relative_to(partial)
        if source.is_dir() and os.path.lexists(destination) and not destination.is_dir():
            raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), str(destination))
        if not source.is_dir() and destination.is_dir() and not destination.is_symlink():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(destination))


def _write_note(partial: Path, target: Path, files: list[Path]) -> None:
    """Write a note of the files to move and those that earlier runs moved; remove the notes of earlier runs."""
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
    """Return the target's files that a hidden folder's note lists and that are unchanged; none for a broken note."""
    try:
        note = json.loads(read_whole(partial / _NOTE))
        found = {name: _identity_or_none(target / name) for name in note}
        return {name: identity for name, identity in found.items() if identity is not None and identity in note[name]}
    except (FormatError, OSError, ValueError, TypeError):
        return {}


def _settle(partial: Path, target: Path) -> None:
    """Remove a hidden folder; if some of its files have moved, keep the note that lists them."""
    if not _find_moved(partial, target):
        _delete(partial)
        return
    for each in partial.iterdir():
        if each.name != _NOTE:
            _delete(each)


def _remove(target: Path, *, with_notes: bool) -> None:
    """Remove the leftovers of killed writers of a target."""
    for partial in _partials(target, _host()):
        with suppress(OSError), _is_owned(partial) as owned:
            if owned and with_notes:
                _delete(partial)
            elif owned:
                _settle(partial, target)


def _partials(target: Path, host: str) -> list[Path]:
    """Return the paths beside the target with a hidden name for it; `host` is a pattern of four digits."""
    file = f".{target.stem}.gsvis-"
    folder = f".{target.name}.gsvis-"
    ours = re.compile(
        rf"{re.escape(file)}{host}[0-9a-f]{{8}}{re.escape(target.suffix)}|{re.escape(folder)}{host}[0-9a-f]{{8}}"
    )
    names = [name for name in _names(target.parent) if name.startswith((file, folder)) and ours.fullmatch(name)]
    return [target.parent / name for name in sorted(names)]


def _names(folder: Path) -> list[str]:
    """Return the names in a folder; empty if it cannot be listed."""
    try:
        return os.listdir(folder)
    except OSError:
        return []


@cache
def _host() -> str:
    """Return four hexadecimal digits for this host; on some file systems a lock works within one host only."""
    digest = hashlib.sha256(os.fsencode(platform.node())).digest()
    return f"{1 + int.from_bytes(digest[:4], 'big') % 0xFFFF:04x}"  # never `_NO_HOST`


def _hidden(name: str, suffix: str = "", host: str = "") -> str:
    """Return a new hidden name for a temporary file beside a target."""
    return f".{name}.gsvis-{host or _host()}{secrets.token_hex(4)}{suffix}"


@contextmanager
def _is_owned(partial: Path) -> Iterator[bool]:
    """Yield whether a hidden file or folder has no live writer; if so, it is locked during the block."""
    with ExitStack() as stack:
        try:
            owned = try_lock(stack.enter_context(_open(partial))) == "held"
        except OSError:  # owned by another user, or removed meanwhile
            owned = False
        yield owned


@contextmanager
def _open(path: Path) -> Iterator[int]:
    """Yield the descriptor of a file or folder, opened to lock it; raise for links and anything else."""
    access = os.O_RDONLY if path.is_dir() else os.O_RDWR  # NFS cannot lock a file that is open for reading only
    descriptor = os.open(path, access | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0))
    try:
        mode = os.fstat(descriptor).st_mode
        if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
            raise OSError(errno.EINVAL, "neither a file nor a folder", str(path))
        yield descriptor
    finally:
        os.close(descriptor)


def _new_file(target: Path) -> tuple[Path, int | None]:
    """Create an empty file with a hidden name; return its path, and its descriptor if that holds a lock.

    Without a lock, its name gets `_NO_HOST`, so that no other writer removes it.
    """
    while True:
        partial = target.with_name(_hidden(target.stem, target.suffix))
        descriptor = os.open(partial, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666)  # default rights, unlike mkstemp's
        held = _lock(partial, descriptor)
        if held == "held" and _lets_others_write(partial):
            return partial, descriptor
        if held == "held":
            os.close(descriptor)
        if held != "lost":
            unlocked = target.with_name(_hidden(target.stem, target.suffix, _NO_HOST))
            with suppress(FileNotFoundError):  # removed by a sweep meanwhile
                partial.rename(unlocked)
                return unlocked, None


def _new_folder(target: Path) -> tuple[Path, int | None]:
    """Create an empty folder with a hidden name; return its path, and its descriptor if that holds a lock."""
    while True:
        partial = target.with_name(_hidden(target.name))
        partial.mkdir(0o700)
        descriptor: int | None = None
        with suppress(PermissionError):  # a system that cannot open folders
            descriptor = os.open(partial, os.O_RDONLY)
        held = "none" if descriptor is None else _lock(partial, descriptor)
        if held != "lost":
            return partial, descriptor if held == "held" else None


def _lock(partial: Path, descriptor: int) -> str:
    """Lock a new file or folder; return "held", "none" without locks, or "lost" if a sweep removed it meanwhile."""
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
    """Return whether a second descriptor can write to a locked empty file; on SMB (CIFS) it cannot."""
    try:
        with open(partial, "r+b", buffering=0) as file:
            file.write(b"0")
            file.truncate(0)
    except PermissionError:
        return False
    except OSError:  # such as a full disk: the writer will get this error too
        return True
    return True


def _delete(path: Path) -> None:
    """Delete a file or a folder; ignore errors."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def _close(descriptor: int | None) -> None:
    """Close a descriptor, if there is one."""
    if descriptor is not None:
        os.close(descriptor)


def _identity(path: Path) -> list[int]:
    """Return inode, size and modification time of a file: a rename keeps them, a write changes them."""
    found = path.stat()
    return [found.st_ino, found.st_size, found.st_mtime_ns]


def _identity_or_none(path: Path) -> list[int] | None:
    """Return the identity of a file; None if it cannot be read."""
    try:
        return _identity(path)
    except OSError:
        return None


def _make(folder: Path, path: str | os.PathLike[str]) -> None:
    """Create a folder and its parents; errors name `path`, which the user gave."""
    with output_errors(path, folder.absolute().anchor):
        folder.mkdir(parents=True, exist_ok=True)
