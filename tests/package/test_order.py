"""Orders of Gaussians in a package: those of numpy's stable sorts."""

from __future__ import annotations

import numpy as np

from gsvis.package._kernels import records as kernels
from gsvis.package.order import _order_of_few


def test_a_chunk_begins_with_its_largest_values_and_equal_ones_stay_in_order() -> None:
    rng = np.random.default_rng(2)
    starts = np.cumsum([0, *rng.integers(1, 257, 40)])[:-1]
    values = rng.integers(0, 30, starts[-1] + 17) / 7.0
    inside = np.repeat(np.arange(len(starts)), np.diff(np.append(starts, len(values))))
    order = np.empty(len(values), np.int64)
    kernels.sort_chunks(starts, values, order)
    assert np.array_equal(order, np.lexsort((-values, inside)))


def test_few_keys_are_sorted_stably() -> None:
    keys = np.random.default_rng(3).choice([0, 5, 300, 65535], 5000)
    assert np.array_equal(_order_of_few(keys), np.argsort(keys, kind="stable"))
