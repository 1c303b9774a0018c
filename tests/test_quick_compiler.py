"""What tests change in Numba changes none of its answers."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numba import njit
from numba.core.compiler import Flags
from numba.core.lowering import BaseLower
from numba.core.targetconfig import TargetConfig

from tests.quick_compiler import compile_quickly


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compile quickly here, and as before afterward."""
    for home, name in ((TargetConfig, "values"), (TargetConfig, "__hash__"), (BaseLower, "create_cfunc_wrapper")):
        monkeypatch.setattr(home, name, getattr(home, name))
    compile_quickly()


def settings(**changed: Any) -> Flags:
    found = Flags()
    for name, value in changed.items():
        setattr(found, name, value)
    return found


@pytest.mark.parametrize("changed", [{}, {"nrt": True}, {"error_model": "numpy", "boundscheck": True}])
def test_settings_are_those_that_are_set_and_else_the_defaults(changed: dict[str, Any]) -> None:
    found = settings(**changed)
    assert list(found.values().items()) == [(name, getattr(found, name)) for name in found.options]


def test_equal_settings_have_one_hash_and_others_another() -> None:
    set_to_default = settings(nrt=Flags.options["nrt"].default)
    assert set_to_default == settings()
    assert hash(set_to_default) == hash(settings())
    others = [settings(), settings(nrt=True), settings(boundscheck=True), settings(error_model="numpy")]
    assert len({hash(each) for each in others}) == len(set(others)) == 4


def test_functions_of_numba_work_in_a_kernel() -> None:
    @njit
    def largest(values: Any, least: float) -> Any:
        found = np.full(2, least)
        for value in values:
            found[0] = max(found[0], value)
        return found

    np.testing.assert_array_equal(largest(np.array([1.0, 3.0, 2.0]), 0.5), [3.0, 0.5])


def test_a_numba_without_these_parts_compiles_as_it_does(monkeypatch: pytest.MonkeyPatch) -> None:
    own = TargetConfig.__dict__["values"]
    monkeypatch.delattr(BaseLower, "create_cfunc_wrapper")
    monkeypatch.setattr(TargetConfig, "values", lambda config: {"other": 1})  # says something else
    before = TargetConfig.values
    compile_quickly()
    assert TargetConfig.values is before is not own
    assert not hasattr(BaseLower, "create_cfunc_wrapper")
