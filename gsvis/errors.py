"""Every exception that gsvis raises on purpose, besides `ValueError` for a bad argument.

    GsvisError
    ├── FormatError       a file is not valid in its format
    ├── SceneError        a scene is valid but does not allow the request (no free space, no Gaussian left)
    ├── ProtocolError     a message is not valid in the protocol
    ├── BackendError      an engine or a library is missing or cannot do this; says what to install
    │   └── MissingExtraError    an optional package is missing; names the extra (also an `ImportError`)
    └── OutputError       a file cannot be written: disk full or no permission (also an `OSError`)

A bad argument raises `ValueError` with the message *name: expected X, got Y; remedy*. It is an `ArgumentError` if a
command has an option with a different name for the argument.
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
"""Most characters of each part of a message."""


class GsvisError(Exception):
    """Base of all errors that gsvis raises on purpose."""


class ArgumentError(ValueError):
    """An argument is bad; a command can put the name of its option in the message.

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
        """Return the same error with a new name, and a new remedy if one is given."""
        return type(self)(name, self.problem, remedy or self.remedy)

    def __reduce__(self) -> tuple[type[ArgumentError], tuple[str, str, str]]:
        """Pickled by its parts."""
        return type(self), (self.name, self.problem, self.remedy)


class FormatError(GsvisError):
    """A file is not valid in its format.

    Args:
        path: The file or folder that was read.
        where: The place in it: a byte offset, a property, a plane, a key. May be empty.
        expected: What the format requires there.
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
    """A scene is valid but does not allow the request.

    Args:
        problem: The request, and why the scene does not allow it.
        remedy: What the user can do about it, with argument names of the library, which commands replace with options.
            May be empty.

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
    """Return printable text of bounded length on one line, because messages quote the content of files."""
    if not text.isprintable():
        text = "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)
    return text if len(text) <= _MOST_TEXT else f"{text[: _MOST_TEXT - 3]}..."


class ProtocolError(GsvisError):
    """A message from the other end of a connection is not valid in the protocol.

    Args:
        message: What was expected and received, on one line that may be sent to the other end.
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
        what: Name of the command or option that needs the package.
        package: Name of the package.
        extra: Extra of gsvis that installs it.

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


_ELSEWHERE = "or write to another folder"
_REMEDIES = {
    errno.ENOSPC: f"make room and run the same command again, {_ELSEWHERE}",
    errno.EDQUOT: f"make room and run the same command again, {_ELSEWHERE}",
    errno.EFBIG: f"raise the limit on the size of files (ulimit -f), {_ELSEWHERE}",
    errno.EROFS: "write to another folder",
    errno.EACCES: f"change its rights, {_ELSEWHERE}",
    errno.EPERM: f"change its rights, {_ELSEWHERE}",
}


class OutputError(GsvisError, OSError):
    """A file cannot be written: the disk is full, the quota is used up, or there is no permission.

    Args:
        path: The file or folder that could not be written.
        code: Number of the fault, as in `errno`.
        kept: Which work is kept, and how to resume. May be empty.
        remedy: What the user can do about it; empty uses the remedy for the code.

    Examples:
        >>> print(OutputError("scene.ply", errno.EROFS))
        scene.ply: cannot be written: read-only file system; write to another folder
    """

    def __init__(self, path: str | PathLike[str], code: int, kept: str = "", remedy: str = "") -> None:
        super().__init__(code, os.strerror(code), fspath(path))
        self.path = fspath(path)
        self.kept = kept
        self.remedy = remedy or _REMEDIES.get(code, f"check the disk, {_ELSEWHERE}")

    def keeping(self, kept: str) -> OutputError:
        """Return the same error with a statement of what is kept, unless it has one."""
        return OutputError(self.path, self.errno or errno.EIO, self.kept or kept, self.remedy)

    def __str__(self) -> str:
        reason = os.strerror(self.errno or errno.EIO)
        parts = (f"cannot be written: {reason[:1].lower()}{reason[1:]}", self.kept, self.remedy)
        return f"{self.path}: {'; '.join(part for part in parts if part)}"

    def __reduce__(self) -> tuple[type[OutputError], tuple[str, int, str, str]]:
        """Pickled by its parts."""
        return type(self), (self.path, self.errno or errno.EIO, self.kept, self.remedy)
