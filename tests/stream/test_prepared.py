"""Records that were prepared once for a scene: coded in one pass, they have the bytes of the obvious way."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsvis.package.layout import RecordLayout
from gsvis.stream.coding import chunks_of
from tests.package.worlds import without_wide_places
from tests.stream.test_coding import SEEDS, any_code, coded, contents_of, hostile_table


@pytest.mark.parametrize("variant", ["rgb", "hsl"])
@pytest.mark.parametrize("coarse", [False, True])
@given(seed=SEEDS, share=st.floats(0.0, 1.0))
@settings(max_examples=20)
def test_some_records_have_the_same_bytes(variant: str, coarse: bool, seed: int, share: float) -> None:
    contents, code = coded(variant, coarse)
    ids = np.flatnonzero(np.random.default_rng(seed).random(len(contents)) < share).astype(np.int32)
    of, chunks = contents.chunks[ids], chunks_of(contents.table)
    found = code.encode_some(code.split_records(contents), ids, of, chunks)
    expected = code.encode_records(contents.records[ids], ids.astype(np.int64), of, chunks)
    assert found.tobytes() == expected.tobytes()


@pytest.mark.parametrize("variant", ["rgb", "hsl"])
@given(seed=SEEDS, n=st.integers(0, 60))
@settings(max_examples=30)
def test_any_records_have_the_same_bytes(variant: str, seed: int, n: int) -> None:
    """Also with rows of chunks that make no sense, where the largest scale is far from what is expected."""
    rng, layout = np.random.default_rng(seed), RecordLayout.from_variant(variant)
    code, table = any_code(contents_of(variant).grids, None, rng), hostile_table(rng, n, layout.position)
    rows = without_wide_places(rng.integers(0, 256, (n, 16)).astype(np.uint8), table, layout)
    of, chunks = table.of_all(), chunks_of(table)
    ids = np.flatnonzero(rng.random(n) < 0.7).astype(np.int32)
    found = code.encode_some(code._split(rows, of, chunks), ids, of[ids], chunks)
    assert found.tobytes() == code.encode_records(rows[ids], ids.astype(np.int64), of[ids], chunks).tobytes()
