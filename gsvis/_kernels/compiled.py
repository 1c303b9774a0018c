"""Options of the compiler: without wrappers that nobody calls, a function compiles in half to nine tenths of the time.

`kernel` is what Python calls, `inner` what only kernels call. Both are kept on disk. While numba compiles a function of
this package, Python looks for no garbage: a compiler makes objects by the hundred thousand, and passes over them each
time took an eighth of its time.
"""

from __future__ import annotations

import gc
from functools import partial
from typing import Any

from numba import njit
from numba.core import event

__all__ = ["inner", "kernel"]

kernel = partial(njit, cache=True, nogil=True, no_cfunc_wrapper=True)
"""Compile a function that Python calls; it releases Python's lock. Without the wrapper for callers from C."""

inner = partial(njit, cache=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
"""Compile a function that only kernels call: without the wrapper for Python, too."""


class _Pause(event.Listener):  # type: ignore[misc]  # numba has no types
    """Pauses the collector from the first function that is compiled to the end of the last that it calls.

    Numba compiles in one thread at a time.
    """

    def __init__(self) -> None:
        self._outer: Any = None

    def on_start(self, event: Any) -> None:
        """Pause, unless another function's compilation has paused it or nobody collects."""
        dispatcher = event.data["dispatcher"]
        if self._outer is None and gc.isenabled() and dispatcher.py_func.__module__.startswith("gsvis."):
            self._outer = dispatcher
            gc.disable()

    def on_end(self, event: Any) -> None:
        """Go on, at the end of the function that began."""
        if event.data["dispatcher"] is self._outer:
            self._outer = None
            gc.enable()


event.register("numba:compile", _Pause())
