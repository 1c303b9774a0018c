"""Every exception that gsvis raises on purpose, besides `ValueError` for a bad argument.

    GsvisError
    ├── FormatError       a file does not hold what its format promises
    ├── SceneError        a scene is well formed but cannot serve the request (no free space, no Gaussian left)
    ├── ProtocolError     a message does not hold what the wire promises
    └── BackendError      an engine or a library is missing or cannot do this; says what to install

A bad argument raises `ValueError`, worded *name: expected X, got Y; remedy*.
"""

from __future__ import annotations

from os import PathLike, fspath

__all__ = ["BackendError", "FormatError", "GsvisError", "ProtocolError", "SceneError"]

_MOST_TEXT = 400
"""Characters of each part of a message."""


class GsvisError(Exception):
    """Base of all errors that gsvis raises on purpose."""


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
        self.path, self.where, self.expected, self.got, self.remedy = fspath(path), where, expected, got, remedy
        place = f"{self.path}: {where}" if where else self.path
        super().__init__(f"{place}: expected {expected}, got {got}" + (f"; {remedy}" if remedy else ""))

    def __reduce__(self) -> tuple[type[FormatError], tuple[str, ...]]:
        """Pickled by its parts, so that it comes back whole from a worker process."""
        return type(self), (self.path, self.where, self.expected, self.got, self.remedy)


class SceneError(GsvisError):
    """A scene is well formed but cannot serve what was asked of it."""


def _one_line(text: str) -> str:
    """Return text that a terminal shows on one line of bounded length: files choose some of what messages quote."""
    if not text.isprintable():
        text = "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)
    return text if len(text) <= _MOST_TEXT else f"{text[: _MOST_TEXT - 3]}..."


class ProtocolError(GsvisError):
    """A message from the other end of a connection does not hold what the wire promises.

    Args:
        message: What was expected and what came, in a line that may be told to the other end.
        code: Number of the fault, as ERROR messages carry it; `gsvis.stream.wire` names them.
    """

    def __init__(self, message: str, code: int = 1) -> None:
        self.code = code
        super().__init__(message)

    def __reduce__(self) -> tuple[type[ProtocolError], tuple[str, int]]:
        """Pickled by its parts."""
        return type(self), (str(self), self.code)


class BackendError(GsvisError):
    """An engine or a library is missing, or cannot do what was asked; the message says what to install."""
