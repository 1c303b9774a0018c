"""Unpack gzipped scene files, and detect pointers of Git LFS and git-annex that stand for missing content.

The size of the file bounds the unpacked size, as for every reader. Knows no format.
"""

from __future__ import annotations

import os
import zlib

from gsvis.errors import FormatError
from gsvis.files.limits import Budget, open_regular, read_whole

__all__ = ["GZIP", "HEAD", "check_pointer", "gunzip", "peek_gzip"]

GZIP = b"\x1f\x8b"
"""First bytes of gzip."""

HEAD = 128
"""Number of first bytes that show whether a file is a pointer."""

_LFS = b"version https://git-lfs.github.com/spec/"
_ANNEX = (b"/annex/objects/", b".git/annex/objects/", b"../.git/annex/objects/")
_BLOCK = 1 << 20


def check_pointer(path: str | os.PathLike[str], head: bytes, where: str = "") -> None:
    """Raise if a file begins as a pointer of Git LFS or git-annex does.

    Args:
        path: The file, or the scene that it belongs to.
        head: Its first bytes, at least `HEAD` unless the file is shorter.
        where: The file inside the scene, for the message.

    Raises:
        FormatError: If it is a pointer.
    """
    if head.startswith(_LFS):
        raise FormatError(path, where, "the content of the file", "a Git LFS pointer, not the file", "run git lfs pull")
    if head.startswith(_ANNEX):
        raise FormatError(
            path, where, "the content of the file", "a git-annex pointer, not the file", "run git annex get"
        )


def peek_gzip(path: str | os.PathLike[str]) -> bytes:
    """Return the first 16 unpacked bytes of a gzip file; fewer if it has no more, or is damaged."""
    with open_regular(path) as stream:
        try:
            return zlib.decompressobj(wbits=31).decompress(stream.read(4096), 16)
        except zlib.error:
            return b""


def gunzip(path: str | os.PathLike[str]) -> bytes:
    """Return the unpacked bytes of a gzip file, which may have several members.

    Raises:
        FormatError: If it is damaged, truncated, or unpacks to more than a file of its size may claim.
        OSError: If it cannot be read.
    """
    data = read_whole(path)
    budget = Budget(path, len(data))
    parts: list[bytes] = []
    while data.startswith(GZIP):
        inflate = zlib.decompressobj(wbits=31)
        try:
            while not inflate.eof:
                block = inflate.decompress(data, _BLOCK)
                budget.claim(len(block), "gzip")
                parts.append(block)
                data = inflate.unconsumed_tail
                if not block and not data and not inflate.eof:
                    raise FormatError(path, "gzip", "a complete stream", "its end", "the file is truncated")
        except zlib.error as error:
            raise FormatError(path, "gzip", "a gzip stream", str(error), "the file is damaged") from error
        data = inflate.unused_data
    return b"".join(parts)
