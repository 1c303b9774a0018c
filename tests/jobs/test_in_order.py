"""Functions called in threads: results in the order of the items, few items ahead, errors raised where they are due."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import numba
import pytest

from gsvis.jobs.in_order import in_order


def test_results_come_in_the_order_of_the_items() -> None:
    gate = threading.Event()

    def square(k: int) -> int:
        """The first waits for the second, so they end in the other order."""
        if k == 0 and numba.get_num_threads() > 1:
            gate.wait(10.0)
        gate.set()
        return k * k

    assert list(in_order(square, range(20))) == [k * k for k in range(20)]
    assert list(in_order(square, [])) == []


def test_items_are_taken_a_few_ahead_in_the_thread_of_the_caller() -> None:
    taken: list[int] = []
    threads = set()

    def items() -> Iterator[int]:
        for k in range(50):
            taken.append(k)
            threads.add(threading.get_ident())
            yield k

    most = 0
    for k in in_order(lambda each: each, items()):
        most = max(most, len(taken) - k)
    assert threads == {threading.get_ident()}
    assert most <= numba.get_num_threads() + 1


def test_an_error_is_raised_after_the_results_before_it() -> None:
    found = []
    with pytest.raises(ZeroDivisionError):
        for value in in_order(lambda k: 6 // (3 - k), range(10)):
            found.append(value)
    assert found == [2, 3, 6]
