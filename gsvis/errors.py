"""Every exception that gsvis raises on purpose, besides `ValueError` for a bad argument.

    GsvisError
    ├── FormatError       a file does not hold what its format promises
    ├── SceneError        a scene is well formed but cannot serve the request (no free space, no Gaussian left)
    ├── ProtocolError     a message does not hold what the wire promises
    ├── BackendError      an engine or a library is missing or cannot do this; says what to install
    │   └── MissingExtraError    an optional package is missing; names the extra (also an `ImportError`)
    └── OutputError       a file cannot be written: the disk is full, or the place is not ours (also an `OSError`)

A bad argument raises `ValueError`, worded *name: expected X, got Y; remedy*. It is an `ArgumentError` where a command
has another name for the argument.
"""

from __future__ import annotations

import errno
import os
from os import PathLike, fspath

__all__ = [
    "ArgumentError",
    "BackendError",
    "FormatError",
    "GsvisError",
    "MissingExtraError",
    "OutputError",
    "ProtocolError",
    "SceneError",
]

_MOST_TEXT = 400
"""Characters of each part of a message."""


class GsvisError(Exception):
    """Base of all errors that gsvis raises on purpose."""


class ArgumentError(ValueError):
    """An argument is bad; a command can name its option in place of the argument.

    Args:
        name: Name of the argument.
        problem: What was expected and what came.
        remedy: What the user can do about it. May be empty.

    Examples:
        >>> print(ArgumentError("shares", "expected at least one, got none").renamed("--levels", "name a share"))
        --levels: expected at least one, got none; name a share
    """

    def __init__(self, name: str, problem: str, remedy: str = "") -> None:
        self.name = name
        self.problem = problem
        self.remedy = remedy
        super().__init__(f"{name}: {problem}" + (f"; {remedy}" if remedy else ""))

    def renamed(self, name: str, remedy: str = "") -> ArgumentError:
        """Return the same error of an argument of another name, with another remedy if one is given."""
        return type(self)(name, self.problem, remedy or self.remedy)

    def __reduce__(self) -> tuple[type[ArgumentError], tuple[str, str, str]]:
        """Pickled by its parts."""
        return type(self), (self.name, self.problem, self.remedy)


class FormatError(GsvisError):
    """A file does not hold what its format promises.

    Args:
        path: The file or folder that was read.
        where: The place in it: a byte offset, a property, a plane, a key. May be empty.
        expected: What the format asks for there.
        got: What was found.
        remedy: What the user can do about it. May be empty.

    Examples:
        >>> print(FormatError("scene.ply", "byte 12", "100 bytes", "the end of the file", "download it again"))
        scene.ply: byte 12: expected 100 bytes, got the end of the file; download it again
    """

    def __init__(self, path: str | PathLike[str], where: str, expected: str, got: str, remedy: str = "") -> None:
        where, expected, got, remedy = (_one_line(text) for text in (where, expected, got, remedy))
        self.path = fspath(path)
        self.where = where
        self.expected = expected
        self.got = got
        self.remedy = remedy
        place = f"{self.path}: {where}" if where else self.path
        super().__init__(f"{place}: expected {expected}, got {got}" + (f"; {remedy}" if remedy else ""))

    def __reduce__(self) -> tuple[type[FormatError], tuple[str, ...]]:
        """Pickled by its parts, so that it comes back whole from a worker process."""
        return type(self), (self.path, self.where, self.expected, self.got, self.remedy)


class SceneError(GsvisError):
    """A scene is well formed but cannot serve what was asked of it.

    Args:
        problem: What was asked for, and why the scene cannot serve it.
        remedy: What the user can do about it, in arguments of the library; a command names its options instead. May be
            empty.

    Examples:
        >>> print(SceneError("no navigable space: nothing is free", "raise max_alpha"))
        no navigable space: nothing is free; raise max_alpha
    """

    def __init__(self, problem: str, remedy: str = "") -> None:
        self.problem = problem
        self.remedy = remedy
        super().__init__(problem + (f"; {remedy}" if remedy else ""))

    def __reduce__(self) -> tuple[type[SceneError], tuple[str, str]]:
        """Pickled by its parts."""
        return type(self), (self.problem, self.remedy)


