r"""The three standard streams of a command, made safe to write to.

A closed one (`>&-`) is the null device, so that no file of ours takes its number. A character that a console cannot
print, or would obey, becomes an escape such as `\u65e5` or `\x1b`, so that no name fails a command or moves a cursor.
Status that cannot be written is dropped: work goes on.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from io import TextIOWrapper
from typing import Any, Literal, TextIO, cast

from gsvis._text import as_text

__all__ = ["safe_streams"]

_OF_A_TERMINAL = re.compile(r"(\r|\x1b\[[0-9;?]*[A-Za-z])")
"""What Rich writes to a terminal: colors and moves of the cursor. Names are escaped before they reach it."""


@contextmanager
def safe_streams() -> Iterator[None]:
    """Make the standard streams of this process safe inside the block."""
    before = sys.stdin, sys.stdout, sys.stderr
    _fill_closed()
    sys.stdin = before[0] or _null("r")
    sys.stdout = cast("TextIO", _Escaping(before[1] or _null("w")))
    sys.stderr = cast("TextIO", _Status(before[2] or _null("w")))
    try:
        yield
    finally:
        sys.stdin, sys.stdout, sys.stderr = (old or new for old, new in zip(before, _inner_streams(), strict=True))


class _Escaping:
    """A stream whose text is escaped; all else is that of the stream inside.

    Args:
        stream: The stream.
    """

    def __init__(self, stream: TextIO) -> None:
        self.inner = stream
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")

    def __getattr__(self, name: str) -> Any:
        return getattr(self.inner, name)

    def write(self, text: str) -> int:
        """Write text; return the number of its characters."""
        self.inner.write(_escape(text, self.inner.isatty()))
        return len(text)

    def writelines(self, lines: Iterable[str]) -> None:
        """Write several texts."""
        for line in lines:
            self.write(line)


class _Status(_Escaping):
    """A stream of status: what cannot be written, as on a full disk or to a reader that has gone, is dropped."""

    def write(self, text: str) -> int:
        """Write text if that can be; return the number of its characters."""
        with suppress(OSError):
            super().write(text)
        return len(text)

    def flush(self) -> None:
        """Write what is buffered if that can be."""
        with suppress(OSError):
            self.inner.flush()


def _escape(text: str, is_terminal: bool) -> str:
    """Return text without characters that move a cursor, but for those of Rich on a terminal."""
    if not is_terminal:
        return as_text(text)
    return "".join(part if at % 2 else as_text(part) for at, part in enumerate(_OF_A_TERMINAL.split(text)))


def _fill_closed() -> None:
    """Open the null device for each closed standard stream, so that the next file gets another number."""
    while True:
        descriptor = os.open(os.devnull, os.O_RDWR)
        if descriptor > 2:
            os.close(descriptor)
            return
        os.set_inheritable(descriptor, True)


def _null(mode: Literal["r", "w"]) -> TextIO:
    return open(os.devnull, mode, encoding="utf-8")


def _inner_streams() -> Iterator[TextIO]:
    for stream in (sys.stdin, sys.stdout, sys.stderr):
        yield stream.inner if isinstance(stream, _Escaping) else stream
