"""The cache: what is kept, what goes first, and what is never kept."""

from __future__ import annotations

import numpy as np
import pytest

from gsvis.files.cache import Cache


def test_the_least_recently_used_goes_first() -> None:
    cache: Cache[np.ndarray] = Cache(30)
    for key in "abc":
        cache.keep(key, np.zeros(10, np.uint8))
    assert cache.find("a") is not None
    cache.keep("d", np.zeros(10, np.uint8))
    assert [cache.find(key) is not None for key in "abcd"] == [True, False, True, True]
    assert (cache.nbytes, len(cache)) == (30, 3)
    cache.keep("large", np.zeros(31, np.uint8))
    assert cache.find("large") is None
    cache.clear()
    assert (cache.nbytes, len(cache)) == (0, 0)


def test_a_value_is_made_once_while_it_is_kept() -> None:
    cache: Cache[list[int]] = Cache(max_items=2)
    made = []

    def make(key: int) -> list[int]:
        made.append(key)
        return [key]

    for key in (1, 2, 1, 3, 1, 2):
        assert cache.find_or_make(key, lambda key=key: make(key)) == [key]  # type: ignore[misc]
    assert made == [1, 2, 3, 2]


@pytest.mark.parametrize("sizes", [[50], [5, 50], [5, 50, 5]])
def test_the_last_value_stays_however_large(sizes: list[int]) -> None:
    cache: Cache[str] = Cache(10, keep_last=True)
    for k, size in enumerate(sizes):
        cache.keep(k, "x", size)
    assert cache.find(len(sizes) - 1) == "x"
    assert cache.nbytes <= max(10, sizes[-1])
    assert cache.nbytes == sum(size for k, size in enumerate(sizes) if cache.find(k))
