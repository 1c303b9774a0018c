"""Give memory that this process has freed back to the system.

The allocator of glibc keeps freed blocks of less than 32 MB for later. Between two stages that is a gigabyte or more,
in which the large blocks of the next stage find no place.
"""

from __future__ import annotations

import ctypes

__all__ = ["release_freed_memory"]


def release_freed_memory() -> None:
    """Give freed memory back to the system; does nothing where the allocator is not that of glibc."""
    try:
        trim = ctypes.CDLL(None).malloc_trim
    except (AttributeError, OSError, TypeError):
        return
    trim.argtypes = [ctypes.c_size_t]
    trim(0)
