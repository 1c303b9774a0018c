"""Report files that cannot be written: `OutputError` carries the path and a remedy as attributes.

The error number decides, never the text. A full disk counts for any path. Missing permissions and broken disks count
only below the path that is being written, because the block may also read.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gsvis.errors import OutputError

__all__ = ["TEMPORARY", "check_file", "check_folder", "check_writable", "keeping", "output_errors"]

TEMPORARY = "make room there, or name a folder for temporary files on another disk in TMPDIR"
"""Remedy if the temporary files of a command do not fit."""

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_FORBIDDEN = (errno.EROFS, errno.EACCES, errno.EPERM, errno.EIO)


@contextmanager
def output_errors(path: str | os.PathLike[str], *inside: str | os.PathLike[str], remedy: str = "") -> Iterator[None]:
    """Raise OutputError for `path` if a write in the block fails.

    Args:
        path: The file or folder that the user knows.
        inside: Temporary files and folders that are written in its place.
        remedy: What the user can do; empty means the usual remedy of the error.

    Raises:
        OutputError: If the disk is full, or `path` may not be written.
    """
    try:
        yield
    except OSError as error:
        code = error.errno
        if code not in _FULL and code not in _FORBIDDEN:
            raise
        name = error.filename if isinstance(error.filename, str | bytes) else None  # a file name can be a descriptor
        named = None if name is None else Path(os.fsdecode(name)).absolute()
        if named is None:  # reads and writes fail without a name, but only writes fail on a full disk
            ours = code in _FULL
        else:
            ours = any(named.is_relative_to(Path(place).absolute()) for place in (path, *inside))
        if ours and not (isinstance(error, OutputError) and error.path == os.fspath(path)):
            kept = error.kept if isinstance(error, OutputError) else ""
            raise OutputError(path, code, kept, remedy) from error
        if isinstance(error, OutputError) or code in _FORBIDDEN:
            raise
        raise OutputError(os.fsdecode(error.filename), code) from error


@contextmanager
def keeping(text: str) -> Iterator[None]:
    """Add a text about kept work to an OutputError of the block, unless it has one."""
    try:
        yield
    except OutputError as error:
        raise error.keeping(text) from error


def check_writable(folder: str | os.PathLike[str]) -> None:
    """Raise unless a file can be written into an existing folder. Leaves no file.

    Raises:
        OutputError: If no file can be written there.
    """
    import tempfile

    with output_errors(folder), tempfile.TemporaryFile(dir=folder) as file:
        file.write(b"0")
        file.flush()


def check_file(path: str | os.PathLike[str]) -> None:
    """Raise unless a file can be written; leave no file behind.

    Raises:
        ValueError: If the path is a folder, or a folder above it is a file.
        OutputError: If nothing can be written there.
    """
    if Path(path).is_dir():
        raise ValueError(f"{path}: expected the name of a file, got a folder; name a file in it")
    check_folder(Path(path).absolute().parent)


def check_folder(path: str | os.PathLike[str]) -> None:
    """Raise unless files can be written into a folder, which may not exist yet; leave no file behind.

    Raises:
        ValueError: If the path, or a folder above it, is a file.
        OutputError: If nothing can be written there.
    """
    folder = Path(path).absolute()
    while not folder.exists():
        folder = folder.parent
    if not folder.is_dir():
        raise ValueError(f"{path}: expected a folder to write to, got the file {folder}; name another")
    with output_errors(path, folder):
        check_writable(folder)
