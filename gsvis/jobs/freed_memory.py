"""Give memory that this process has freed back to the system, or keep it.

The allocator of glibc keeps freed blocks of less than 32 MB for later, and that of Arrow all of its blocks. Between two
stages that is a gigabyte or more, in which the large blocks of the next stage find no place.

It gives back what is free at the end of its heap as soon as that is a few megabytes. Where each step of a long work
frees all that it allocated, the next one gets pages that the system clears first: a third of a step of training.
"""

from __future__ import annotations

import ctypes
import os
import sys

__all__ = ["keep_freed_memory", "release_freed_memory"]

_KEPT = 256 << 20
"""Bytes at the end of the heap that stay for the next step."""
_MAPPED = 32 << 20
"""Bytes from which a block is mapped alone, and given back when it is freed; the most that glibc allows."""
_TRIM_THRESHOLD = -1
_MMAP_THRESHOLD = -3
"""Numbers of `mallopt`."""


def keep_freed_memory() -> None:
    """Keep up to 256 MB of freed blocks of less than 32 MB, for the life of the process.

    Does nothing where the allocator is not that of glibc, or where its environment variables say what it keeps.
    """
    if "MALLOC_TRIM_THRESHOLD_" in os.environ or "MALLOC_MMAP_THRESHOLD_" in os.environ:
        return
    try:
        change = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):
        return
    change.argtypes = [ctypes.c_int, ctypes.c_int]
    change(_TRIM_THRESHOLD, _KEPT)
    change(_MMAP_THRESHOLD, _MAPPED)


def release_freed_memory() -> None:
    """Give freed memory back to the system where an allocator can: that of glibc, and that of Arrow if it is used."""
    if (arrow := sys.modules.get("pyarrow")) is not None:
        arrow.default_memory_pool().release_unused()
    try:
        trim = ctypes.CDLL(None).malloc_trim
    except (AttributeError, OSError, TypeError):
        return
    trim.argtypes = [ctypes.c_size_t]
    trim(0)
