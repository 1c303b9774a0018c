"""Rounded records come back from packages and take fewer bytes; packages that keep all bits stay as they were."""

from __future__ import annotations

from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from gsvis.errors import FormatError
from gsvis.package import Contents, Package, write_package
from gsvis.package.coded import TermsLack, decode_gaussians, decode_terms, encode_gaussians, encode_terms
from gsvis.package.layout import TermLayout
from gsvis.package.rounding import Limits, Quality, limits_of, rounded_contents
from tests.package.worlds import colors_of, levels_of

VARIANTS = ("rgb", "hsl")
FINER = (-1.0, 0.0, 2.0)


@cache
def exact_of(variant: str, *, lattice: bool = False) -> Contents:
    return Contents.from_levels(levels_of(1500, 5, lattice=lattice), colors_of(1500, variant, 5)[1])


@cache
def rounded_of(variant: str, finer: float, *, lattice: bool = False) -> Contents:
    limits = limits_of(exact_of(variant, lattice=lattice), Quality().finer(finer))
    return rounded_contents(levels_of(1500, 5, lattice=lattice), colors_of(1500, variant, 5)[1], limits)


def parts_of(contents: Contents) -> tuple[bytes, bytes]:
    """All Gaussians and all terms of a small scene, each as one part."""
    gaussians = encode_gaussians(
        contents.records, contents.term_counts, contents.table, contents.layout, contents.limits
    )
    return gaussians, encode_terms(
        contents.term_records, firsts_of(contents), TermLayout.from_grids(contents.grids), lacking_of(contents)
    )


def firsts_of(contents: Contents) -> np.ndarray:
    owners = np.repeat(np.arange(len(contents)), contents.term_counts)
    return np.concatenate([[True], np.diff(owners) != 0])


def lacking_of(contents: Contents) -> TermsLack | None:
    columns = contents.records, contents.term_counts, contents.table, contents.grids, contents.limits
    return TermsLack.from_records(*columns)


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("finer", FINER)
@pytest.mark.parametrize("lattice", [False, True])
def test_rounded_parts_come_back(variant: str, finer: float, lattice: bool) -> None:
    contents = rounded_of(variant, finer, lattice=lattice)
    gaussians, terms = parts_of(contents)
    n = len(contents)
    records, counts = decode_gaussians(gaussians, n, contents.table, contents.layout, contents.limits)
    assert np.array_equal(records, contents.records)
    assert np.array_equal(counts, contents.term_counts)
    found = decode_terms(terms, firsts_of(contents), TermLayout.from_grids(contents.grids), lacking_of(contents))
    assert np.array_equal(found, contents.term_records)


@pytest.mark.parametrize("variant", VARIANTS)
def test_the_coarser_the_fewer_bytes_and_the_larger_the_errors(variant: str) -> None:
    exact = exact_of(variant)
    sizes = [tuple(map(len, parts_of(exact)))]
    errors = [0.0]
    g = exact.gaussians()
    for finer in FINER[::-1]:
        rounded = rounded_of(variant, finer)
        sizes.append(tuple(map(len, parts_of(rounded))))
        errors.append(float(np.abs(rounded.gaussians().quats - g.quats).mean()))
    for before, after in pairwise(sizes):
        assert after[0] < before[0]
        assert after[1] < before[1]
    assert errors == sorted(errors)


def test_terms_that_lack_nothing_come_back_with_the_rules_of_those_that_do() -> None:
    """Rules choose contexts alone, so any terms can be coded with them."""
    contents = rounded_of("rgb", 0.0)
    layout = TermLayout.from_grids(contents.grids)
    rng = np.random.default_rng(3)
    words = rng.integers(0, 1 << int(layout.widths.sum()), len(contents.term_records), dtype=np.uint64)
    records = np.ascontiguousarray(words.astype("<u8").view(np.uint8).reshape(-1, 8)[:, : layout.nbytes])
    data = encode_terms(records, firsts_of(contents), layout, lacking_of(contents))
    assert np.array_equal(decode_terms(data, firsts_of(contents), layout, lacking_of(contents)), records)


def test_parts_of_the_other_version_and_damage_are_refused() -> None:
    exact = exact_of("rgb")
    rounded = rounded_of("rgb", 0.0)
    n = len(exact)
    layout = TermLayout.from_grids(exact.grids)
    for data, limits, found in (
        (parts_of(exact), rounded.limits, "version 2"),
        (parts_of(rounded), None, "version 1"),
    ):
        with pytest.raises(ValueError, match=found):
            decode_gaussians(data[0], n, rounded.table, rounded.layout, limits)
        with pytest.raises(ValueError, match=found):
            decode_terms(data[1], firsts_of(exact), layout, None if limits is None else lacking_of(rounded))
    good = parts_of(rounded)[0]
    rng = np.random.default_rng(1)
    for _ in range(60):
        at = int(rng.integers(16, len(good)))
        bad = good[:at] + bytes([good[at] ^ int(rng.integers(1, 256))]) + good[at + 1 :]
        try:
            records, _ = decode_gaussians(bad, n, rounded.table, rounded.layout, rounded.limits)
        except ValueError:
            continue
        assert records.shape == (n, 16)
    for bad in (good[:-1], good[:-4], good + b"\0\0\0\0"):
        with pytest.raises(ValueError, match="expected"):
            decode_gaussians(bad, n, rounded.table, rounded.layout, rounded.limits)


def test_a_package_says_how_it_was_rounded(tmp_path: Path) -> None:
    levels = levels_of(400)
    colors = colors_of(400)[1]
    limits = limits_of(Contents.from_levels(levels, colors), Quality())
    with (
        write_package(tmp_path / "whole.gsvis", levels, colors) as whole,
        write_package(tmp_path / "rounded.gsvis", levels, colors, limits=limits) as rounded,
    ):
        assert (whole.manifest.version, whole.manifest.limits) == (3, None)
        assert (rounded.manifest.version, rounded.manifest.limits) == (4, limits)
        expected = rounded_contents(levels, colors, limits)
        assert np.array_equal(rounded.contents.records, expected.records)
        assert np.array_equal(rounded.contents.term_records, expected.term_records)
        assert np.array_equal(rounded.part_of(399)[0].records[-1], expected.records[-1])
        rounded.verify()
        sizes = whole.manifest.sizes(), rounded.manifest.sizes()
        assert all(sizes[1][name] < sizes[0][name] for name in ("records", "terms"))


def test_a_limit_that_is_out_of_range_is_refused(tmp_path: Path) -> None:
    levels = levels_of(60)
    wrong = Limits(1 << 20, *(0 for _ in Limits._fields[1:]))
    with pytest.raises(FormatError, match=r"place.*expected an integer from -32768 to 32768"):
        write_package(tmp_path / "s.gsvis", levels, colors_of(60)[1], limits=wrong)
    assert not (tmp_path / "s.gsvis" / "parts" / "x").exists()
    with pytest.raises(FormatError):
        Package.open(tmp_path / "s.gsvis")
