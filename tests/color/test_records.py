from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsvis.color import grids as _grids
from gsvis.color.fit import FitConfig, fit_srbf
from gsvis.color.records import (
    INTENSITY_FLOOR,
    PRECISIONS,
    Grids,
    Precision,
    bytes_per_base,
    bytes_per_term,
    quantize,
    record_bytes,
    sh_bytes,
)
from gsvis.color.srbf import SrbfColors, srbf, unit_vectors
from gsvis.color.variants import VARIANTS
from gsvis.io import load_scene
from gsvis.render import psnr, rasterize
from gsvis.scene.navigable import NavigableSpace
from tests.color.samples import random_colors

PARTS = ("base", "scales", "offsets", "functions", "centers", "decays", "intensities")
SPHERE = unit_vectors(
    np.stack([np.arccos(np.linspace(-1, 1, 4001)), np.mod(np.arange(4001) * 2.399963, 2 * np.pi)], axis=1)
)


def spread_colors(seed: int, count: int, name: str, most_terms: int) -> SrbfColors:
    """Random colors with some wild values: bases outside [0, 1] where they may be, large opposite intensities."""
    rng = np.random.default_rng(seed)
    c = random_colors(rng, count, name, most_terms)
    wild = rng.random((c.num_terms, 1)) < 0.2
    base = c.base + (rng.normal(scale=3.0, size=c.base.shape) if c.kind.space == "rgb" else 0.0)
    intensities = np.where(wild, 100.0, 1.0) * c.intensities
    decays = np.where(wild[:, 0], 500.0, 1.0) * c.decays
    return SrbfColors(name, base, c.scales, c.offsets, c.functions, c.centers, np.minimum(decays, 1e4), intensities)


def field_error(before: SrbfColors, after: SrbfColors) -> np.ndarray:
    """(N,) root mean square over the sphere of what the terms of each Gaussian add, all functions together."""
    errors = np.zeros(len(before))
    for g in range(len(before)):
        difference = np.zeros((len(SPHERE), before.kind.intensities * len(before.kind.functions)))
        for sign, c in ((1.0, before), (-1.0, after)):
            for t in range(c.offsets[g], c.offsets[g + 1]):
                lobe = srbf(SPHERE, unit_vectors(c.centers[t]), c.decays[t])
                first = int(c.functions[t]) * c.kind.intensities
                difference[:, first : first + c.kind.intensities] += sign * lobe[:, None] * c.intensities[t]
        errors[g] = np.sqrt((difference**2).mean())
    return errors


@given(
    st.integers(0, 2**32 - 1),
    st.integers(0, 12),
    st.sampled_from(sorted(VARIANTS)),
    st.sampled_from(sorted(PRECISIONS)),
    st.integers(0, 6),
    st.booleans(),
)
def test_rounding_twice_is_rounding_once(
    seed: int, count: int, name: str, precision: str, most_terms: int, refit: bool
) -> None:
    once = quantize(spread_colors(seed, count, name, most_terms), precision, refit=refit)
    values = once.dequantize()
    twice = quantize(values, precision, refit=refit)
    assert twice.grids == once.grids
    for part in PARTS:
        np.testing.assert_array_equal(getattr(twice, part), getattr(once, part), err_msg=part)
        np.testing.assert_array_equal(getattr(twice.dequantize(), part), getattr(values, part), err_msg=part)


