"""Options of the compiler: without wrappers that nobody calls, a function compiles in half to nine tenths of the time.

`kernel` is what Python calls, `inner` what only kernels call. Both are kept on disk: where numba finds no place to keep
them, in `GSVIS_CACHE` or among temporary files, else not at all; one line says so. While numba compiles a function of
this package, Python looks for no garbage: a compiler makes objects by the hundred thousand, and passes over them each
time took an eighth of its time.
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
from numba.core import event

from gsvis.files.temporary import private_folder

__all__ = ["inner", "kernel", "njit"]

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
        _choose_place()  # numba would make a folder `~` in the current one
    try:
        return numba.njit(**options)(function)
    except RuntimeError:  # neither the installation nor a folder of this user can be written
        pass
    try:
        if _choose_place():
            return numba.njit(**options)(function)
    except RuntimeError:
        pass
    _report_none()
    return numba.njit(**{**options, "cache": False})(function)


@cache
def _choose_place() -> bool:
    """Let numba keep kernels in a folder of ours, once in a process; return whether one can be written."""
    if os.environ.get(_PLACE):  # a folder that somebody chose, or that the process before this one found
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
        _LOG.warning("compiled kernels are kept in %s, as no other place can be written; GSVIS_CACHE names one", place)
        return True
    return False


def _named_folder() -> Path | None:
    named = os.environ.get("GSVIS_CACHE")
    if not named:
        return None
    place = Path(named) / "kernels"
    place.mkdir(parents=True, exist_ok=True)
    return place


def _temporary_folder() -> Path:
    user = os.getuid() if hasattr(os, "getuid") else os.environ.get("USERNAME", "")
    return private_folder(Path(tempfile.gettempdir()) / f"gsvis-kernels-{user}")


@cache
def _report_none() -> None:
    _LOG.warning("compiled kernels are not kept, so each start compiles them; name a folder in GSVIS_CACHE")


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
