"""Work that threads share: each unit is taken once, and largest values do not depend on who writes first."""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from gsvis._kernels.shared import WORKERS, raise_to, take_next


@njit(parallel=True)
def _take_all(taken, times):
    for _worker in prange(WORKERS):
        unit = take_next(taken)
        while unit < len(times):
            times[unit] += 1
            unit = take_next(taken)


@njit(parallel=True)
def _raise_all(places, values, largest):
    for i in prange(len(values)):
        raise_to(largest, places[i], values[i])


def test_every_unit_is_taken_once() -> None:
    for count in (0, 1, 1000):
        times = np.zeros(count, np.int64)
        taken = np.zeros(1, np.int64)
        _take_all(taken, times)
        assert (times == 1).all()
        assert taken[0] == count + WORKERS  # each worker asks once in vain


def test_values_rise_to_the_largest() -> None:
    rng = np.random.default_rng(0)
    places, values = rng.integers(0, 7, 5000), (10.0 ** rng.uniform(-40, 30, 5000)).astype(np.float32)
    largest = np.zeros(7, np.float32)
    _raise_all(places, values, largest)
    expected = np.zeros(7, np.float32)
    np.maximum.at(expected, places, values)
    np.testing.assert_array_equal(largest, expected)
