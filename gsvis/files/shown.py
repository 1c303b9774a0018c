"""Names under which files are shown to people that are here only for a while, such as a fetched scene."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["shown_as", "shown_name"]

_names: dict[str, str] = {}


@contextmanager
def shown_as(path: str | os.PathLike[str], name: str) -> Iterator[None]:
    """Have messages of this block show a file or folder by another name: where it came from, or where it goes."""
    where = os.fspath(path)
    _names[where] = name
    try:
        yield
    finally:
        _names.pop(where, None)


def shown_name(path: str | os.PathLike[str]) -> str:
    """Return the name under which a path is shown: its own, unless a block of `shown_as` gives another.

    Examples:
        >>> with shown_as("/tmp/x1/scene.ply", "https://example.org/scene.ply"):
        ...     shown_name("/tmp/x1/scene.ply")
        'https://example.org/scene.ply'
        >>> shown_name("/tmp/x1/scene.ply")
        '/tmp/x1/scene.ply'
    """
    where = os.fspath(path)
    return _names.get(where, where)
