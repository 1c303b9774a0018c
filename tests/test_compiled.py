"""While numba compiles a function of this package, nobody looks for garbage; afterward all is as it was."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from typing import Any

import pytest
from numba import njit, types
from numba.core.errors import NumbaError
from numba.extending import intrinsic

import gsvis._kernels.compiled  # noqa: F401  # pauses the collector

collected: list[bool] = []


def function(module: str, fails: bool = False) -> Any:
    """Return a function of a module that notes whether the collector is on when numba types it."""

    @intrinsic
    def look(typing_context: Any) -> Any:
        """Note it: numba asks once for each intrinsic."""
        collected.append(gc.isenabled())
        return types.void(), lambda context, builder, signature, arguments: context.get_dummy_value()

    def ours() -> None:
        look()

    def wrong() -> None:
        look()
        len(1)  # type: ignore[arg-type]

    chosen = wrong if fails else ours
    chosen.__module__ = module
    return njit(chosen)


@pytest.fixture(autouse=True)
def _fresh() -> Iterator[None]:
    collected.clear()
    yield
    gc.enable()


def test_the_collector_pauses_and_goes_on() -> None:
    function("gsvis.room")()
    assert collected
    assert not any(collected)
    assert gc.isenabled()


def test_it_goes_on_after_a_function_that_does_not_compile() -> None:
    with pytest.raises(NumbaError):
        function("gsvis.room", fails=True)()
    assert gc.isenabled()


def test_it_stays_off_where_somebody_turned_it_off() -> None:
    gc.disable()
    function("gsvis.room")()
    assert not gc.isenabled()


def test_functions_of_others_change_nothing() -> None:
    function("somebody")()
    assert collected
    assert all(collected)
