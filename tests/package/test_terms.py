"""Records of terms: exact for what was rounded, and something to be shown for any bytes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsvis.color.fit import FitConfig
from gsvis.color.records import Precision, QuantizedColors, bytes_per_term, quantize
from gsvis.color.variants import VARIANTS
from gsvis.package import TermLayout, decode_terms, encode_terms
from gsvis.package.layout import RecordLayout
from tests.color.samples import random_colors


@pytest.mark.parametrize("variant", sorted(VARIANTS))
@pytest.mark.parametrize("precision", ["coarse", "wire"])
def test_terms_come_back_to_the_bit_in_as_few_whole_bytes_as_hold_them(variant: str, precision: str) -> None:
    colors = quantize(random_colors(np.random.default_rng(0), 50, variant), precision)
    records = encode_terms(colors)
    assert records.shape == (colors.num_terms, int(np.ceil(bytes_per_term(variant, precision))))
    found = decode_terms(records, colors.grids)
    for name in ("functions", "centers", "decays", "intensities"):
        np.testing.assert_array_equal(getattr(found, name), getattr(colors, name), err_msg=name)


@given(data=st.binary(min_size=5, max_size=50))
def test_any_bytes_decode_to_something_that_can_be_shown(data: bytes) -> None:
    for variant in VARIANTS:
        grids = quantize(random_colors(np.random.default_rng(0), 3, variant)).grids
        width = TermLayout.from_grids(grids).nbytes
        records = np.frombuffer(data[: len(data) // width * width], np.uint8).reshape(-1, width)
        found, n = decode_terms(records, grids), len(records)
        scales = np.zeros(0 if grids.kind.space == "rgb" else 1, np.uint16)
        QuantizedColors(grids, np.zeros((1, 3), np.uint16), scales, np.array([0, n]), *found).dequantize()


def test_terms_that_are_too_wide_are_refused() -> None:
    colors = random_colors(np.random.default_rng(0), 5, "rgb")
    with pytest.raises(ValueError, match="at most 8 bits"):
        encode_terms(quantize(colors, "fine"))
    wide = Precision("wide", base=8, scale=8, axis=8, center=15, decay=16, intensity=16)
    with pytest.raises(ValueError, match="at most 64 bits"):
        encode_terms(quantize(colors, wide))
    with pytest.raises(ValueError, match="records: expected shape"):
        decode_terms(np.zeros((2, 3), np.uint8), quantize(colors).grids)


def test_unknown_variants_are_refused_by_name() -> None:
    with pytest.raises(ValueError, match=r"variant: expected one of .*rgb.*hsl"):
        RecordLayout.from_variant("yuv")
    with pytest.raises(ValueError, match=r"variant: expected one of .*rgb.*hsl"):
        FitConfig(variant="yuv")
