"""A kernel is compiled once, however many processes of a test run want it: the others wait, then load it.

Without this, workers that start with an empty cache compile the same kernels at the same time, and one of two that save
at once is lost. Kernels call each other in no circle, so that no two processes wait for each other.
"""

from __future__ import annotations

import os
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from numba.core.caching import NullCache
from numba.core.compiler_lock import global_compiler_lock
from numba.core.dispatcher import Dispatcher

from tests.quick_compiler import compile_quickly

try:
    import fcntl
except ImportError:  # not on Windows: there, kernels may be compiled twice
    fcntl = None  # type: ignore[assignment]

__all__ = ["LOCKS", "compile_once", "locked"]

LOCKS = Path(__file__).parent / "__pycache__" / "kernels.lock"
"""In the checkout, as the caches are: in a folder for all, such as /tmp, somebody else could put a link here."""

_compile = Dispatcher.compile
_files: dict[int, int | None] = {}


def pytest_configure() -> None:
    """Let workers of doctests take turns, too: `pytest -p tests.one_compiler`."""
    compile_once()


def compile_once() -> None:
    """Let one process at a time compile a kernel that has a cache, and quickly; from now on, in this process."""
    compile_quickly()
    if fcntl is not None:
        Dispatcher.compile = _compile_alone


def _compile_alone(dispatcher: Any, signature: Any) -> Any:
    if isinstance(dispatcher._cache, NullCache):
        return _compile(dispatcher, signature)
    code = dispatcher.py_func.__code__
    with global_compiler_lock, locked(f"{code.co_filename}:{code.co_firstlineno}"):
        return _compile(dispatcher, signature)


@contextmanager
def locked(name: str) -> Iterator[None]:
    """Hold the byte of a file that stands for a name; nothing, where the file cannot be opened."""
    file, place = _file(), zlib.crc32(name.encode())
    with suppress(OSError):
        if file is not None:
            fcntl.lockf(file, fcntl.LOCK_EX, 1, place)
    try:
        yield
    finally:
        with suppress(OSError):
            if file is not None:
                fcntl.lockf(file, fcntl.LOCK_UN, 1, place)


def _file() -> int | None:
    """Return the file of locks, open in this process. A lock ends with its process, and a fork has none."""
    if os.getpid() not in _files:
        try:
            LOCKS.parent.mkdir(exist_ok=True)
            _files[os.getpid()] = os.open(LOCKS, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
        except OSError:  # nobody else writes where this is, so that only rights or a full disk lead here
            _files[os.getpid()] = None
    return _files[os.getpid()]
