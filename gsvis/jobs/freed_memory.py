"""Give memory that this process has freed back to the system.

The allocator of glibc keeps freed blocks of less than 32 MB for later, and that of Arrow all of its blocks. Between two
stages that is a gigabyte or more, in which the large blocks of the next stage find no place.
"""

from __future__ import annotations

import ctypes
import sys

__all__ = ["release_freed_memory"]


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
