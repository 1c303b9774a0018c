"""Coded parts give back every record, whatever it is, are smaller than zstd makes them, and damage is refused."""

from __future__ import annotations

import numpy as np
import pytest
import zstandard
from numpy.typing import NDArray

from gsvis._kernels.compiled import kernel
from gsvis.package import Contents
from gsvis.package._kernels.adaptive import carry
from gsvis.package.codec import ChunkTable
from gsvis.package.coded import decode_gaussians, decode_terms, encode_gaussians, encode_terms
from gsvis.package.layout import RecordLayout, TermLayout
from tests.package.worlds import colors_of, levels_of, without_wide_places

U8 = NDArray[np.uint8]
VARIANTS = ("rgb", "hsl")


def table_of(counts: list[int], seed: int = 0, position: int = 14) -> ChunkTable:
    """Rows of chunks with any numbers."""
    rng, c = np.random.default_rng(seed), len(counts)
    bits = rng.integers(0, position + 1, (c, 3))
    bits[0] = position
    return ChunkTable(
        np.zeros((c, 3)), np.ones((c, 3)), rng.integers(-8000, 8000, c).astype(np.int16),
        rng.integers(1, 256, c).astype(np.uint8), np.array(counts, np.uint16), bits,
    )  # fmt: skip


def any_records(n: int, kind: str) -> U8:
    rng = np.random.default_rng(n)
    if kind == "zeros":
        return np.zeros((n, 16), np.uint8)
    if kind == "ones":
        return np.full((n, 16), 255, np.uint8)
    if kind == "extremes":
        return np.repeat(rng.integers(0, 2, (n, 1)), 16, axis=1).astype(np.uint8) * np.uint8(255)
    return rng.integers(0, 256, (n, 16)).astype(np.uint8)


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("kind", ["zeros", "ones", "extremes", "noise"])
@pytest.mark.parametrize("counts", [[1], [2, 1, 3], [256, 256, 88]])
def test_any_records_come_back(variant: str, kind: str, counts: list[int]) -> None:
    layout, n = RecordLayout.from_variant(variant), sum(counts)
    table = table_of(counts, position=layout.position)
    records = without_wide_places(any_records(n, kind), table, layout)
    records[:, 15] &= 255 if variant == "rgb" else 127  # the last bit has no meaning in hsl
    terms = np.random.default_rng(1).integers(0, 256, n).astype(np.uint8)
    for numbers in (terms, terms * 0, terms // 64):
        data = encode_gaussians(records, numbers, table, layout)
        found, found_numbers = decode_gaussians(data, n, table, layout)
        assert np.array_equal(found, records)
        assert np.array_equal(found_numbers, numbers)
        assert data == encode_gaussians(records, numbers, table, layout)


@pytest.mark.parametrize("bits", [(0, 6, 7, 5, 6, 3), (3, 6, 7, 5, 6, 1), (2, 12, 13, 9, 9, 3), (0, 16, 16, 14, 16, 1)])
@pytest.mark.parametrize("kind", ["zeros", "noise"])
def test_any_terms_come_back(bits: tuple[int, ...], kind: str) -> None:
    layout, rng, n = TermLayout(*bits), np.random.default_rng(2), 500
    words = rng.integers(0, 1 << 63, n, dtype=np.uint64) if kind == "noise" else np.zeros(n, np.uint64)
    words &= np.uint64((1 << int(layout.widths.sum())) - 1)
    records = np.ascontiguousarray(words.astype("<u8").view(np.uint8).reshape(-1, 8)[:, : layout.nbytes])
    for firsts in (rng.random(n) < 0.4, np.ones(n, np.bool_)):
        data = encode_terms(records, firsts, layout)
        assert np.array_equal(decode_terms(data, firsts, layout), records)
    none = records[:0]
    assert len(decode_terms(encode_terms(none, firsts[:0], layout), firsts[:0], layout)) == 0


@pytest.mark.parametrize("variant", VARIANTS)
def test_parts_of_a_scene_are_smaller_than_zstd_makes_them(variant: str) -> None:
    contents = Contents.from_levels(levels_of(3000), colors_of(3000, variant)[1])
    planes = b"".join(contents.records[:, k].tobytes() for k in range(16)) + contents.term_counts.tobytes()
    data = encode_gaussians(contents.records, contents.term_counts, contents.table, contents.layout)
    assert len(data) < len(zstandard.ZstdCompressor(19).compress(planes))


def test_damage_and_other_parts_are_refused() -> None:
    layout, table, terms = RecordLayout.from_variant("rgb"), table_of([200, 100]), TermLayout(0, 6, 7, 5, 6, 3)
    records, counts, firsts = any_records(300, "noise"), np.zeros(300, np.uint8), np.ones(300, np.bool_)
    good = encode_gaussians(records, counts, table, layout)
    other = encode_terms(records[:, : terms.nbytes], firsts, terms)
    for bad in (
        b"",
        good[:15],
        good[:-1],
        good + b"\0",
        other,
        good[:4] + b"\2" + good[5:],
        good[:6] + b"\11" + good[7:],
    ):
        with pytest.raises(ValueError, match="expected"):
            decode_gaussians(bad, 300, table, layout)
    for data in (good, other + b"\0", other[:-4], other[:6] + b"\1" + other[7:]):
        with pytest.raises(ValueError, match="expected"):
            decode_terms(data, firsts, terms)
    for count, of in ((299, table), (300, table_of([200, 99])), (1 << 30, table)):
        with pytest.raises(ValueError, match="expected"):
            decode_gaussians(good, count, of, layout)
    rng = np.random.default_rng(3)
    for _ in range(100):
        at = int(rng.integers(16, len(good)))
        bad = good[:at] + bytes([good[at] ^ int(rng.integers(1, 256))]) + good[at + 1 :]
        try:
            found, _ = decode_gaussians(bad, 300, table, layout)
        except ValueError:
            continue
        assert found.shape == (300, 16)


def test_a_carry_goes_through_full_words() -> None:
    @kernel
    def add_one(words: NDArray[np.uint32]) -> None:
        carry(words, 4)

    words = np.array([7, 41, 0xFFFFFFFF, 0xFFFFFFFF, 5], np.uint32)
    add_one(words)
    assert words.tolist() == [7, 42, 0, 0, 5]
