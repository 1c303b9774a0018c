"""Links between levels: 32 bits of a Gaussian say what the lists of all links say, or that these have to be read."""

from __future__ import annotations

import numpy as np
import pytest

from gsvis.abr._kernels.plan import NONE, SEVERAL, only_of
from gsvis.abr.links import pack_single_links


@pytest.mark.parametrize("count", [0, 1, 63, 64, 1000])
@pytest.mark.parametrize("most", [5, 60_000, 1 << 30])
def test_rows_say_what_the_lists_say(count: int, most: int) -> None:
    rng = np.random.default_rng(count + most)
    counts = rng.choice([0, 1, 1, 1, 3], count).astype(np.int64)
    ranks = (rng.integers(0, 3, len(counts)).repeat(counts) + rng.integers(0, most, counts.sum())).astype(np.int32)
    units = rng.integers(1, 1 << 16, len(ranks)).astype(np.int32)
    only, firsts = pack_single_links(counts, ranks, units)
    assert len(firsts) == -(-count // 64)
    starts, packed = np.cumsum(counts) - counts, 0
    for g in range(count):
        found, start = only_of.py_func(only[g], np.int64(firsts[g >> 6])), starts[g]
        if counts[g] == 0:
            assert found == NONE
        elif counts[g] > 1:
            assert found == SEVERAL
        elif found != SEVERAL:  # else it lies too far from the others of its word
            assert found == ranks[start]
            assert only[g] >> 16 == units[start]
            packed += 1
    if most < 1 << 16:
        assert packed == np.count_nonzero(counts == 1)
