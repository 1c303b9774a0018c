"""Create temporary folders that only their owner can enter and that are removed even after a kill.

A folder of a block holds a lock while its process lives. Whoever makes the next one, and every command when it starts,
removes those without a live owner.
"""

from __future__ import annotations

import logging
import os
import re
import shutil
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from gsvis.files.locks import try_lock

__all__ = ["private_folder", "remove_abandoned", "temporary_folder"]

_PREFIX = "gsvis-tmp-"
_LOCK = ".gsvis-lock"
_OURS = re.compile(rf"{_PREFIX}[a-z0-9_]+")
_LOG = logging.getLogger(__name__)


@contextmanager
def temporary_folder(root: Path | None = None) -> Iterator[Path]:
    """Yield an empty folder for this block, and remove it afterward; first remove those of killed processes.

    Args:
        root: Where to make it; None takes the place for temporary files.

    Raises:
        OSError: If it cannot be made there.
    """
    root = Path(tempfile.gettempdir()) if root is None else root
    remove_abandoned(root)
    while True:
        folder = Path(tempfile.mkdtemp(prefix=_PREFIX, dir=root))
        with suppress(FileNotFoundError):  # another process has taken it for abandoned
            descriptor = os.open(folder / _LOCK, os.O_CREAT | os.O_RDWR, 0o600)
            state = try_lock(descriptor)
            if state != "none" and _is_there(folder, descriptor):
                break
            if state == "none":  # a file system without locks: nobody removes it but us
                (folder / _LOCK).unlink()
                break
            os.close(descriptor)
    inner = folder / "files"
    try:
        inner.mkdir()
        yield inner
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(descriptor)


def private_folder(path: Path) -> Path:
    """Return a folder among temporary files that only this user can enter; a new one if the usual one is not usable.

    It is made with mode 700. A link, a file, or a folder of another user is never used, since its owner could put links
    in it.

    Raises:
        OSError: If no folder can be made.
    """
    with suppress(FileExistsError):
        path.mkdir(mode=0o700)
    found = path.lstat()
    if not _is_own_folder(found):
        other = _other_folder(path)
        _LOG.warning("%s is no folder of this user; %s takes its place", path, other)
        return other
    if hasattr(os, "getuid") and stat.S_IMODE(found.st_mode) != 0o700:
        path.chmod(0o700)
    return path


def _is_own_folder(found: os.stat_result) -> bool:
    """Return whether a path is a folder of this user, by its status without following links."""
    return stat.S_ISDIR(found.st_mode) and (not hasattr(os, "getuid") or found.st_uid == os.getuid())


def _other_folder(path: Path) -> Path:
    """Return a substitute folder of this user: the one used last time, or a new one."""
    ours = re.compile(rf"{re.escape(path.name)}-[a-z0-9_]{{8}}")
    for name in sorted(_names(path.parent)):
        if ours.fullmatch(name):
            with suppress(OSError):
                found = (path.parent / name).lstat()
                if _is_own_folder(found) and stat.S_IMODE(found.st_mode) == 0o700:
                    return path.parent / name
    return Path(tempfile.mkdtemp(prefix=f"{path.name}-", dir=path.parent))


def remove_abandoned(root: Path | None = None) -> None:
    """Remove the folders of this user whose processes were killed.

    Args:
        root: Where they are; None means the place for temporary files.
    """
    try:
        root = Path(tempfile.gettempdir()) if root is None else root
    except OSError:  # there is none
        return
    for name in _names(root):
        folder = root / name
        if not _OURS.fullmatch(name):
            continue
        with suppress(OSError):
            if not _is_own_folder(folder.lstat()):
                continue
            descriptor = os.open(folder / _LOCK, os.O_RDWR | getattr(os, "O_NOFOLLOW", 0))
            try:
                if try_lock(descriptor) == "held":
                    shutil.rmtree(folder, ignore_errors=True)
            finally:
                os.close(descriptor)


def _names(root: Path) -> list[str]:
    """Return the names in a folder; empty if it cannot be listed."""
    try:
        return os.listdir(root)
    except OSError:
        return []


def _is_there(folder: Path, descriptor: int) -> bool:
    """Return whether the locked file still exists in the folder."""
    return os.path.samestat(os.fstat(descriptor), os.stat(folder / _LOCK))
