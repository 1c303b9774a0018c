"""Pieces that tests of several files read: whichever worker needs one first makes it, and the others wait for it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from filelock import FileLock

__all__ = ["make_once"]


def make_once(folder: Path, name: str, make: Callable[[Path], object]) -> Path:
    """Return a folder below one that all workers share, made by the first of them. Nobody may change it.

    Args:
        folder: The folder that they share, from the fixture `shared_folder`.
        name: Name of the piece.
        make: Fills an empty folder, which gets its name when it is whole.
    """
    made = folder / name
    with FileLock(folder / f"{name}.lock"):
        if not made.exists():
            part = folder / f"{name}.part"
            part.mkdir()
            make(part)
            part.rename(made)
    return made
