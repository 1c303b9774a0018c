"""Limits for readers: regular files only, names inside the folder only, memory bounded by the real size of the files.

A compressed file states its uncompressed size. Readers claim that size from a `Budget` before they allocate. So a few
bytes that claim gigabytes raise an error, while every real scene passes. This module knows no format.
docs/design/026-hostile-inputs.md lists the bound of each input.
"""

from __future__ import annotations

import errno
import hashlib
import os
import stat
from io import BufferedReader
from pathlib import Path, PurePosixPath

from gsvis.errors import FormatError

__all__ = [
    "DAMAGED",
    "MAX_EXPANSION",
    "MIN_BUDGET",
    "Budget",
    "check_regular",
    "digest_of",
    "inside",
    "open_regular",
    "read_whole",
    "safe_name",
]

DAMAGED = "the file is damaged: copy it again, or make it again"
"""Remedy of every `FormatError` for a damaged gsvis file."""

MAX_EXPANSION = 256
"""Most bytes of memory for one byte on disk; real compressed scenes need 3 to 20."""

MIN_BUDGET = 64 << 20
"""Bytes that a file of any size may claim: procedural scenes compress extremely well."""

_LONGEST_PART = 255  # bytes


class Budget:
    """The memory that a set of files may claim, based on their real size.

    Args:
        path: The scene, for the error message.
        file_bytes: Real size of the files known so far.
    """

    def __init__(self, path: str | os.PathLike[str], file_bytes: int = 0) -> None:
        self.path = path
        self.file_bytes = file_bytes
        self.claimed = 0

    def claim(self, nbytes: int, where: str) -> None:
        """Add `nbytes` to the claims; raise if they exceed the budget.

        Args:
            nbytes: Bytes that the caller is about to allocate.
            where: Place in the file that states this size, for the error message.

        Raises:
            FormatError: If all claims together exceed the limit for files of this size.
        """
        self.claimed += nbytes
        allowed = MIN_BUDGET + MAX_EXPANSION * self.file_bytes
        if self.claimed > allowed:
            raise FormatError(
                self.path,
                where,
                f"at most {allowed:,} bytes of data from {self.file_bytes:,} bytes of file",
                f"a promise of {self.claimed:,} bytes",
                "the file is damaged or made to exhaust memory",
            )


def safe_name(path: str | os.PathLike[str], where: str, name: object) -> str:
    """Return a relative file name in normal form; raise unless it stays inside its folder.

    Args:
        path: The file that holds the name, for the error message.
        where: The key or entry that holds the name.
        name: The value found there.

    Returns:
        The name with forward slashes and without `.` parts.

    Raises:
        FormatError: If the name is no text, empty, longer than 1000 characters or absolute; if it holds `..`, a
            backslash, a colon, a NUL or half of a surrogate pair; or if a part is too long for a file system.
    """
    expected = "the name of a file inside the scene's folder"
    if not isinstance(name, str):
        raise FormatError(path, where, expected, f"{type(name).__name__}")
    parts = PurePosixPath(name).parts
    bad = not parts or len(name) > 1000 or name.startswith("/") or ".." in parts or any(c in name for c in "\\:\0")
    bad = bad or any("\ud800" <= c <= "\udfff" for c in name) or any(len(p.encode()) > _LONGEST_PART for p in parts)
    if bad:
        raise FormatError(path, where, expected, repr(name[:80]), "names that leave the folder are refused")
    return str(PurePosixPath(*parts))


def inside(path: str | os.PathLike[str], where: str, folder: Path, name: str) -> Path:
    """Return the path of a name in a folder; raise if links lead out of the folder.

    Links inside the folder are allowed. A folder in a cache of the Hugging Face hub,
    `CACHE/snapshots/REVISION/...`, may link into its own `CACHE/blobs`.

    Args:
        path: The file that holds the name, for the error message.
        where: The key or entry that holds the name.
        folder: The folder, which may be a link itself.
        name: A name from `safe_name`.

    Raises:
        FormatError: If links lead out of the folder. Their target is not read.
    """
    root = Path(os.path.realpath(folder))
    found = Path(os.path.realpath(root / name))
    if not any(found.is_relative_to(place) for place in (root, *_blobs_of(root))):
        remedy = "copy the files, e.g. with cp -rL, or download to a plain folder; links out of it are not followed"
        raise FormatError(path, where, f"a file inside {folder}", "a link that leads out of it", remedy)
    return folder / name


def _blobs_of(root: Path) -> list[Path]:
    """Return the `blobs` folder of the Hugging Face snapshot that a real path is in; empty if it is in none."""
    parts = root.parts
    at = max((i for i, part in enumerate(parts[:-1]) if part == "snapshots"), default=-1)
    return [Path(*parts[:at], "blobs")] if at > 0 else []


_KINDS = {
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


def check_regular(path: str | os.PathLike[str]) -> os.stat_result:
    """Return the status of a regular file; raise for anything else. A read from a pipe or a device could block forever.

    Raises:
        FormatError: If the path is a pipe, a socket or a device.
        IsADirectoryError: If the path is a folder.
        OSError: If the status cannot be read.
    """
    found = os.stat(path)
    _refuse_others(path, found)
    return found


def _refuse_others(path: str | os.PathLike[str], found: os.stat_result) -> None:
    """Raise unless a status is that of a regular file."""
    if stat.S_ISDIR(found.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), os.fspath(path))
    if not stat.S_ISREG(found.st_mode):
        kind = _KINDS.get(stat.S_IFMT(found.st_mode), "something else")
        raise FormatError(path, "", "a regular file", kind, "write its content to a file and give that")


def open_regular(path: str | os.PathLike[str]) -> BufferedReader:
    """Open a regular file for reading. Every reader uses this, so that none blocks on a pipe.

    Raises:
        FormatError: If the path is a pipe, a socket or a device.
        IsADirectoryError: If the path is a folder.
        OSError: If the file cannot be opened.
    """
    check_regular(path)  # before opening: to open a device can have effects
    flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0) | getattr(os, "O_CLOEXEC", 0)
    descriptor = os.open(path, flags)
    try:
        _refuse_others(path, os.fstat(descriptor))  # again: the file may have been replaced meanwhile
        return os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def read_whole(path: str | os.PathLike[str], most: int | None = None) -> bytes:
    """Return all bytes of a regular file; raise if its size changes meanwhile.

    Args:
        path: The file.
        most: Most bytes of the file; None sets no limit.

    Raises:
        FormatError: If the file is not regular, is larger than `most`, or changes its size.
        OSError: If the file cannot be read.
    """
    with open_regular(path) as stream:
        size = os.fstat(stream.fileno()).st_size
        if most is not None and size > most:
            raise FormatError(path, "", f"at most {most:,} bytes", f"{size:,}")
        data = stream.read(size + 1)
    if len(data) != size:
        raise FormatError(path, "", f"{size:,} bytes", "a file that changes while it is read")
    return data


def digest_of(path: str | os.PathLike[str]) -> str:
    """Return the SHA-256 of a regular file as 64 hexadecimal digits.

    Raises:
        FormatError: If it is no regular file.
        OSError: If it cannot be read.
    """
    digest = hashlib.sha256()
    with open_regular(path) as stream:
        while block := stream.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()
