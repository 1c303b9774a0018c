"""Colors from one eye and along directions: the kernels against their plain twin, and known answers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsvis.color import reference
from gsvis.color._kernels import rgb as _kernels_rgb
from gsvis.color.evaluate import Evaluator, evaluate, evaluate_along
from gsvis.color.spaces import hsl_to_rgb
from gsvis.color.srbf import MAX_DECAY, SrbfColors, spherical_coordinates
from gsvis.color.variants import VARIANTS
from gsvis.files.scratch import Scratch
from tests.color.samples import random_colors

EYE = np.array([0.3, -0.2, 0.1])


def replaced(colors: SrbfColors, **fields: Any) -> SrbfColors:
    names = ("variant", "base", "scales", "offsets", "functions", "centers", "decays", "intensities")
    return SrbfColors(**{name: fields.get(name, getattr(colors, name)) for name in names})


@pytest.mark.parametrize("name", VARIANTS)
@pytest.mark.parametrize("count", [0, 1, 17, 256, 700])
def test_kernel_equals_the_twin(name: str, count: int) -> None:
    rng = np.random.default_rng(count)
    colors, means = random_colors(rng, count, name), rng.normal(size=(count, 3)).astype(np.float32)
    active = rng.random(colors.num_terms) < 0.6
    maker = Evaluator(colors)
    assert len(maker) == count
    for mask in (None, active):
        got = maker.colors(means, EYE, active=mask)
        assert got.dtype == np.float32
        assert got.shape == (count, 3)
        np.testing.assert_allclose(got, reference.evaluate(colors, means, EYE, active=mask), atol=3e-6)
    np.testing.assert_array_equal(maker.colors(means, EYE, active=active), evaluate(colors.keep(active), means, EYE))


def test_colors_that_lie_in_files_are_the_same_after_their_memory_was_given_back(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    colors = random_colors(rng, 700, "rgb")
    means = rng.normal(size=(700, 3)).astype(np.float32)
    scratch = Scratch(tmp_path)
    maker = Evaluator(colors, scratch=scratch)
    for _ in range(2):
        scratch.release()
        np.testing.assert_array_equal(maker.colors(means, EYE), Evaluator(colors).colors(means, EYE))


@given(
    seed=st.integers(0, 10_000),
    name=st.sampled_from(sorted(VARIANTS)),
    decay=st.sampled_from([1e-6, 1.0, 300.0, MAX_DECAY]),
    size=st.sampled_from([1e-20, 1.0, 1e15]),
    strength=st.sampled_from([0.0, 1.0, 40.0]),
)
def test_kernel_equals_the_twin_at_the_edges(seed: int, name: str, decay: float, size: float, strength: float) -> None:
    """Narrow and wide lobes, some centered on the direction, at all sizes; colors far out of range."""
    rng = np.random.default_rng(seed)
    means = (size * rng.normal(size=(40, 3))).astype(np.float32)
    eye = means[3].astype(np.float64) + np.where(rng.random() < 0.5, 0.0, size)
    colors = random_colors(rng, 40, name, 6)
    away = (means.astype(np.float64) - eye)[colors.gaussian_ids]
    near = np.where(np.linalg.norm(away, axis=1, keepdims=True) > 0, away, [0, 0, 1.0])
    centers = spherical_coordinates(near / np.linalg.norm(near, axis=1, keepdims=True))
    centers += rng.normal(scale=0.3 / np.sqrt(1.0 + decay), size=centers.shape)
    colors = replaced(
        colors, centers=centers, decays=np.full(colors.num_terms, decay), intensities=strength * colors.intensities
    )
    got, want = evaluate(colors, means, eye), reference.evaluate(colors, means, eye)
    assert np.isfinite(got).all()
    np.testing.assert_allclose(got, want, atol=1e-5 * (1 + 5 * strength) * (1 + decay / 100))


@pytest.mark.parametrize("name", VARIANTS)
def test_some_gaussians_are_as_among_all(name: str) -> None:
    rng = np.random.default_rng(1)
    colors, means = random_colors(rng, 900, name), rng.normal(size=(900, 3))
    active = rng.random(colors.num_terms) < 0.5
    maker = Evaluator(colors)
    for ids in (np.zeros(0, np.int64), np.array([899]), rng.integers(0, 900, 50), np.arange(900)[::-1]):
        for mask in (None, active):
            among = maker.colors(means, EYE, active=mask)[ids]
            np.testing.assert_array_equal(maker.colors(means, EYE, active=mask, ids=ids), among)
        np.testing.assert_allclose(evaluate(colors[ids], means[ids], EYE), maker.colors(means, EYE)[ids], atol=1e-6)


@pytest.mark.parametrize("name", VARIANTS)
@pytest.mark.parametrize("number", [0, 1, 16, 37])
def test_along_equals_from_eyes(name: str, number: int) -> None:
    rng = np.random.default_rng(number)
    colors, directions = random_colors(rng, 300, name), rng.normal(size=(number, 3))
    got = evaluate_along(colors, directions)
    assert got.shape == (300, number, 3)
    for d in range(number):
        np.testing.assert_allclose(got[:, d], evaluate(colors, np.zeros((300, 3)), -directions[d]), atol=2e-6)


def test_a_lobe_has_its_height_and_width() -> None:
    lobe = SrbfColors("rgb", [[0.5, 0.5, 0.5]], [1], [0, 1], [0], [[0.5, 0.7]], [9.0], [[3, 0, -1]])
    center = np.array([np.sin(0.5) * np.cos(0.7), np.sin(0.5) * np.sin(0.7), np.cos(0.5)])
    side = np.cross(center, [0, 0, 1.0])
    turned = np.cos(0.4) * center + np.sin(0.4) * side / np.linalg.norm(side)
    height = np.exp(9.0 * (np.cos(0.4) - 1.0))
    np.testing.assert_allclose(evaluate_along(lobe, [center])[0, 0], [3.5, 0.5, 0.0], atol=1e-6)  # clipped below alone
    np.testing.assert_allclose(
        evaluate(lobe, [[1, 2, 3]], np.array([1, 2, 3]) - 7 * turned)[0], [0.5 + 3 * height, 0.5, max(0.5 - height, 0)],
        atol=1e-6,
    )  # fmt: skip


def test_an_eye_at_a_center_looks_up() -> None:
    colors = random_colors(np.random.default_rng(0), 5)
    means = np.full((5, 3), 0.25)
    np.testing.assert_array_equal(evaluate(colors, means, means[0]), evaluate_along(colors, [[0, 0, 1]])[:, 0])


@pytest.mark.parametrize("name", VARIANTS)
def test_no_terms_leave_the_base(name: str) -> None:
    colors = random_colors(np.random.default_rng(2), 60, name)
    bare = evaluate(colors.first(0), np.zeros((60, 3)), EYE)
    np.testing.assert_array_equal(evaluate_along(colors.first(0), [[1, 0, 0], [0, 1, 0]]), np.stack([bare] * 2, axis=1))
    none = np.zeros(colors.num_terms, bool)
    np.testing.assert_array_equal(evaluate(colors, np.zeros((60, 3)), EYE, active=none), bare)
    if colors.kind.space == "rgb":
        np.testing.assert_array_equal(bare, colors.base)


def test_one_gaussian_may_have_thousands_of_terms() -> None:
    rng = np.random.default_rng(3)
    counts = np.zeros(300, np.int64)
    counts[[5, 280]] = 40_000, 7
    total = int(counts.sum())
    colors = SrbfColors(
        "rgb", rng.random((300, 3)), np.ones(300), np.concatenate([[0], np.cumsum(counts)]),
        np.zeros(total, np.uint8), rng.uniform(0, 3, (total, 2)), np.full(total, 5.0), rng.uniform(0, 1e-4, (total, 3)),
    )  # fmt: skip
    means = rng.normal(size=(300, 3))
    np.testing.assert_allclose(evaluate(colors, means, EYE), reference.evaluate(colors, means, EYE), rtol=1e-3)


def test_threads_change_nothing() -> None:
    rng = np.random.default_rng(4)
    colors, means = random_colors(rng, 2000, "hsl"), rng.normal(size=(2000, 3))
    plain = evaluate(colors, means, EYE)
    threads = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        np.testing.assert_array_equal(evaluate(colors, means, EYE), plain)
    finally:
        numba.set_num_threads(threads)


def test_hsl_of_the_kernels_is_that_of_the_room() -> None:
    rng = np.random.default_rng(5)
    values = rng.uniform([-2.0, 0, 0], [2.0, 1, 1], (2000, 3)).astype(np.float32)
    values[:8] = np.array(np.meshgrid([0, 1], [0, 1], [0, 1])).reshape(3, -1).T
    room, factors = np.empty((3, 2001), np.float32), rng.uniform(0.5, 2, 2000).astype(np.float32)
    found = room[:, :2000]  # part of longer rows, as kernels call it
    found[:] = values.T
    _kernels_rgb.to_rgb(_kernels_rgb.SPACES["hsl"], found, factors)
    want = np.maximum(hsl_to_rgb(values.astype(np.float64)), 0) * factors[:, None]
    np.testing.assert_allclose(found.T, want, atol=4e-6)


def test_bad_arguments() -> None:
    colors = random_colors(np.random.default_rng(6), 4, most_terms=2)
    maker = Evaluator(colors)
    with pytest.raises(ValueError, match=r"means: expected shape \(4, 3\), got \(3, 3\)"):
        maker.colors(np.zeros((3, 3)), EYE)
    with pytest.raises(ValueError, match="eye: expected finite"):
        maker.colors(np.zeros((4, 3)), [0, 0, np.nan])
    with pytest.raises(ValueError, match="active: expected bool of shape"):
        maker.colors(np.zeros((4, 3)), EYE, active=np.ones(colors.num_terms))
    with pytest.raises(ValueError, match="active: expected bool of shape"):
        maker.colors(np.zeros((4, 3)), EYE, active=np.ones(colors.num_terms + 1, bool))
    with pytest.raises(ValueError, match=r"ids: expected values in \[0, 3\], got 4"):
        maker.colors(np.zeros((4, 3)), EYE, ids=[0, 4])
    with pytest.raises(ValueError, match="directions: expected non-zero"):
        maker.along([[0, 0, 0]])
    with pytest.raises(ValueError, match="colors: expected SrbfColors, got ndarray"):
        evaluate(np.zeros((4, 3)), np.zeros((4, 3)), EYE)


def test_colors_without_terms_are_their_base_from_everywhere() -> None:
    rgb = np.random.default_rng(0).uniform(0, 1, (5, 3)).astype(np.float32)
    colors = SrbfColors.without_terms(rgb)
    assert (len(colors), colors.num_terms) == (5, 0)
    np.testing.assert_array_equal(evaluate(colors, np.zeros((5, 3)), EYE), rgb)


@pytest.mark.parametrize("offsets", [[1, 1], [-1, 0], [0, -1]])
def test_offsets_start_at_zero_and_never_fall(offsets: list[int]) -> None:
    one = np.zeros((1, 3))
    with pytest.raises(ValueError, match="offsets: expected ascending values from 0"):
        SrbfColors("rgb", one, [1.0], offsets, [0], [[0, 0]], [1.0], one)


def test_the_narrowest_lobe_is_documented() -> None:
    """Stores and records hold decays up to 1e4: another bound would refuse what is written already."""
    one = np.zeros((1, 3))
    for decay, fits in ((1e4, True), (np.nextafter(np.float32(1e4), np.float32(2e4)), False)):
        words = ("rgb", one, [1.0], [0, 1], [0], [[0, 0]], [decay], one)
        if fits:
            assert SrbfColors(*words).decays[0] == decay
        else:
            with pytest.raises(ValueError, match="decays: expected values"):
                SrbfColors(*words)