def _one_line(text: str) -> str:
    """Return text that a terminal shows on one line of bounded length: files choose some of what messages quote."""
    if not text.isprintable():
        text = "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)
    return text if len(text) <= _MOST_TEXT else f"{text[: _MOST_TEXT - 3]}..."


class ProtocolError(GsvisError):
    """A message from the other end of a connection does not hold what the wire promises.

    Args:
        message: What was expected and what came, in a line that is safe to send to the other end.
        code: Number of the fault, as ERROR messages carry it; `gsvis.stream.wire` names them.
        remedy: What this end can do about it. May be empty.
    """

    def __init__(self, message: str, code: int = 1, remedy: str = "") -> None:
        self.message = message
        self.code = code
        self.remedy = remedy
        super().__init__(message + (f"; {remedy}" if remedy else ""))

    def __reduce__(self) -> tuple[type[ProtocolError], tuple[str, int, str]]:
        """Pickled by its parts."""
        return type(self), (self.message, self.code, self.remedy)


class BackendError(GsvisError):
    """An engine or a library is missing, or cannot do what was asked; the message says what to install."""


class MissingExtraError(BackendError, ImportError):
    """An optional package is not installed.

    Args:
        what: What needs the package.
        package: Name of the package.
        extra: Extra of gsvis that brings it.

    Examples:
        >>> print(MissingExtraError("gsvis train", "torch", "torch"))
        gsvis train: expected the package torch, got none; pip install "gsvis[torch]"
    """

    def __init__(self, what: str, package: str, extra: str) -> None:
        self.what = what
        self.package = package
        self.extra = extra
        super().__init__(f'{what}: expected the package {package}, got none; pip install "gsvis[{extra}]"')

    def __reduce__(self) -> tuple[type[MissingExtraError], tuple[str, str, str]]:
        """Pickled by its parts."""
        return type(self), (self.what, self.package, self.extra)


_ELSEWHERE = "or write to another place"
_REMEDIES = {
    errno.ENOSPC: f"make room and run the same command again, {_ELSEWHERE}",
    errno.EDQUOT: f"make room and run the same command again, {_ELSEWHERE}",
    errno.EFBIG: f"raise the limit on the size of files (ulimit -f), {_ELSEWHERE}",
    errno.EROFS: "write to another place",
    errno.EACCES: f"change its rights, {_ELSEWHERE}",
    errno.EPERM: f"change its rights, {_ELSEWHERE}",
}


class OutputError(GsvisError, OSError):
    """A file cannot be written: the disk is full, the quota is used up, or nothing may be written there.

    Args:
        path: The file or folder that was to be written.
        code: Number of the fault, as in `errno`.
        kept: What is kept of the work, and how to resume. May be empty.
        remedy: What the user can do about it; empty takes the usual one of the fault.

    Examples:
        >>> print(OutputError("scene.ply", errno.EROFS))
        scene.ply: cannot be written: read-only file system; write to another place
    """

    def __init__(self, path: str | PathLike[str], code: int, kept: str = "", remedy: str = "") -> None:
        super().__init__(code, os.strerror(code), fspath(path))
        self.path = fspath(path)
        self.kept = kept
        self.remedy = remedy or _REMEDIES.get(code, f"check the disk, {_ELSEWHERE}")

    def keeping(self, kept: str) -> OutputError:
        """The same error with a word on what is kept, where it says nothing of it yet."""
        return OutputError(self.path, self.errno or errno.EIO, self.kept or kept, self.remedy)

    def __str__(self) -> str:
        reason = os.strerror(self.errno or errno.EIO)
        parts = (f"cannot be written: {reason[:1].lower()}{reason[1:]}", self.kept, self.remedy)
        return f"{self.path}: {'; '.join(part for part in parts if part)}"

    def __reduce__(self) -> tuple[type[OutputError], tuple[str, int, str, str]]:
        """Pickled by its parts."""
        return type(self), (self.path, self.errno or errno.EIO, self.kept, self.remedy)
