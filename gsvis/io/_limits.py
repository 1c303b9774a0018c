"""What a reader may believe: names that stay inside the folder, and memory bounded by the real size of the files.

A compressed file says how large it will become. Readers claim that size from a `Budget` before they allocate, so a
few bytes that promise gigabytes are refused while every real scene passes. This module knows no format.
"""

from __future__ import annotations

import os
from pathlib import PurePosixPath

from gsvis.errors import FormatError

__all__ = ["MAX_EXPANSION", "MIN_BUDGET", "Budget", "read_whole", "safe_name"]

MAX_EXPANSION = 256
"""Bytes in memory that one byte on disk may become; real compressed scenes need 3 to 20."""

MIN_BUDGET = 64 << 20
"""Bytes that any file may claim, however small: procedural scenes compress extremely well."""


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
        FormatError: If it is no text, empty, absolute, climbs with `..`, or holds a backslash, a drive or a NUL.
    """
    expected = "the name of a file inside the scene's folder"
    if not isinstance(name, str):
        raise FormatError(path, where, expected, f"{type(name).__name__}")
    parts = PurePosixPath(name).parts
    bad = not parts or len(name) > 1000 or name.startswith("/") or ".." in parts or any(c in name for c in "\\:\0")
    if bad:
        raise FormatError(path, where, expected, repr(name[:80]), "names that leave the folder are refused")
    return str(PurePosixPath(*parts))


def read_whole(path: str | os.PathLike[str], size: int) -> bytes:
    """All bytes of a file whose size was taken before; a file that has changed meanwhile is refused.

    Raises:
        FormatError: If the file is no longer `size` bytes long.
    """
    with open(path, "rb") as stream:
        data = stream.read(size + 1)
    if len(data) != size:
        raise FormatError(path, "", f"{size:,} bytes", "a file that changes while it is read")
    return data
