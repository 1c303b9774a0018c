"""One way to report a file that cannot be written: with its path and what helps, as attributes of `OutputError`.

The number of the fault decides, never its text. A full disk is a full disk wherever it shows; missing rights and broken
disks count only below the place that is being written, since a block that writes may read as well.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gsvis.errors import OutputError

__all__ = ["TEMPORARY", "check_writable", "keeping", "output_errors"]

TEMPORARY = "make room there, or name a folder for temporary files on another disk in TMPDIR"
"""What helps where the temporary files of a command do not fit."""

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_FORBIDDEN = (errno.EROFS, errno.EACCES, errno.EPERM, errno.EIO)


@contextmanager
def output_errors(path: str | os.PathLike[str], *inside: str | os.PathLike[str], remedy: str = "") -> Iterator[None]:
    """Raise OutputError for `path` where a write in the block fails.

    Args:
        path: The file or folder that the user knows.
        inside: Files and folders that stand for it while it is written.
        remedy: What the user can do about it; empty takes the usual one of the fault.

    Raises:
        OutputError: If the disk is full, or `path` may not be written.
    """
    try:
        yield
    except OSError as error:
        code = error.errno
        if code not in _FULL and code not in _FORBIDDEN:
            raise
        name = error.filename if isinstance(error.filename, str | bytes) else None  # it may be a descriptor
        named = None if name is None else Path(os.fsdecode(name)).absolute()
        if named is None:  # a read fails without a name as a write does, but never because the disk is full
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
    """Add what is kept of the work, and how to go on, to an OutputError that says nothing of it yet."""
    try:
        yield
    except OutputError as error:
        raise error.keeping(text) from error


def check_writable(folder: str | os.PathLike[str]) -> None:
    """Raise unless a file can be written into a folder that exists; leaves no trace.

    Raises:
        OutputError: If nothing can be written there.
    """
    import tempfile

    with output_errors(folder), tempfile.TemporaryFile(dir=folder) as file:
        file.write(b"0")
        file.flush()
