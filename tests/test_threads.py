"""A kernel on several threads: each row falls to one of them, each unit is taken once, errors come through."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator

import numpy as np
import pytest
from numba import get_num_threads, njit, set_num_threads

from gsvis._kernels.shared import take_next
from gsvis._kernels.threads import in_parts, in_threads


@in_parts(lambda rows, *_: len(rows))
@njit(nogil=True)
def _count(begin, end, rows, ends):
    """Count each row, and note where a part ends."""
    for i in range(begin, end):
        rows[i] += 1
    ends[begin] = end


@in_threads(lambda units: len(units))
@njit(nogil=True)
def _take(taken, units):
    unit = take_next(taken)
    while unit < len(units):
        units[unit] += 1
        unit = take_next(taken)


@in_parts(lambda rows, *_: rows)
def _plain(begin: int, end: int, rows: int, seen: list[tuple[int, int, str]]) -> None:
    seen.append((begin, end, threading.current_thread().name))
    if end == rows:
        raise ValueError("the last part")


@pytest.fixture(params=[1, 2])
def threads(request: pytest.FixtureRequest) -> Iterator[int]:
    before = get_num_threads()
    set_num_threads(min(request.param, before))
    yield get_num_threads()
    set_num_threads(before)


@pytest.mark.parametrize("rows", [0, 1, 2, 1001])
def test_each_row_falls_to_one_thread_and_each_unit_is_taken_once(rows: int, threads: int) -> None:
    counts, ends, units = np.zeros(rows, np.int64), np.zeros(rows + 1, np.int64), np.zeros(rows, np.int64)
    _count(counts, ends)
    _take(units)
    assert (counts == 1).all()
    assert (units == 1).all()
    assert np.count_nonzero(ends) == min(threads, rows)


def test_an_error_in_any_part_is_raised_when_all_have_ended(threads: int) -> None:
    seen: list[tuple[int, int, str]] = []
    with pytest.raises(ValueError, match="the last part"):
        _plain(8, seen)
    assert sorted(row[:2] for row in seen) == ([(0, 8)] if threads == 1 else [(0, 4), (4, 8)])
    assert threading.current_thread().name in {row[2] for row in seen}


def test_the_name_and_the_words_are_the_kernels() -> None:
    assert _count.__name__ == "_count"
    assert _count.__doc__ == "Count each row, and note where a part ends."


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
def test_a_fork_has_threads_of_its_own(threads: int) -> None:
    rows, ends = np.zeros(100, np.int64), np.zeros(101, np.int64)
    _count(rows, ends)
    child = os.fork()
    if child == 0:  # leaves at once: nothing of pytest runs twice
        _count(rows, ends)
        os._exit(0 if (rows == 2).all() else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
