"""Records that were prepared once for a scene: coded in one pass, they have the bytes of the obvious way."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit

from gsvis.package.layout import RecordLayout, TermLayout
from gsvis.package.rounding import chunks_of
from gsvis.stream._kernels import coder, records
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
    found = code.encode_some(code._split_rows(rows, of, chunks), ids, of[ids], chunks)
    assert found.tobytes() == code.encode_records(rows[ids], ids.astype(np.int64), of[ids], chunks).tobytes()


@pytest.mark.parametrize("variant", ["rgb", "hsl"])
@given(seed=SEEDS, share=st.floats(0.0, 1.0))
@settings(max_examples=20)
def test_some_terms_have_the_same_bytes(variant: str, seed: int, share: float) -> None:
    contents, code = coded(variant, False)
    ids = np.flatnonzero(np.random.default_rng(seed).random(len(contents.term_records)) < share).astype(np.uint32)
    owners = np.repeat(np.arange(len(contents), dtype=np.int32), contents.term_counts)[ids]
    found = code.encode_some_terms(contents.term_records, ids, owners)
    assert found.tobytes() == code.encode_terms(contents.term_records[ids], owners).tobytes()


@pytest.mark.parametrize("variant", ["rgb", "hsl"])
@given(seed=SEEDS, n=st.integers(1, 60))
@settings(max_examples=30)
def test_any_terms_have_the_same_bytes(variant: str, seed: int, n: int) -> None:
    rng, grids = np.random.default_rng(seed), contents_of(variant).grids
    code, layout = any_code(grids, None, rng), TermLayout.from_grids(grids)
    numbers = rng.integers(0, 1 << sum(layout.widths), n, np.uint64)
    rows = np.ascontiguousarray(numbers.astype("<u8").view(np.uint8).reshape(n, 8)[:, : layout.nbytes])
    ids = np.flatnonzero(rng.random(n) < 0.7).astype(np.uint32)
    owners = np.sort(rng.integers(0, n, len(ids))).astype(np.int32)
    found = code.encode_some_terms(rows, ids, owners)
    assert found.tobytes() == code.encode_terms(rows[ids], owners).tobytes()


def test_inverses_divide_every_state_by_every_size() -> None:
    sizes = np.arange(1, coder.TOTAL + 1, dtype=np.uint64)
    inverses = ((np.uint64(1) << np.uint64(coder.INVERSE)) - np.uint64(1)) // sizes + np.uint64(1)
    most = (sizes << np.uint64(32 - coder.BITS)) - np.uint64(1)  # larger states lose a word first
    for k in range(200):
        states = np.random.default_rng(k).integers(0, most, dtype=np.uint64, endpoint=True)
        for near in (states, states // sizes * sizes, np.maximum(states // sizes * sizes, 1) - np.uint64(1), most):
            np.testing.assert_array_equal((near * inverses) >> np.uint64(coder.INVERSE), near // sizes)


@njit
def divide(values: np.ndarray, strides: np.ndarray, out: np.ndarray) -> None:
    for i in range(len(values)):
        out[i] = records._divide(values[i], strides[i], records._inverse(strides[i]))


def test_strides_divide_without_a_division() -> None:
    strides = np.arange(1, 256)
    for k in range(100):
        rng = np.random.default_rng(k)
        values = rng.integers(-(strides << 18), strides << 18)
        for near in (values, values // strides * strides, -(strides << 18), (strides << 18) - 1):
            out = np.empty(len(strides), np.int64)
            divide(near, strides, out)
            np.testing.assert_array_equal(out, near // strides)
