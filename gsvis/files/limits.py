"""What a reader may believe: regular files, names that stay inside the folder, memory bounded by the files' real size.

A compressed file says how large it will become. Readers claim that size from a `Budget` before they allocate, so a
few bytes that promise gigabytes are refused while every real scene passes. This module knows no format.
docs/design/026-hostile-inputs.md lists what is bounded by what.
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
"""What helps where bytes are not as they were written: the remedy of every `FormatError` of a damaged file of ours."""

MAX_EXPANSION = 256
"""Bytes in memory that one byte on disk may become; real compressed scenes need 3 to 20."""

MIN_BUDGET = 64 << 20
"""Bytes that any file may claim, however small: procedural scenes compress extremely well."""

_LONGEST_PART = 255  # bytes


class Budget:
    """The memory that a set of files may ask for, given how large they really are.

    Args:
        path: The scene, for the error message.
        file_bytes: Real size of the files known so far.
    """

    def __init__(self, path: str | os.PathLike[str], file_bytes: int = 0) -> None:
        self.path = path
        self.file_bytes = file_bytes
        self.claimed = 0

    def claim(self, nbytes: int, where: str) -> None:
        """Set `nbytes` aside.

        Args:
            nbytes: Bytes that the caller is about to allocate.
            where: What promises them, for the error message.

        Raises:
            FormatError: If all claims together exceed what files of this size can hold.
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
    """A relative file name that stays inside its folder, in normal form.

    Args:
        path: The file that holds the name, for the error message.
        where: The key or entry that holds it.
        name: What was found there.

    Returns:
        The name with forward slashes and without `.` parts.

    Raises:
        FormatError: If it is no text, empty, absolute, climbs with `..`, holds a backslash, a drive, a NUL or half of a
            pair of UTF-16, or a part of it is too long for a file system.
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
    """Return the path of that name in a folder, unless links lead out of it; a link inside the folder is fine.

    A folder in a cache of the Hugging Face hub, `CACHE/snapshots/REVISION/...`, may link into its own `CACHE/blobs`.

    Args:
        path: The file that holds the name, for the error message.
        where: The key or entry that holds it.
        folder: The folder, which may be a link itself.
        name: A name that `safe_name` gave.

    Raises:
        FormatError: If links lead out of the folder. What they lead to is not looked at.
    """
    root = Path(os.path.realpath(folder))
    found = Path(os.path.realpath(root / name))
    if not any(found.is_relative_to(place) for place in (root, *_blobs_of(root))):
        remedy = "copy the files, e.g. with cp -rL, or download to a plain folder; links out of it are not followed"
        raise FormatError(path, where, f"a file inside {folder}", "a link that leads out of it", remedy)
    return folder / name


def _blobs_of(root: Path) -> list[Path]:
    """Return the folder that holds the content of the snapshot that a real path is in, if it is in one."""
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
    """Raise unless there is a regular file at `path`; a pipe, a socket or a device would be waited for without end.

    Raises:
        FormatError: If it is a pipe, a socket or a device.
        IsADirectoryError: If it is a folder.
        OSError: If it cannot be looked at.
    """
    found = os.stat(path)
    _refuse_others(path, found)
    return found


def _refuse_others(path: str | os.PathLike[str], found: os.stat_result) -> None:
    if stat.S_ISDIR(found.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), os.fspath(path))
    if not stat.S_ISREG(found.st_mode):
        kind = _KINDS.get(stat.S_IFMT(found.st_mode), "something else")
        raise FormatError(path, "", "a regular file", kind, "write its content to a file and give that")


def open_regular(path: str | os.PathLike[str]) -> BufferedReader:
    """Open a regular file to read its bytes: what every reader uses, so that none waits for a pipe.

    Raises:
        FormatError: If it is a pipe, a socket or a device.
        IsADirectoryError: If it is a folder.
        OSError: If it cannot be opened.
    """
    check_regular(path)  # before it is opened: opening a device can do something
    flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0) | getattr(os, "O_CLOEXEC", 0)
    descriptor = os.open(path, flags)
    try:
        _refuse_others(path, os.fstat(descriptor))  # again: it may have been replaced since
        return os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def read_whole(path: str | os.PathLike[str], most: int | None = None) -> bytes:
    """Return all bytes of a regular file; one that changes meanwhile is refused.

    Args:
        path: The file.
        most: Bytes that it may have.

    Raises:
        FormatError: If it is no regular file, larger, or its size changes.
        OSError: If it cannot be read.
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
