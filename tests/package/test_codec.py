"""Records of 16 bytes: the kernels say what the slow twins say, and no Gaussian harms another."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsvis.package import codec
from gsvis.package.codec import ChunkTable, build_chunks, chunk_starts, decode_records, encode_records
from gsvis.package.layout import RECORD_BYTES, RecordLayout, TermLayout
from gsvis.package.reference import decode_one, encode_one
from gsvis.scene.gaussians import Gaussians

LAYOUTS = (RecordLayout.from_variant("rgb"), RecordLayout.from_variant("hsl"))


def scene(n: int, seed: int = 0, spread: float = 1.0) -> Gaussians:
    rng = np.random.default_rng(seed)
    means = rng.normal(size=(n, 3)) * spread
    scales = np.exp(rng.normal(-3, 1.0, (n, 3)))
    return Gaussians(means, rng.normal(size=(n, 4)), scales, rng.uniform(0, 1, n), rng.normal(size=(n, 1, 3)))


def wild(n: int, seed: int) -> Gaussians:
    """Outliers at 250 and 2e4 units and beyond, thin, huge and denormal scales, repeated and axis-aligned rotations."""
    rng = np.random.default_rng(seed)
    means = rng.normal(size=(n, 3)) * rng.choice([0.0, 1e-20, 1.0, 250.0, 2e4, 1e30, 3e38], (n, 1)).astype(np.float64)
    means = np.clip(means, -3.4e38, 3.4e38)
    scales = np.exp(rng.normal(-3, 1, (n, 3))) * rng.choice([1.0, 1e-42, 1e-30, 1e-6, 1e5, 1e37], (n, 3))
    scales = np.maximum(scales.astype(np.float32), 1e-45)
    quats = np.where(rng.random((n, 1)) < 0.5, rng.normal(size=(n, 4)), rng.integers(-1, 2, (n, 4)) + 1e-9)
    opacities = rng.choice([0.0, 1.0, 1e-42, 0.5, 0.998], n)
    return Gaussians(means, quats, scales, opacities, np.zeros((n, 1, 3)))


def colors_of(n: int, layout: RecordLayout, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (n, 4 if layout.color_scale else 3), np.uint8)


@pytest.mark.parametrize("layout", LAYOUTS, ids=["rgb", "hsl"])
@given(seed=st.integers(0, 1 << 30), n=st.integers(1, 40), tame=st.booleans())
def test_kernels_say_what_the_slow_twins_say_to_the_bit(layout: RecordLayout, seed: int, n: int, tame: bool) -> None:
    g = scene(n, seed) if tame else wild(n, seed)
    colors = colors_of(n, layout, seed)
    table = build_chunks(g, layout)
    records = encode_records(g, colors, table, layout)
    found = decode_records(records, table, layout)
    rows = table.of_all()
    for i in range(n):
        chunk = (table, int(rows[i]))
        twin = encode_one(g.means[i], g.quats[i], g.scales[i], g.opacities[i], colors[i].tobytes(), chunk, layout)
        assert records[i].tobytes() == twin
        mean, quat, scales, opacity = decode_one(twin, *chunk, layout)
        np.testing.assert_array_equal(found.means[i], np.float32(mean))
        np.testing.assert_array_equal(found.quats[i], np.float32(quat))
        np.testing.assert_array_equal(found.scales[i], np.float32(scales))
        assert found.opacities[i] == np.float32(opacity)
    np.testing.assert_array_equal(codec.base_colors(records, layout), colors)


@pytest.mark.parametrize("layout", LAYOUTS, ids=["rgb", "hsl"])
@given(seed=st.integers(0, 1 << 30), n=st.integers(1, 600))
def test_errors_stay_within_their_bounds_whatever_the_neighbors(layout: RecordLayout, seed: int, n: int) -> None:
    g = wild(n, seed)
    table = build_chunks(g, layout)
    found = decode_records(encode_records(g, colors_of(n, layout), table, layout), table, layout)
    kept = Gaussians(*found, g.sh0)  # every value is valid
    largest = g.scales.max(axis=1).astype(np.float64)
    away = np.abs(kept.means.astype(np.float64) - g.means).max(axis=1)
    rounding = np.abs(g.means).max(axis=1) * 1e-6  # of float32 itself
    assert np.all(away <= largest * codec.STEP + rounding)
    asked = np.maximum(g.scales.astype(np.float64), np.maximum(largest * 2.0**-11, 2.0**-126)[:, None])
    octaves = np.abs(np.log2(kept.scales.astype(np.float64) / asked)).max(axis=1)
    assert octaves.max() <= (2.0 if layout.scale == 9 else 3.5) / 64 + 1e-6
    assert np.abs(kept.opacities - g.opacities).max() <= 0.5 / 255 + 1e-7


@pytest.mark.parametrize(("layout", "degrees"), [(LAYOUTS[0], 0.6), (LAYOUTS[1], 1.2)], ids=["rgb", "hsl"])
def test_the_ellipsoid_hardly_turns(layout: RecordLayout, degrees: float) -> None:
    g = scene(2000)
    table = build_chunks(g, layout)
    found = decode_records(encode_records(g, colors_of(2000, layout), table, layout), table, layout)
    assert np.all(found.quats[:, 0] >= 0.49)
    axes, turned = g.rotations(), Gaussians(*found, g.sh0).rotations()
    cosines = np.abs(np.einsum("nij,nij->nj", axes, turned))  # axis by axis, whatever their signs
    assert np.degrees(np.arccos(np.minimum(cosines, 1.0))).max() < degrees


def test_an_outlier_does_not_make_its_neighbors_coarse() -> None:
    layout = LAYOUTS[0]
    g = scene(300)
    means = g.means.copy()
    means[[7, 150]] = [[250.0, 0, 0], [0, -2e4, 3e30]]
    far = Gaussians(means, g.quats, g.scales, g.opacities, g.sh0)
    table = build_chunks(far, layout)
    found = decode_records(encode_records(far, colors_of(300, layout), table, layout), table, layout)
    near = np.delete(np.arange(300), [7, 150])
    assert np.abs(found.means[near] - g.means[near]).max() < 10.0 / (1 << 14)
    np.testing.assert_allclose(found.means[[7, 150]], far.means[[7, 150]], rtol=1e-6)
    assert len(table) <= 12  # 0..6, 7, 8..149, 150, 151..299, and few more


@pytest.mark.parametrize("layout", LAYOUTS, ids=["rgb", "hsl"])
def test_any_subset_decodes_as_it_does_among_all(layout: RecordLayout) -> None:
    g = scene(3000)
    table = build_chunks(g, layout, starts=chunk_starts(g, cuts=[100, 100, 2999]))
    assert {100, 2999} <= set(table.starts.tolist())
    records = encode_records(g, colors_of(3000, layout), table, layout)
    whole = decode_records(records, table, layout)
    ids = np.random.default_rng(1).permutation(3000)[:777]
    some = decode_records(records[ids], table, layout, chunks=table.of_all()[ids])
    for one, all_of_it in zip(some, whole, strict=True):
        np.testing.assert_array_equal(one, all_of_it[ids])
    alone = table[table.of_all()[ids[:1]]]
    np.testing.assert_array_equal(decode_records(records[ids[:1]], alone, layout, chunks=[0]).means, some.means[:1])


@given(data=st.binary(min_size=16, max_size=16), origin=st.floats(-(2.0**127), 2.0**127, width=32))
def test_any_bytes_decode_to_something_that_can_be_drawn(data: bytes, origin: float) -> None:
    steps = np.array([[3e38, 1e-45, 0.0]], np.float32)
    table = ChunkTable([[origin] * 3], steps, [32767], [255], [1], [[14] * 3])
    for layout in LAYOUTS:
        for low in (-32768, 0, 32767):
            rows = replace(table, lows=[low])
            found = decode_records(np.frombuffer(data, np.uint8)[None], rows, layout)
            Gaussians(*found, np.zeros((1, 1, 3)))


def test_nothing_and_one() -> None:
    layout = LAYOUTS[0]
    table = build_chunks(scene(0), layout)
    assert len(table) == 0
    assert encode_records(scene(0), colors_of(0, layout), table, layout).shape == (0, RECORD_BYTES)
    assert decode_records(np.zeros((0, 16), np.uint8), table, layout).means.shape == (0, 3)
    one = scene(1)
    table = build_chunks(one, layout)
    found = decode_records(encode_records(one, colors_of(1, layout), table, layout), table, layout)
    np.testing.assert_array_equal(found.means, one.means)


def test_what_does_not_fit_is_refused() -> None:
    layout = LAYOUTS[0]
    g = scene(20)
    table = build_chunks(g, layout)
    with pytest.raises(ValueError, match="boxes of their chunks"):
        encode_records(scene(20, 1, 50.0), colors_of(20, layout), table, layout)
    bigger = Gaussians(g.means, g.quats, g.scales * np.float32(1e6), g.opacities, g.sh0)
    with pytest.raises(ValueError, match="ranges of their chunks"):
        encode_records(bigger, colors_of(20, layout), table, layout)
    with pytest.raises(ValueError, match="chunks of 3"):
        decode_records(np.zeros((3, 16), np.uint8), table, layout)
    with pytest.raises(ValueError, match="chunks: expected values"):
        decode_records(np.zeros((1, 16), np.uint8), table, layout, chunks=[9])
    with pytest.raises(ValueError, match="records: expected shape"):
        decode_records(np.zeros((1, 15), np.uint8), table, layout, chunks=[0])
    with pytest.raises(ValueError, match="cuts: expected rising"):
        chunk_starts(g, cuts=[30])
    with pytest.raises(ValueError, match="starts: expected chunks"):
        build_chunks(g, layout, starts=[1])
    with pytest.raises(ValueError, match="strides"):
        replace(table, strides=np.zeros(len(table), np.uint8))


def test_layouts_use_at_most_128_bits() -> None:
    for layout in LAYOUTS:
        used = 8 * layout.packed_from + 3 * sum(layout.bits)
        assert used <= 8 * RECORD_BYTES
    assert TermLayout(0, 6, 7, 5, 6, 3).nbytes == 5
