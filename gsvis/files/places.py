"""Where gsvis keeps files of its own for this user: what can be computed again."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from gsvis.files.temporary import private_folder

__all__ = ["TABLES", "cache_folder"]

TABLES = "tables"
"""Folder in `cache_folder` of the tables that `gsvis serve` keeps."""


def cache_folder() -> Path:
    """Return the folder of what gsvis keeps for this user: `GSVIS_CACHE`, or one below `XDG_CACHE_HOME` or home.

    A user without a home gets a folder among temporary files that nobody else can enter, or one that cannot be made if
    there is no place for those.
    """
    named = os.environ.get("GSVIS_CACHE")
    shared = os.environ.get("XDG_CACHE_HOME")
    if named:
        return Path(named)
    home = os.path.expanduser("~")
    if shared or os.path.isabs(home):
        return (Path(shared) if shared else Path(home) / ".cache") / "gsvis"
    user = os.getuid() if hasattr(os, "getuid") else os.environ.get("USERNAME", "")
    try:
        return private_folder(Path(tempfile.gettempdir()) / f"gsvis-cache-{user}")
    except OSError:
        return Path(os.devnull) / "gsvis"
