"""Exchange two folders in one step if the system can, so that not even a kill leaves a mixture of both."""

from __future__ import annotations

import ctypes
import errno
import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

__all__ = ["swap_folder", "take_owner"]

_HERE = -100  # AT_FDCWD: paths are relative to the current folder
_MOST = 10_000  # files beside the result that are linked; a folder with more holds other things
_EXCHANGE = 2  # RENAME_EXCHANGE of Linux, RENAME_SWAP of macOS


def swap_folder(made: Path, target: Path) -> bool:
    """Replace an old folder by a new one in one step; return whether that was possible.

    Files that only the old folder has are first linked into the new one. Afterward `made` is the old folder, which the
    caller may remove. If the exchange is not possible, the old folder is unchanged.

    Args:
        made: The new folder, on the same file system. It and the folders in it get the rights of the old ones.
        target: The old folder.
    """
    place = Path(os.path.realpath(target))
    if _call() is None or _is_in_use(place) or not os.access(place, os.W_OK | os.X_OK):
        return False
    try:
        if sum(1 for _ in _missing_entries(place, made)) > _MOST:
            return False
        _keep_others(place, made)
        _take_rights(place, made)
        if not _exchange(made, place):
            return False
    except OSError:
        return False
    with suppress(OSError):
        _keep_others(made, place)  # files that were written meanwhile
    return True


def _missing_entries(old: Path, new: Path) -> Iterator[tuple[os.DirEntry[str], Path]]:
    """Yield the entries of a folder, at any depth, that a second folder lacks, and their places there.

    Raises:
        OSError: If another file system is mounted there, or a link leads to a folder whose files are to be replaced.
    """
    with os.scandir(old) as entries:
        for entry in entries:
            other = new / entry.name
            if entry.is_symlink() and _is_folder(other):
                raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), entry.path)
            is_new = not os.path.lexists(other)
            if is_new:
                yield entry, other
            if not entry.is_dir(follow_symlinks=False):
                continue
            if os.path.ismount(entry.path):
                raise OSError(errno.EXDEV, os.strerror(errno.EXDEV), entry.path)
            if is_new or _is_folder(other):
                yield from _missing_entries(Path(entry.path), other)


def _keep_others(old: Path, new: Path) -> None:
    """Link all files of a folder into a second folder, which has none of their names."""
    for entry, other in _missing_entries(old, new):
        if entry.is_dir(follow_symlinks=False):
            other.mkdir()
        else:
            os.link(entry.path, other, follow_symlinks=False)


def _take_rights(old: Path, new: Path) -> None:
    """Give a folder, and each folder in it that a second folder has too, the owner and rights of the second."""
    with os.scandir(old) as entries:
        for entry in entries:
            if entry.is_dir(follow_symlinks=False) and _is_folder(new / entry.name):
                _take_rights(Path(entry.path), new / entry.name)
    times = new.stat()
    take_owner(old.stat(), new)
    shutil.copystat(old, new)  # lists of rights too
    os.utime(new, ns=(times.st_atime_ns, times.st_mtime_ns))


def take_owner(old: os.stat_result, new: Path) -> None:
    """Give a file or folder the group and the owner of a second one, as far as this user may."""
    if not hasattr(os, "chown"):
        return
    state = new.stat()
    if state.st_gid != old.st_gid:
        with suppress(OSError):  # a member of both groups may
            os.chown(new, -1, old.st_gid)
    if state.st_uid != old.st_uid:
        with suppress(OSError):  # root may
            os.chown(new, old.st_uid, -1)


def _is_folder(path: Path) -> bool:
    return path.is_dir() and not path.is_symlink()


def _is_in_use(folder: Path) -> bool:
    """Return whether this process, and so maybe its shell, has its current folder in a folder."""
    try:
        here = Path(os.path.realpath(os.getcwd()))
    except OSError:
        return True
    return here == folder or folder in here.parents


def _exchange(a: Path, b: Path) -> bool:
    """Exchange the names of two folders; return whether the system did."""
    call = _call()
    if call is None:
        return False
    first = os.fsencode(a)
    second = os.fsencode(b)
    if sys.platform == "darwin":
        return bool(call(first, second, _EXCHANGE) == 0)
    return bool(call(_HERE, first, _HERE, second, _EXCHANGE) == 0)


@cache
def _call() -> Any:
    """Return the function of the C library; None if there is none."""
    if sys.platform == "win32":
        return None
    try:
        library = ctypes.CDLL(None, use_errno=True)
        return library.renamex_np if sys.platform == "darwin" else library.renameat2
    except (OSError, AttributeError):
        return None
