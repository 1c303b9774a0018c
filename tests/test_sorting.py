"""Order: as a stable sort has it, whatever is equal."""

from __future__ import annotations

import numpy as np
import pytest

from gsvis._sorting import stable_order


@pytest.mark.parametrize("many", [1, 2, 7, 1_000_000])
@pytest.mark.parametrize("kind", [np.float64, np.float32, np.uint64, np.int64])
def test_the_order_is_that_of_a_stable_sort(many: int, kind: type) -> None:
    values = np.random.default_rng(many).integers(0, many, 3_000).astype(kind)
    np.testing.assert_array_equal(stable_order(values), np.argsort(values, kind="stable"))


def test_signed_zeros_are_equal_and_infinities_have_a_place() -> None:
    values = np.array([0.0, np.inf, -0.0, 1.0, np.inf, 0.0, -np.inf])
    assert stable_order(values).tolist() == [6, 0, 2, 5, 3, 1, 4]


def test_nothing_has_an_empty_order() -> None:
    assert len(stable_order(np.zeros(0))) == 0
