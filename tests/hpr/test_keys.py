"""Keys are sorted as numpy sorts them, wherever their distances lie."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from gsvis._kernels.compiled import kernel
from gsvis.hpr._kernels.keys import BELOW, PLACES, sort_keys

U64 = NDArray[np.uint64]


@kernel
def _sorted(keys, room, tally, count):
    return room if sort_keys(keys, room, tally, count) else keys


def in_order(keys: U64) -> U64:
    found = _sorted(keys.copy(), np.zeros(len(keys) + 3, np.uint64), np.empty(PLACES + 1, np.int64), len(keys))
    return found[: len(keys)]


def keys_of(squared: NDArray[np.float32], rows: NDArray[np.int64]) -> U64:
    return (squared.view(np.uint32).astype(np.uint64) << BELOW) | rows.astype(np.uint64)


@given(st.integers(0, 10_000), st.sampled_from([1, 2, 11, 12, 13, 300, 3000]))
def test_keys_come_nearest_first(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    squared = (rng.random(count) ** rng.choice([1, 4, 30])).astype(np.float32)
    keys = keys_of(squared, rng.permutation(count))
    assert in_order(keys).tolist() == np.sort(keys).tolist()


@pytest.mark.parametrize("away", [0.0, 1.0, 1e30])
def test_keys_of_one_distance_but_one_are_ordered_by_row(away: float) -> None:
    squared = np.full(5000, 2.0, np.float32)
    squared[1234] = away
    keys = keys_of(squared, np.random.default_rng(0).permutation(5000))
    assert in_order(keys).tolist() == np.sort(keys).tolist()
