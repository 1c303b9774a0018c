"""Locks that keep two processes from one piece of work; they go with the process that holds them."""

from __future__ import annotations

from typing import IO, Literal

__all__ = ["locked", "try_lock"]


def locked(file: IO[str]) -> bool:
    """Whether an open file could be locked, until it is closed; where a system has no such locks it always could."""
    return try_lock(file.fileno()) != "busy"


def try_lock(descriptor: int) -> Literal["held", "busy", "none"]:
    """Lock an open file or folder until it is closed, without waiting.

    Args:
        descriptor: Of the open file. Another opening of the same file conflicts, in this process too.

    Returns:
        "held" if the lock is ours now, "busy" if another has it, "none" where the system or the file system has no
        such locks.
    """
    try:
        import fcntl
    except ImportError:
        return "none"
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return "busy"
    except OSError:
        return "none"
    return "held"
