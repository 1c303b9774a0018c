"""Find folders that gsvis wrote and may replace: which files are its own, and whether there are others."""

from __future__ import annotations

import re
import shutil
from collections.abc import Collection
from contextlib import suppress
from pathlib import Path

from gsvis.errors import FormatError
from gsvis.files.fields import parse_object
from gsvis.files.limits import read_whole

__all__ = ["GENERATOR", "check_replaceable", "remove_earlier"]

GENERATOR = "gsvis"
"""What `asset.generator` of a document says that gsvis wrote."""


def check_replaceable(target: Path, document: str, ours: re.Pattern[str], overwrite: bool) -> None:
    """Raise unless a folder may be filled: it is new, empty, or holds a result of gsvis to replace.

    Args:
        target: The folder.
        document: Name of the JSON file that says in `asset.generator` who made the folder.
        ours: Matches the names of all other files and folders of gsvis in it.
        overwrite: Whether an earlier result may be replaced.

    Raises:
        ValueError: If it holds something else, or an earlier scene and `overwrite` is false.
    """
    if not target.exists():
        return
    if not target.is_dir():
        raise ValueError(f"--out: expected a folder, got the file {target}; name another")
    others = sorted(p.name for p in target.iterdir() if p.name[:1] != "." and not ours.fullmatch(p.name))
    if others and not (others == [document] and _says_ours(target / document)):
        raise ValueError(
            f"--out: expected a new or an empty folder, got {target}, which has {others[0]} of something else; name"
            " another"
        )
    if others and not overwrite:
        raise ValueError(
            f"--out: expected a new or an empty folder, got {target} with an earlier scene; name another, or say"
            " --overwrite"
        )


def remove_earlier(target: Path, ours: re.Pattern[str], kept: Collection[str]) -> None:
    """Remove the files and folders of an earlier result of gsvis, by their names, except those to keep."""
    for path in target.iterdir():
        if ours.fullmatch(path.name) and path.name not in kept:
            with suppress(OSError):
                shutil.rmtree(path) if path.is_dir() else path.unlink()


def _says_ours(document: Path) -> bool:
    """Return whether a JSON file states that gsvis wrote it."""
    with suppress(OSError, FormatError):
        return bool(parse_object(document, read_whole(document)).child("asset").raw("generator") == GENERATOR)
    return False
