"""Work that threads share: each unit is taken once, and largest values do not depend on who writes first."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from numba import get_num_threads, njit, set_num_threads

from gsvis._kernels.shared import raise_to, share, take_next
from gsvis._kernels.threads import on_numba_threads


@njit
def _count_unit(unit, times, order, taken):  # type: ignore[no-untyped-def]
    times[unit] += 1
    order[take_next(taken)] = unit


@on_numba_threads
@njit(nogil=True)
def _count_all(times, order):  # type: ignore[no-untyped-def]
    share(_count_unit, len(times), (times, order, np.zeros(1, np.int64)))


@njit
def _raise_one(i, places, values, largest):  # type: ignore[no-untyped-def]
    raise_to(largest, places[i], values[i])


@on_numba_threads
@njit(nogil=True)
def _raise_all(places, values, largest):  # type: ignore[no-untyped-def]
    share(_raise_one, len(values), (places, values, largest))


@pytest.fixture(params=[1, 2])
def threads(request: pytest.FixtureRequest) -> Iterator[None]:
    before = get_num_threads()
    set_num_threads(min(request.param, before))
    yield
    set_num_threads(before)


@pytest.mark.parametrize("count", [0, 1, 2, 1000])
@pytest.mark.usefixtures("threads")
def test_every_unit_is_taken_once(count: int) -> None:
    times, order = np.zeros(count, np.int64), np.full(count, -1)
    _count_all(times, order)
    assert (times == 1).all()
    assert sorted(order) == list(range(count))


@pytest.mark.usefixtures("threads")
def test_values_rise_to_the_largest() -> None:
    rng = np.random.default_rng(0)
    places, values = rng.integers(0, 7, 5000), (10.0 ** rng.uniform(-40, 30, 5000)).astype(np.float32)
    largest = np.zeros(7, np.float32)
    _raise_all(places, values, largest)
    expected = np.zeros(7, np.float32)
    np.maximum.at(expected, places, values)
    np.testing.assert_array_equal(largest, expected)
