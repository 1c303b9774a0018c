"""Lattices of SOG files are found in the centers, chunks keep such centers, and other scenes have none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gsvis.package import in_package_order
from gsvis.package.codec import (
    build_chunks,
    chunk_starts,
    decode_records,
    encode_records,
    lay_linear,
    packed_bits,
    unpack_bits,
)
from gsvis.package.lattice import Lattices, find_lattices
from gsvis.package.layout import RecordLayout
from gsvis.package.reference import decode_one, encode_one
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels
from gsvis.scene.procedural import random_scene
from gsvis.scene.symlog import from_symlog, symlog
from tests.package.worlds import on_lattice

LAYOUTS = [RecordLayout.from_variant(name) for name in ("rgb", "hsl")]


def cloud(n: int, away: float = 0.0) -> Gaussians:
    """Gaussians around the middle, and one in a hundred far out."""
    rng = np.random.default_rng(n)
    g = random_scene(rng, n)
    means = rng.normal(size=(n, 3)) + away
    means[::100] *= rng.uniform(1, 1000, (len(means[::100]), 1))
    return Gaussians(means, *parts(g))


def scanned(n: int = 6000, away: float = 0.0) -> Gaussians:
    return on_lattice(cloud(n, away), 32767)


def along_curve(g: Gaussians) -> Gaussians:
    return in_package_order(Levels.single(g)).union


def test_the_symmetric_logarithm_has_an_inverse() -> None:
    x = np.array([-1e30, -3.5, -1e-6, 0.0, 1e-6, 3.5, 1e30])
    np.testing.assert_allclose(from_symlog(symlog(x)), x, rtol=1e-12)
    np.testing.assert_allclose(symlog([np.e - 1.0, 1.0 - np.e]), [1.0, -1.0])


def test_a_lattice_is_found_with_every_center_on_it() -> None:
    g = along_curve(scanned())
    found = find_lattices(g.means)
    assert len(found) == 1
    assert (found.of == 0).all()
    logs = symlog(g.means)
    np.testing.assert_allclose(found.steps[0], np.ptp(logs, axis=0) / 32767, rtol=1e-6)
    assert (np.ptp(found.places, axis=0) == 32767).all()
    made = from_symlog(found.offsets[0] + found.steps[0] * found.places)
    np.testing.assert_allclose(made, g.means, rtol=1e-5, atol=1e-6)


def test_two_files_have_two_lattices_and_what_lies_on_none_stays_apart() -> None:
    left, right, free = scanned(20000), scanned(30000, 9.0), cloud(5000, 60.0)
    together = Gaussians.concatenate([along_curve(g) for g in (left, right, free)])
    found = find_lattices(together.means)
    assert len(found) == 2
    for came, lattice in zip(np.split(found.of, [20000, 50000]), (1, 0, -1), strict=True):  # most Gaussians first
        assert (came == lattice).mean() > 0.99


def parts(g: Gaussians) -> tuple[np.ndarray, ...]:
    return g.quats, g.scales, g.opacities, g.sh0, g.shN


@pytest.mark.parametrize("n", [0, 1, 255, 3000])
def test_other_scenes_have_none(n: int) -> None:
    rng = np.random.default_rng(n)
    assert len(find_lattices(random_scene(rng, max(n, 1)).means[:n])) == 0
    assert len(find_lattices(np.zeros((n, 3), np.float32))) == 0
    assert len(find_lattices(np.rint(rng.normal(size=(n, 3)) * 3).astype(np.float32))) == 0
    assert len(find_lattices((1e30 * rng.normal(size=(n, 3))).astype(np.float32))) == 0


@pytest.mark.parametrize("layout", LAYOUTS, ids=["rgb", "hsl"])
def test_records_keep_centers_of_a_lattice_in_fewer_bits(layout: RecordLayout) -> None:
    g = along_curve(scanned())
    lattices = find_lattices(g.means)
    starts = chunk_starts(g, lattices=lattices)
    table = build_chunks(g, layout, starts=starts, lattices=lattices)
    on = np.repeat(table.logarithmic, table.counts)
    assert on.mean() > (0.5 if layout.color_scale else 0.9)  # with fewer bits more chunks are too wide
    assert len(starts) <= 1.25 * len(chunk_starts(g)) + 1
    assert np.average(table.bits.sum(axis=1), weights=table.counts) < 3 * layout.position - 2
    colors = np.zeros((len(g), 4 if layout.color_scale else 3), np.uint8)
    found = decode_records(encode_records(g, colors, table, layout), table, layout)
    np.testing.assert_allclose(found.means[on], g.means[on], rtol=1e-5, atol=1e-6)
    plain = build_chunks(g, layout, starts=starts)
    rounded = decode_records(encode_records(g, colors, plain, layout), plain, layout)
    assert np.abs(rounded.means[on] - g.means[on]).max() > 1e-4


def test_chunks_that_reach_too_far_on_their_lattice_stay_linear() -> None:
    g = along_curve(on_lattice(random_scene(np.random.default_rng(3), 400)))
    lattices = find_lattices(g.means)
    assert len(lattices) == 1
    table = build_chunks(g, LAYOUTS[0], starts=chunk_starts(g, lattices=lattices), lattices=lattices)
    assert not table.logarithmic.all()
    assert (table.bits[~table.logarithmic] == 14).all()


@pytest.mark.parametrize("apart", [2, 16])
def test_groups_far_apart_have_a_chunk_each_if_that_is_not_one_for_a_few(apart: int) -> None:
    """Sixteen groups across a lattice that one box would hold: of 16 Gaussians they have chunks, of two a box."""
    rng = np.random.default_rng(5)
    groups = 20000 * np.stack(np.unravel_index(np.arange(16), (4, 4, 1)), axis=1)
    places = np.repeat(groups, apart, axis=0) + rng.integers(0, 1000, (16 * apart, 3))
    offsets, steps = np.full((1, 3), -0.5), np.full((1, 3), 2e-5)
    g = random_scene(rng, len(places))
    wide = np.full((len(places), 3), 0.1, np.float32)
    g = replace(g, means=from_symlog(offsets + steps * places).astype(np.float32), scales=wide)
    lattices = Lattices(offsets, steps, np.zeros(len(places), np.int16), places.astype(np.int32))
    assert len(chunk_starts(g)) == 1
    starts = chunk_starts(g, lattices=lattices)
    assert len(starts) == (16 if apart == 16 else 1)
    assert build_chunks(g, LAYOUTS[0], starts=starts, lattices=lattices).logarithmic.all() == (apart == 16)


@pytest.mark.parametrize("layout", LAYOUTS, ids=["rgb", "hsl"])
def test_the_plain_twin_writes_and_reads_the_same(layout: RecordLayout) -> None:
    g = along_curve(scanned())
    lattices = find_lattices(g.means)
    table = build_chunks(g, layout, starts=chunk_starts(g, lattices=lattices), lattices=lattices)
    colors = np.zeros((len(g), 4 if layout.color_scale else 3), np.uint8)
    records, rows = encode_records(g, colors, table, layout), table.of_all()
    found = decode_records(records, table, layout)
    some = np.flatnonzero(table.logarithmic[rows])[::97]
    assert len(some) > 20
    for i in some:
        chunk = table, int(rows[i])
        one = encode_one(g.means[i], g.quats[i], g.scales[i], g.opacities[i], bytes(colors[i]), chunk, layout)
        assert one == records[i].tobytes()
        np.testing.assert_allclose(decode_one(one, *chunk, layout)[0], found.means[i], rtol=2e-7)


def test_a_chunk_ends_where_another_lattice_begins() -> None:
    g = along_curve(scanned(600))
    of = np.repeat([0, 1, -1], 200).astype(np.int16)
    places = np.zeros((600, 3), np.int32)
    starts = chunk_starts(g, lattices=Lattices(np.zeros((2, 3)), np.ones((2, 3)), of, places))
    assert {0, 200, 400} <= set(starts.tolist())


@pytest.mark.parametrize("layout", LAYOUTS, ids=["rgb", "hsl"])
def test_records_are_laid_in_boxes_and_keep_all_but_their_centers(layout: RecordLayout) -> None:
    g = along_curve(Gaussians.concatenate([scanned(3000), cloud(300, away=40.0)]))
    lattices = find_lattices(g.means)
    table = build_chunks(g, layout, starts=chunk_starts(g, lattices=lattices), lattices=lattices)
    assert 0 < table.logarithmic.sum() < len(table)
    colors = np.random.default_rng(4).integers(0, 256, (len(g), 4 if layout.color_scale else 3)).astype(np.uint8)
    records = encode_records(g, colors, table, layout)
    laid, boxes = lay_linear(records, table, layout)
    assert not boxes.logarithmic.any()
    assert (boxes.bits == layout.position).all()
    before, after = decode_records(records, table, layout), decode_records(laid, boxes, layout)
    for name in ("quats", "scales", "opacities"):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))
    np.testing.assert_array_equal(laid[:, : layout.packed_from], records[:, : layout.packed_from])
    assert (np.abs(after.means - before.means) <= 0.51 * boxes.steps[boxes.of_all()] + 1e-5).all()
    same = ~table.logarithmic[table.of_all()]
    np.testing.assert_array_equal(laid[same], records[same])
    assert lay_linear(laid, boxes, layout)[0] is laid


def test_bits_of_places_are_packed_four_by_four() -> None:
    bits = np.array([[0, 0, 0], [14, 1, 13], [3, 14, 2]], np.uint8)
    assert packed_bits(bits).tolist() == [0, 14 | 1 << 4 | 13 << 8, 3 | 14 << 4 | 2 << 8]
    np.testing.assert_array_equal(unpack_bits(packed_bits(bits), 14), bits)
    for word in (15, 14 << 8, 1 << 12):
        with pytest.raises(ValueError, match="bits: expected values in"):
            unpack_bits([word], 13)


def test_what_is_farther_than_a_logarithmic_chunk_reaches_stays_linear() -> None:
    n = 300
    rng = np.random.default_rng(2)
    logs = 88.0 + 1e-3 * rng.integers(-200, 200, (n, 3))
    g = random_scene(rng, n)
    g = Gaussians(from_symlog(logs), *parts(g))
    places = np.rint(logs / 1e-3).astype(np.int32)
    lattices = Lattices(np.zeros((1, 3)), np.full((1, 3), 1e-3), np.zeros(n, np.int16), places)
    table = build_chunks(g, LAYOUTS[0], starts=[0, 200], lattices=lattices)
    assert not table.logarithmic.any()


def test_steps_that_mean_nothing_are_refused() -> None:
    table = build_chunks(cloud(10), LAYOUTS[0], starts=[0])
    mixed, flat, small, large = [-1e-3, 1e-3, -1e-3], [-1e-3, 0.0, -1e-3], [-1e-3] * 3, [-1.0] * 3
    for steps, origin in ((mixed, 0.0), (flat, 0.0), (small, 89.0), (large, 0.0)):
        with pytest.raises(ValueError, match="steps: expected all >= 0, or all < 0 and logarithms up to 88"):
            replace(table, steps=np.array([steps], np.float32), origins=np.full((1, 3), origin, np.float32))
    with pytest.raises(ValueError, match="bits"):
        replace(table, bits=[[15, 0, 0]])


def test_the_smallest_gap_of_a_run_is_always_among_those_that_are_compared() -> None:
    """Its twenty-fourth part times 24 may round below it: with this seed that left nothing to compare."""
    means = np.random.default_rng(136).normal(size=(2000, 3)).astype(np.float32)
    assert not len(find_lattices(means[np.argsort(means[:, 0])]).steps)