@given(st.integers(0, 2**32 - 1), st.sampled_from(sorted(VARIANTS)), st.sampled_from(sorted(PRECISIONS)))
def test_every_number_stays_within_its_bound(seed: int, name: str, precision: str) -> None:
    before = spread_colors(seed, 40, name, 4)
    packed = quantize(before, precision, refit=False)
    after, p, g = packed.dequantize(), PRECISIONS[precision], packed.grids
    chords = np.linalg.norm(unit_vectors(before.centers) - unit_vectors(after.centers), axis=1)
    assert np.all(2 * np.arcsin(chords / 2) <= np.pi / 2**p.center / np.sqrt(2) + 1e-6)
    half_ratio = 0.5 * np.log(g.decays[1] / g.decays[0]) / (2**p.decay - 1)
    assert np.all(np.abs(np.log(after.decays / before.decays)) <= half_ratio * (1 + half_ratio) + 1e-6)
    if before.kind.space != "rgb":
        low, high = g.scales
        half_step = 0.5 * (min(high, 1) - min(low, 1) + np.log(max(high, 1) / max(low, 1))) / (2**p.scale - 1)
        bound = half_step * np.maximum(before.scales, 1) * (1 + 2 * half_step)
        assert np.all(np.abs(after.scales - before.scales) <= bound + 1e-6)
    k = np.log1p(g.intensity / INTENSITY_FLOOR) / (2 ** (p.intensity - 1) - 1)
    moved = np.abs(after.intensities - before.intensities)
    assert np.all(moved <= (np.abs(before.intensities) + INTENSITY_FLOOR) * np.expm1(k / 2) * (1 + 1e-5) + 1e-7)
    np.testing.assert_array_equal(after.offsets, before.offsets)
    np.testing.assert_array_equal(after.functions, before.functions)


@given(st.integers(0, 2**32 - 1), st.sampled_from(sorted(PRECISIONS)))
def test_base_colors_within_the_unit_interval_have_even_steps_whatever_lies_outside(seed: int, precision: str) -> None:
    rng = np.random.default_rng(seed)
    rgb = rng.uniform(-0.1, 1.1, (200, 3))
    rgb[0], rgb[1] = -7.0, 30.0
    packed = quantize(SrbfColors.without_terms(rgb), precision)
    table = packed.grids.base_table(0).astype(np.float64)
    inside = np.diff(table[(table > 0) & (table < 1)])
    np.testing.assert_allclose(inside, inside[0], rtol=1e-2, atol=3e-7)
    assert inside[0] < 1.0 / (2 ** PRECISIONS[precision].base / 6)  # a sixth of all at least, for outliers of 30
    moved = np.abs(packed.dequantize().base - rgb)
    assert np.all(moved[2:] <= 0.65 * inside[0] + 1e-6)
    assert np.all(moved[:2] < 1e-5)  # the ends are exact


@pytest.mark.parametrize("name", sorted(VARIANTS))
def test_intensities_make_up_for_rounded_lobes(name: str) -> None:
    before = random_colors(np.random.default_rng(3), 60, name, 5)
    plain, adapted = (quantize(before, "wire", refit=refit).dequantize() for refit in (False, True))
    adapted_errors, plain_errors = field_error(before, adapted), field_error(before, plain)
    assert adapted_errors.mean() < 0.9 * plain_errors.mean()
    assert np.mean(adapted_errors > 1.2 * plain_errors + 1e-3) < 0.1


def test_lobes_that_nearly_cancel_survive_rounding() -> None:
    rng, n = np.random.default_rng(8), 60
    first = np.stack([rng.uniform(0.5, 2.5, n), rng.uniform(-3, 3, n)], axis=1)
    centers = np.stack([first, first + rng.normal(scale=0.03, size=(n, 2))], axis=1).reshape(-1, 2)
    intensities = np.tile([[20.0], [-20.1]], (n, 3))
    offsets, decays = 2 * np.arange(n + 1), np.tile([4.0, 4.1], n)
    before = SrbfColors(
        "rgb", np.full((n, 3), 0.5), np.ones(n), offsets, np.zeros(2 * n, int), centers, decays,
        intensities,
    )  # fmt: skip
    plain, adapted = (field_error(before, quantize(before, refit=refit).dequantize()) for refit in (False, True))
    assert adapted.mean() < 0.85 * plain.mean()


def test_hue_goes_around() -> None:
    base = np.array([[0.9999, 0.5, 0.5], [1.0, 0.5, 0.5], [-0.0001, 0.5, 0.5], [0.0, 0.5, 0.5]])
    c = SrbfColors("hsl", base, np.ones(4), np.zeros(5, int), [], np.zeros((0, 2)), [], np.zeros((0, 1)))
    assert np.all(quantize(c, "coarse").dequantize().base[:, 0] == 0.0)


