"""Decorators that compile functions with numba, without unused wrappers, which saves 10 to 50% of the time.

`kernel` is for functions that Python calls, `inner` for functions that only kernels call, `uncounted` for those among
them that hold the loops. Compiled code is kept on disk. If numba finds no folder for it, it goes to `GSVIS_CACHE` or to
a temporary folder, else it is not kept; a warning is logged. During compilation the garbage collector is paused,
because it took an eighth of the time.
"""

from __future__ import annotations

import gc
import logging
import os
import tempfile
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any

import numba
from numba.core import event, registry

from gsvis.files.temporary import private_folder

__all__ = ["inner", "kernel", "load_numba", "njit", "uncounted"]

_LOG = logging.getLogger(__name__)
_PLACE = "NUMBA_CACHE_DIR"


def njit(function: Callable[..., Any] | None = None, /, **options: Any) -> Any:
    """Compile a function as `numba.njit` does; one that cannot be kept on disk is compiled in each process.

    Args:
        function: The function; None returns a decorator.
        **options: Those of `numba.njit`.
    """
    if function is None:
        return partial(njit, **options)
    if not options.get("cache"):
        return numba.njit(**options)(function)
    if not os.path.isabs(os.path.expanduser("~")):
        _choose_folder()  # numba would make a folder `~` in the current one
    try:
        return numba.njit(**options)(function)
    except RuntimeError:  # neither the installation nor a folder of this user can be written
        pass
    try:
        if _choose_folder():
            return numba.njit(**options)(function)
    except RuntimeError:
        pass
    _report_none()
    return numba.njit(**{**options, "cache": False})(function)


@cache
def _choose_folder() -> bool:
    """Choose a folder for compiled kernels, once in a process; return whether there is one that can be written."""
    if os.environ.get(_PLACE):  # set by the user or by a parent process
        return False
    for make in (_named_folder, _temporary_folder):
        try:
            place = make()
            if place is None:
                continue
            tempfile.TemporaryFile(dir=place).close()
        except OSError:
            continue
        os.environ[_PLACE] = numba.config.CACHE_DIR = str(place)
        hint = "because no other folder is writable; set GSVIS_CACHE to choose one"
        _LOG.warning("compiled kernels are kept in %s, %s", place, hint)
        return True
    return False


def _named_folder() -> Path | None:
    """Return the folder for kernels in `GSVIS_CACHE`, created if missing; None if that is not set."""
    named = os.environ.get("GSVIS_CACHE")
    if not named:
        return None
    place = Path(named) / "kernels"
    place.mkdir(parents=True, exist_ok=True)
    return place


def _temporary_folder() -> Path:
    """Return a folder for kernels among temporary files, which only this user can write to."""
    user = os.getuid() if hasattr(os, "getuid") else os.environ.get("USERNAME", "")
    return private_folder(Path(tempfile.gettempdir()) / f"gsvis-kernels-{user}")


@cache
def _report_none() -> None:
    """Log once that kernels are not kept."""
    _LOG.warning("compiled kernels are not kept, so each start compiles them; set GSVIS_CACHE to a writable folder")


kernel = partial(njit, cache=True, nogil=True, no_cfunc_wrapper=True)
"""Compile a function that Python calls; it releases the GIL. It has no wrapper for C."""

inner = partial(njit, cache=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
"""Compile a function that only kernels call; it has no wrappers for Python and C."""


uncounted = partial(inner, _nrt=False)
"""Compile a function that only kernels call, without counting references to its arrays.

It may allocate nothing and return no array. Counting is atomic, so it costs some nanoseconds for each array and call.
"""


def load_numba() -> None:
    """Load what Numba needs before its first kernel, 0.2 s, so that it does not wait for a kernel to do so."""
    registry.cpu_target.typing_context.refresh()
    registry.cpu_target.target_context.refresh()


class _Pause(event.Listener):  # type: ignore[misc]  # numba has no types
    """Pauses the garbage collector while a function, and the functions that it calls, are compiled.

    Numba compiles in one thread at a time.
    """

    def __init__(self) -> None:
        self._outer: Any = None

    def on_start(self, event: Any) -> None:
        """Pause the collector, unless it is paused or disabled."""
        dispatcher = event.data["dispatcher"]
        if self._outer is None and gc.isenabled() and dispatcher.py_func.__module__.startswith("gsvis."):
            self._outer = dispatcher
            gc.disable()

    def on_end(self, event: Any) -> None:
        """Resume the collector at the end of the outermost function."""
        if event.data["dispatcher"] is self._outer:
            self._outer = None
            gc.enable()


event.register("numba:compile", _Pause())
