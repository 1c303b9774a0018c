"""Numba compiles the same code in five sixths of the time: what it does for nobody here is left out.

Only for tests, which compile some hundred functions where nothing is cached. Compiled code is the same: what changes is
how Numba compares its own settings, what it reports, and wrappers of its own functions that nobody calls.
"""

from __future__ import annotations

from contextlib import suppress
from functools import cache
from typing import Any

from llvmlite.binding import ffi
from numba.core.lowering import BaseLower
from numba.core.targetconfig import TargetConfig

__all__ = ["compile_quickly"]

_wrap_for_c = BaseLower.create_cfunc_wrapper


def compile_quickly() -> None:
    """Let Numba waste less time, from now on, in this process."""
    TargetConfig.values = _values
    TargetConfig.__hash__ = _hash
    BaseLower.create_cfunc_wrapper = _wrap_ours_for_c
    with suppress(AttributeError):
        ffi.lib._lock._cblist.clear()  # listeners to each call of LLVM, of which there are ten thousands


def _values(config: Any) -> dict[str, Any]:
    """Return the options of a configuration by name, defaults without asking each for its own."""
    return {**_defaults(type(config)), **config._values}


@cache
def _defaults(kind: Any) -> dict[str, Any]:
    return {name: option.default for name, option in kind.options.items()}


def _hash(config: Any) -> int:
    """Return a hash of what is set; that of Numba is one for all, so that each lookup compares with many."""
    return hash(tuple([value for value in _values(config).values() if isinstance(value, bool | int | str)]))


def _wrap_ours_for_c(lower: Any) -> None:
    """Add a wrapper for C, but to none of the functions that Numba brings: kernels call those directly."""
    if not lower.fndesc.modname.startswith("numba."):
        _wrap_for_c(lower)