def test_parts_of_a_scene_share_its_tables() -> None:
    whole = spread_colors(5, 50, "rgb", 4)
    packed = quantize(whole, "wire", refit=False)
    part = quantize(whole[10:30], refit=False, grids=packed.grids)
    np.testing.assert_array_equal(part.base, packed.base[10:30])
    np.testing.assert_array_equal(part.intensities, packed.intensities[packed.offsets[10] : packed.offsets[30]])
    with pytest.raises(ValueError, match=r"expected within .* use wider grids"):
        quantize(spread_colors(6, 500, "rgb", 4), grids=Grids.from_colors(whole[:1]))
    with pytest.raises(ValueError, match="grids: expected tables of variant 'hsl'"):
        quantize(random_colors(np.random.default_rng(0), 3, "hsl"), grids=packed.grids)


def test_sizes_are_counted_by_hand() -> None:
    p = Precision("mine", base=10, scale=9, axis=8, center=8, decay=6, intensity=7)
    assert bytes_per_term("rgb", p) == (8 + 9 + 6 + 3 * 7) / 8
    assert bytes_per_term("hsl", p) == (1 + 8 + 9 + 6 + 7) / 8
    assert bytes_per_base("hsl", p) == (30 + 9) / 8
    assert bytes_per_base("hsl", None) == 12 + 4
    assert bytes_per_term("hsl", None) == 1 + 8 + 4 + 4
    c = random_colors(np.random.default_rng(7), 33, "hsl", 5)
    bits = 33 * (39 + 3) + c.num_terms * 31
    assert record_bytes(c, p) == quantize(c, p).nbytes == record_bytes(quantize(c, p)) == -(-bits // 8)
    assert (sh_bytes(3), sh_bytes(3, 8), sh_bytes(0, 16)) == (192.0, 48.0, 6.0)


def test_nothing_at_all_and_nothing_but_bases() -> None:
    none = SrbfColors.without_terms(np.zeros((0, 3)))
    assert len(quantize(none).dequantize()) == 0
    assert record_bytes(none) == 0
    same = quantize(SrbfColors.without_terms(np.full((5, 3), 0.25))).dequantize()
    np.testing.assert_array_equal(same.base, 0.25)  # one value needs no steps


def test_scales_of_rgb_are_not_dropped_in_silence() -> None:
    c = random_colors(np.random.default_rng(1), 3, "rgb")
    other = SrbfColors("rgb", c.base, np.full(3, 2.0), c.offsets, c.functions, c.centers, c.decays, c.intensities)
    with pytest.raises(ValueError, match="scales: expected 1 for 'rgb'"):
        quantize(other)


@pytest.mark.parametrize(("bits", "message"), [(1, "at least 2"), (17, "2 to 16 bits"), (8.5, "an integer")])
def test_bits_are_checked(bits: int, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Precision("odd", bits, 8, 8, 8, 8, 8)
    with pytest.raises(ValueError, match="'coarse', 'wire', 'fine'"):
        bytes_per_term("rgb", "best")


@given(st.floats(-50, 0.4), st.floats(0.6, 80), st.integers(2, 12))
def test_tables_rise_and_keep_their_ends(low: float, high: float, bits: int) -> None:
    low, high = float(np.float32(low)), float(np.float32(high))
    for table in (_grids.bend(low, high, 0.5, 0.5, bits), _grids.geometric(0.01, high, bits)):
        assert len(table) == 2**bits
        assert np.all(np.diff(table) >= 0)
        assert table[-1] == np.float32(high)
        np.testing.assert_array_equal(table[_grids.nearest(table, table)], table)
    intensities = _grids.compand(high, 0.05, bits)
    np.testing.assert_array_equal(intensities, -intensities[::-1])
    assert intensities[len(intensities) // 2] == 0


@pytest.mark.realdata
@pytest.mark.slow
def test_real_images_keep_their_quality(realdata: Path) -> None:
    g = load_scene(realdata / "scenes/nika_sh3/lod-meta.json", lod=3)
    cameras = NavigableSpace.from_scene(g, resolution=64).sample_cameras(4, np.random.default_rng(0))
    colors = fit_srbf(g, config=FitConfig(variant="rgb", mean_terms=None, max_terms=4)).colors
    exact = rasterize(g, cameras, colors=colors).images
    for precision, least in (("coarse", 42.0), ("wire", 50.0), ("fine", 60.0)):
        values = quantize(colors, precision).dequantize()
        assert float(psnr(rasterize(g, cameras, colors=values).images, exact).mean()) >= least
