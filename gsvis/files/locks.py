"""Locks that keep two processes from one piece of work; they go with the process that holds them."""

from __future__ import annotations

import weakref
from typing import IO, Literal

__all__ = ["locked", "try_lock"]


def locked(file: IO[str]) -> bool:
    """Return whether an open file could be locked, until it is closed.

    Where the system or the file system has no such locks, a file `NAME.lock` beside it takes their place until the
    file object is gone. It says who made it: one of a process of this host that was killed keeps nobody out.
    """
    state = try_lock(file.fileno())
    return _mark(file) if state == "none" else state == "held"


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
    except ImportError:  # as on Windows
        return _try_other_lock(descriptor)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return "busy"
    except OSError:
        return "none"
    return "held"


def _try_other_lock(descriptor: int) -> Literal["held", "busy", "none"]:
    """Do what `try_lock` does with the locks of another system than Unix."""
    from filelock import lock_descriptor

    try:
        return "held" if lock_descriptor(descriptor, blocking=False) else "busy"
    except OSError:
        return "none"


def _mark(file: IO[str]) -> bool:
    """Return whether the file beside an open file that takes the place of a lock could be made."""
    from filelock import SoftFileLock, Timeout

    mark = SoftFileLock(f"{file.name}.lock", timeout=0, is_singleton=False)
    try:
        mark.acquire()
    except Timeout:
        return False
    weakref.finalize(file, mark.release)
    return True
