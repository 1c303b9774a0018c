"""Locks that keep two processes from one piece of work; they go with the process that holds them."""

from __future__ import annotations

from typing import IO

__all__ = ["locked"]


def locked(file: IO[str]) -> bool:
    """Whether an open file could be locked, until it is closed; where a system has no such locks it always could."""
    try:
        import fcntl
    except ImportError:
        return True
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a file system without locks
        return True
    return True
