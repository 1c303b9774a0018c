"""Lock files, so that two processes do not do the same work. A lock ends with its process."""

from __future__ import annotations

import weakref
from typing import IO, Literal

__all__ = ["MARK", "lock_file", "try_lock"]

MARK = ".lock"
"""Suffix of the file beside a locked file that serves as the lock where there are no other locks."""


def lock_file(file: IO[str]) -> bool:
    """Lock an open file until it is closed; return whether that succeeded.

    If the system or the file system has no locks, a file `NAME.lock` beside it serves as the lock until the file
    object is deleted. It records its process, so the leftover of a killed process of this host blocks nobody.
    """
    state = try_lock(file.fileno())
    return _mark(file) if state == "none" else state == "held"


def try_lock(descriptor: int) -> Literal["held", "busy", "none"]:
    """Lock an open file or folder until it is closed, without waiting.

    Args:
        descriptor: Descriptor of the open file or folder. A second opening of the same file conflicts, even in this
            process.

    Returns:
        "held" if the caller now has the lock, "busy" if another has it, "none" if the system or the file system has
        no locks.
    """
    try:
        import fcntl
    except ImportError:  # such as on Windows
        return _try_other_lock(descriptor)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return "busy"
    except OSError:
        return "none"
    return "held"


def _try_other_lock(descriptor: int) -> Literal["held", "busy", "none"]:
    """Lock as in `try_lock`, on systems other than Unix."""
    from filelock import lock_descriptor

    try:
        return "held" if lock_descriptor(descriptor, blocking=False) else "busy"
    except OSError:
        return "none"


def _mark(file: IO[str]) -> bool:
    """Create the file `NAME.lock` beside an open file; return whether that succeeded."""
    from filelock import SoftFileLock, Timeout

    mark = SoftFileLock(f"{file.name}{MARK}", timeout=0, is_singleton=False)
    try:
        mark.acquire()
    except Timeout:
        return False
    weakref.finalize(file, mark.release)
    return True
