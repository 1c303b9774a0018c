"""A store that lies in several files answers as one in one file."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsvis.files.cache import Cache
from gsvis.files.joined import JoinedFiles
from gsvis.pvs.codec import pack_some
from gsvis.pvs.store import VisibilityStore
from tests.pvs.test_store import structured


@pytest.mark.parametrize("first", [0, 64, 1_000_037])
@pytest.mark.parametrize("most", [0, 1 << 20])
def test_a_store_in_parts_answers_as_one_file_in_ids_that_begin_anywhere(tmp_path: Path, first: int, most: int) -> None:
    truth = structured(5_000, 12)
    whole, data = truth.write(tmp_path / "whole.pvs"), (tmp_path / "whole.pvs").read_bytes()
    cuts = np.linspace(0, len(data), 8).astype(int).tolist()
    for k, (start, end) in enumerate(pairwise(cuts)):
        (tmp_path / f"{k}").write_bytes(data[start:end])
    joined = JoinedFiles([tmp_path / f"{k}" for k in range(7)], np.diff(cuts).tolist())
    shared = Cache[Any](most)
    with VisibilityStore(tmp_path / "none.pvs", joined=joined, cache=shared.scope("tile")).load() as store:
        for cell in range(len(whole)):
            numbers, masks = store.visible_masks(cell, first=first)
            expected = pack_some(first + whole.visible_ids(cell))
            assert np.array_equal(numbers, expected[0])
            assert np.array_equal(masks, expected[1])
            for mine, theirs in zip(store.classes(cell), whole.classes(cell), strict=True):
                assert np.array_equal(mine, theirs)
        assert shared.nbytes <= most
        assert bool(shared.nbytes) == bool(most)


@pytest.mark.parametrize("first", [0, 1_000_037])
def test_rings_hold_what_earlier_ones_do_not_whether_or_not_the_order_is_known(tmp_path: Path, first: int) -> None:
    truth, rings = structured(5_000, 12), [[3], [2, 4, 11], [], [0, 3, 1]]
    with truth.write(tmp_path / "a.pvs") as store:
        cache = Cache[Any]()
        with VisibilityStore(tmp_path / "a.pvs", cache=cache, order=store.order) as known:
            for each in (store, known):
                before = np.zeros(5_000, bool)
                for ring, sets in zip(rings, each.ring_masks(rings, first=first), strict=True):
                    seen = truth.seen[ring].any(axis=0)
                    (found,) = sets
                    for mine, theirs in zip(found, pack_some(first + np.flatnonzero(seen & ~before)), strict=True):
                        assert np.array_equal(mine, theirs)
                    before |= seen
        assert cache.find("order") is None
        with pytest.raises(ValueError, match=r"^order: expected 5,000 Gaussians, got 4,999"):
            VisibilityStore(tmp_path / "a.pvs", order=store.order[1:])
