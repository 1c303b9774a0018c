"""Sets of spherical harmonics that Gaussians share: what is lost, what each block is worth, how they are written."""

from __future__ import annotations

import zlib

import numpy as np
import pytest

from gsvis.export.harmonics import BLOCK, Harmonics, Palette, label_bytes

N, K = 3000, 8


def coefficients_of(distinct: int) -> np.ndarray:
    rng = np.random.default_rng(4)
    sets = rng.normal(0.0, 0.1, (distinct, K, 3)).astype(np.float32)
    return sets[np.concatenate([np.arange(distinct), rng.integers(0, distinct, N - distinct)])]


LIGHTS = np.random.default_rng(5).uniform(0.1, 2.0, N)


@pytest.mark.parametrize(("distinct", "most"), [(40, 64), (1500, None), (N, N)])
def test_few_different_sets_lose_nothing_beyond_their_bytes(distinct: int, most: int | None) -> None:
    values = coefficients_of(distinct)
    ranges = Harmonics.from_coefficients(values, 2)
    made = Palette.from_scene(values, LIGHTS, ranges, most)
    assert len(made.sets) == (N if most is None else distinct)
    assert np.array_equal(made.sets[made.labels], ranges.encode(values))
    assert made.error == 0.0


def test_many_sets_become_so_many_and_the_error_is_said() -> None:
    values = coefficients_of(N)
    ranges = Harmonics.from_coefficients(values, 2)
    errors = []
    for most in (16, 256):
        made = Palette.from_scene(values, LIGHTS, ranges, most)
        assert len(made.sets) <= most
        apart = ranges.decode(made.sets)[made.labels] - values
        # the mean square of each basis function over the sphere is 1 / 4 pi
        assert made.error == pytest.approx(np.sqrt((apart**2).sum(axis=1).mean() / (4 * np.pi)), rel=1e-4)
        errors.append(made.error)
    assert errors[1] < errors[0]


def test_blocks_come_by_their_worth_which_is_the_light_that_they_change() -> None:
    values = coefficients_of(N)
    made = Palette.from_scene(values, LIGHTS, Harmonics.from_coefficients(values, 2), N)
    squared = (values.astype(np.float64) ** 2).sum(axis=(1, 2)) / (3 * 4 * np.pi)
    for block, worth in enumerate(made.worth):
        mine = made.labels // BLOCK == block
        assert worth == pytest.approx((LIGHTS * squared)[mine].sum() / LIGHTS.sum())
    assert (np.diff(made.worth) < 0.0).all()


def test_a_file_holds_what_each_byte_adds_to_the_set_before() -> None:
    values = coefficients_of(2000)
    made = Palette.from_scene(values, LIGHTS, Harmonics.from_coefficients(values, 2), N)
    files = made.blocks()
    assert len(files) == 2
    read = [np.frombuffer(zlib.decompress(data), np.uint8).reshape(3 * K, -1).T for data in files]
    assert [len(each) for each in read] == [BLOCK, 2000 - BLOCK]
    found = [(128 + np.cumsum(each, axis=0, dtype=np.int64)) % 256 for each in read]
    assert np.array_equal(np.concatenate(found), made.sets)


def test_neighbors_in_a_file_resemble_each_other() -> None:
    values = coefficients_of(900)
    made = Palette.from_scene(values, LIGHTS, Harmonics.from_coefficients(values, 2), N)
    shuffled = np.random.default_rng(0).permutation(made.sets)

    def steps(sets: np.ndarray) -> float:
        return float(np.linalg.norm(np.diff(sets.astype(float), axis=0), axis=1).mean())

    assert steps(made.sets) < 0.9 * steps(shuffled)


@pytest.mark.parametrize(("sets", "width"), [(1, 1), (256, 1), (257, 2), (65536, 2), (65537, 3), (1 << 24, 3)])
def test_a_label_takes_as_many_bytes_as_it_needs(sets: int, width: int) -> None:
    assert label_bytes(sets) == width
