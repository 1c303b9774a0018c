"""Numba compiles the same code in five sixths of the time: what it does for nobody here is left out.

Only for tests, which compile some hundred functions where nothing is cached. Compiled code is the same: what changes is
how Numba compares its own settings, what it reports, and wrappers of its own functions that nobody calls. These are
private parts of Numba: where a version has none of that name, or they say something else, it compiles as it does.
"""

from __future__ import annotations

from contextlib import suppress
from functools import cache
from typing import Any

__all__ = ["compile_quickly"]


def compile_quickly() -> None:
    """Let Numba waste less time, from now on, in this process."""
    for change in (_compare_settings_quickly, _wrap_only_ours, _end_listening):
        with suppress(ImportError, AttributeError):
            change()


def _compare_settings_quickly() -> None:
    from numba.core.compiler import Flags
    from numba.core.targetconfig import TargetConfig

    flags = Flags()
    flags.nrt = not flags.nrt
    if list(_values(flags).items()) == list(flags.values().items()):
        TargetConfig.values = _values
        TargetConfig.__hash__ = _hash


def _values(config: Any) -> dict[str, Any]:
    """Return the options of a configuration by name, defaults without asking each for its own."""
    return {**_defaults(type(config)), **config._values}


@cache
def _defaults(kind: Any) -> dict[str, Any]:
    return {name: option.default for name, option in kind.options.items()}


def _hash(config: Any) -> int:
    """Return a hash of what is set; that of Numba is one for all, so that each lookup compares with many."""
    return hash(tuple([value for value in _values(config).values() if isinstance(value, bool | int | str)]))


def _wrap_only_ours() -> None:
    """Let kernels of ours have a wrapper for C, but no function that Numba brings: kernels call those directly."""
    from numba.core.lowering import BaseLower

    wrap_for_c = BaseLower.create_cfunc_wrapper
    if wrap_for_c.__module__ == __name__:  # done before
        return

    def wrap_ours_for_c(lower: Any) -> None:
        if not lower.fndesc.modname.startswith("numba."):
            wrap_for_c(lower)

    BaseLower.create_cfunc_wrapper = wrap_ours_for_c


def _end_listening() -> None:
    """Tell no listener of a call of LLVM, of which there are ten thousands."""
    from llvmlite.binding import ffi

    ffi.lib._lock._cblist.clear()
