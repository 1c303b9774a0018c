"""Options of the compiler: without wrappers that nobody calls, a function compiles in half to nine tenths of the time.

`kernel` is what Python calls, `inner` what only kernels call. Both are kept on disk.
"""

from __future__ import annotations

from functools import partial

from numba import njit

__all__ = ["inner", "kernel"]

kernel = partial(njit, cache=True, nogil=True, no_cfunc_wrapper=True)
"""Compile a function that Python calls; it releases Python's lock. Without the wrapper for callers from C."""

inner = partial(njit, cache=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
"""Compile a function that only kernels call: without the wrapper for Python, too."""
