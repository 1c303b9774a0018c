"""Codebooks and palettes: exact where they can be, better with more entries, the same every time."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from gsvis.io.quantize import codebook_of, nearest_entry, palette_of


def test_few_distinct_values_are_kept_exactly() -> None:
    values = np.random.default_rng(0).choice(np.linspace(-3, 7, 200, dtype=np.float32), (500, 3))
    book = codebook_of(values)
    np.testing.assert_array_equal(book[nearest_entry(values, book)], values)


def test_a_codebook_beats_even_steps_and_keeps_outliers_near() -> None:
    values = np.random.default_rng(0).standard_normal(20_000).astype(np.float32)
    values[0] = 30.0
    book = codebook_of(values)
    even = np.linspace(values.min(), values.max(), 256, dtype=np.float32)
    error = [np.mean((values - b[nearest_entry(values, b)]) ** 2) for b in (book, even)]
    assert error[0] < error[1] / 3
    assert np.abs(values - book[nearest_entry(values, book)]).max() < (values.max() - values.min()) / 64


@given(hnp.arrays(np.float32, st.integers(1, 600), elements=st.floats(-1e6, 1e6, width=32)))
def test_any_values_have_a_rising_codebook_within_their_range(values: np.ndarray) -> None:
    book = codebook_of(values)
    assert book.shape == (256,)
    assert (np.diff(book) >= 0).all()
    assert values.min() <= book[0]
    assert book[-1] <= values.max()


def test_few_distinct_vectors_are_kept_exactly() -> None:
    some = np.random.default_rng(0).standard_normal((50, 9)).astype(np.float32)
    vectors = some[np.random.default_rng(1).integers(0, 50, 400)]
    palette, labels = palette_of(vectors, 64)
    assert len(palette) <= 50
    np.testing.assert_array_equal(palette[labels], vectors)


@pytest.mark.parametrize("entries", [1, 2, 30, 300])
def test_a_palette_has_at_most_its_entries_and_each_vector_the_nearest_of_its_group(entries: int) -> None:
    vectors = np.random.default_rng(0).standard_normal((2000, 9)).astype(np.float32)
    palette, labels = palette_of(vectors, entries)
    assert len(palette) <= entries
    assert labels.min() >= 0
    assert labels.max() < len(palette)
    again = palette_of(vectors, entries)
    np.testing.assert_array_equal(palette, again[0])
    np.testing.assert_array_equal(labels, again[1])


def test_more_entries_err_less() -> None:
    rng = np.random.default_rng(0)
    centers = rng.standard_normal((40, 9))
    vectors = (centers[rng.integers(0, 40, 4000)] + 0.05 * rng.standard_normal((4000, 9))).astype(np.float32)
    errors = []
    for entries in (8, 64, 512):
        palette, labels = palette_of(vectors, entries)
        errors.append(np.mean((palette[labels] - vectors) ** 2))
    assert errors[0] > errors[1] > errors[2]
    assert errors[1] < 0.2 * vectors.var()
