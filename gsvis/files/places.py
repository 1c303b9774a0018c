"""Where gsvis keeps files of its own for this user: what can be computed again."""

from __future__ import annotations

import os
from pathlib import Path

__all__ = ["TABLES", "cache_folder"]

TABLES = "tables"
"""Folder in `cache_folder` of the tables that `gsvis serve` keeps."""


def cache_folder() -> Path:
    """Return the folder of what gsvis keeps for this user: `GSVIS_CACHE`, or one below `XDG_CACHE_HOME` or home."""
    named, shared = os.environ.get("GSVIS_CACHE"), os.environ.get("XDG_CACHE_HOME")
    if named:
        return Path(named)
    return (Path(shared) if shared else Path(os.path.expanduser("~")) / ".cache") / "gsvis"
