"""Find the folder where gsvis keeps files that can be computed again, for this user."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from gsvis.files.temporary import private_folder

__all__ = ["TABLES", "cache_folder"]

TABLES = "tables"
"""Folder in `cache_folder` of the tables that `gsvis serve` keeps."""


def cache_folder() -> Path:
    """Return the cache folder of this user: `GSVIS_CACHE`, or a folder below `XDG_CACHE_HOME` or home.

    A user without a home gets a private folder among temporary files; if there is no place for those either, the
    returned folder cannot be created.
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
